"""Plain columns of a text through pyarrow, which reads numbers many times as fast as text.

Everything here answers None where anything is not plain: a row with other than the header's cells,
quotes, a cell that is no number. `csv_table` then looks at cells as text and finds out where.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from heli_jax.flights.csv_cells import MISSING
from heli_jax.flights.csv_text import Body, OnDisk

# Imported again within the functions that need it: it takes a quarter of a second, which
# flights made in Python need not wait for.
if TYPE_CHECKING:
    import pyarrow as pa

_SAMPLE = 1 << 20
"""bytes by which columns of numbers are told from others"""


class Column(NamedTuple):
    """Numbers (N,) float64, NaN where a cell is empty, and how many cells are not."""

    values: np.ndarray
    filled: int


def number_columns(
    body: Body, width: int, indices: Sequence[int], signs: Sequence[str]
) -> dict[int, Column] | None:
    """Columns of numbers by index; None where anything is not plain.

    Args:
        body: the rows.
        width: number of columns of the header.
        indices: of the columns to read.
        signs: which may be decimal, in the order to try.
    """
    import pyarrow as pa

    # Of the columns read all have to be of one kind: a column of 1.500 beside one of 1,5 holds
    # thousands.
    for sign in signs:
        table = _table(body, width, dict.fromkeys(indices, pa.float64()), sign)
        if table is not None:
            columns = {i: table.column(str(i)) for i in dict.fromkeys(indices)}
            return {i: Column(floats(c), len(c) - c.null_count) for i, c in columns.items()}
    return None


def text_columns(body: Body, width: int, indices: Sequence[int]) -> list["pa.ChunkedArray"] | None:
    """Columns as text; None where a row has other than the header's number of cells.

    Args:
        body: the rows.
        width: number of columns of the header.
        indices: of the columns to read.
    """
    import pyarrow as pa

    table = _table(body, width, dict.fromkeys(indices, pa.string()), ".")
    return None if table is None else [table.column(str(i)) for i in indices]


def likely_numbers(body: Body, width: int, signs: Sequence[str]) -> list[int]:
    """The columns that hold numbers as far as the first rows tell.

    Args:
        body: the rows.
        width: number of columns of the header.
        signs: which may be decimal.
    """
    import pyarrow as pa

    first = body.beginning(_SAMPLE)
    if body.size > len(first):
        first = first[: first.rfind(b"\n") + 1]
    sample = dataclasses.replace(body, rows=memoryview(first))
    columns: dict[int, Any] = {}
    for sign in signs:
        table = _table(sample, width, dict.fromkeys(range(width)), sign)
        if table is not None:
            columns |= {
                i: None
                for i in range(width)
                if pa.types.is_integer(kind := table.schema.field(i).type)
                or pa.types.is_floating(kind)
            }
    return sorted(columns)


def _table(body: Body, width: int, kinds: dict[int, Any], sign: str) -> "pa.Table | None":
    """Columns by index, in their types; None as a type lets pyarrow guess."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    # pyarrow takes a line break within quotes for one within a cell or for the end of a row, by
    # an option; either way the lines that it counts are not those of the file.
    if body.has_quotes or not kinds:
        return None
    # By number, since two columns may have one name.
    names = [str(i) for i in range(width)]
    stated = {str(i): kind for i, kind in kinds.items() if kind is not None}
    ragged: list[Any] = []

    # Called for each row with other than the header's number of cells: so for blank lines too,
    # which are no error. That there is any other is enough: `Body.records` finds its line.
    def skip(row: Any) -> str:
        if not body.is_blank(row.text):
            ragged.append(row)
        return "skip"

    try:
        table = arrow_csv.read_csv(
            _stream(body),
            read_options=arrow_csv.ReadOptions(column_names=names),
            parse_options=arrow_csv.ParseOptions(
                delimiter=body.delimiter,
                quote_char=False,
                double_quote=False,
                invalid_row_handler=skip,
            ),
            convert_options=arrow_csv.ConvertOptions(
                column_types=stated,
                include_columns=[str(i) for i in kinds],
                # Not its own list, which has words such as #N/A N/A.
                null_values=["", *MISSING],
                decimal_point=sign,
            ),
        )
    except pa.ArrowException:  # such as a line longer than a block, or a cell that is no number
        return None
    return None if ragged or not table.num_rows else table


def _stream(body: Body) -> "pa.NativeFile":
    """The rows, for pyarrow to read."""
    import pyarrow as pa

    if not isinstance(body.rows, OnDisk):
        return pa.BufferReader(pa.py_buffer(body.rows))
    file = pa.OSFile(str(body.rows.path))
    file.seek(body.rows.begin)
    return file


def floats(numbers: "pa.ChunkedArray") -> np.ndarray:
    """Numbers of pyarrow as float64 (N,), NaN where null."""
    values = np.empty(len(numbers), np.float64)
    at = 0
    # As buffers, since to_numpy imports pandas, a fifth of a second.
    for chunk in numbers.chunks:
        if not len(chunk):
            continue
        piece = values[at : at + len(chunk)]
        piece[:] = np.frombuffer(chunk.buffers()[1], np.float64, len(chunk), 8 * chunk.offset)
        if chunk.null_count:
            piece[~_valid(chunk)] = np.nan
        at += len(chunk)
    return values


def _valid(chunk: "pa.Array") -> np.ndarray:
    import pyarrow as pa

    flags = chunk.is_valid().cast(pa.uint8())
    return np.frombuffer(flags.buffers()[1], np.uint8, len(flags), flags.offset).astype(bool)
