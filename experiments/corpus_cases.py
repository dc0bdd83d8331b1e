"""Cases of corpus.py, with names, the right answers, and groups that share compiled programs."""

import contextlib
import csv
import functools
import io
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
import zoo
from corpus import ROOT, Result, code_of, coded, of_fit
from corpus_records import RIGS, Rig, roll, written

CONFIGS = ROOT / "configs"


class Case(NamedTuple):
    """One run of the program."""

    name: str
    group: str
    """Cases that run in one process."""
    run: Callable[[Path], Result]
    """Function that runs the case in its own folder; raises LookupError if a file is absent."""
    sound: bool | None = None
    """True if the right answer is exit code 0 and adequate; None if unknown."""
    ought: tuple[str, ...] = ()
    """For an unsound case: parts of codes, of which one must appear."""
    quick: bool = False


class Ended(NamedTuple):
    """Output of a command."""

    code: int
    out: str
    notes: list[str]
    """Lines of standard error."""


def command(*arguments: str | Path) -> Ended:
    """Run heli-jax in this process."""
    from heli_jax import cli

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main([*map(str, arguments), "--quiet"])
        except SystemExit as e:
            code = e.code if isinstance(e.code, int) else 2
    notes = [n.removeprefix("heli-jax: ") for n in err.getvalue().splitlines() if n.strip()]
    return Ended(code, out.getvalue(), notes)


def fit_of(problem: Any) -> tuple[Any, Result]:
    """Return the fit of a Problem, and its stored result."""
    from heli_jax import fit
    from heli_jax.report import files

    found = fit(problem)
    content = files.fit_json(found, problem, None)
    return found, of_fit(content, found.exit_code)


def names_of(config: Path) -> set[str]:
    """Return the names of signals, parameters and flights in a configuration."""
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    names = {*(content.get("fit") or {}).get("free", {})}
    for flight in content.get("flights", ()):
        signals = flight.get("signals", {})
        names |= {flight.get("name", "")}
        for kind in ("inputs", "outputs"):
            for name, signal in signals.get(kind, {}).items():
                names |= {name, signal.get("signal", "") if isinstance(signal, dict) else signal}
    return {n for n in names if isinstance(n, str) and n}


def fit_config(config: Path, *more: str) -> Result:
    """Run `heli-jax fit`."""
    ended, names = command("fit", config, "--out", "fit", *more), names_of(config)
    if not Path("fit/fit.json").exists():
        return refused(ended, names)
    content = json.loads(Path("fit/fit.json").read_text())
    result = of_fit(content, ended.code)
    said = {f"log {n['code']}" for source in content["data"] for n in source.get("notes", ())}
    result["codes"]["note"] = sorted({*result["codes"].get("note", ()), *said})
    return result


def refused(ended: Ended, names: set[str]) -> Result:
    """Return the result of a command that wrote nothing."""
    return {"exit": ended.code, "codes": coded([f"error {code_of(n, names)}" for n in ended.notes])}


def check_config(config: Path, *more: str) -> Result:
    """Run `heli-jax check`."""
    ended, names = command("check", config, "--json", *more), names_of(config)
    if not ended.out.startswith("{"):
        return refused(ended, names)
    content = json.loads(ended.out)
    findings = [f for f in content["findings"] if f["severity"] != "ok"]
    by = {s: [code_of(f, names) for f in findings if f["severity"] == s] for s in SEVERITIES}
    exits = [] if content["identifiable"] else ["exit not-identifiable"]
    notes = [f"log {f['code']}" for f in content["log_notes"]]
    return {
        "exit": ended.code,
        "codes": coded([*exits, *by["refuse"]], by["doubt"], [*by["note"], *notes]),
        "numbers": content["expected_relative_sd"],
    }


SEVERITIES = ("refuse", "doubt", "note")


