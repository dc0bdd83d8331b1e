"""Time and memory for reading large logs, compared with the libraries of their formats.

It makes files in a temporary folder: CSV and Parquet with 50 columns at 1 kHz, DataFlash, and
blackbox (`bbl`: many flights of 2 MB; `one.bbl`: a single one of a twentieth of the size). Every
reader has a process of its own, in turn with the other library's:

    python experiments/benchmarks/logs.py --minutes 10 --megabytes 50

prints the best elapsed and processor times, and their ratios to the other library's. It also prints
the largest memory beyond the imports, in multiples of the file size. On a busy computer use the
processor time. Use --minutes 120 for two hours.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

COLUMNS = 50
FIT = ("t", *(f"c{i}" for i in range(3, 24, 3)))
"""Columns of a fit: a time, three inputs and four outputs."""
_MESSAGES = {  # number, types, columns, messages per cycle
    "IMU": (129, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", 4),
    "ATT": (130, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", 1),
    "RATE": (131, "Qffffff", "TimeUS,RDes,R,ROut,PDes,P,POut", 1),
    "RCOU": (132, "QHHHH", "TimeUS,C1,C2,C3,C4", 1),
}


def write_tables(folder: Path, minutes: float) -> None:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    rng, count = np.random.default_rng(0), int(minutes * 60_000)
    data = {"t": pa.array(np.round(1e-3 * np.arange(count), 3))}
    for i in range(1, COLUMNS):
        walk = np.cumsum(rng.standard_normal(count).astype(np.float32))
        data[f"c{i}"] = pa.array(np.round(walk.astype(float), 4))
    table = pa.table(data)
    pyarrow.csv.write_csv(
        table, folder / "log.csv", pyarrow.csv.WriteOptions(quoting_header="none")
    )
    pyarrow.parquet.write_table(table, folder / "log.parquet")


def write_dataflash(path: Path, megabytes: float) -> None:
    from heli_jax.flights.formats.dataflash import FIELDS

    known = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns", 0)} | _MESSAGES
    head, cycle = b"", []
    for name, (number, kinds, columns, times) in known.items():
        fields = [(c, FIELDS[k][0]) for c, k in zip(columns.split(","), kinds, strict=True)]
        size = np.dtype(fields).itemsize + 3
        row = np.zeros((), [("T", "u1"), ("L", "u1"), ("N", "S4"), ("F", "S16"), ("C", "S64")])
        row["T"], row["L"] = number, size
        row["N"], row["F"], row["C"] = name.encode(), kinds.encode(), columns.encode()
        head += b"\xa3\x95\x80" + row.tobytes()
        cycle += [(f"{name}{i}", [("head", "S2"), ("type", "u1"), *fields]) for i in range(times)]
    rows = np.zeros(int(megabytes * 1e6 / np.dtype(cycle).itemsize), cycle)
    rng = np.random.default_rng(0)
    for i, (name, fields) in enumerate(cycle):
        part = rows[name]
        part["head"], part["type"] = b"\xa3\x95", known[name.rstrip("0123456789")][0]
        part["TimeUS"] = 2500 * np.arange(rows.size) + 100 * i
        for field, kind in fields[3:]:
            small = rng.integers(0, 120, rows.size)
            part[field] = 0 if field == "I" else small.astype(kind)
    path.write_bytes(head + rows.tobytes())


def write_blackbox(path: Path, megabytes: float, single: bool) -> None:
    """Write a flight of 2 MB, repeated as on a card; or a `single` flight."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tests.flights.log_writers import blackbox

    rng, count = np.random.default_rng(0), int(15_000 * megabytes) if single else 30_000
    kinds = [(3, 1, 0), (4, 2, 8), (3, 3, 0), (8, 1, 6), (6, 1, 9), (3, 2, 7), (6, 1, 0)]
    names, predictors, encodings, columns = [], [], [], []
    for group, (width, predictor, encoding) in enumerate(kinds):
        for i in range(width):
            names.append(f"f{group}[{i}]")
            predictors.append(predictor)
            encodings.append(encoding)
            size = 0 if encoding == 9 else (30, 6, 30, 3, 0, 12, 30)[group]
            columns.append(np.cumsum(rng.integers(-size, size + 1, count)))
    clock = [np.arange(count), 2000 * np.arange(count)]
    flight = blackbox(names, np.array([*clock, *columns]).T, predictors, encodings)
    path.write_bytes(flight * (1 if single else max(1, round(megabytes * 1e6 / len(flight)))))


