"""Logs of Python users and web tools, and files that are refused."""

import io
import json
import time
import zipfile
from pathlib import Path

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.feather
import pyarrow.ipc
import pytest

from heli_jax.errors import InputError
from heli_jax.flights.describe import describe_log
from heli_jax.flights.open_log import open_table

N = 60
T, P = 0.02 * np.arange(N), np.sin(np.arange(N))
FRAME = pandas.DataFrame({"t": T, "p": P})


def arrow(path: Path, new) -> None:
    table = pa.table({"t": T, "p": P})
    with new(path, table.schema) as writer:
        writer.write_table(table)


RECORD = np.rec.fromarrays([T, P], names="t,p")
WRITERS = {
    "a.npz": lambda path: np.savez(path, t=T, p=P),
    "b.npz": lambda path: np.savez_compressed(path, t=T.astype(">f8"), p=P),
    "c.npy": lambda path: np.save(path, RECORD),
    "d.npz": lambda path: np.savez(path, p=P, t=(T * 1e3).astype("m8[ms]")),
    "a.feather": lambda path: pyarrow.feather.write_feather(pa.table({"t": T, "p": P}), path),
    "a.arrow": lambda path: arrow(path, pa.ipc.new_file),
    "a.arrows": lambda path: arrow(path, pa.ipc.new_stream),
    "a.jsonl": lambda path: FRAME.to_json(path, orient="records", lines=True, double_precision=15),
}


@pytest.mark.parametrize("name", WRITERS)
def test_columns_are_what_was_stored(tmp_path: Path, name) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    read = open_table(path).numbers(["t", "p"])
    np.testing.assert_allclose(read["p"], P, rtol=0, atol=1e-14)
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.column, info.time.duration) == ("t", pytest.approx(T[-1]))


def test_matrices(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.stack([T, P]))
    assert open_table(tmp_path / "a.npy").names == ("data[0]", "data[1]")


def test_records_within_records_gaps_in_them_and_dates(tmp_path: Path) -> None:
    stamps = np.datetime64("2024-03-01T12:00:00", "ms") + (1000 * T).astype("m8[ms]")
    rows = [
        {"time": str(s), "imu": {"gyro": [p, 2 * p]}, "mode": "hover"}
        for s, p in zip(stamps, P.tolist(), strict=True)
    ]
    rows[7] = {"time": rows[7]["time"], "baro": 1.0}
    path = tmp_path / "a.jsonl"
    path.write_text("\n".join(map(json.dumps, rows)) + '\n{"time": "2024')
    read = open_table(path).numbers(["imu.gyro[1]", "baro"])
    np.testing.assert_allclose(read["imu.gyro[1]"], np.where(np.arange(N) == 7, np.nan, 2 * P))
    assert np.flatnonzero(np.isfinite(read["baro"])).tolist() == [7]
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.column, info.time.duration) == ("time", pytest.approx(T[-1]))


def test_two_columns_of_one_name_are_listed_and_one_is_not_chosen(tmp_path: Path) -> None:
    columns = [pa.array(T), pa.array([[1.0]] * N), pa.array(P), pa.array(2 * P)]
    pyarrow.feather.write_feather(
        pa.Table.from_arrays(columns, ["t", "p", "p", "p"]), tmp_path / "a.feather"
    )
    rows = "\n".join(f"{t},0,{p},{2 * p}" for t, p in zip(T, P, strict=True))
    (tmp_path / "a.csv").write_text(f"t,p,p,p\n{rows}\n")
    for name in ("a.feather", "a.csv"):
        table = open_table(tmp_path / name)
        last = table.survey()[-1].values
        assert last is not None
        np.testing.assert_allclose(last, 2 * P)
        with pytest.raises(InputError):
            table.numbers(["p"])


def test_a_name_as_long_as_a_book_is_refused_at_once(tmp_path: Path) -> None:
    for i, name in enumerate(("[" + "a" * 125_000, "_" * 125_000, "x" + " " * 125_000 + "y")):
        path = tmp_path / f"{i}.csv"
        path.write_text(f"t,{name}\n" + "".join(f"{t},1\n" for t in T))
        begin = time.process_time()
        with pytest.raises(InputError):
            describe_log(path)
        assert time.process_time() - begin < 5


def test_no_object_of_python_is_made(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    objects = np.array([Trap(), 1], dtype=object)
    np.savez(tmp_path / "a.npz", allow_pickle=True, x=objects)
    with pytest.raises(InputError):
        open_table(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", allow_pickle=True, x=objects, t=T, p=P)
    table = open_table(tmp_path / "b.npz")
    assert table.names == ("t", "p")
    assert table.notes[0].subjects == ("x",)
    assert not (tmp_path / "ran").exists()


def archive(name: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as packed:
        packed.writestr(name, "x")
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xlsx", archive("[Content_Types].xml")),
        ("a.csv", archive("[Content_Types].xml")),
        ("a.dat", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(99)),
        ("a.zip", archive("a.csv")),
        ("a.db3", b"SQLite format 3\0"),
        ("a.tlog", bytes(99)),
        ("a.pkl", b"\x80\x04"),
        ("a.csv", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"),
        ("a.h5", b"/annex/objects/SHA256E-s1--0.h5\n"),
        ("a.xyz", b"t,p\n"),
        # Only their names identify them as logs.
        *(
            (f"a{end}", b"ULog")
            for end in (".ulg", ".bin", ".log", ".bbl", ".mat", ".nc", ".h5", "")
        ),
    ],
)
def test_what_is_not_read_is_refused(tmp_path: Path, name, content) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        open_table(tmp_path / name).numbers(["t"])
    assert "\n" not in str(caught.value)
