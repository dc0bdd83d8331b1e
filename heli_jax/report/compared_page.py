"""The page of several runs side by side: tables, and simulated outputs over the measured."""

import contextlib
import functools
import itertools
import os
import urllib.parse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from heli_jax import units
from heli_jax.finding import sentences
from heli_jax.identification.result import Signals
from heli_jax.report import style
from heli_jax.report.charts import Chart, Numbers, Series, limits_of, panel, samples
from heli_jax.report.compared_runs import ComparedRuns
from heli_jax.report.figures import time_label
from heli_jax.report.origin import origin
from heli_jax.report.page import Picture, filled, picture
from heli_jax.report.saved_fit import SavedFit

_FILES = ("report.html", "fit.json", "signals.csv", "config.yaml")
_MOST_FIGURES = 24
_SHOWN, _FAR = 2.0, 20.0
"""of an output's measured range: how far from its middle the axes reach at most, and curves"""
_SI = ("1", "m", "m/s", "m/s^2", "rad", "rad/s", "rad/s^2")


def write_page(path: Path, compared: ComparedRuns) -> None:
    """The page, self-contained."""
    numbers = Numbers()
    pictures = list(_pictures(compared, numbers))
    folder = path.absolute().parent
    page = filled(
        "compared.html.j2",
        labels=compared.labels,
        tables=[
            ("Estimates", compared.page_estimates),
            ("Verdicts", compared.verdicts),
            ("Agreement", compared.agreement),
        ],
        notes=sentences(compared.notes),
        pictures=pictures,
        numbers=numbers.content(),
        # Relative, so that page and runs can be moved together.
        files=[
            (label, [(n, _link(run.directory / n, folder)) for n in _FILES if _is(run, n)])
            for label, run in zip(compared.labels, compared.runs, strict=True)
        ],
        configs=[
            (label, (run.directory / "config.yaml").read_text(encoding="utf-8"))
            for label, run in zip(compared.labels, compared.runs, strict=True)
            if _is(run, "config.yaml")
        ],
        origin=origin(),
    )
    path.write_text(page, encoding="utf-8")


def _is(run: SavedFit, name: str) -> bool:
    return (run.directory / name).is_file()


def _link(file: Path, folder: Path) -> str:
    """The address of a file for a page in a folder."""
    try:
        relative = os.path.relpath(file.absolute(), folder)
    except ValueError:  # on another drive
        return file.absolute().as_uri()
    return urllib.parse.quote(relative.replace(os.sep, "/"))


def _pictures(compared: ComparedRuns, numbers: Numbers) -> Iterator[tuple[Picture, str]]:
    """The figures, each with its caption."""
    for name, output, by_run in itertools.islice(_overlaps(compared), _MOST_FIGURES):
        unit = _unit(compared, output)
        made = picture("overlay", functools.partial(_overlay, by_run, name, output, unit), numbers)
        if made is not None:
            drawn = {label for label, _ in by_run}
            missing = [label for label in compared.labels if label not in drawn]
            without = f"no {output} of that log in a flight named {name}, or no result"
            yield made, f"Not drawn: {', '.join(missing)} ({without})." if missing else ""


def _overlaps(
    compared: ComparedRuns,
) -> Iterator[tuple[str, str, list[tuple[str, Signals]]]]:
    """Flights and outputs that more than one run has, with the runs' signals."""
    by_place: dict[tuple[str, str, str], list[tuple[str, Signals]]] = {}
    names: dict[tuple[str, tuple[float, ...]], str] = {}
    for label, run in zip(compared.labels, compared.runs, strict=True):
        # What stopped on its way is no result, and simulates nothing that was found.
        if run.status == "not-converged":
            continue
        # Flights without a name are all called flight 1, whatever log they are of.
        logs = {f["flight"]: f for f in run.content["data"] if f.get("flight")}
        for signals in run.signals:
            flight = logs.get(signals.flight, {})
            log, name = str(flight.get("sha256", "")), signals.flight
            # And one part of a log may have a name of its own in each run.
            if log and flight.get("window"):
                part = (log, tuple(round(float(t), 3) for t in flight["window"]))
                called = names.setdefault(part, name)
                name = called if called not in logs else name
            for output in signals.measured:
                by_place.setdefault((log, name, output), []).append((label, signals))
    for (_, name, output), by_run in by_place.items():
        if len(by_run) > 1:
            yield name, output, by_run


def _unit(compared: ComparedRuns, output: str) -> str:
    """The SI unit of an output, by the unit that it was logged in; empty where none is stated."""
    flights = [f for run in compared.runs for f in run.content.get("data", ())]
    logged = [((f.get("signals") or {}).get("outputs") or {}).get(output) for f in flights]
    for stated in (signal.get("unit") for signal in logged if isinstance(signal, dict)):
        for si in _SI:
            with contextlib.suppress(ValueError):
                units.factor(str(stated), si)
                return si
    return ""


def _overlay(by_run: Sequence[tuple[str, Signals]], name: str, output: str, unit: str) -> Chart:
    first = by_run[0][1]
    # By what was measured: one run that diverges would leave of all others a straight line.
    measured = first.measured[output][np.isfinite(first.measured[output])]
    middle = float(np.mean(measured)) if measured.size else 0.0
    size = float(np.ptp(measured)) if measured.size and np.ptp(measured) > 0 else 1.0
    t, colours = first.log_times, style.CYCLE
    series = [samples("measured", t, first.measured[output], style.PALE, 1.2)]
    for i, (label, signals) in enumerate(by_run):
        simulated = signals.simulated[output]
        far = np.abs(simulated - middle) > _FAR * size
        if far.any():
            label, simulated = f"{label} (diverges)", np.where(far, np.nan, simulated)
        look = {"width": 0.9, "dashed": i // len(colours) % 2 == 1}
        color = colours[i % len(colours)]
        series.append(Series(label, signals.log_times, simulated, color, **look))
    low, high = limits_of(series)
    limits = max(low, middle - _SHOWN * size), min(high, middle + _SHOWN * size)
    words = f"{output} [{unit}]" if unit not in ("", "1") else output
    begin = min(float(s.log_times[0]) for _, s in by_run)
    end = max(float(s.log_times[-1]) for _, s in by_run)
    return Chart(
        f"{output}, {style.short(name)}: simulated",
        time_label(first.log_start),
        (begin, end if end > begin else begin + 1.0),
        (panel(words, series, 2.2, limits=limits),),
        of=name,
    )
