"""The clock of a table: the column that a user names, a rate of its rows, or as the file shows it.

Rows, or counts of a column, are samples at a rate that is known. Where the time begins anew with
each run, or a column numbers them, the runs are put one after another with some seconds between, as
a gap, at which they become flights.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath

import numpy as np

from heli_jax import units
from heli_jax.errors import InputError, nearest
from heli_jax.finding import Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import not_increasing, shared_stamps, without_overflow
from heli_jax.flights.log import holds_commands
from heli_jax.flights.table import (
    Survey,
    Table,
    TableView,
    column,
    listed,
    require_columns,
    shown,
    wrong,
)
from heli_jax.flights.time_units import (
    LETTERS,
    SECONDS,
    TIME_NAMES,
    likely_unit,
    split_unit,
    time_unit,
)

ROWS = "row number"
"""what the numbers of rows are called, from 0, as a column"""
COUNTS_ROWS = "clock.counts-rows"
"""code of a column that might be taken for a clock"""
_SAMPLED = "timestamp_sample"
"""of a topic of PX4, beside `timestamp`, when it was published"""
_PACKETS = {"frame", "frames", "seq", "sequence", "index", "idx", "packet", "row", "iteration"}
"""counts of which only each second or tenth may be of the samples at hand, as where packets of
several sensors are counted together"""
_COUNTERS = {
    *("sample", "samples", "count", "counter", "id", "no", "nr", "number", "n", "tick", "axis"),
    *("line", *_PACKETS),
}
_OTHERS = {"freq", "freqs", "frequency", "frequencies", "hz", "distance", "dist", "address"}
"""what may increase along a table all the same, as the frequencies of a response"""
_STEPS, _RATES = {"ts", "dt", "tsample", "tsamp", "tsampling"}, {"fs", "hz"}
_OF_SAMPLES = {"sample", "samples", "sampling", "time"}
_STEP_WORDS, _RATE_WORDS = {"time", "step", "period", "interval"}, {"rate", "freq", "frequency"}
_OTHER_RATE = 0.01
"""by which a stated rate differs from that of the times at least: less is a clock's own error"""
_FASTEST, _SLOWEST = 1e5, 0.2
"""Hz: no record of a flight is outside of these"""
_BETWEEN = 10.0
"""s between two runs, which no gap that is bridged is long"""
_SHORTEST = 20
"""rows of a run"""
_BEGINNING = 0.1
"""part of the run before, in which the next begins: a stamp that goes back is no new run"""
_RUN_NAMES = {
    *("run", "runs", "segment", "seg", "maneuver", "manoeuvre", "experiment", "exp", "trial"),
    *("test", "record", "repetition", "rep", "case", "leg"),
}


# Which column it is.


def table_clock(
    table: Table,
    surveys: Sequence[Survey],
    time: str | Signal | None,
    unit: str | None,
    rate: float | None,
) -> tuple[Signal | None, bool, str]:
    """The clock, None without one, True if its unit or rate is a guess, and what the file says of
    its rate.

    Args:
        time: the column of time stamps, where it is stated.
        rate: samples a second [Hz], of rows or of what `time` counts.
    """
    said = ""
    if rate is not None:
        if not (rate > 0 and np.isfinite(rate)):
            raise wrong(table.path, f"expected a positive number of samples a second, got {rate:g}")
        name = time.name if isinstance(time, Signal) else time
        name = counter_of(surveys) if name is None else _asked(table, surveys, name).name
        return by_rate(rate, name), False, said
    if time is None:
        # A rate in the file goes before what merely increases, as a distance may.
        stated = stated_rate(surveys)
        signal, guessed = guess_clock(table, surveys, by_name=stated is not None)
        if signal is None and stated is not None:
            return by_rate(stated[0], counter_of(surveys)), True, stated[1]
    else:
        signal, guessed = _asked(table, surveys, time), False
    # A stated unit goes with whatever column is the clock, the guessed one too.
    if signal is not None and unit is not None:
        signal, guessed = _asked(table, surveys, Signal(signal.name, unit, "s")), False
    return signal, guessed, said


