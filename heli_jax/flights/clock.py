"""Clock of a table: the column that a user names, a rate of the rows, or a guess from the file.

Rows, or counts in a column, may be samples at a known rate. Several runs in a table are put one
after another with some seconds between. A time that begins anew or a column of numbers separates
them. The gaps then split them into flights.
"""

import datetime
import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax import units
from heli_jax.errors import nearest
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import not_increasing, without_overflow
from heli_jax.flights.log import (
    Survey,
    Table,
    column,
    listed,
    require_columns,
    shown,
    wrong,
)

ROWS = "row number"
"""Name of the column of row numbers, from 0."""
_BETWEEN = 10.0
"""Time between two runs [s], longer than any gap that is bridged."""
_SHORTEST = 20
"""Fewest rows of a run."""
_BEGINNING = 0.1
"""First part of the previous run in which the next must begin. A later step back is no new run."""


# Units of time, in words or at the end of a name.

TIME_NAMES = {
    *("t", "time", "timestamp", "timestamps", "seconds", "sec", "elapsed", "clock"),
    *("zeit", "temps", "tempo", "tiempo"),
}
"""Words in the names of clocks."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0}
"""Size of the units of clocks [s]; pint knows all units but takes 0.25 s to load."""
_WORDS = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds"),
    "us": ("us", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds"),
    "ns": ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"),
    "min": ("min", "mins", "minute", "minutes"),
    "h": ("h", "hr", "hrs", "hour", "hours"),
    "day": ("d", "day", "days"),
}
_UNITS = {word: unit for unit, words in _WORDS.items() for word in words}
# A unit follows a name as time_ms, 'time ms', time[ms] or time(ms). The group records an opened
# bracket, which must be closed.
_AT_END = re.compile(r"^(.*?)\s*(?:_|\s|(?P<open>[\[(]))([^\W\d_]+)(?(open)[\])])$")
# TimeUS, timestampMs: joined by a capital alone.
_JOINED = re.compile(r"^(.*(?:[Tt]ime|[Ss]tamp|TIME))(US|Us|MS|Ms|NS|Ns|Sec|Secs|S)$")
_SINCE = re.compile(r"\s+since\s+\S", re.IGNORECASE)
"""Reference time in 'days since 2024-03-01', the CF conventions' unit of a clock."""
LETTERS = ("h", "d")
"""Ambiguous units, accepted only in brackets: pos_d is a position down."""
_SLOWEST_STEP = 5.0
"""Longest usual step of a flight [s]."""
_LONGEST_FLIGHT, _LONGEST_SLOW = 6 * 3600.0, 2 * 3600.0
"""Longest flight, and longest flight of a slow log [s]. A longer one indicates the next smaller
unit: 20 s at 1 kHz in ms would be hours at 1 Hz in s."""