def frf_config(config: Path, *more: str) -> Result:
    """Run `heli-jax frf`; keep gain, phase and coherence of each response at three frequencies."""
    ended, names = command("frf", config, "--out", "frf", *more), names_of(config)
    found = sorted(Path("frf").glob("**/responses.csv"))
    if not found:
        return refused(ended, names)
    pairs: dict[tuple[str, str], list[dict[str, str]]] = {}
    with found[0].open(newline="") as file:
        for row in csv.DictReader(file):
            pairs.setdefault((row["output"], row["input"]), []).append(row)

    def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
        return np.array([float(row[name] or "nan") for row in rows])

    by_output = {output: rows for (output, _), rows in reversed(pairs.items())}
    outputs = list(reversed(by_output.values()))
    gains = [column(rows, "gain") for rows in pairs.values()]
    angles = [np.radians(column(rows, "phase_deg")) for rows in pairs.values()]
    errors = [np.radians(column(rows, "phase_sd_deg")) for rows in pairs.values()]
    variables = {
        "real": [a * np.cos(b) for a, b in zip(gains, angles, strict=True)],
        "imaginary": [a * np.sin(b) for a, b in zip(gains, angles, strict=True)],
        "sd": [a * b for a, b in zip(gains, errors, strict=True)],
        "coherence": [column(rows, "coherence") for rows in pairs.values()],
        "multiple_coherence": [column(rows, "multiple_coherence") for rows in outputs],
        "half95": [np.array([column(rows, "half95_in_sd")[0] for rows in outputs])],
    }
    numbers: dict[str, Any] = {}
    for variable, each in variables.items():
        for i, row in enumerate(each[:4]):
            seen = row[np.isfinite(row)]
            for at in (0.25, 0.5, 0.75) if seen.size else ():
                numbers[f"{variable} {i} {at}"] = float(seen[int(at * (seen.size - 1))])
    notes = [code_of(n, names) for n in ended.notes]
    return {"exit": ended.code, "codes": coded([], [], notes), "numbers": numbers}


# The zoo.


def _puzzle(kind: Callable[[int], zoo.Puzzle], seed: int, _: Path) -> Result:
    puzzle = kind(seed)
    found, result = fit_of(puzzle.problem)
    return {**result, "wrong": zoo.complaint(puzzle, found)}


def zoo_cases() -> Iterator[Case]:
    """Yield the hundred problems with known answers."""
    quick = {"plain", "two_inputs", "product", "something_else"}
    for sound, kinds in ((True, zoo.SOUND), (False, zoo.UNSOUND)):
        for i, (kind, count) in enumerate(kinds):
            # Misfits, and problems that are not identifiable.
            ought = () if sound else ("exit", "adequacy")
            for seed in range(count):
                yield Case(
                    f"zoo {kind.__name__} {seed}",
                    f"zoo-{'sound' if sound else 'unsound'}-{i % 2}",
                    functools.partial(_puzzle, kind, seed),
                    sound,
                    ought,
                    quick=seed == 0 and kind.__name__ in quick,
                )


# Shipped configurations.


def _shipped(config: Path, do: str, shared: Path, folder: Path) -> Result:
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    more: list[str] = []
    real = shared / "data" / "trex550" / "Pitchtest.csv"
    log = folder / "log.csv"
    if config.stem == "trex550-roll" and real.exists():
        log = real
    elif "simulate" in content:
        ended = command("simulate", config, "--out", log)
        if ended.code:
            return refused(ended, set())
    for i, _ in enumerate(content.get("flights", ())):
        more += ["--set", f"flights.{i}.log={log}"]
    return ASKED[do](config, *more)


ASKED = {"fit": fit_config, "check": check_config, "frf": frf_config}


def shipped_cases(shared: Path) -> Iterator[Case]:
    """Yield every configuration of configs/ with flights."""
    for config in sorted(CONFIGS.glob("*.yaml")):
        content = yaml.safe_load(config.read_text(encoding="utf-8"))
        if "flights" not in content:
            continue
        for do in ASKED:
            if do != "frf" and "fit" not in content:
                continue
            yield Case(
                f"shipped {config.stem} {do}",
                f"shipped-{config.stem}",
                functools.partial(_shipped, config, do, shared),
                quick=config.stem == "bench-roll" and do == "check",
            )


# Small inputs that once failed: ../shared/cases.

_OUGHT: Mapping[str, tuple[bool | None, tuple[str, ...]]] = {
    "fast-loop-slow-log/fe.yaml": (False, ("loop-between",)),
    "fast-loop-slow-log/fe_from_truth.yaml": (False, ("loop-between",)),
    "fast-loop-slow-log/iv.yaml": (False, ("instrument", "trusted")),
    "delay-wrong-optimum/fe.yaml": (True, ()),
    # D is 0.4 +- 0.8, not significant with a start of 0.5.
    "delay-wrong-optimum/fe_from_truth.yaml": (None, ()),
    "doublets-and-chirp/fit.yaml": (True, ()),
    "free-decay/decay.yaml": (True, ()),
    "free-decay/step.yaml": (True, ()),
    "input-rate/rate.yaml": (False, ("rate",)),
    "lone-row-after-gap/split.yaml": (True, ()),
    "ulog-damage/stamp.yaml": (True, ()),
    "ulog-damage/whole.yaml": (True, ()),
    "ulog-damage/zeros.yaml": (True, ()),
}
_TRUTH = {
    "fast-loop-slow-log": {"K": 365.0, "D": 0.5},
    "delay-wrong-optimum": {"K": 365.0, "D": 0.5, "tau": 0.008},
    "doublets-and-chirp": {"Lp": -8.0, "Lda": 40.0, "tau": 0.06},
    "free-decay": {"k": 1.65, "d": 0.2},
}


