"""Description of a log's content, before a configuration exists."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.clock import (
    ROWS,
    SECONDS,
    clock_scale,
    restarts,
    table_clock,
    with_runs,
)
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.arrays import clock_notes
from heli_jax.flights.grid import (
    Uneven,
    clock_fault,
    rounding_of,
    uniform_grid,
    without_overflow,
)
from heli_jax.flights.log import (
    ChannelLog,
    Survey,
    Table,
    Topic,
    as_floats,
    listed,
    sample_count,
    shown,
    wrong,
)
from heli_jax.flights.marks import mark_notes
from heli_jax.flights.open_log import chosen_flights, open_flights

_GAP_STEPS = 1.5
"""Shortest gap [usual steps]: a lost sample makes a step of two, jitter one of 1.1."""
_FILTER = re.compile(
    r"lpf|low_?pass|notch|hntch|hntc2|cutoff|_flt[tde]?$|filt|_nf\d|decimation|looptime|pid_process_denom",
    re.IGNORECASE,
)
"""Names of settings of the firmware's filters, which change signals before they are logged."""


@dataclass(frozen=True)
class ColumnInfo:
    """One column: `count` filled cells; statistics of the finite values, in the log's unit.

    The statistics are NaN for text or without finite values.
    """

    name: str
    kind: Literal["number", "text"]
    count: int
    n_nan: int
    min: float
    max: float
    mean: float
    sd: float
    unit: str = ""
    """Unit that the log states, or empty."""
    strays: str = ""
    """Cells of a text column that are no numbers, if most are."""
    rows: int = 0
    """Rows of a column of numbers, with missing ones."""


@dataclass(frozen=True)
class Gap:
    """A step of more than 1.5 usual ones; `start` counts from the first sample [s]."""

    start: float
    length: float


@dataclass(frozen=True)
class TimeInfo:
    """Clock of a log or of one of its topics.

    `rate` [Hz] is that of the usual step. `jitter` is the largest error of a step, relative to the
    step; without a uniform grid the 95 % quantile of these errors, gaps excluded. `problem` is the
    reason why the stamps are no clock, otherwise empty. `guessed` is True if nothing states the
    unit. `counted` [Hz] is the number of samples a second if `column` counts samples, or if the
    rows do (`heli_jax.flights.clock.ROWS`). If the time begins anew, the table holds several
    `runs`, put one after another.
    """

    column: str
    unit: str
    duration: float
    rate: float
    uniform: bool
    jitter: float
    gaps: tuple[Gap, ...]
    problem: str = ""
    guessed: bool = False
    counted: float | None = None
    runs: int = 1

    @property
    def signal(self) -> Signal:
        """The clock as a signal of the log."""
        return Signal(self.column, self.unit, "s", scale=1.0 / (self.counted or 1.0))


@dataclass(frozen=True)
class TopicInfo:
    """Channels of one clock; `time` is None if their rows have only an order."""

    name: str
    n_rows: int
    time: TimeInfo | None
    columns: tuple[ColumnInfo, ...]


@dataclass(frozen=True)
class LogInfo:
    """Content of a log, or of one of its flights.

    A table has one topic without a name, whose `time` is None if no column looks like a clock.
    `duration` [s] is from the first sample to the last.
    """

    path: str
    format: str
    size: int
    sha256: str
    topics: tuple[TopicInfo, ...]
    duration: float = float("nan")
    flight: tuple[int, int] = (1, 1)
    firmware: str = ""
    parameters: Mapping[str, str | int | float] = field(default_factory=dict)
    notes: tuple[Finding, ...] = ()

    @property
    def is_table(self) -> bool:
        """True for rows with a common clock, False for topics with their own."""
        return not self.topics[0].name

    @property
    def time(self) -> TimeInfo | None:
        """Clock of a table."""
        return self.topics[0].time if self.is_table else None

    @property
    def n_rows(self) -> int:
        """Rows of the longest topic."""
        return max(topic.n_rows for topic in self.topics)

    @property
    def columns(self) -> tuple[ColumnInfo, ...]:
        """The columns of all topics."""
        return tuple(each for topic in self.topics for each in topic.columns)

    @property
    def filters(self) -> dict[str, str | int | float]:
        """The parameters that describe the firmware's filters."""
        return {k: v for k, v in self.parameters.items() if _FILTER.search(k)}


