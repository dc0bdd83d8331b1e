"""What stands in cells of text beside plain numbers: marks for nothing, units."""

import re
from collections.abc import Sequence

from heli_jax import units
from heli_jax.flights.time_units import time_unit

MISSING = ("NA", "N/A", "n/a", "null", "NULL", "None", "-", "#N/A")
"""cells that say that there is no value, beside NaN, which is a number"""
NUMBER = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eEdD][+-]?[0-9]+)?|[+-]?(?:nan|inf|infinity)"
"""what counts as a number, in any case; float() would also take 1_000, and digits of any script"""
_NUMBER = re.compile(NUMBER, re.IGNORECASE)


def number(cell: str) -> float | None:
    """A cell as a number; None where it is none. Fortran writes 1.0D+00."""
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
    words = [unit for unit in bare if unit not in ("", "-", "1", "--")]
    # A row of marks for nothing says nothing of units.
    if not words or any(is_number(word) or word in MISSING for word in words):
        return None
    known = [unit for unit in words if time_unit(unit) or units.is_unit(unit)]
    # One of them may be written as only its author does.
    return tuple(bare) if 2 * len(known) > len(words) else None