def wrong_of(result: Result, sound: bool | None, truth: Mapping[str, float], off: float = 3) -> str:
    """Return the error of an answer; empty if it is right."""
    estimates = result.get("estimates", {})
    for name, value in truth.items():
        at, sd = (*estimates.get(name, ()), None, None)[:2]
        if sound and sd is None:
            return f"{name} not determined"
        far = at is not None and sd is not None and abs(at - value) > off * sd
        if far and not result["exit"]:
            return f"silent: {name} is {at:.4g} +- {sd:.2g}, not {value:.4g}"
        if far and sound:
            return f"{name} is {at:.4g} +- {sd:.2g}, not {value:.4g}"
    if sound and (result["exit"] or result.get("adequate") is False):
        return "false alarm"
    return ""


def _public(config: Path, do: str, folder: Path) -> Result:
    if not config.exists():
        raise LookupError(f"{config} is absent")
    result = ASKED[do](config)
    key = f"{config.parent.name}/{config.name}"
    if do != "fit":
        return result
    truth = _TRUTH.get(config.parent.name, {})
    return {**result, "wrong": wrong_of(result, _OUGHT[key][0], truth)}


def public_cases(shared: Path) -> Iterator[Case]:
    """Yield every folder of ../shared/cases: its configurations, or its logs if it has none."""
    for key, (sound, ought) in _OUGHT.items():
        config = shared / "cases" / key
        for do in ("fit", "check"):
            yield Case(
                f"public {key} {do}",
                f"public-{'a' if 'l' in key[:4] else 'b'}",
                functools.partial(_public, config, do),
                sound if do == "fit" else None,
                ought,
            )
    for log in ("fmt-redefined/order.bin", "gps-week-time/old.log", "stacked-segments/seg.npz"):
        path = shared / "cases" / log
        yield Case(f"public {log} read", "logs", functools.partial(read_log, path))


# Logs.


def read_log(path: Path, folder: Path, *more: str) -> Result:
    """Run `info`, `new` and `convert` on one log."""
    if not path.exists():
        raise LookupError(f"{path} is absent")
    info = command("info", path, "--json", *more)
    numbers: dict[str, Any] = {}
    names: set[str] = set()
    for flight in json.loads(info.out)["flights"] if not info.code else ():
        at = f"flight {flight['number']}"
        numbers |= {f"{at} duration": flight["duration"], f"{at} topics": len(flight["topics"])}
        for topic in flight["topics"][:6]:
            numbers[f"{at} {topic['name']} rows"] = topic["rows"]
            numbers[f"{at} {topic['name']} rate"] = (topic["time"] or {}).get("rate")
        for topic in flight["topics"]:
            names |= {topic["name"] or "", *(c["name"] for c in topic["channels"])}
    new = command("new", path, "--out", folder / "new.yaml")
    if (folder / "new.yaml").exists():
        made = yaml.safe_load((folder / "new.yaml").read_text(encoding="utf-8"))
        numbers["new model"] = str(made.get("model"))
        signals = made["flights"][0].get("signals", {})
        for kind in ("inputs", "outputs"):
            numbers[f"new {kind}"] = " ".join(signals.get(kind, {}))
        numbers["new free"] = " ".join((made.get("fit") or {}).get("free", {}))
    table = folder / "out.csv"
    converted = command("convert", path, table, "--rate", "50")
    if table.exists():
        rows = np.genfromtxt(table, delimiter=",", names=True, dtype=float)
        numbers["rows"] = len(rows)
        for name in (rows.dtype.names or ())[:12]:
            numbers[f"mean {name}"] = float(np.nanmean(rows[name]))
            numbers[f"sd {name}"] = float(np.nanstd(rows[name]))
    done = {"info": info, "new": new, "convert": converted}
    # A sentence may only have the start of a signal's name, such as `ekf...`.
    said = [f"{do} {code_of(n, names)}" for do, e in done.items() for n in e.notes]
    codes = {f"exit {do}": e.code for do, e in done.items()}
    return {"exit": max(codes.values()), "codes": coded([], [], said), "numbers": numbers | codes}


