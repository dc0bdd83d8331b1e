"""The cases of corpus.py: each a name, a group that shares compiled programs, and what is right."""

import contextlib
import functools
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
import zoo
from corpus import ROOT, Result, code_of, coded, of_fit

CONFIGS = ROOT / "configs"


class Case(NamedTuple):
    """One run of the program."""

    name: str
    group: str
    """what runs in one process"""
    run: Callable[[Path], Result]
    """in a folder of its own; LookupError where something is absent"""
    sound: bool | None = None
    """whether the right answer is exit 0 and adequate; None where nobody knows"""
    ought: tuple[str, ...] = ()
    """of an unsound case: words of the codes one of which says what is wrong"""
    quick: bool = False


class Ended(NamedTuple):
    """What a command printed."""

    code: int
    out: str
    notes: list[str]
    """lines of standard error"""


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
    """A Problem's fit, and what is kept of it."""
    from heli_jax import cli, fit
    from heli_jax.report import files

    found = fit(problem)
    flights = [f.name for f in problem.flights]
    signals = [n for f in problem.flights for n in (*f.inputs, *f.outputs)]
    content = files.fit_json(found, problem, None)
    return found, of_fit(content, cli._fit_code(found), [*filter(None, flights), *signals])


def names_of(config: Path) -> set[str]:
    """Of signals, parameters and flights that a configuration names."""
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
    """`heli-jax fit`."""
    ended, names = command("fit", config, "--out", "fit", *more), names_of(config)
    if not Path("fit/fit.json").exists():
        return refused(ended, names)
    result = of_fit(json.loads(Path("fit/fit.json").read_text()), ended.code, names)
    said = {f"log {code_of(n, names)}" for n in ended.notes}
    result["codes"]["note"] = sorted({*result["codes"].get("note", ()), *said})
    return result


def refused(ended: Ended, names: set[str]) -> Result:
    """A command that wrote nothing."""
    return {"exit": ended.code, "codes": coded([f"error {code_of(n, names)}" for n in ended.notes])}


def check_config(config: Path, *more: str) -> Result:
    """`heli-jax check`."""
    ended, names = command("check", config, "--json", *more), names_of(config)
    if not ended.out.startswith("{"):
        return refused(ended, names)
    content = json.loads(ended.out)
    findings = [f for f in content["record"] if f["severity"] != "ok"]
    by = {s: [code_of(f, names) for f in findings if f["severity"] == s] for s in SEVERITIES}
    exits = [] if content["identifiable"] else ["exit not-identifiable"]
    notes = [code_of(n, names) for n in content["notes"]]
    notes += [f"log {code_of(n, names)}" for n in content["log_notes"]]
    return {
        "exit": ended.code,
        "codes": coded([*exits, *by["refuse"]], by["doubt"], [*by["note"], *notes]),
        "numbers": content["expected_relative_sd"],
    }


SEVERITIES = ("refuse", "doubt", "note")


def frf_config(config: Path, *more: str) -> Result:
    """`heli-jax frf`: gain, phase and coherence of each response at three frequencies."""
    import xarray as xr

    ended, names = command("frf", config, "--out", "frf", *more), names_of(config)
    found = sorted(Path("frf").glob("**/responses.nc"))
    if not found:
        return refused(ended, names)
    numbers: dict[str, Any] = {}
    with xr.open_dataset(found[0], engine="h5netcdf") as data:
        for variable in data.data_vars:
            values = np.asarray(data[variable].values)
            if values.dtype.kind != "f" or not values.size:
                continue
            rows = values.reshape(-1, values.shape[-1]) if values.ndim else values.reshape(1, 1)
            for i, row in enumerate(rows[:4]):
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
    """The hundred problems with known answers."""
    quick = {"plain", "two_inputs", "product", "something_else"}
    for sound, kinds in ((True, zoo.SOUND), (False, zoo.UNSOUND)):
        for i, (kind, count) in enumerate(kinds):
            # Problems whose answer is a misfit, and those that are not identifiable.
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