def time_unit(text: str) -> str | None:
    """Return the unit of time in a text: `ms` for Milliseconds, msec and Ms; None for others.

    Capitals are ignored: nobody logs megaseconds.
    """
    # The epoch does not matter: times count from the first sample.
    text = _SINCE.split(text, maxsplit=1)[0]
    # The micro sign, and the Greek letter that looks the same.
    word = text.strip().casefold().replace("µ", "u").replace("μ", "u")
    return _UNITS.get(word)


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without the unit of time at its end, and the unit, empty if none."""
    match = _AT_END.fullmatch(name)
    if match is None and (joined := _JOINED.fullmatch(name)):
        return joined[1], time_unit(joined[2]) or ""
    unit = time_unit(match[3]) if match else None
    if match and unit and not match["open"] and match[3].casefold() in LETTERS:
        return name, ""
    return (match[1], unit) if match and unit else (name, "")


def likely_unit(stamps: np.ndarray | None) -> str:
    """Return the likely unit of stamps (N,) from their usual step and their length.

    No flight has a step of 5 s or lasts a day.
    """
    if stamps is None or stamps.size < 2:
        return "s"
    with np.errstate(all="ignore"):
        step = float(np.median(np.diff(stamps)))
        length = float(stamps[-1] - stamps[0])
    # From the coarsest unit on, take the first whose usual step is plausible for a log.
    for unit, most, slow in (("s", _SLOWEST_STEP, 0.5), ("ms", 1e3, 100.0), ("us", 1e6, np.inf)):
        longest = _LONGEST_SLOW if step >= slow else _LONGEST_FLIGHT
        # No common clock counts finer parts of a second.
        whole = unit == "ms" or step >= slow
        if not step >= most and not (whole and length * SECONDS[unit] > longest):
            return unit
    return "ns"


# Dates of ISO 8601, and times of day.

_ISO = re.compile(r"\d{4}[-/]\d\d[-/]\d\d[T ,]+\d\d:\d\d(?::\d\d.*)?")
_TIME_OF_DAY = re.compile(r"(\d{1,3}):(\d\d):(\d\d(?:[.,]\d{1,12})?)")
_LONGEST_TIME = 60
"""Longest text of a time; a damaged file may have one cell as long as the file."""


def is_date(cell: str) -> bool:
    """True for a date with a time of day, or a time of day."""
    return len(cell) <= _LONGEST_TIME and _form_of(cell) is not None


def seconds_of_dates(cells: Sequence[str | None]) -> np.ndarray | int:
    """Return seconds (N,) from the first midnight, NaN where a cell is empty.

    Times of day continue after midnight. All cells must have one form, and all dates or none an
    offset from UTC.

    Returns:
        The seconds, or the row of the first cell that is no such date.
    """
    filled = [i for i, cell in enumerate(cells) if cell is not None]
    values = np.full(len(cells), np.nan)
    if not filled:
        return values
    form = _form_of(cells[filled[0]] or "")
    begin = None
    for i in filled:
        cell = cells[i] or ""
        if form is None or len(cell) > _LONGEST_TIME or _form_of(cell) is not form:
            return i
        try:
            if form is _TIME_OF_DAY:
                hours, minutes, seconds = cell.replace(",", ".").split(":")
                values[i] = 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds)
                continue
            date = _date(cell)
            begin = begin or date.replace(hour=0, minute=0, second=0, microsecond=0)
            values[i] = (date - begin).total_seconds()
        # TypeError: dates with an offset from UTC cannot be compared with dates without.
        except (ValueError, TypeError, OverflowError):
            return i
    if form is _TIME_OF_DAY:
        day = SECONDS["day"]
        falls = np.diff(values[filled]) < -0.5 * day
        values[filled] += np.cumsum(np.r_[0.0, np.where(falls, day, 0.0)])
    return values


def _form_of(cell: str) -> re.Pattern[str] | None:
    return next((form for form in (_ISO, _TIME_OF_DAY) if form.fullmatch(cell)), None)


def _date(cell: str) -> datetime.datetime:
    text = cell.replace("/", "-").removesuffix(" UTC").removesuffix(" GMT")
    return datetime.datetime.fromisoformat(re.sub("[ ,]+", "T", text, count=1))


# Choice of the column.


def table_clock(
    table: Table,
    surveys: Sequence[Survey],
    time: str | Signal | None,
    unit: str | None,
    rate: float | None,
) -> tuple[Signal | None, bool]:
    """Return the clock, None without one, and True if its unit is a guess.

    Args:
        surveys: surveys of its columns.
        time: column of time stamps, if stated.
        unit: unit of the time stamps, if stated.
        rate: samples a second [Hz], of rows or of the counts in `time`.
    """
    if rate is not None:
        if not (rate > 0 and np.isfinite(rate)):
            raise wrong(table.path, f"expected a positive number of samples a second, got {rate:g}")
        name = time.name if isinstance(time, Signal) else time
        return by_rate(rate, name and _asked(table, surveys, name).name), False
    signal, guessed = guess_clock(table, surveys)
    if time is not None:
        signal, guessed = _asked(table, surveys, time), False
    # A stated unit also applies to a guessed column.
    if signal is not None and unit is not None:
        signal, guessed = _asked(table, surveys, Signal(signal.name, unit, "s")), False
    return signal, guessed


def guess_clock(table: Table, surveys: Sequence[Survey]) -> tuple[Signal | None, bool]:
    """Return the clock by the names of columns, and True if its unit is a guess."""
    values = {s.name: s.values for s in reversed(surveys) if s.values is not None}
    numeric = [s.name for s in surveys if s.values is not None]
    found = [n for n in numeric if is_called_time(n) or table.time_unit(n)]
    # Names whose last word means time must also increase: flight_time could be a parameter.
    found += [
        n
        for n in numeric
        if TIME_NAMES & set(words_in(split_unit(n)[0])[-1:])
        and values[n].size > 1
        and np.all(values[n][1:] > values[n][:-1])
    ]
    if not found:
        return None, False
    name = found[0]
    unit = table.time_unit(name) or split_unit(name)[1]
    # `ms` and `minutes` are also names of columns; clocks of any unit are called seconds.
    alone = time_unit(name) or ""
    unit = unit or ("" if alone == "s" else alone)
    return Signal(name, unit or likely_unit(values[name]), "s"), not unit


def is_called_time(name: str) -> bool:
    """True if a column's name is that of a clock or a unit of time."""
    # In a path such as log.roll.time, the last part is the name. %time and __time are names of
    # tools.
    leaf = re.split(r"[./]", split_unit(name)[0])[-1].strip("%_ ").casefold()
    return leaf in TIME_NAMES or (len(leaf) > 1 and time_unit(leaf) is not None)