def _written(path: Path, x: Mapping[str, np.ndarray]) -> None:
    """Write columns in the format of the file's suffix."""
    import h5py
    import pyarrow as pa
    import pyarrow.feather
    import pyarrow.parquet
    import scipy.io
    import xarray as xr

    from tests.flights import log_writers as writers

    us = np.round(1e6 * (x["t"] + 10.0)).astype(int)
    names = [n for n in x if n != "t"]
    table = np.stack(list(x.values()), axis=1).tolist()
    stamped = [[int(at), *row[1:]] for at, row in zip(us, table, strict=True)]
    match path.suffix:
        case ".csv":
            rows = [",".join(x), *(",".join(f"{v:.9g}" for v in row) for row in table)]
            path.write_text("\n".join(rows) + "\n")
        case ".parquet":
            pyarrow.parquet.write_table(pa.table(dict(x)), path)
        case ".feather":
            pyarrow.feather.write_feather(pa.table(dict(x)), path)
        case ".jsonl":
            rows = [json.dumps(dict(zip(x, row, strict=True))) for row in table]
            path.write_text("\n".join(rows) + "\n")
        case ".mat":
            scipy.io.savemat(path, {n: v[:, None] for n, v in x.items()})
        case ".nc":
            xr.Dataset({n: ("t", x[n]) for n in names}, {"t": x["t"]}).to_netcdf(path)
        case ".h5":
            with h5py.File(path, "w") as file:
                for n, v in x.items():
                    file[n] = v
        case ".npz":
            columns: Any = x
            np.savez(path, **columns)
        case ".ulg":
            fields = [("uint64_t", "timestamp"), *(("float", n) for n in names)]
            path.write_bytes(writers.ulog([("rig", 0, fields, stamped)]))
        case ".bin" | ".log":
            messages = {"RIG": (210, "Q" + "f" * len(names), ",".join(["TimeUS", *names]))}
            rows = [("RIG", row) for row in stamped]
            binary = path.suffix == ".bin"
            write = writers.dataflash if binary else writers.dataflash_text
            path.write_bytes(write(messages, rows))
        case ".bbl":
            scaled = [np.round(1e4 * x[n]).astype(int) for n in names]
            values = np.stack([np.arange(us.size), us, *scaled], axis=1)
            count = [1] * len(names), [0] * len(names)
            path.write_bytes(writers.blackbox(names, values, *count))


def _format(suffix: str, folder: Path) -> Result:
    made = roll(1)
    x = {"t": made["t"], "lat": made["da"], "p": made["p"], "phi": made["phi"]}
    path = folder / f"flight{suffix}"
    _written(path, x)
    return read_log(path, folder)


FORMATS = (
    ".csv", ".parquet", ".feather", ".jsonl", ".mat", ".nc", ".h5", ".npz", ".ulg", ".bin", ".log",
    ".bbl",
)  # fmt: skip
_LOGS = (
    "data/trex550/Pitchtest.csv", "data/trex550/Hovertest.csv", "data/ulog/sample_log_small.ulg",
    "data/dataflash/test.BIN", "data/rotorflight/LOG246.TXT", "data/new-user.csv",
)  # fmt: skip


def log_cases(shared: Path) -> Iterator[Case]:
    """Yield one log for each format, and the records of ../shared/data."""
    for suffix in FORMATS:
        yield Case(
            f"format {suffix[1:]}",
            "logs",
            functools.partial(_format, suffix),
            quick=suffix in (".csv", ".ulg"),
        )
    for log in _LOGS:
        yield Case(f"log {log}", "logs", functools.partial(read_log, shared / log))


# Records of our own.


def _rig(rig: Rig, do: str, folder: Path) -> Result:
    result = ASKED[do](written(rig, folder))
    if do != "fit":
        return result
    sound = rig.ought is None
    said = wrong_of(result, sound, rig.truth)
    if not (sound or rig.truth) and not result["exit"]:
        said = "silent: exit 0"
    return {**result, "wrong": said}


