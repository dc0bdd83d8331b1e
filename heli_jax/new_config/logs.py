"""View of a log for `heli-jax new`, independent of its format."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.clock import is_called_time, require_increasing
from heli_jax.flights.describe import LogInfo, TimeInfo, describe_table
from heli_jax.flights.formats.arrays import ArrayTable, by_clocks
from heli_jax.flights.log import ChannelLog, Table, as_floats, shown, wrong
from heli_jax.flights.marks import without_marks
from heli_jax.flights.open_log import chosen_flights, open_flights
from heli_jax.flights.read_table import guessed_log
from heli_jax.new_config.guess import Series

_ASSUMED = 100.0
"""Assumed rate of rows without any information on their rate [Hz]."""
FEWEST = 8
"""Fewest samples of a signal."""


class Log(NamedTuple):
    """A flight for `new`."""

    path: str
    format: str
    series: Mapping[str, Series]
    time: TimeInfo | None
    """Clock of a table; None if topics have separate clocks."""
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
    time, notes, others = None, list[Finding](), ()
    if isinstance(opened, ArrayTable) and rate is None:
        # Arrays may have separate clocks, by their place in the file.
        opened = by_clocks(opened) or opened
    if isinstance(opened, tuple):
        opened, *others = opened
    if isinstance(opened, ChannelLog):
        if rate is not None:
            problem = "its topics have clocks of their own, expected no rate of rows to be stated"
            raise wrong(str(path), problem)
        log = opened
        if not any(topic.clock for topic in log.topics):
            problem = "its rows have no times, which a fit needs, expected a log with a"
            raise wrong(str(path), f"{problem} clock, of ArduPilot one with TimeUS")
    else:
        log, time, notes = _read_table(opened, rate)
    series = {
        name: Series(topic.times, without_marks(as_floats(values)), topic.units.get(name, ""))
        for topic in log.topics
        if topic.clock and topic.times.size >= FEWEST
        for name, values in topic.columns.items()
        if np.asarray(values).dtype.kind in "biuf" and _is_known(as_floats(values))
    }
    flight = log.flight[0] if others or log.flight[1] > 1 else None
    notes += [n for n in log.notes if n.code in (LEFT_OUT, "clock.runs")]
    autopilot = log if time is None else None
    return Log(
        str(path), log.format, series, time, flight, flight is not None, notes, autopilot=autopilot
    )


def _read_table(table: Table, rate: float | None) -> tuple[ChannelLog, TimeInfo, list[Finding]]:
    """Return the columns of a table, its clock, and notes on the clock."""
    info, notes = describe_table(table, None, None, rate), []
    if info.time is None:
        _require_whole_clock(table, info)
        notes.append(
            note("clock.not-found", f"{_without_time(info)}: state its samples per second")
        )
        # Only the user knows the number of samples a second; a guess needs only their order.
        info = describe_table(table, None, None, _ASSUMED)
    time = info.time
    assert time is not None
    if time.problem and time.column in table.names:
        # This error names the line and the remedy.
        require_increasing(table, time.column, table.numbers([time.column])[time.column])
    log = guessed_log(table, info)
    return log, dataclasses.replace(time, counted=math.nan) if notes else time, notes


def _require_whole_clock(table: Table, info: LogInfo) -> None:
    """Refuse a column of times with a few cells of text, such as means below the samples.

    With a stated rate such rows would be read as samples.
    """
    for c in info.columns:
        if c.strays and is_called_time(c.name):
            problem = f"column {shown(c.name)}: {c.strays}; expected times: delete such rows"
            raise wrong(table.path, f"{problem} (--time-rate counts every row as a sample)")


def _without_time(info: LogInfo) -> str:
    """Return why none of a table's columns is a time."""
    strays = next((f"; {shown(c.name)}: {c.strays}" for c in info.columns if c.strays), "")
    return f"no column is a time{strays}"


def _is_known(values: np.ndarray) -> bool:
    return int(np.sum(np.isfinite(values))) >= FEWEST
