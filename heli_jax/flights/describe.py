"""What a log holds, before anybody asks for anything."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from heli_jax import units
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import (
    LATEST,
    SHORTEST_STEP,
    Uneven,
    not_increasing,
    rounding_of,
    uniform_grid,
)
from heli_jax.flights.open_log import open_table
from heli_jax.flights.table import Survey, Table, column, require_columns, wrong

_TIME_NAMES = {"t", "time", "timestamp", "timestamps", "seconds", "sec", "elapsed", "clock"}
_UNIT_AT_END = re.compile(
    r"^(.*?)\s*(?:_|\s|(?P<open>[\[(]))(s|sec|ms|us|µs|ns|min)(?(open)[\])])$"
)
_GAP_STEPS = 1.5
"""usual steps: a lost sample makes a step of two, and jitter one of a tenth more"""


@dataclass(frozen=True)
class ColumnInfo:
    """One column: `count` cells are filled; the numbers are NaN for text or where none is finite.

    The numbers are over the finite values, in the log's unit.
    """

    name: str
    kind: Literal["number", "text"]
    count: int
    n_nan: int
    min: float
    max: float
    mean: float
    sd: float


@dataclass(frozen=True)
class Gap:
    """A step of more than one and a half usual ones: when it starts, from the first sample [s]."""

    start: float
    length: float


@dataclass(frozen=True)
class TimeInfo:
    """The log's clock.

    `rate` [Hz] is that of the usual step; `jitter` the largest error of a step in steps, NaN where
    the stamps are no uniform grid; `problem` says why they are no clock at all, otherwise empty.
    """

    column: str
    unit: str
    duration: float
    rate: float
    uniform: bool
    jitter: float
    gaps: tuple[Gap, ...]
    problem: str = ""


@dataclass(frozen=True)
class LogInfo:
    """What a log holds; `time` is None where no column looks like a clock."""

    path: str
    format: str
    size: int
    sha256: str
    n_rows: int
    columns: tuple[ColumnInfo, ...]
    time: TimeInfo | None


def describe_log(path: str | Path, time: str | Signal | None = None) -> LogInfo:
    """Signals, rates, duration and gaps of a log.

    Args:
        path: the log, in a format that `read_flight` reads.
        time: the column of time stamps, in seconds where only its name is given; by default a
            column with a usual name (its unit from an ending such as `_ms`), or the first that
            increases from row to row.

    Raises:
        InputError: the log cannot be read, or has no such column.
    """
    table = open_table(path)
    surveys = table.survey()
    signal = _guess_time(table, surveys) if time is None else _asked_time(table, surveys, time)
    return LogInfo(
        path=table.path,
        format=table.format,
        size=table.size,
        sha256=table.sha256,
        n_rows=_n_rows(surveys),
        columns=tuple(_describe_column(each) for each in surveys),
        time=None if signal is None else _describe_time(table, surveys, signal),
    )


def _n_rows(surveys: list[Survey]) -> int:
    # Of a column of text only the filled cells are known, so the longest column is asked.
    sizes = (each.n_filled if each.values is None else each.values.size for each in surveys)
    return max(sizes, default=0)


def _describe_column(survey: Survey) -> ColumnInfo:
    nan = float("nan")
    if survey.values is None:
        return ColumnInfo(survey.name, "text", survey.n_filled, 0, nan, nan, nan, nan)
    n_nan = int(np.count_nonzero(np.isnan(survey.values)))
    x = survey.values[np.isfinite(survey.values)]
    numbers = (nan, nan, nan, nan)
    if x.size:
        with np.errstate(all="ignore"):  # a sum of huge numbers may overflow
            numbers = (float(x.min()), float(x.max()), float(x.mean()), float(x.std()))
    return ColumnInfo(survey.name, "number", survey.n_filled, n_nan, *numbers)


def _asked_time(table: Table, surveys: list[Survey], time: str | Signal) -> Signal:
    signal = Signal(time, "s", "s") if isinstance(time, str) else time
    require_columns(table.path, table.names, [signal.name])
    if _values(surveys, signal.name) is None:
        raise wrong(table.path, "holds text, expected times", column(signal.name))
    try:
        units.factor(signal.unit, "s")
    except ValueError as e:
        raise wrong(table.path, str(e), column(signal.name)) from e
    return signal


def _guess_time(table: Table, surveys: list[Survey]) -> Signal | None:
    numeric = [survey.name for survey in surveys if survey.values is not None]
    # A name decides before the numbers do: a counter or a distance may increase all along too.
    for name in numeric:
        stem, unit = _split_unit(name)
        if stem.casefold() in _TIME_NAMES or table.time_unit(name):
            return Signal(name, unit, "s")
    for name in numeric:
        values = _values(surveys, name)
        if values is not None and values.size > 1 and np.all(values[1:] > values[:-1]):
            return Signal(name, _split_unit(name)[1], "s")
    return None


def _split_unit(name: str) -> tuple[str, str]:
    match = _UNIT_AT_END.fullmatch(name)
    return (match[1], match[3]) if match else (name, "s")


def _values(surveys: list[Survey], name: str) -> np.ndarray | None:
    return next(survey.values for survey in surveys if survey.name == name)


def _describe_time(table: Table, surveys: list[Survey], signal: Signal) -> TimeInfo:
    unit = table.time_unit(signal.name) or signal.unit
    stamps = _values(surveys, signal.name)
    assert stamps is not None  # only a column of numbers is guessed or taken for a clock
    with np.errstate(all="ignore"):
        seconds = stamps * units.factor(unit, "s")
        steps = np.diff(seconds)
    problem = _clock_problem(seconds, steps)
    nan = float("nan")
    if problem:
        return TimeInfo(signal.name, unit, nan, nan, False, nan, (), problem)
    usual = float(np.median(steps))  # the mean would count the gaps
    grid = uniform_grid(seconds - seconds[0], rounding_of(stamps) * units.factor(unit, "s"))
    uneven = isinstance(grid, Uneven)
    # Stamps that are a grid but for their rounding have no gaps, however coarse it is.
    long = np.flatnonzero(steps > _GAP_STEPS * usual) if uneven else []
    return TimeInfo(
        column=signal.name,
        unit=unit,
        duration=float(seconds[-1] - seconds[0]),
        rate=1.0 / (usual if uneven else grid.dt),
        uniform=not uneven,
        jitter=nan if uneven else grid.jitter,
        gaps=tuple(Gap(float(seconds[i] - seconds[0]), float(steps[i])) for i in long),
    )


def _clock_problem(seconds: np.ndarray, steps: np.ndarray) -> str:
    if seconds.size < 2:
        return "a single sample"
    bad = int(np.count_nonzero(~np.isfinite(seconds)))
    if bad:
        return f"{bad} stamps are empty or no finite numbers"
    if not np.all(np.abs(seconds) <= LATEST):
        return "the stamps are too large for times"
    back = not_increasing(seconds)
    if back is not None:
        row, fault = back
        return f"the time {fault} after {seconds[row - 1] - seconds[0]:.6g} s"
    if np.median(steps) < SHORTEST_STEP:
        return "the steps are shorter than 1 ns"
    return ""