def rig_cases() -> Iterator[Case]:
    """Yield the records of corpus_records.py."""
    quick = {"loop frequency error by instrument fit", "missing samples fit", "p clipped fit"}
    for i, (name, rig) in enumerate(RIGS.items()):
        for do in rig.do:
            yield Case(
                f"rig {name} {do}",
                f"rig-{i % 3}",
                functools.partial(_rig, rig, do),
                rig.ought is None if do == "fit" else None,
                rig.ought or (),
                quick=f"{name} {do}" in quick,
            )


def _own_model(folder: Path) -> Result:
    """Fit a model by import path, from `heli-jax new-model`."""
    command("new-model", "swing", "--out", "swing")
    config = folder / "swing" / "swing.yaml"
    command("simulate", config, "--out", folder / "swing" / "swing.csv")
    result = fit_config(config)
    return {**result, "wrong": wrong_of(result, True, {})}


def _study(folder: Path) -> Result:
    """Run eight fits of one record, with different windows and starts."""
    import xarray as xr

    config = written(RIGS["plain"], folder)
    over = ("--over", "flights.0.window=[0, 15],[15, 30]", "--over")
    starts = "fit.free.Lp.start=-1,-2,-6,-9"
    ended = command("fit", config, "--out", "study", *over, starts)
    with xr.open_zarr("study/study.zarr", consolidated=False, chunks=None) as data:
        values = {n: np.asarray(data[n].values).reshape(8, -1) for n in ("estimate", "sd")}
        statuses = sorted({str(v) for v in np.ravel(data["status"].values)})
    numbers = {
        f"{n} {i} {k}": float(v[i, k]) for n, v in values.items() for i, k in np.ndindex(8, 2)
    }
    return {"exit": ended.code, "status": " ".join(statuses), "numbers": numbers}


def _sweep(folder: Path) -> Result:
    """Run a sweep of 256 vehicles on the stand."""
    import xarray as xr

    more = ("--set", "sweep.n=256", "--set", "simulate.duration=20", "--no-figures")
    ended = command("sweep", CONFIGS / "bench-sweep.yaml", "--out", "sweep", *more)
    store = next(Path("sweep").glob("*.zarr"))
    numbers = {}
    with xr.open_zarr(store, consolidated=False, chunks=None) as data:
        for name in data.data_vars:
            values = np.asarray(data[name].values)
            if values.dtype.kind in "fc":
                numbers[f"mean {name}"] = float(np.nanmean(np.abs(values)))
                numbers[f"last {name}"] = float(np.abs(np.ravel(values)[-1]))
    return {"exit": ended.code, "numbers": numbers}


R50: tuple[str, ...] = ("Lb", "Alat", "Blat", "Lu", "Lv")
"""Free parameters of the R-50; a fit of all 33 would take minutes."""


def _r50(method: str, folder: Path) -> Result:
    """Fit the R-50, held by a pilot in gusts on six axes."""
    from r50_record import problem, record, truth

    from heli_jax import Free, Nuisance, Problem, linear_model, naming

    flight = record(1, 30.0)
    values = {n: float(v) for n, v in naming.asdict(truth()).items()}
    if method == "filter-error":
        fixed = tuple(n for n in values if n not in R50)
        factors = dict.fromkeys(R50, 1.2)
        result = fit_of(problem([flight], factors, taus=False, fixed=fixed))[1]
    else:
        shipped = linear_model("r50-hover")
        free = {n: Free(1.2 * values[n]) for n in R50}
        params, nuisance = shipped.vehicle().params, Nuisance(initial_state=False, bias=False)
        given = Problem(shipped.model, params, [flight], free, nuisance, method=method)
        result = fit_of(given)[1]
    sound = method == "filter-error"
    return {**result, "wrong": wrong_of(result, sound, {n: values[n] for n in R50})}


def other_cases() -> Iterator[Case]:
    """Yield cases that are no single fit of a configuration, and the R-50."""
    yield Case("own model by import path", "other", _own_model, True)
    yield Case("study of 8 fits", "other", _study)
    yield Case("sweep of 256", "other", _sweep)
    for method in ("filter-error", "frequency-error", "frequency-response"):
        yield Case(
            f"r50 {method}",
            "r50",
            functools.partial(_r50, method),
            method == "filter-error",
            () if method == "filter-error" else ("follow", "trusted"),
        )


def cases(shared: Path) -> list[Case]:
    """Return all cases, without computing any."""
    # The slowest processes come first.
    made = [*shipped_cases(shared), *zoo_cases(), *public_cases(shared), *rig_cases()]
    made += [*other_cases(), *log_cases(shared)]
    names = [c.name for c in made]
    assert len(set(names)) == len(names)
    return made


if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