def ours(path: Path) -> None:
    from heli_jax.flights.log import ChannelLog
    from heli_jax.flights.open_log import open_flights

    log = open_flights(path)
    if not isinstance(log, tuple):
        log.numbers(FIT)
        return
    for flight in log:
        assert isinstance(flight, ChannelLog)
        for name in flight.topics[0].columns:
            flight.channel(name)


def fingerprint(path: Path) -> None:
    from heli_jax.flights.open_log import open_table

    table = open_table(path)
    table.numbers(FIT)
    assert table.sha256


def pyarrows(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    if path.suffix == ".parquet":
        table = pyarrow.parquet.read_table(path, columns=list(FIT))
    else:
        options = pyarrow.csv.ConvertOptions(
            include_columns=list(FIT), column_types=dict.fromkeys(FIT, pa.float64())
        )
        table = pyarrow.csv.read_csv(path, convert_options=options)
    for name in FIT:
        table.column(name).to_numpy()


def pymavlinks(path: Path) -> None:
    from pymavlink import DFReader

    log = DFReader.DFReader_binary(str(path))
    while log.recv_msg() is not None:
        pass


READERS = {f.__name__: f for f in (ours, fingerprint, pyarrows, pymavlinks)}


def peak_memory() -> int:
    """Return the peak memory of this process [bytes]; `resource` would include its parent's."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def child(reader: str, path: Path) -> None:
    """Run one reader in this process; print seconds, processor seconds, and bytes."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    import heli_jax.flights.open_log  # noqa: F401

    # pyarrow imports pandas at its first NumPy array.
    pa.chunked_array([[1.0]]).to_numpy()
    before = peak_memory()
    began, worked = time.perf_counter(), time.process_time()
    READERS[reader](path)
    seconds = [time.perf_counter() - began, time.process_time() - worked]
    print(json.dumps([*seconds, peak_memory() - before]))


def measured(path: Path, readers: list[str], runs: int) -> dict[str, list[float]]:
    """Return the least times and memory of some runs in turn, by reader."""
    best: dict[str, list[float]] = {}
    for _ in range(runs):
        for reader in readers:
            command = [sys.executable, __file__, "--child", reader, str(path)]
            out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            now = json.loads(out.splitlines()[-1])
            before = best.get(reader) or now
            best[reader] = [min(pair) for pair in zip(now, before, strict=True)]
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and memory of large logs.")
    parser.add_argument("--minutes", type=float, default=10, help="of the tables, at 1 kHz")
    parser.add_argument("--megabytes", type=float, default=50, help="of DataFlash and blackbox")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--only", nargs="+", default=["csv", "parquet", "bin", "bbl", "one.bbl"])
    parser.add_argument("--quick", action="store_true", help="small, to see that it runs")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.quick:
        options.minutes, options.megabytes, options.runs = 0.2, 1.0, 1
    if options.child:
        child(options.child[0], Path(options.child[1]))
        return
    others = {"csv": ["fingerprint", "pyarrows"], "parquet": ["fingerprint", "pyarrows"]}
    others |= {"bin": ["pymavlinks"], "bbl": [], "one.bbl": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if {"csv", "parquet"} & set(options.only):
            write_tables(folder, options.minutes)
        if "bin" in options.only:
            write_dataflash(folder / "log.bin", options.megabytes)
        if "bbl" in options.only:
            write_blackbox(folder / "log.bbl", options.megabytes, single=False)
        if "one.bbl" in options.only:
            write_blackbox(folder / "log.one.bbl", options.megabytes / 10, single=True)
        print("file         MB  reader       seconds   MB/s  to library  processor  memory/file")
        for ending in options.only:
            path = folder / f"log.{ending}"
            size = path.stat().st_size
            best = measured(path, ["ours", *others[ending]], options.runs)
            library = best[others[ending][-1]] if others[ending] else [float("nan")] * 3
            for reader, (seconds, worked, memory) in best.items():
                print(
                    f"{path.name:11s} {size / 1e6:4.0f}  {reader:11s} {seconds:8.2f} "
                    f"{size / 1e6 / seconds:6.0f} {seconds / library[0]:11.2f} "
                    f"{worked / library[1]:10.2f} {memory / size:12.2f}"
                )


if __name__ == "__main__":
    main()
