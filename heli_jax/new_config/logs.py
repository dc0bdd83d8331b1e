"""View of a log for `heli-jax new`, independent of its format."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.clock import (
    ROWS,
    clock_scale,
    columns_of,
    is_called_time,
    require_increasing,
    with_runs,
)
from heli_jax.flights.describe import LogInfo, describe_table
from heli_jax.flights.formats.arrays import ArrayTable, by_clocks
from heli_jax.flights.log import ChannelLog, Table, as_floats, shown, wrong
from heli_jax.flights.marks import without_marks
from heli_jax.flights.open_log import chosen_flights, open_flights
from heli_jax.new_config.guess import Series

_ASSUMED = 100.0
"""Assumed rate of rows without any information on their rate [Hz]."""
_FEWEST = 8
"""Fewest samples of a signal."""


class Log(NamedTuple):
    """A flight for `new`."""

    path: str
    format: str
    series: Mapping[str, Series]
    time: Any
    """`TimeInfo` of a table; None if topics have separate clocks."""
    flight: int | None
    several: bool
    notes: Sequence[Finding] = ()
    """Notes on the parts of the log that are left out."""
    autopilot: ChannelLog | None = None
    """The log itself with the firmware's settings, if topics have separate clocks."""


def read_log(path: Path, number: int | None, rate: float | None = None) -> Log:
    """Read the channels of a log that hold samples.

    Args:
        path: path of the log.
        number: number of the flight in a log that holds several, from 1.
        rate: samples a second [Hz] of a table without times.

    Raises:
        InputError: it cannot be read, or its times are invalid.
    """
    opened = chosen_flights(path, open_flights(path), number)
    if not isinstance(opened, tuple):
        # Arrays may have separate clocks, by their place in the file.
        grouped = None
        if isinstance(opened, ArrayTable) and rate is None:
            grouped = by_clocks(opened)
        if grouped is None:
            return _read_table(opened, rate)
        opened = (grouped,)
    if rate is not None:
        problem = "its topics have clocks of their own, expected no rate of rows to be stated"
        raise wrong(str(path), problem)
    first, *others = opened
    if not any(topic.clock for topic in first.topics):
        problem = "its rows have no times, which a fit needs, expected a log with a"
        raise wrong(str(path), f"{problem} clock, of ArduPilot one with TimeUS")
    series = {
        name: Series(topic.times, without_marks(as_floats(values)), topic.units.get(name, ""))
        for topic in first.topics
        if topic.clock and topic.times.size >= _FEWEST
        for name, values in topic.columns.items()
        if np.asarray(values).dtype.kind in "biuf" and _is_known(as_floats(values))
    }
    flight = first.flight[0] if others or first.flight[1] > 1 else None
    notes = tuple(n for n in first.notes if n.code == LEFT_OUT)
    return Log(
        str(path),
        first.format,
        series,
        None,
        flight,
        flight is not None,
        notes,
        autopilot=first,
    )


def _read_table(table: Table, rate: float | None) -> Log:
    info: LogInfo = describe_table(table, None, None, rate)
    notes: tuple[Finding, ...] = ()
    time = info.time
    if time is None:
        _require_whole_clock(table, info)
        # Only the user knows the number of samples a second; a guess needs only their order.
        time = describe_table(table, None, None, _ASSUMED).time
        assert time is not None
        time = dataclasses.replace(time, counted=math.nan)
        words = f"{_without_time(info)}: state its samples per second"
        notes = (note("clock.not-found", words),)
    if time.problem:
        if time.column in table.names:
            # This error names the line and the remedy.
            require_increasing(table, time.column, table.numbers([time.column])[time.column])
        problem = "expected a column of increasing times, got none"
        raise wrong(table.path, f"{problem}: {time.problem}")
    clock = time.column
    names = [c.name for c in info.columns if c.kind == "number"]
    # Columns that share a name cannot be selected.
    names = [n for n in names if table.names.count(n) == 1]
    # Only arrays with the length of the clock.
    rows = {ROWS: info.n_rows} | {c.name: c.rows for c in info.columns}
    others = [n for n in names if rows[n] != rows[clock]]
    names = [n for n in names if n not in others]
    values = columns_of(table, list(dict.fromkeys([clock, *names])))
    if time.runs > 1:
        values, notices = with_runs(table, clock, values, clock_scale(table, time.signal))
        notes += notices
    times = _from_first(values[clock], time.duration)
    series = {
        n: Series(times, without_marks(values[n]), table.units.get(n, ""))
        for n in names
        if n != clock and _is_known(values[n])
    }
    if others:
        listed = ", ".join(map(shown, others[:6]))
        words = shown(clock) if clock != ROWS else "the others"
        words = f"left out, because they are not as long as {words}: {listed}"
        notes += (note(LEFT_OUT, words, *others),)
    return Log(table.path, table.format, series, time, None, False, notes)


def _require_whole_clock(table: Table, info: LogInfo) -> None:
    """Refuse a column of times with a few cells of text, such as means below the samples.

    With a stated rate such rows would be read as samples.
    """
    for c in info.columns:
        if c.strays and is_called_time(c.name):
            problem = f"column {shown(c.name)}: {c.strays}; expected times: delete such rows"
            raise wrong(table.path, f"{problem} (--time-rate counts every row as a sample)")


def _from_first(stamps: np.ndarray, duration: float) -> np.ndarray:
    """Return stamps (N,) in seconds from the first, evenly spread over `duration` [s] if invalid.

    A guess needs no more of their unit.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        elapsed = stamps - stamps[0]
        rises = elapsed.size > 1 and bool(np.all(np.diff(elapsed) > 0))
    if not (rises and np.isfinite(elapsed[-1])):
        return np.linspace(0.0, duration, stamps.size)
    return elapsed * (duration / float(elapsed[-1]))


def _without_time(info: LogInfo) -> str:
    """Return why none of a table's columns is a time."""
    strays = next((f"; {shown(c.name)}: {c.strays}" for c in info.columns if c.strays), "")
    return f"no column is a time{strays}"


def _is_known(values: np.ndarray) -> bool:
    return int(np.sum(np.isfinite(values))) >= _FEWEST