def describe_log(
    path: str | Path,
    time: str | Signal | None = None,
    unit: str | None = None,
    rate: float | None = None,
) -> LogInfo:
    """Describe the first flight of a log only, as `describe_flights`."""
    return next(describe_flights(path, time, unit, rate=rate))


def describe_flights(
    path: str | Path,
    time: str | Signal | None = None,
    unit: str | None = None,
    number: int | None = None,
    rate: float | None = None,
) -> Iterator[LogInfo]:
    """Describe signals, rates, duration and gaps of the flights of a log, one by one.

    Args:
        path: the log, in a format that `read_flight` reads.
        time: column of time stamps; by default one with a usual name. Without `unit` its unit comes
            from an ending such as `_ms`, or is guessed from the steps.
        unit: unit of the time stamps, if stated.
        number: number of the one flight to describe, from 1.
        rate: sample rate [Hz] of a table without times.

    Raises:
        InputError: the log cannot be read, has no such column, or needs no column of times.
    """
    # The reader reads all flights of a file in one pass, so `number` saves no time.
    log = chosen_flights(path, open_flights(path), number)
    if not isinstance(log, tuple):
        yield describe_table(log, time, unit, rate)
        return
    for option, value in (("time", time), ("unit of time", unit), ("rate of rows", rate)):
        if value is not None:
            problem = f"its topics have clocks of their own, expected no {option} to be stated"
            raise wrong(str(path), problem)
    for flight in log:
        yield _describe_channels(flight)


def _describe_channels(log: ChannelLog) -> LogInfo:
    topics = tuple(_describe_topic(topic) for topic in log.topics)
    # A single sample, published when the firmware began, does not show the duration.
    last = [float(t.times[-1]) for t in log.topics if t.clock and t.times.size > 1]
    return LogInfo(
        path=log.path,
        format=log.format,
        size=log.size,
        sha256=log.sha256,
        topics=topics,
        duration=max(last) - log.first_time if last else float("nan"),
        flight=log.flight,
        firmware=log.firmware,
        parameters=log.parameters,
        notes=(*log.notes, *mark_notes(c for topic in log.topics for c in topic.columns.items())),
    )


def _describe_topic(topic: Topic) -> TopicInfo:
    columns = tuple(
        _describe_column(Survey(name, as_floats(x), x.size), topic.units.get(name, ""))
        for name, x in topic.columns.items()
    )
    time = _describe_stamps(topic.clock, "s", topic.times) if topic.clock else None
    return TopicInfo(topic.name, topic.times.size, time, columns)


def describe_table(
    table: Table, time: str | Signal | None, unit: str | None, rate: float | None = None
) -> LogInfo:
    """Describe a table that is open, as `describe_flights`.

    Args:
        rate: samples a second [Hz], of rows or of the counts in `time`; with it the clock is the
            rows or the column of counts, unless `time` names one.
    """
    surveys = table.survey()
    signal, guessed = table_clock(table, surveys, time, unit, rate)
    clock = None
    if signal is not None:
        rows = np.arange(_n_rows(surveys), dtype=np.float64)
        stamps = rows if signal.name == ROWS else _values(surveys, signal.name)
        runs = restarts(stamps).size + 1
        if runs > 1:
            scale = clock_scale(table, signal)
            stamps = with_runs(table, signal.name, {signal.name: stamps}, scale)[0][signal.name]
        clock = replace(_describe_time(table, signal, stamps, guessed), runs=runs)
    columns = tuple(_describe_column(s, table.units.get(s.name, "")) for s in surveys)
    # Stamps have no marks: a wrong one is refused with its row.
    measured = [s for s in surveys if signal is None or s.name != signal.name]
    marks = mark_notes((s.name, s.values) for s in measured if s.values is not None)
    return LogInfo(
        path=table.path,
        format=table.format,
        size=table.size,
        sha256=table.sha256,
        topics=(TopicInfo("", _n_rows(surveys), clock, columns),),
        duration=float("nan") if clock is None else clock.duration,
        notes=(
            *table.notes,
            *_other_lengths(surveys),
            *clock_notes(table),
            *marks,
        ),
    )


