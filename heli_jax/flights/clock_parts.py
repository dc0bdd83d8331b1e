"""A clock that a file has in several columns: seconds and what is left of them, or hours, minutes
and seconds, perhaps with the date."""

import datetime
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.flights.channel_names import words_in
from heli_jax.flights.time_units import SECONDS, time_unit

_LAST_WORD = re.compile(r"(.*?)([A-Za-z]+)")
_UNIT = re.compile(r"\s*[\[(][^\[\]()]*[\])]\s*$|\.s+$", re.IGNORECASE)
"""behind a name, as in `Second (s)` and `SS.sss`"""
_CLOCKS = ("time", "timestamp", "zeit")
_COMPACT = {"utc", "hhmmss", "uhrzeit"}
"""words in names of times of day that may be one number"""
_FINER = ("ms", "us", "ns")
_UNITS_OF_A_CLOCK = {"h": "hour", "min": "minute", "s": "second"}
_OTHER_WORDS = {
    **dict.fromkeys(("hh", "std", "stunde", "stunden"), "hour"),
    **dict.fromkeys(("mm", "mi", "minuten"), "minute"),
    **dict.fromkeys(("ss", "sss", "sek", "sekunde", "sekunden"), "second"),
    **dict.fromkeys(("year", "yyyy", "yy", "jahr"), "year"),
    **dict.fromkeys(("month", "mon", "monat"), "month"),
    **dict.fromkeys(("day", "dd", "tag"), "day"),
    **dict.fromkeys(("doy", "yday"), "day of the year"),
}
"""beside the units of time that are words of a clock too"""
_MOST = {"hour": 24.0, "minute": 60.0, "second": 60.0 + 1.0}
"""that a clock shows; a second more where one leaps"""
_DAY = 86400.0
_CENTURY = 2000


