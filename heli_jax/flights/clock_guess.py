"""The clock of a table: as a user states it, as the file does, or as its columns look; and what is
wrong with its times, in words."""

import math
import re
from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from heli_jax import units
from heli_jax.errors import nearest
from heli_jax.finding import Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import not_increasing, shared_stamps
from heli_jax.flights.log import holds_commands
from heli_jax.flights.row_clock import by_rate, restarts, stated_rate
from heli_jax.flights.table import Survey, Table, column, require_columns, shown, wrong
from heli_jax.flights.time_units import LETTERS, SECONDS, likely_unit, split_unit, time_unit

TIME_NAMES = {
    "zeit",
    "temps",
    "t",
    "time",
    "timestamp",
    "timestamps",
    "seconds",
    "sec",
    "elapsed",
    "clock",
}
COUNTS_ROWS = "clock.counts-rows"
"""code of a column that might be taken for a clock"""
_STAMP = ("header", "stamp")
_SAMPLED = "timestamp_sample"
"""of a topic of PX4, beside `timestamp`, when it was published"""
_COUNTERS = {
    *(
        "frame",
        "frames",
        "seq",
        "sequence",
        "index",
        "idx",
        "sample",
        "samples",
        "count",
        "counter",
    ),
    *("row", "iteration", "id", "no", "nr", "number", "n", "packet", "tick", "axis", "line"),
}
_OTHERS = {"freq", "freqs", "frequency", "frequencies", "hz", "distance", "dist", "address"}
"""what may increase along a table all the same, as the frequencies of a response"""
_NO_TIMES = {"frame", "frames", "seq", "sequence", "index", "idx", "packet", "row", "iteration"}
"""of which only each second or tenth may be of the samples at hand, as where packets of several
sensors are counted together: a count all the same"""


def guess_clock(
    table: Table, surveys: Sequence[Survey], by_name: bool = False
) -> tuple[Signal | None, bool]:
    """The clock, and whether its unit is a guess.

    Args:
        by_name: whether only one that is called so is taken.
    """
    values = {s.name: s.values for s in reversed(surveys) if s.values is not None}
    numeric = [s.name for s in surveys if s.values is not None]
    # When a sample was taken, before when its message arrived: rostopic writes both.
    for name in numeric:
        if _says_when_sampled(table, name) and _increases(values[name]):
            return _with_unit(table, name, values[name])
    # A name decides before the numbers do: a counter or a distance may increase all along too.
    for name in numeric:
        if is_called_time(name) or table.time_unit(name):
            return _with_unit(table, name, values[name])
    increasing = [n for n in numeric if _increases(values[n])]
    # Those whose last word is one of time: flight_time could be a parameter, but for its steps.
    named = [n for n in increasing if TIME_NAMES & set(words_in(split_unit(n)[0])[-1:])]
    # Without a name to go by, the first column that increases all along is taken, but for numbers
    # of rows. The result names it, so that a wrong guess is seen.
    increasing += [n for n in numeric if n not in increasing and restarts(values[n]).size]
    # Of arrays beside one another two limits are no clock of the hundreds of samples.
    longest = max((x.size for x in values.values()), default=0)
    others = [
        n
        for n in increasing
        if not by_name
        and values[n].size == longest
        and not (_counts(n, values[n]) or _OTHERS & set(words_in(n)))
    ]
    for name in (*named, *others):
        return _with_unit(table, name, values[name])
    return None, False


def is_called_time(name: str) -> bool:
    """Whether a column's name is one of a clock."""
    stem, _ = split_unit(name)
    # Of a path, log.roll.time, the last part is the name; %time and __time are names of tools.
    return re.split(r"[./]", stem)[-1].strip("%_ ").casefold() in TIME_NAMES


def _says_when_sampled(table: Table, name: str) -> bool:
    """True for a clock that goes before all others, since it is that of the samples themselves:
    field.header.stamp, timestamp_sample."""
    *_, last = path = tuple(re.split(r"[./]", name.casefold()))
    if last != _SAMPLED:
        return path[-2:] == _STAMP
    # `convert` has put the clock of the topic beside what it copied. And a command acts from when
    # it was published, 0.4 to 3 ms behind the gyro's sample: by the topic before the column
    # (`/actuator_motors/timestamp_sample`) or by the name of the file, as ulog2csv gives it.
    topic = re.split(r"[./]", name)[-2:-1]
    commands = holds_commands(topic[0] if any(topic) else PurePath(table.path).name)
    return "time" not in table.names and not commands


def counter_notes(surveys: Sequence[Survey]) -> tuple[Finding, ...]:
    """That a column which might be taken for a clock counts rows, where one does.

    Args:
        surveys: of a table's columns, none of which is a clock.
    """
    name = counter_of(surveys)
    if name is None:
        return ()
    return (note(COUNTS_ROWS, f"{shown(name)} counts rows and is taken for no time", name),)


def counter_of(surveys: Sequence[Survey]) -> str | None:
    """The column that counts rows or frames, some of which may be lost; None without one."""
    with_numbers = [(s.name, s.values) for s in surveys if s.values is not None]
    return next((n for n, x in with_numbers if _increases(x) and _is_counter(n, x)), None)


def _is_counter(name: str, values: np.ndarray) -> bool:
    whole = bool(np.all(values == np.rint(values)))
    return whole and _by_name(name) and float(np.median(np.diff(values))) == 1.0


def _increases(values: np.ndarray) -> bool:
    return values.size > 1 and bool(np.all(values[1:] > values[:-1]))


