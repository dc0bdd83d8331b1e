"""What stands in cells of text beside plain numbers: marks for nothing, units."""

import re
from collections.abc import Sequence

from heli_jax import units
from heli_jax.flights.time_units import time_unit

MISSING = (
    *("NA", "N/A", "n/a", "null", "NULL", "None", "-", "#N/A", "--", "---", "?", "missing"),
    *("1.#QNAN", "-1.#QNAN", "1.#IND", "-1.#IND", "1.#QNAN0", "-1.#IND00", "NaT", "<NA>"),
)
"""cells that say that there is no value, beside NaN, which is a number"""
_OF_NO_MODEL = {
    *("degc", "°c", "celsius", "degf", "°f", "kelvin", "bar", "mbar", "hpa", "psi", "inhg", "mmhg"),
    *("gauss", "mgauss", "mg", "ut", "µt", "nt", "tesla", "db", "dbm", "mah", "ah", "wh", "ppm"),
    *("raw", "counts", "count", "adc", "lsb", "bool", "boolean", "enum", "flag", "flags", "bits"),
    *("norm", "normalized", "none", "nd", "n-d", "non-dim", "unitless", "ratio", "pwm", "us"),
    *("gs", "g's", "m/s/s", "ft/s/s", "ft/sec^2", "m/sec^2", "m/s2", "ft/s2", "kts"),
}
"""what stands in rows of units too, and no model asks for"""
_SIGN = "[+\u2212-]?"
NUMBER = (
    rf"{_SIGN}(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eEdD]{_SIGN}[0-9]+)?|{_SIGN}(?:nan|inf|infinity)"
)
"""what counts as a number, in any case; float() would also take 1_000, and digits of any script"""
_NUMBER = re.compile(NUMBER, re.IGNORECASE)


def number(cell: str) -> float | None:
    """A cell as a number; None where it is none. Fortran writes 1.0D+00, and some a true minus."""
    cell = cell.replace("\u2212", "-")
    if not _NUMBER.fullmatch(cell):
        return None
    return float(cell.replace("D", "e").replace("d", "e"))


def is_number(cell: str) -> bool:
    """Whether a cell is a number."""
    return _NUMBER.fullmatch(cell) is not None


def row_of_units(cells: Sequence[str]) -> tuple[str, ...] | None:
    """The units in a row below the names, brackets taken off; None where it is no such row.

    Args:
        cells: of the row, one for each column.
    """
    bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell.strip().strip('"')).strip() for cell in cells]
    # A row of marks for nothing says nothing of units.
    words = [word for word in bare if word not in ("", "-", "1", "--", *MISSING)]
    if not words or any(is_number(word) for word in words):
        return None
    spelled = {word: _unit(word) for word in words}
    known = [word for word in words if spelled[word] is not None]
    # One of them may be written as only its author does.
    if 2 * len(known) <= len(words):
        return None
    return tuple(spelled.get(word) or word for word in bare)


def _unit(word: str) -> str | None:
    """A unit as it is known, in small letters where it is by these alone, as of DEG/SEC; None where
    a word is none."""
    if time_unit(word) or units.is_unit(word) or word.casefold() in _OF_NO_MODEL:
        return word
    # Of one letter there are too many: P is pressure, rate and pitch.
    small = word.casefold()
    return small if len(word) > 1 and units.is_unit(small) else None