def guess_clock(
    table: Table, surveys: Sequence[Survey], by_name: bool = False
) -> tuple[Signal | None, bool]:
    """The clock, and True if its unit is a guess.

    Args:
        by_name: True if only a column that is called so is taken.
    """
    values = {s.name: s.values for s in reversed(surveys) if s.values is not None}
    numeric = [s.name for s in surveys if s.values is not None]
    increasing = [n for n in numeric if _increases(values[n])]
    # When a sample was taken, before when its message arrived: rostopic writes both. Then a name
    # decides before the numbers do: a counter or a distance may increase all along too.
    found = [n for n in increasing if _says_when_sampled(table, n)]
    found += [n for n in numeric if is_called_time(n) or table.time_unit(n)]
    # Those whose last word is one of time: flight_time could be a parameter, but for its steps.
    found += [n for n in increasing if TIME_NAMES & set(words_in(split_unit(n)[0])[-1:])]
    if not by_name:
        # Else the first column that increases all along is taken, but for numbers of rows. Of
        # arrays beside one another two limits are no clock of the hundreds of samples.
        increasing += [n for n in numeric if n not in increasing and restarts(values[n]).size]
        longest = max((x.size for x in values.values()), default=0)
        found += [
            n
            for n in increasing
            if values[n].size == longest
            and not (_counts(n, values[n]) or _OTHERS & set(words_in(n)))
        ]
    if not found:
        return None, False
    name = found[0]
    unit = table.time_unit(name) or split_unit(name)[1]
    # `ms` and `minutes` alone are names too; seconds are what clocks of any unit are called.
    alone = "" if name.casefold() in LETTERS else time_unit(name) or ""
    unit = unit or ("" if alone == "s" else alone)
    return Signal(name, unit or likely_unit(values[name]), "s"), not unit


def is_called_time(name: str) -> bool:
    """True for a column's name that is one of a clock."""
    stem, _ = split_unit(name)
    # Of a path, log.roll.time, the last part is the name; %time and __time are names of tools.
    return re.split(r"[./]", stem)[-1].strip("%_ ").casefold() in TIME_NAMES


def _says_when_sampled(table: Table, name: str) -> bool:
    """True for a clock that goes before all others, since it is that of the samples themselves:
    field.header.stamp, timestamp_sample."""
    *_, last = path = tuple(re.split(r"[./]", name.casefold()))
    if last != _SAMPLED:
        return path[-2:] == ("header", "stamp")
    # `convert` has put the clock of the topic beside what it copied. And a command acts from when
    # it was published, 0.4 to 3 ms behind the gyro's sample: by the topic before the column
    # (`/actuator_motors/timestamp_sample`) or by the name of the file, as ulog2csv gives it.
    topic = re.split(r"[./]", name)[-2:-1]
    commands = holds_commands(topic[0] if any(topic) else PurePath(table.path).name)
    return "time" not in table.names and not commands


def _increases(values: np.ndarray) -> bool:
    return values.size > 1 and bool(np.all(values[1:] > values[:-1]))


def _counts(name: str, values: np.ndarray) -> bool:
    """True for whole numbers that count rows or frames, one by one, by name too: a log at a sample
    a second has such times. Numbers of packets do so whatever their steps."""
    if not _is_counter_name(name) or not np.all(values == np.rint(values)):
        return False
    return bool(_PACKETS & set(words_in(name))) or bool(np.all(np.diff(values) == 1.0))


def _is_counter_name(name: str) -> bool:
    """True for the name of a counter, or none: of a matrix, or of a text without names."""
    is_numbered = not name or name.endswith("]") or re.fullmatch(r"column\d+", name) is not None
    return is_numbered or bool(_COUNTERS & set(words_in(name)))


def counter_of(surveys: Sequence[Survey]) -> str | None:
    """The column that counts rows or frames, some of which may be lost; None without one."""
    return next(
        (
            s.name
            for s in surveys
            if s.values is not None
            and _is_counter_name(s.name)
            and _increases(s.values)
            and np.all(s.values == np.rint(s.values))
            and float(np.median(np.diff(s.values))) == 1.0
        ),
        None,
    )


def counter_notes(surveys: Sequence[Survey]) -> tuple[Finding, ...]:
    """A note on a column that might be taken for a clock and counts rows, where one does."""
    name = counter_of(surveys)
    if name is None:
        return ()
    return (note(COUNTS_ROWS, f"{shown(name)} counts rows and is taken for no time", name),)


def _asked(table: Table, surveys: Sequence[Survey], time: str | Signal) -> Signal:
    """A column of times as a user names it."""
    signal = Signal(time, "s", "s") if isinstance(time, str) else time
    require_columns(table.path, table.names, [signal.name])
    if all(s.values is None for s in surveys if s.name == signal.name):
        raise wrong(table.path, "holds text, expected times", column(signal.name))
    if signal.unit not in SECONDS:
        try:
            units.factor(signal.unit, "s")
        except ValueError as e:
            # Of the units of time alone: the nearest of all units may be one of capacity.
            hint = nearest(signal.unit, SECONDS)
            known = units.is_unit(signal.unit)
            problem = str(e) if known else f"unknown unit of time {shown(signal.unit)}{hint}"
            raise wrong(table.path, problem, column(signal.name)) from e
    return signal


