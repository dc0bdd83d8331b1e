"""Times as text: dates of ISO 8601 and of German spreadsheets, times of day, counts with a unit."""

import datetime
import re
from collections.abc import Callable, Sequence

import numpy as np

from heli_jax.flights.time_units import LETTERS, SECONDS, time_unit

_DAY = 86400.0
_CLOCK = re.compile(r"(\d{1,3}):(\d\d):(\d\d(?:[.,]\d{1,12})?)")
_SPAN = re.compile(r"(\d{1,5}) ?days?,? +(\d{1,2}:\d\d:\d\d(?:\.\d{1,12})?)")
"""0 days 00:00:01.25, as pandas and Python write what has passed"""
_COUNT = re.compile(r"([+-]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([A-Za-zµμ]+)")
"""0.01 sec, as MATLAB writes durations"""
_ISO = re.compile(r"\d{4}[-/]\d\d[-/]\d\d[T ,]+\d\d:\d\d(?::\d\d.*)?")
_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4}),? (\d{1,2}:\d\d:\d\d(?:[.,]\d{1,6})?)")
_LONGEST = 60
"""characters of a time; of a damaged file a cell may be as long as itself"""


def is_date(cell: str) -> bool:
    """True for a date with a time of day, a time of day, or a time with its unit."""
    return len(cell) <= _LONGEST and _reader(cell) is not None


def seconds_of_dates(cells: Sequence[str | None]) -> np.ndarray | int:
    """Seconds (N,) from the first midnight, NaN where a cell is empty.

    Times of day go on behind midnight. All cells have to be of one kind, and dates with an offset
    from UTC or without.

    Returns:
        The row of the first cell that is none, in place of the seconds.
    """
    filled = [i for i, cell in enumerate(cells) if cell is not None]
    values = np.full(len(cells), np.nan)
    if not filled:
        return values
    read = _reader(cells[filled[0]] or "")
    begin = None
    for i in filled:
        cell = cells[i] or ""
        try:
            time = read(cell) if read is not None and len(cell) <= _LONGEST else None
            if isinstance(time, datetime.datetime):
                begin = begin or time.replace(hour=0, minute=0, second=0, microsecond=0)
                time = (time - begin).total_seconds()
        # TypeError: dates with an offset from UTC and without cannot be compared.
        except (ValueError, TypeError, OverflowError):
            return i
        if time is None:
            return i
        values[i] = time
    if read is _of_clock:
        steps = np.diff(values[filled])
        turns = np.cumsum(np.r_[0.0, np.where(steps < -0.5 * _DAY, _DAY, 0.0)])
        values[filled] += turns
    return values


type _Read = Callable[[str], datetime.datetime | float | None]


def _reader(cell: str) -> _Read | None:
    """What reads cells such as this one; None where it is no time."""
    if _ISO.fullmatch(cell):
        return _of_iso
    forms = (_GERMAN, _of_german), (_CLOCK, _of_clock), (_SPAN, _of_span)
    read = next((read for form, read in forms if form.fullmatch(cell)), None)
    if read is None and (match := _COUNT.fullmatch(cell)):
        # 3D is what a receiver calls its fix, and no three days.
        unit = None if match[2].casefold() in LETTERS else time_unit(match[2])
        read = None if unit is None else _of_counts(unit)
    return read


def _of_iso(cell: str) -> datetime.datetime | None:
    if not _ISO.fullmatch(cell):
        return None
    text = cell.replace("/", "-").removesuffix(" UTC").removesuffix(" GMT")
    return datetime.datetime.fromisoformat(re.sub("[ ,]+", "T", text, count=1))


def _of_german(cell: str) -> datetime.datetime | None:
    match = _GERMAN.fullmatch(cell)
    if match is None:
        return None
    clock = match[4].replace(",", ".").zfill(8)
    return datetime.datetime.fromisoformat(
        f"{match[3]}-{int(match[2]):02d}-{int(match[1]):02d}T{clock}"
    )


def _of_clock(cell: str) -> float | None:
    match = _CLOCK.fullmatch(cell)
    if match is None:
        return None
    return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3].replace(",", "."))


def _of_span(cell: str) -> float | None:
    match = _SPAN.fullmatch(cell)
    clock = _of_clock(match[2]) if match else None
    return None if match is None or clock is None else _DAY * int(match[1]) + clock


def _of_counts(unit: str) -> _Read:
    def read(cell: str) -> float | None:
        match = _COUNT.fullmatch(cell)
        if match is None or time_unit(match[2]) != unit:
            return None
        return SECONDS[unit] * float(match[1])

    return read
