"""Cells of text as numbers, column by column, in pyarrow's arrays."""

from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax.flights.csv_arrow import floats
from heli_jax.flights.csv_cells import MISSING, NUMBER, number

# Imported again within the functions that need it: it takes a quarter of a second.
if TYPE_CHECKING:
    import pyarrow as pa

CELLS_AT_ONCE = 1 << 16
"""cells that are looked at as text, in which they take many times as much"""


def compute() -> Any:
    """pyarrow's functions on columns; they are made at run time, so no checker knows them."""
    import pyarrow.compute

    return pyarrow.compute


def filled_cells(text: "pa.ChunkedArray") -> "pa.ChunkedArray":
    """Cells without the blanks around them, null where nothing or a mark for it is left."""
    import pyarrow as pa

    pc = compute()
    trimmed = pc.utf8_trim_whitespace(text)
    # Not compared with "": pyarrow imports pandas, a fifth of a second, to take a value of Python.
    nothing = pa.nulls(1, trimmed.type)[0]
    marks = pa.array(MISSING, trimmed.type)
    is_filled = pc.and_(
        pc.cast(pc.utf8_length(trimmed), pa.bool_()),
        pc.invert(pc.is_in(trimmed, value_set=marks)),
    )
    return pc.if_else(is_filled, trimmed, nothing)


def text_floats(text: "pa.ChunkedArray") -> np.ndarray | int:
    """Cells as float64 (N,), NaN where empty; or the first row that holds no number."""
    import pyarrow as pa

    filled = filled_cells(text)
    try:
        numbers = filled.cast(pa.float64())
    except pa.ArrowInvalid:  # it does not say which row
        return _floats_one_by_one(filled)
    return floats(numbers)


def _floats_one_by_one(filled: "pa.ChunkedArray") -> np.ndarray | int:
    # In pieces: as objects of Python all cells at once take many times the file's size.
    values = np.full(len(filled), np.nan)
    pieces = (filled.slice(at, CELLS_AT_ONCE) for at in range(0, len(filled), CELLS_AT_ONCE))
    for row, cell in enumerate(cell for piece in pieces for cell in piece.to_pylist()):
        if cell is None:
            continue
        value = number(cell)
        if value is None:
            return row
        values[row] = value
    return values


def few_strays(text: "pa.ChunkedArray") -> int:
    """How many cells are no numbers where most are; 0 of a column of text.

    Args:
        text: a column (N,).
    """
    pc, filled = compute(), filled_cells(text)
    numbers = pc.sum(pc.match_substring_regex(filled, f"^(?:{NUMBER})$", ignore_case=True)).as_py()
    count = len(filled) - filled.null_count
    return count - numbers if 2 * (numbers or 0) > count else 0