# What its stamps are.


def clock_scale(table: Table, time: Signal) -> float:
    """Return the size of a clock's unit or count [s]."""
    if time.scale != 1.0:
        return time.scale
    # A column of time stamps says by its type what its ticks are, whatever the user thinks.
    return units.factor(table.time_unit(time.name) or time.unit, "s")


def unit_notes(time: Signal, stated: str | None) -> tuple[Finding, ...]:
    """A note where the file, or the name of its clock, says another unit than the configuration."""
    named, factor = split_unit(time.name)[1], units.factor(time.unit, "s")
    other = stated or named
    if not other or math.isclose(units.factor(other, "s"), factor):
        return ()
    if stated:
        words = f"taken in {stated}, as the file says, and not in {time.unit}"
    else:
        words = f"taken in {time.unit}, though its name says {named}: if that is right, state"
        words += f" unit: {named} beside it"
    return (note("units.contradicted", f"time: {shown(time.name)} is {words}"),)


def require_increasing(table: Table, name: str, stamps: np.ndarray) -> None:
    """Refuse a clock of which a stamp is not later than the one before it."""
    back = not_increasing(stamps)
    if back is None:
        return
    row, fault = back
    after, now = table.cell_text(name, row - 1), table.cell_text(name, row)
    problem = f"the time {fault}, got {now} after {after}, expected increasing times"
    # Where the one before is left out the times go on: it is the wrong one.
    if row > 1 and stamps[row - 2] < stamps[row] < stamps[row - 1]:
        remedy = f"{table.place(row - 1)} is out of order with those around it: leave it out"
    elif (starts := restarts(stamps)).size:
        runs = f"{starts.size + 1} runs in one file"
        remedy = f"there are {runs}: gaps: split beside log: makes a flight of each"
    else:
        remedy = shared_stamps(stamps) or "sort the rows by time, or leave out those that go back"
    raise wrong(table.path, f"{problem}; {remedy}", table.place(row), column(name))


# Rates in place of times.


def by_rate(rate: float, counter: str | None = None) -> Signal:
    """The clock of rows that were sampled at a rate [Hz], or of a column that counts samples."""
    return Signal(counter or ROWS, "s", "s", scale=1.0 / rate)


def counted(table: Table) -> Table:
    """A table of which the numbers of the rows can be asked for as a column, `ROWS`."""
    return TableView(table, columns={ROWS: None})


def stated_rate(surveys: Sequence[Survey]) -> tuple[float, str] | None:
    """The rate [Hz] that a file states in a single number beside its samples (`Ts`, `dt`, `fs`),
    and what says so; None where there is none, or are several."""
    rates: dict[float, str] = {}
    for each in surveys:
        if each.values is not None:
            for rate, words in _rate_of(each.name, each.values).items():
                rates.setdefault(rate, words)
    if len(rates) != 1:
        return None
    rate, words = next(iter(rates.items()))
    # 1/0.02 is 50 in numbers of the vehicle, 1/0.033 is what it is.
    near = round(rate, 6)
    return (near if math.isclose(rate, near, rel_tol=1e-9) else rate), words


def contradicted_rate(table: Table, clock: str, rate: float) -> tuple[Finding, ...]:
    """A caution for each rate that a file states and that is neither that of its times [Hz] nor a
    whole multiple, of which every second or tenth sample may have been logged."""
    if not (math.isfinite(rate) and rate > 0):
        return ()
    stated: dict[float, str] = {}
    for name in table.names:
        # Of another clock than this one its path tells.
        if _is_step(name) is not None and _group(name) == _group(clock):
            try:
                stated |= _rate_of(name, table.numbers([name])[name])
            except InputError:
                continue
    return tuple(
        Finding(
            "clock.rate-contradicted",
            "doubt",
            f"the file states {other:.6g} Hz ({words}), and its times {shown(clock)} are at "
            f"{rate:.6g} Hz: one of the two clocks is wrong, and rates that follow from it are off "
            f"by {abs(other / rate - 1):.0%}.",
            other / rate,
            f"stated rate over that of the times, whole numbers to {_OTHER_RATE:g}",
        )
        for other, words in stated.items()
        if abs(other / rate / max(round(other / rate), 1) - 1.0) > _OTHER_RATE
    )


