"""Times as people and spreadsheets write them: dates, times of day, minutes, counts with a unit."""

import datetime
import functools
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.flights.time_units import LETTERS, SECONDS, time_unit

_DAY, _HOUR = 86400.0, 3600.0
_CLOCK = r"(\d{1,3}):(\d\d):(\d\d(?:[.,]\d{1,12}|:\d{3})?)\s?([AaPp]\.?[Mm]\.?)?"
_ZONE = r"\s?(Z|UTC|GMT|[+-]\d\d:?\d\d)?"
_DAYS = (
    r"(?P<y>\d{4})(?P<a>[-/.])(?P<m>\d{1,2})(?P=a)(?P<d>\d{1,2})"
    r"|(?P<first>\d{1,2})(?P<b>[-/.])(?P<second>\d{1,2})(?P=b)(?P<year>\d{4}|\d\d)"
    r"|(?P<day>\d{1,2})[- ](?P<name>[A-Za-z]{3})[a-z]*\.?[- ,]+(?P<of>\d{4}|\d\d)"
)
_DATE = re.compile(rf"(?P<date>{_DAYS})(?:T|,?\s+){_CLOCK}{_ZONE}")
# Without seconds: a log at a sample a minute is none of a flight, but a date alone is a date.
_DATE_MINUTES = re.compile(rf"(?P<date>{_DAYS})(?:T|,?\s+)(\d{{1,2}}):(\d\d){_ZONE}")
_DATE_ALONE = re.compile(_DAYS)
_TIME_OF_DAY = re.compile(_CLOCK)
_SPAN = re.compile(r"(\d{1,5}) ?(?:days?|d),? +(\d{1,2}):(\d\d):(\d\d(?:[.,]\d{1,12})?)")
"""0 days 00:00:01.25, as pandas and Python write what has passed"""
_MINUTES = re.compile(r"(\d{1,3}):(\d\d[.,]\d{1,12})")
_COUNT = re.compile(r"([+-]?\d*[.,]?\d+(?:[eE][+-]?\d+)?)\s*([A-Za-zµμ]+)")
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_CENTURY = 2000
_LONGEST = 60
"""characters of a time; of a damaged file a cell may be as long as itself"""


class Dates(NamedTuple):
    """Seconds (N,) from the first midnight, NaN where empty, and what was assumed, else empty."""

    seconds: np.ndarray
    note: str = ""


def is_date(cell: str) -> bool:
    """Whether a cell is a date with a time of day, a time of day, or a time with its unit."""
    if len(cell) > _LONGEST:
        return False
    known = (_DATE, _DATE_MINUTES, _TIME_OF_DAY, _MINUTES, _SPAN)
    return any(form.fullmatch(cell) for form in known) or _unit_of_count(cell) is not None


def is_day(cell: str) -> bool:
    """Whether a cell is a date without a time of day."""
    return len(cell) <= _LONGEST and _DATE_ALONE.fullmatch(cell) is not None


def seconds_of_dates(
    cells: Sequence[str | None], days: Sequence[str | None] | None = None
) -> Dates | int:
    """Seconds from the first midnight, of dates, times of day, minutes, or counts with a unit.

    Times of day go on behind midnight, minutes of an hour behind the hour. All cells have to be of
    one kind, and dates with a zone or without.

    Args:
        cells: N.
        days: N dates that stand in a column beside times of day.

    Returns:
        The first cell's number where it is none of them.
    """
    filled = [i for i, cell in enumerate(cells) if cell is not None]
    if not filled:
        return Dates(np.full(len(cells), np.nan))
    if (long := next((i for i in filled if len(cells[i] or "") > _LONGEST), None)) is not None:
        return long
    first = cells[filled[0]] or ""
    read: Callable[[Sequence[str]], Dates | int]
    if form := next((f for f in (_DATE, _DATE_MINUTES) if f.fullmatch(first)), None):
        read = functools.partial(_of_dates, form)
    elif _TIME_OF_DAY.fullmatch(first):
        beside = None if days is None else [days[i] or "" for i in filled]
        read = functools.partial(_of_clocks, days=beside)
    elif _MINUTES.fullmatch(first):
        read = _of_minutes
    elif _SPAN.fullmatch(first):
        read = _of_spans
    else:
        read = _of_counts
    dates = read([cells[i] or "" for i in filled])
    if isinstance(dates, int):
        return filled[dates]
    values = np.full(len(cells), np.nan)
    values[filled] = dates.seconds
    return dates._replace(seconds=values)


def _of_dates(form: re.Pattern[str], cells: Sequence[str]) -> Dates | int:
    matches: list[re.Match[str]] = []
    for i, cell in enumerate(cells):
        match = form.fullmatch(cell)
        # With a zone all have one, or none.
        if not match or (matches and (_zone(match) is None) != (_zone(matches[0]) is None)):
            return i
        matches.append(match)
    zones = np.array([_zone(match) or 0.0 for match in matches])
    days = _ordinals([match["date"] for match in matches])
    if isinstance(days, int):
        return days
    seconds = np.empty(len(cells))
    for i, match in enumerate(matches):
        clock = match.groups()[match.re.groupindex["of"] :]
        time = _seconds(*clock[:4]) if form is _DATE else _seconds(clock[0], clock[1], "0", None)
        if time is None:
            return i
        seconds[i] = time
    # As where summer time begins within a log: the clock of the first row goes on.
    turned = "" if np.ptp(zones) == 0 else "the offset from UTC changes, times go on in the first"
    said = "; ".join(filter(None, (days.note, turned)))
    seconds -= zones - zones[0]
    return Dates(seconds + _DAY * (days.seconds - days.seconds[0]), said)