class ClockParts(NamedTuple):
    """Columns that are one clock.

    Attributes:
        name: of the clock, of those of its columns.
        scales: seconds for each column's unit, by column.
        date: columns of year, month and day; or of the day of the year alone; empty without.
    """

    name: str
    scales: Mapping[str, float]
    date: tuple[str, ...] = ()

    @property
    def columns(self) -> list[str]:
        """All that the clock is made of."""
        return [*self.date, *self.scales]

    def seconds(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """The clock (N,) [s], which goes on where its largest part begins anew.

        Args:
            columns: (N,) each.
        """
        seconds = np.zeros(next(iter(columns.values())).size)
        # The finest first, of which digits would be lost beside a large one.
        for name, scale in reversed(list(self.scales.items())):
            seconds = seconds + scale * columns[name]
        if self.date:
            return seconds + _DAY * _days([columns[name] for name in self.date])
        largest = max(self.scales.values())
        # Seconds alone count on by themselves.
        turn = {SECONDS["h"]: _DAY, SECONDS["min"]: SECONDS["h"]}.get(largest)
        if turn is None:
            return seconds
        return _going_on(seconds, turn)

    def fits(self, columns: Mapping[str, np.ndarray]) -> bool:
        """Whether numbers are those of parts of a clock, and no clocks each.

        Args:
            columns: (N,) each.
        """
        values = list(columns.values())
        if values[0].size < 2 or not all(np.isfinite(x).all() for x in values):
            return False
        finest = min(self.scales, key=lambda name: self.scales[name])
        if not all(_is_whole(columns[name]) for name in self.columns if name != finest):
            return False
        coarser = np.inf
        for name, scale in self.scales.items():
            # A leap second, and 24:00, are more than the next larger part.
            most = 1.0 if scale < 1.0 else coarser + scale
            if np.min(columns[name]) < 0 or np.max(columns[name]) * scale >= most:
                return False
            coarser = {SECONDS["h"]: SECONDS["h"], SECONDS["min"]: SECONDS["min"]}.get(scale, 1.0)
        if self.date and not np.isfinite(_days([columns[n] for n in self.date])).all():
            return False
        # The part above the finest stands still now and then: else it is a clock of its own.
        above = [name for name in self.scales if name != finest]
        return bool(np.any(np.diff(columns[above[-1]]) == 0))


class CompactClock(NamedTuple):
    """A time of day in one number, 235959.99 of 23:59:59.99, as receivers of GPS send it.

    Attributes:
        column: of the numbers.
    """

    column: str

    @property
    def name(self) -> str:
        """Of the clock."""
        return f"{self.column} (HHMMSS)"

    @property
    def columns(self) -> list[str]:
        """All that the clock is made of."""
        return [self.column]

    def seconds(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """The clock (N,) [s], which goes on behind midnight.

        Args:
            columns: (N,) each.
        """
        numbers = columns[self.column]
        minutes = np.floor(numbers / 100.0)
        hours = np.floor(minutes / 100.0)
        seconds = 3600.0 * hours + 60.0 * (minutes - 100.0 * hours) + (numbers - 100.0 * minutes)
        return _going_on(seconds, _DAY)

    def fits(self, columns: Mapping[str, np.ndarray]) -> bool:
        """Whether numbers are such times, a minute or more of them: within one they are seconds.

        Args:
            columns: (N,) each.
        """
        numbers = columns[self.column]
        if numbers.size < 2 or not (np.isfinite(numbers).all() and np.min(numbers) >= 0):
            return False
        minutes = np.floor(numbers / 100.0)
        is_clock = numbers < 240000, minutes % 100 < 60, numbers % 100 < 61
        turns = np.diff(minutes) != 0
        # 59 is followed by 100: 40 more than the time that went by.
        return bool(np.all(is_clock) and turns.any()) and bool(
            np.all(np.diff(numbers)[turns] % 10000 > 40.0)
        )


def _going_on(seconds: np.ndarray, turn: float) -> np.ndarray:
    steps = np.diff(seconds)
    return seconds + np.cumsum(np.r_[0.0, np.where(steps < -0.5 * turn, turn, 0.0)])


def _is_whole(values: np.ndarray) -> bool:
    return bool(np.all(values == np.rint(values)))


def _days(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Days (N,), counted from the first; NaN where a date is none."""
    if len(parts) == 1:
        return parts[0] - parts[0][0]
    rows, which = np.unique(np.stack(parts, axis=1), axis=0, return_inverse=True)
    days = np.array([_ordinal(*row) for row in rows])[which.reshape(-1)]
    return days - days[0]


def _ordinal(year: float, month: float, day: float) -> float:
    try:
        full = int(year) + (_CENTURY if year < 100 else 0)
        return float(datetime.date(full, int(month), int(day)).toordinal())
    except (ValueError, OverflowError):
        return float("nan")


def clock_parts(names: Sequence[str]) -> ClockParts | CompactClock | None:
    """The columns whose names are those of a clock in parts, alike but for these, or the one of a
    time of day in a number; None where there are none.

    Args:
        names: of a table's columns.
    """
    groups: dict[str, dict[str, str]] = {}
    finer: list[tuple[str, str, str]] = []
    times = {}
    for name in names:
        match = _LAST_WORD.fullmatch(_UNIT.sub("", name))
        if match is None:
            continue
        stem, word = match[1].casefold(), match[2].casefold()
        unit = time_unit(word)
        if name.casefold() in _CLOCKS:
            times.setdefault("", name)
        elif unit in _FINER:
            finer.append((stem, name, unit))
        elif unit == "day" or unit in _UNITS_OF_A_CLOCK or word in _OTHER_WORDS:
            part = _OTHER_WORDS.get(word) or _UNITS_OF_A_CLOCK.get(unit or "", "day")
            groups.setdefault(stem, {})[part] = name
    for stem, group in groups.items():
        clock = _of_group(group, [(name, unit) for s, name, unit in finer if s == stem])
        if clock is not None:
            return clock
    # A time of day in whole seconds beside milliseconds.
    for stem, name, unit in finer:
        if stem in times:
            whole = times[stem]
            return ClockParts(f"{whole}+{name}", {whole: 1.0, name: SECONDS[unit]})
    for name in names:
        words = set(words_in(name))
        with_date = name.casefold() in _CLOCKS and "date" in map(str.casefold, names)
        if _COMPACT & words or with_date:
            return CompactClock(name)
    return None


def _of_group(group: Mapping[str, str], finer: Sequence[tuple[str, str]]) -> ClockParts | None:
    """A clock of columns by what each is, and of parts of a second by their units."""
    if "second" not in group or ("hour" in group and "minute" not in group):
        return None
    units = {"hour": SECONDS["h"], "minute": SECONDS["min"], "second": 1.0}
    scales = {group[part]: scale for part, scale in units.items() if part in group}
    scales |= {name: SECONDS[unit] for name, unit in finer[:1]}
    if len(scales) < 2:
        return None
    date: tuple[str, ...] = ()
    if "hour" in group:
        calendar = ("year", "month", "day")
        if all(part in group for part in calendar):
            date = tuple(group[part] for part in calendar)
        elif "day of the year" in group:
            date = (group["day of the year"],)
    # The date's columns would make a long name of it.
    return ClockParts("+".join(scales), scales, date)
