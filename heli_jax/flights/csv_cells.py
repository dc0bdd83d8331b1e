"""What stands in cells of text beside plain numbers: marks for nothing, dates, units."""

import re
from collections.abc import Sequence

import numpy as np

from heli_jax import units
from heli_jax.flights.time_units import time_unit

MISSING = ("NA", "N/A", "n/a", "null", "NULL", "None", "-", "#N/A")
"""cells that say that there is no value, beside NaN, which is a number"""
NUMBER = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eEdD][+-]?[0-9]+)?|[+-]?(?:nan|inf|infinity)"
"""what counts as a number, in any case; float() would also take 1_000, and digits of any script"""
_NUMBER = re.compile(NUMBER, re.IGNORECASE)
_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)\s?(Z|UTC|[+-]\d\d:?\d\d)?"
)
_CLOCK = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d{1,9})?)")
_DAY = 86400.0


def number(cell: str) -> float | None:
    """A cell as a number; None where it is none. Fortran writes 1.0D+00."""
    if not _NUMBER.fullmatch(cell):
        return None
    return float(cell.replace("D", "e").replace("d", "e"))


def is_number(cell: str) -> bool:
    """Whether a cell is a number."""
    return _NUMBER.fullmatch(cell) is not None


def is_date(cell: str) -> bool:
    """Whether a cell is a date with a time of day, or a time of day."""
    return bool(_DATE.fullmatch(cell) or _CLOCK.fullmatch(cell))


def seconds_of_dates(cells: Sequence[str | None]) -> np.ndarray | int:
    """Seconds (N,) from the first midnight, of dates or of times of day, NaN where empty.

    Times of day go on behind midnight. All cells have to be of one kind, and dates of one zone.

    Args:
        cells: N.

    Returns:
        The first cell's number where it is none of them.
    """
    filled = [i for i, cell in enumerate(cells) if cell is not None]
    values = np.full(len(cells), np.nan)
    first = cells[filled[0]] if filled else None
    if first is None:
        return values
    dated = _DATE.fullmatch(first)
    for i in filled:
        cell = cells[i] or ""
        match = (_DATE if dated else _CLOCK).fullmatch(cell)
        if not match or (dated and match[3] != dated[3]):
            return i
        try:
            values[i] = _of_date(match, dated[1]) if dated else _of_clock(match)
        except ValueError:  # the 31st of a short month
            return i
    if not dated:
        steps = np.diff(values[filled])
        turns = np.cumsum(np.r_[0.0, np.where(steps < -0.5 * _DAY, _DAY, 0.0)])
        values[filled] += turns
    return values


def _of_date(match: re.Match[str], first_day: str) -> float:
    since = np.datetime64(f"{match[1]}T{match[2]}", "ns") - np.datetime64(first_day, "ns")
    return float(since / np.timedelta64(1, "ns")) * 1e-9


def _of_clock(match: re.Match[str]) -> float:
    return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3].replace(",", "."))


def row_of_units(cells: Sequence[str]) -> tuple[str, ...] | None:
    """The units in a row below the names, brackets taken off; None where it is no such row.

    Args:
        cells: of the row, one for each column.
    """
    bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell.strip().strip('"')).strip() for cell in cells]
    words = [unit for unit in bare if unit not in ("", "-", "1", "--")]
    # A row of marks for nothing says nothing of units.
    if not words or any(is_number(word) or word in MISSING for word in words):
        return None
    known = [unit for unit in words if time_unit(unit) or units.is_unit(unit)]
    # One of them may be written as only its author does.
    return tuple(bare) if 2 * len(known) > len(words) else None