def words_in(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case, as of rollRate, roll_rate and `Roll Rate`."""
    apart = re.sub(r"([a-z0-9])([A-Z])|([A-Z])(?=[A-Z][a-z])", r"\1\3 \2", name)
    # ch1, rc2in: a number is no part of a word.
    return tuple(w for w in re.split(r"[^a-z]+", apart.lower()) if w)


def _asked(table: Table, surveys: Sequence[Survey], time: str | Signal) -> Signal:
    """Return a column of times as the user names it."""
    signal = Signal(time, "s", "s") if isinstance(time, str) else time
    require_columns(table.path, table.names, [signal.name])
    if all(s.values is None for s in surveys if s.name == signal.name):
        raise wrong(
            table.path,
            "holds text, expected seconds or times such as 2024-03-01T23:59:55.01",
            column(signal.name),
        )
    if signal.unit not in SECONDS:
        try:
            units.factor(signal.unit, "s")
        except ValueError as e:
            # Suggest units of time only: the nearest of all units may be one of capacity.
            hint = nearest(signal.unit, SECONDS)
            known = units.is_unit(signal.unit)
            problem = str(e) if known else f"unknown unit of time {shown(signal.unit)}{hint}"
            raise wrong(table.path, problem, column(signal.name)) from e
    return signal


# Stamps.


def clock_scale(table: Table, time: Signal) -> float:
    """Return the size of a clock's unit or count [s]."""
    if time.scale != 1.0:
        return time.scale
    # The type of a time-stamp column defines its ticks and overrides a stated unit.
    return units.factor(table.time_unit(time.name) or time.unit, "s")


def unit_notes(time: Signal, stated: str | None) -> tuple[Finding, ...]:
    """Return a note if the file or the clock's name contradicts the configured unit."""
    named, factor = split_unit(time.name)[1], units.factor(time.unit, "s")
    other = stated or named
    if not other or math.isclose(units.factor(other, "s"), factor):
        return ()
    if stated:
        words = f"taken in {stated}, as the file states, not in {time.unit}"
    else:
        words = f"taken in {time.unit}, though its name states {named}; if the name is right, state"
        words += f" unit: {named} beside it"
    return (note("units.contradicted", f"time: {shown(time.name)} is {words}"),)


def require_increasing(table: Table, name: str, stamps: np.ndarray) -> None:
    """Refuse a clock with a stamp that is not later than the one before."""
    if (back := not_increasing(stamps)) is None:
        return
    row, fault = back
    after, now = table.cell_text(name, row - 1), table.cell_text(name, row)
    problem = f"the time {fault}, got {now} after {after}, expected increasing times"
    if (starts := restarts(stamps)).size:
        remedy = f"the file holds {starts.size + 1} runs: gaps: split makes a flight of each"
    else:
        remedy = "delete rows that go back or were written twice, log time with more digits, or "
        remedy += "state the rate (time: {rate: HZ})"
    raise wrong(table.path, f"{problem}; {remedy}", table.place(row), column(name))


def require_likely(path: str, time: Signal, stamps: np.ndarray) -> None:
    """Refuse stamps (N,) in seconds that are plausible only in another unit.

    This applies if their name states that unit, or if seconds were not stated.
    """
    named, likely = split_unit(time.name)[1], likely_unit(stamps)
    if time.unit != "s" or likely == "s" or not (named == likely or time.assumed):
        return
    step, length = float(np.median(np.diff(stamps))), float(stamps[-1] - stamps[0])
    problem = f"in s its stamps are {step:.4g} s apart over {length:.4g} s: they look like {likely}"
    why = f", as its name states {named}" if named == likely else ""
    remedy = f"expected its unit: {{signal: {time.name}, unit: {likely}}}"
    if named != likely:
        remedy += ", or unit: s if it is that slow"
    raise wrong(path, f"{problem}{why}; {remedy}", column(time.name))


# Rates in place of times.


def by_rate(rate: float, counter: str | None = None) -> Signal:
    """Return the clock of rows sampled at a rate [Hz], or of a column that counts samples."""
    return Signal(counter or ROWS, "s", "s", scale=1.0 / rate)


def columns_of(table: Table, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return columns of a table as float64 (N,), `ROWS` as its row numbers from 0."""
    own = [name for name in names if name != ROWS] or [table.names[0]]
    columns = table.numbers(list(dict.fromkeys(own)))
    columns[ROWS] = np.arange(columns[own[0]].size, dtype=np.float64)
    return {name: columns[name] for name in names}


# Several runs in one table.


def restarts(stamps: np.ndarray) -> np.ndarray:
    """Return the rows (n,) at which the time begins anew; none if it only steps back at times."""
    none = np.zeros(0, int)
    if stamps.size < 2 * _SHORTEST or not np.isfinite(stamps).all():
        return none
    stamps = without_overflow(stamps)
    steps = np.diff(stamps)
    # A stick that steps also has equal values.
    if np.any(steps == 0):
        return none
    falls = np.flatnonzero(steps < 0) + 1
    bounds = np.concatenate([[0], falls, [stamps.size]])
    if not falls.size or np.diff(bounds).min() < _SHORTEST:
        return none
    # If the clock continues without one row, that stamp is wrong and no run begins.
    if np.any((stamps[falls] > stamps[falls - 2]) | (stamps[falls + 1] > stamps[falls - 1])):
        return none
    first, last = stamps[bounds[:-2]], stamps[falls - 1]
    anew = stamps[falls] <= first + _BEGINNING * (last - first)
    return falls if anew.all() else none


def with_runs(
    table: Table, clock: str, columns: Mapping[str, np.ndarray], scale: float, runs: str = ""
) -> tuple[dict[str, np.ndarray], tuple[Finding, ...]]:
    """Return the columns (N,) with runs one after another on the clock, and a note.

    The columns are unchanged if the table has only one run.

    Args:
        clock: name of the clock.
        columns: columns of the table, with the clock.
        scale: unit of the stamps [s].
        runs: column that numbers runs; without one they begin where the time does.
    """
    stamps = columns[clock]
    starts = np.flatnonzero(np.diff(columns[runs])) + 1 if runs else restarts(stamps)
    if not starts.size:
        return dict(columns), ()
    apart = stamps.copy()
    for start in starts:
        apart[start:] += apart[start - 1] - apart[start] + _BETWEEN / scale
    places = listed(table.place(int(start)) for start in starts)
    why = f"{shown(runs)} is another" if runs else "the time begins anew"
    words = f"{why} in {places}: {starts.size + 1} runs, joined with {_BETWEEN:g} s between"
    return {**columns, clock: apart}, (note("clock.runs", words, value=starts.size + 1),)