def _other_lengths(surveys: list[Survey]) -> tuple[Finding, ...]:
    """Return a note for each length that is not the log's; arrays may have their own."""
    by_size: dict[int, list[str]] = {}
    for each in surveys:
        if each.values is not None:
            by_size.setdefault(each.values.size, []).append(each.name)
    rows = _n_rows(surveys)
    return tuple(
        note(
            "channels.other-length",
            f"{sample_count(size)}, not {rows}: {listed(map(shown, names))}",
            *names,
            value=size,
        )
        for size, names in by_size.items()
        if size != rows
    )


def _n_rows(surveys: list[Survey]) -> int:
    # For a column of text only the filled cells are known, so the longest column decides.
    sizes = (each.n_filled if each.values is None else each.values.size for each in surveys)
    return max(sizes, default=0)


def _describe_column(survey: Survey, unit: str = "") -> ColumnInfo:
    nan = float("nan")
    if survey.values is None:
        empty = (nan, nan, nan, nan)
        return ColumnInfo(survey.name, "text", survey.n_filled, 0, *empty, unit, survey.strays)
    # Infinite cells are not counted as missing, but the statistics use only finite ones; a single
    # infinite one would make mean and sd infinite.
    n_nan = int(np.count_nonzero(np.isnan(survey.values)))
    x = survey.values[np.isfinite(survey.values)]
    numbers = (nan, nan, nan, nan)
    if x.size:
        with np.errstate(all="ignore"):  # a sum of huge numbers may overflow
            numbers = (float(x.min()), float(x.max()), float(x.mean()), float(x.std()))
    rows = survey.values.size
    return ColumnInfo(survey.name, "number", survey.n_filled, n_nan, *numbers, unit, rows=rows)


def _values(surveys: list[Survey], name: str) -> np.ndarray:
    values = next(survey.values for survey in surveys if survey.name == name)
    assert values is not None  # only a column of numbers is used as a clock
    return values


def _describe_time(table: Table, signal: Signal, stamps: np.ndarray, guessed: bool) -> TimeInfo:
    if signal.name == ROWS or signal.scale != 1.0:
        clock = _describe_stamps(signal.name, "s", stamps, signal.scale)
        return replace(clock, guessed=guessed, counted=round(1.0 / signal.scale, 9))
    unit = table.time_unit(signal.name) or signal.unit
    return replace(_describe_stamps(signal.name, unit, stamps), guessed=guessed)


def _describe_stamps(
    name: str, unit: str, stamps: np.ndarray, scale: float | None = None
) -> TimeInfo:
    """Describe stamps (N,), in a unit of time or of `scale` [s], as a clock."""
    if scale is None:
        scale = SECONDS[unit] if unit in SECONDS else units.factor(unit, "s")
    with np.errstate(all="ignore"):
        stamps = without_overflow(stamps)
        seconds = stamps * scale
    # A column that the user named as the clock may be anything, so stamps and steps are checked
    # first.
    problem = _clock_problem(seconds)
    nan = float("nan")
    if problem:
        return TimeInfo(name, unit, nan, nan, False, nan, (), problem)
    steps = np.diff(seconds)
    usual = float(np.median(steps))  # gaps would change the mean
    # The same function as for reading a flight, so that `info` and a fit agree on uniformity.
    grid = uniform_grid(seconds - seconds[0], rounding_of(stamps) * scale)
    uneven = isinstance(grid, Uneven)
    # Stamps that are a grid except for rounding have no gaps, however coarse it is.
    long = np.flatnonzero(steps > _GAP_STEPS * usual) if uneven else []
    # Gaps are listed separately; they would dominate the jitter.
    short = steps[steps <= _GAP_STEPS * usual]
    return TimeInfo(
        column=name,
        unit=unit,
        duration=float(seconds[-1] - seconds[0]),
        rate=1.0 / (usual if uneven else grid.dt),
        uniform=not uneven,
        jitter=float(np.quantile(np.abs(short / usual - 1), 0.95)) if uneven else grid.jitter,
        gaps=tuple(Gap(float(seconds[i] - seconds[0]), float(steps[i])) for i in long),
    )


def _clock_problem(seconds: np.ndarray) -> str:
    if seconds.size < 2:
        return "a single sample"
    if bad := int(np.count_nonzero(~np.isfinite(seconds))):
        return f"{bad} time stamps are empty or not finite"
    if (found := clock_fault(seconds)) is None:
        return ""
    row, fault = found
    return f"the time {fault} in row {row + 1}"