BIG = {"xcell-combined", "xcell-hover"}


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
    """Every configuration of configs/ with flights."""
    for config in sorted(CONFIGS.glob("*.yaml")):
        content = yaml.safe_load(config.read_text(encoding="utf-8"))
        if "flights" not in content:
            continue
        for do in ASKED:
            if do != "frf" and "fit" not in content:
                continue
            yield Case(
                f"shipped {config.stem} {do}",
                f"shipped-{config.stem.partition('-')[0]}",
                functools.partial(_shipped, config, do, shared),
                quick=config.stem == "bench-roll" and do != "frf",
            )


# Small inputs that failed once: ../shared/cases.

_OUGHT: Mapping[str, tuple[bool, tuple[str, ...]]] = {
    "fast-loop-slow-log/fe.yaml": (False, ("rate", "trusted")),
    "fast-loop-slow-log/fe_from_truth.yaml": (False, ("rate", "trusted")),
    "fast-loop-slow-log/iv.yaml": (False, ("instrument", "trusted")),
    "delay-wrong-optimum/fe.yaml": (True, ()),
    "delay-wrong-optimum/fe_from_truth.yaml": (True, ()),
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
    """What is wrong with an answer; empty where it is right."""
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
    """Every folder of ../shared/cases: its configurations, and its logs where it has none."""
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


def read_log(path: Path, folder: Path) -> Result:
    """`info`, `new` and `convert` of one log."""
    if not path.exists():
        raise LookupError(f"{path} is absent")
    info = command("info", path, "--json")
    numbers: dict[str, Any] = {}
    if not info.code:
        for i, flight in enumerate(_listed(json.loads(info.out))):
            numbers |= {f"{i} {k}": v for k, v in _flat(flight) if not isinstance(v, str)}
    new = command("new", path, "--out", folder / "new.yaml")
    made = folder / "new.yaml"
    if made.exists():
        content = yaml.safe_load(made.read_text(encoding="utf-8"))
        numbers |= {f"new {k}": v for k, v in _flat({k: content[k] for k in content})}
    converted = command("convert", path, folder / "out.csv", "--rate", "50")
    table = folder / "out.csv"
    if table.exists():
        rows = np.genfromtxt(table, delimiter=",", names=True, dtype=float)
        numbers["rows"] = len(rows)
        for name in (rows.dtype.names or ())[:12]:
            numbers[f"mean {name}"] = float(np.nanmean(rows[name]))
            numbers[f"sd {name}"] = float(np.nanstd(rows[name]))
    said = [f"{do} {code_of(n)}" for do, e in _named(info, new, converted) for n in e.notes]
    kept = {k: v for k, v in numbers.items() if str(folder) not in str(v)}
    codes = {f"exit {do}": e.code for do, e in _named(info, new, converted)}
    return {"exit": max(codes.values()), "codes": coded([], [], said), "numbers": kept | codes}


def _named(info: Ended, new: Ended, converted: Ended) -> Iterator[tuple[str, Ended]]:
    yield from (("info", info), ("new", new), ("convert", converted))


def _listed(content: Any) -> list[Any]:
    return content if isinstance(content, list) else [content]


def _flat(content: Any, at: str = "", most: int = 40) -> Iterator[tuple[str, Any]]:
    """Leaves of plain data by their path; of long lists the first."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _flat(value, f"{at}.{key}" if at else str(key))
    elif isinstance(content, Sequence) and not isinstance(content, str):
        for i, value in enumerate(content[:most]):
            yield from _flat(value, f"{at}.{i}")
    elif isinstance(content, bool | int | str) or (
        isinstance(content, float) and math.isfinite(content)
    ):
        yield at, content


_LOGS = (
    "data/trex550/Pitchtest.csv", "data/trex550/Hovertest.csv", "data/ulog/sample_log_small.ulg",
    "data/dataflash/test.BIN", "data/rotorflight/LOG246.TXT", "data/new-user.csv",
)  # fmt: skip


def log_cases(shared: Path) -> Iterator[Case]:
    """The records of ../shared/data."""
    for log in _LOGS:
        yield Case(f"log {log}", "logs", functools.partial(read_log, shared / log))


def cases(shared: Path) -> list[Case]:
    """All of them; nothing is computed yet."""
    made = [*zoo_cases(), *shipped_cases(shared), *public_cases(shared), *log_cases(shared)]
    names = [c.name for c in made]
    assert len(set(names)) == len(names)
    return made


if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