def _zone(match: re.Match[str]) -> float | None:
    """The offset from UTC [s] of a date's zone, which is the last group; None without one."""
    zone = match[match.re.groups]
    if zone is None or not zone.startswith(("+", "-")):
        return None if zone is None else 0.0
    sign, digits = (-1.0 if zone[0] == "-" else 1.0), zone[1:].replace(":", "")
    return sign * (_HOUR * int(digits[:2]) + 60.0 * int(digits[2:]))


def _of_clocks(cells: Sequence[str], days: Sequence[str] | None) -> Dates | int:
    seconds = np.empty(len(cells))
    for i, cell in enumerate(cells):
        match = _TIME_OF_DAY.fullmatch(cell)
        time = _seconds(*match.groups()) if match else None
        if time is None:
            return i
        seconds[i] = time
    dates = _ordinals(days) if days is not None and all(map(is_day, days)) else 0
    if isinstance(dates, int) or np.ptp(dates.seconds) == 0:
        return Dates(_going_on(seconds, _DAY))
    note = "times of day are counted on by the dates beside them"
    said = "; ".join(filter(None, (note, dates.note)))
    return Dates(seconds + _DAY * (dates.seconds - dates.seconds[0]), said)


def _of_minutes(cells: Sequence[str]) -> Dates | int:
    seconds = np.empty(len(cells))
    for i, cell in enumerate(cells):
        match = _MINUTES.fullmatch(cell)
        if not match:
            return i
        seconds[i] = 60.0 * int(match[1]) + float(match[2].replace(",", "."))
    return Dates(_going_on(seconds, _HOUR), "times are taken as minutes and seconds, MM:SS.s")


def _of_spans(cells: Sequence[str]) -> Dates | int:
    seconds = np.empty(len(cells))
    for i, cell in enumerate(cells):
        match = _SPAN.fullmatch(cell)
        time = _seconds(match[2], match[3], match[4], None) if match else None
        if match is None or time is None:
            return i
        seconds[i] = _DAY * int(match[1]) + time
    return Dates(seconds)


def _of_counts(cells: Sequence[str]) -> Dates | int:
    unit = _unit_of_count(cells[0])
    seconds = np.empty(len(cells))
    for i, cell in enumerate(cells):
        match = _COUNT.fullmatch(cell)
        if unit is None or not match or time_unit(match[2]) != unit:
            return i
        seconds[i] = SECONDS[unit] * float(match[1].replace(",", "."))
    return Dates(seconds)


def _unit_of_count(cell: str) -> str | None:
    """The unit of a time that has its unit behind it, as MATLAB writes durations: `0.01 sec`."""
    match = _COUNT.fullmatch(cell)
    # 3D is what a receiver calls its fix, and no three days.
    if match is None or match[2].casefold() in LETTERS:
        return None
    return time_unit(match[2])


def _going_on(seconds: np.ndarray, turn: float) -> np.ndarray:
    steps = np.diff(seconds)
    return seconds + np.cumsum(np.r_[0.0, np.where(steps < -0.5 * turn, turn, 0.0)])


def _seconds(hours: str, minutes: str, seconds: str, half: str | None) -> float | None:
    """Since midnight; None of an hour that no clock of twelve shows."""
    hour = int(hours)
    if half:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + (12 if half[0] in "Pp" else 0)
    # 12:30:01:123, as some loggers have milliseconds.
    fraction = seconds.replace(",", ".").replace(":", ".")
    return 3600.0 * hour + 60.0 * int(minutes) + float(fraction)


def _ordinals(dates: Sequence[str]) -> Dates | int:
    """Days (N,), counted; the first date's number where it is none."""
    known = {date: _DATE_ALONE.fullmatch(date) for date in dict.fromkeys(dates)}
    numbered = [m for m in known.values() if m and m["first"]]
    orders = _orders(numbered)
    by_order = []
    for order in orders:
        days = {date: _day(match, order) for date, match in known.items()}
        bad = next((date for date, day in days.items() if day is None), None)
        if bad is None:
            by_order.append((order, np.array([days[date] for date in dates], float)))
        elif order == orders[-1] and not by_order:
            return list(dates).index(bad)
    order, ordinals = min(by_order, key=lambda one: np.ptp(one[1]))
    if len(by_order) == 1 or np.ptp(ordinals) == 0:
        # Within one day it does not matter which of the two numbers is the month.
        return Dates(ordinals)
    what = "day and month" if order == "dm" else "month and day"
    return Dates(ordinals, f"dates such as {dates[0]} are taken as {what}: the log is shorter so")


def _orders(numbered: Sequence[re.Match[str]]) -> tuple[str, ...]:
    """In which orders day and month may stand: `dm`, `md`."""
    if not numbered or numbered[0]["b"] == ".":
        return ("dm",)
    first, second = (max(int(m[part]) for m in numbered) for part in ("first", "second"))
    return ("dm",) if first > 12 else ("md",) if second > 12 else ("md", "dm")


def _day(match: re.Match[str] | None, order: str) -> int | None:
    """The day of a date, counted; None where there is none, as of the 31st of a short month."""
    if match is None:
        return None
    if match["y"]:
        year, month, day = match["y"], int(match["m"]), match["d"]
    elif match["name"]:
        if match["name"].lower() not in _MONTHS:
            return None
        year, day = match["of"], match["day"]
        month = _MONTHS.index(match["name"].lower()) + 1
    else:
        day, month = (match["first"], match["second"])[:: 1 if order == "dm" else -1]
        year, month = match["year"], int(month)
    try:
        full = int(year) + (_CENTURY if len(year) == 2 else 0)
        return datetime.date(full, month, int(day)).toordinal()
    except ValueError:
        return None