def _group(name: str) -> str:
    return re.split(r"[./][^./]*$", name)[0] if re.search(r"[./]", name) else ""


def _rate_of(name: str, values: np.ndarray) -> dict[float, str]:
    """The rate [Hz] that a column (N,) of a single number states, one that stands in the first row
    alone or in each, and what says so; empty of others."""
    step, values = _is_step(name), values[np.isfinite(values)]
    if step is None or not values.size or np.ptp(values) > 0 or values[0] <= 0:
        return {}
    rate = 1.0 / float(values[0]) if step else float(values[0])
    return {rate: f"{shown(name)} = {values[0]:g}"} if _SLOWEST <= rate <= _FASTEST else {}


def _is_step(name: str) -> bool | None:
    """True for the name of a time step, False of a rate, None of anything else."""
    words = words_in(name.rpartition(".")[2].rpartition("/")[2])
    joined, first, last = "".join(words), words[:1], words[-1:]
    if len(words) == 2:
        if first[0] in (*_OF_SAMPLES, "delta") and last[0] in _STEP_WORDS:
            return True
        if first[0] in _OF_SAMPLES and last[0] in _RATE_WORDS:
            return False
    return True if joined in _STEPS else False if joined in _RATES else None


# Several runs in one table.


def restarts(stamps: np.ndarray) -> np.ndarray:
    """The rows (n,) in which the time begins anew; none where it only goes back here or there."""
    none = np.zeros(0, int)
    if stamps.size < 2 * _SHORTEST or not np.isfinite(stamps).all():
        return none
    stamps = without_overflow(stamps)
    steps = np.diff(stamps)
    # A stick that steps stands still in between.
    if np.any(steps == 0):
        return none
    falls = np.flatnonzero(steps < 0) + 1
    bounds = np.concatenate([[0], falls, [stamps.size]])
    if not falls.size or np.diff(bounds).min() < _SHORTEST:
        return none
    # Without one row the clock goes on: that stamp is wrong, and nothing begins.
    if np.any((stamps[falls] > stamps[falls - 2]) | (stamps[falls + 1] > stamps[falls - 1])):
        return none
    first, last = stamps[bounds[:-2]], stamps[falls - 1]
    anew = stamps[falls] <= first + _BEGINNING * (last - first)
    return falls if anew.all() else none


def _changes(numbers: np.ndarray) -> np.ndarray:
    """The rows (n,) in which the number of a run is another than in the row before."""
    return np.flatnonzero(np.diff(numbers) != 0) + 1


def with_runs(
    table: Table, clock: str, numbers: Mapping[str, np.ndarray], scale: float, column: str = ""
) -> Table:
    """A table whose runs follow one another; as it is where it holds one.

    Args:
        numbers: that column (N,), and the one that numbers runs.
        scale: [s] of a unit of the stamps.
        column: that numbers runs; without one they begin where the time does.
    """
    stamps = numbers[clock]
    starts = _changes(numbers[column]) if column else restarts(stamps)
    if not starts.size:
        return table
    apart = stamps.copy()
    for start in starts:
        apart[start:] += apart[start - 1] - apart[start] + _BETWEEN / scale
    places = listed(table.place(int(start)) for start in starts)
    why = f"{shown(column)} is another" if column else "the time begins anew"
    words = (
        f"{why} in {places}: {starts.size + 1} runs, put one after another with "
        f"{_BETWEEN:g} s between"
    )
    said = note("clock.runs", words, value=starts.size + 1)
    return TableView(table, columns={clock: apart}, note=said)


def numbering(surveys: Sequence[Survey]) -> str:
    """The column that numbers runs, by its name and numbers; empty without one."""
    for each in surveys:
        values = each.values
        if values is None or not _RUN_NAMES & set(words_in(each.name)):
            continue
        if not np.isfinite(values).all() or np.any(values != np.rint(values)):
            continue
        bounds = np.concatenate([[0], _changes(values), [values.size]])
        if bounds.size > 2 and np.all(np.diff(values) >= 0) and np.diff(bounds).min() >= _SHORTEST:
            return each.name
    return ""


def numbering_notes(column: str) -> tuple[Finding, ...]:
    """A note on a column that numbers runs, where one does."""
    remedy = f"time: {{..., runs: {column}}} in a configuration makes a flight of each"
    words = f"{shown(column)} seems to number runs, which the time does not part: {remedy}"
    return (note("clock.runs-numbered", words, column),)