def _counts(name: str, values: np.ndarray) -> bool:
    """Whether whole numbers count rows or frames, one by one, by name too: a log at a sample a
    second has such times. Numbers of packets do so whatever their steps."""
    if not _by_name(name) or not np.all(values == np.rint(values)):
        return False
    return bool(_NO_TIMES & set(words_in(name))) or bool(np.all(np.diff(values) == 1.0))


def _by_name(name: str) -> bool:
    """Whether a name is that of a counter, or none: of a matrix, or of a text without names."""
    is_numbered = not name or name.endswith("]") or re.fullmatch(r"column\d+", name) is not None
    return is_numbered or bool(_COUNTERS & set(words_in(name)))


def _unit_alone(name: str) -> str:
    """The unit of time that is all of a name, as `ms` and `minutes`; empty of seconds, which clocks
    of any unit are called."""
    unit = time_unit(name) or ""
    return "" if unit == "s" or name.casefold() in LETTERS else unit


def _with_unit(table: Table, name: str, stamps: np.ndarray) -> tuple[Signal, bool]:
    stated = table.time_unit(name) or split_unit(name)[1] or _unit_alone(name)
    if stated:
        return Signal(name, stated, "s"), False
    return Signal(name, likely_unit(stamps), "s"), True


def table_clock(
    table: Table,
    surveys: Sequence[Survey],
    time: str | Signal | None,
    unit: str | None,
    rate: float | None,
) -> tuple[Signal | None, bool, str]:
    """The clock, None without one, whether its unit or rate is a guess, and what the file says of
    its rate.

    Args:
        time: the column of time stamps, where it is stated.
        rate: samples a second [Hz], of rows or of what `time` counts.

    Raises:
        InputError: there is no such column, or the unit or the rate is none.
    """
    said = ""
    if rate is not None:
        if not (rate > 0 and np.isfinite(rate)):
            raise wrong(table.path, f"expected a positive number of samples a second, got {rate:g}")
        name = time.name if isinstance(time, Signal) else time
        name = counter_of(surveys) if name is None else asked_time(table, surveys, name).name
        signal, guessed, unit = by_rate(rate, name), False, None
    elif time is None:
        # A rate in the file goes before what merely increases, as a distance may.
        stated = stated_rate(surveys)
        signal, guessed = guess_clock(table, surveys, by_name=stated is not None)
        if signal is None and stated is not None:
            (clock, said), unit = stated, None
            signal, guessed = by_rate(clock, counter_of(surveys)), True
    else:
        signal, guessed = asked_time(table, surveys, time), False
    # A stated unit goes with whatever column is the clock, the guessed one too: then nothing is a
    # guess.
    if signal is not None and unit is not None:
        signal, guessed = asked_time(table, surveys, Signal(signal.name, unit, "s")), False
    return signal, guessed, said


def asked_time(table: Table, surveys: Sequence[Survey], time: str | Signal) -> Signal:
    """A column of times as a user names it.

    Raises:
        InputError: there is none, or its unit is none of time.
    """
    signal = Signal(time, "s", "s") if isinstance(time, str) else time
    require_columns(table.path, table.names, [signal.name])
    if all(s.values is None for s in surveys if s.name == signal.name):
        raise wrong(table.path, "holds text, expected times", column(signal.name))
    if signal.unit not in SECONDS:
        if not units.is_unit(signal.unit):
            # Of the units of time alone: the nearest of all units may be one of capacity.
            problem = f"unknown unit of time {shown(signal.unit)}{nearest(signal.unit, SECONDS)}"
            raise wrong(table.path, problem, column(signal.name))
        try:
            units.factor(signal.unit, "s")
        except ValueError as e:
            raise wrong(table.path, str(e), column(signal.name)) from e
    return signal


def unit_notes(time: Signal, stated: str | None) -> tuple[Finding, ...]:
    """A note where the file, or the name of its clock, says another unit than the configuration."""
    named = split_unit(time.name)[1]
    factor = units.factor(time.unit, "s")
    if stated and not math.isclose(units.factor(stated, "s"), factor):
        words = f"time: {shown(time.name)} is taken in {stated}, as the file says"
        return (note("units.contradicted", f"{words}, and not in {time.unit}"),)
    if not stated and named and not math.isclose(units.factor(named, "s"), factor):
        words = f"time: {shown(time.name)} is taken in {time.unit}, though its name says {named}"
        words += f": if that is right, state unit: {named} beside it"
        return (note("units.contradicted", words),)
    return ()


def require_increasing(table: Table, name: str, stamps: np.ndarray) -> None:
    """Refuse a clock of which a stamp is not later than the one before it."""
    back = not_increasing(stamps)
    if back is None:
        return
    row, fault = back
    after, now = table.cell_text(name, row - 1), table.cell_text(name, row)
    problem = f"the time {fault}, got {now} after {after}, expected increasing times"
    words = f"{problem}; {_remedy(table, stamps, row)}"
    raise wrong(table.path, words, table.place(row), column(name))


def _remedy(table: Table, stamps: np.ndarray, row: int) -> str:
    """What to do about a stamp that is not later than the one before it, in words."""
    # Where the one before is left out the times go on: it is the wrong one.
    if row > 1 and stamps[row - 2] < stamps[row] and stamps[row] < stamps[row - 1]:
        return f"{table.place(row - 1)} is out of order with those around it: leave it out"
    if (starts := restarts(stamps)).size:
        runs = f"{starts.size + 1} runs in one file"
        return f"there are {runs}: gaps: split beside log: makes a flight of each"
    return shared_stamps(stamps) or "sort the rows by time, or leave out those that go back"
