"""Logs in delimited text: fast through pyarrow, and line by line where something is wrong.

pyarrow neither names the line of a bad cell nor keeps lines apart inside quotes. So a clean file
takes the fast way, and `Body.records` walks the text again to say where an error is.
"""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax.flights.csv_text import (
    LONGEST_HEADER,
    Body,
    decode,
    find_delimiter,
    find_header,
    header_names,
    is_of_blanks,
    require_short_lines,
    tabs_for_blanks,
)
from heli_jax.flights.table import (
    Survey,
    column,
    require_columns,
    require_few_columns,
    shown,
    wrong,
)
from heli_jax.regular_file import read_regular

# Imported again within the functions that need it: it takes a quarter of a second, which
# flights made in Python need not wait for.
if TYPE_CHECKING:
    import pyarrow as pa

# What counts as a number. float() would also take 1_000, and digits of any script.
_NUMBER = re.compile(
    r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
    r"|[+-]?(?:nan|inf|infinity)",
    re.IGNORECASE,
)
_LARGEST = 10**9
"""bytes: a log in text is read as a whole, and takes about ten times its size meanwhile"""
_CELLS_AT_ONCE = 1 << 16


def open_csv(path: Path) -> "CsvTable":
    """Read a text file, find its delimiter and its header.

    Raises:
        InputError: it is no UTF-8 text, or holds no header or no rows.
        OSError: it cannot be read.
    """
    data = read_regular(path, "a log in CSV (convert larger ones to Parquet)", _LARGEST)
    text = decode(str(path), data)
    start, line = find_header(text)
    if start is None:
        raise wrong(str(path), "holds no header, expected names of columns and rows of numbers")
    # Found, not split: a list of all lines takes many times the text's memory.
    end = text.find("\n", start)
    end = len(text) if end < 0 else end
    body = text[end + 1 :]
    if not body.strip():
        raise wrong(str(path), "holds a header alone, expected rows of numbers", f"line {line}")
    header = text[start:end]
    if len(header) > LONGEST_HEADER:
        raise wrong(str(path), "is longer than a line of a log can be", f"line {line}")
    require_short_lines(str(path), body, line + 1)
    first = body.lstrip("\n").split("\n", 1)[0]
    delimiter = find_delimiter(header, first)
    if path.suffix.lower() not in (".csv", ".tsv") and is_of_blanks(header, first):
        header, body, delimiter = tabs_for_blanks(header), tabs_for_blanks(body), "\t"
    # Counted before the names are parsed, so that a line of commas makes no million names.
    require_few_columns(str(path), header.count(delimiter) + 1, f"line {line}")
    names = header_names(str(path), header, delimiter, line)
    return CsvTable(
        size=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
        names=names,
        body=Body(str(path), body, delimiter, line + 1),
    )


class CsvTable:
    """A `Table` on delimited text."""

    format = "csv"

    def __init__(self, *, size: int, sha256: str, names: tuple[str, ...], body: Body) -> None:
        self.path, self.size, self.sha256, self.names = body.path, size, sha256, names
        self._body = body

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty.

        Raises:
            InputError: a column is missing or there twice, a row has more or fewer cells than
                the header, a cell is no number.
        """
        self._require(names)
        indices = [self.names.index(name) for name in names]
        try:
            texts = _decimal_points(self._texts(indices), self._body.delimiter)
        except _TwoDecimalSigns as e:
            raise wrong(self.path, str(e)) from e
        result = {}
        for name, text in zip(names, texts, strict=True):
            values = _floats(text)
            if isinstance(values, int):
                problem = f"got {self.cell_text(name, values)}, expected a number"
                raise wrong(self.path, problem, self.place(values), column(name))
            result[name] = values
        return result

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        result = []
        for name, text in zip(self.names, self._texts(range(len(self.names))), strict=True):
            try:
                values = _floats(_decimal_points([text], self._body.delimiter)[0])
            # Neither commas nor points are decimal for sure: a survey calls it text, row 0 on.
            except _TwoDecimalSigns:
                values = 0
            filled = len(text) - _filled(text).null_count
            result.append(Survey(name, None if isinstance(values, int) else values, filled))
        return result

    def place(self, row: int) -> str:
        """`line 12`, counted from the top of the file, comments and blank lines included."""
        return f"line {self._record(row)[0]}"

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        cell = self._record(row)[1][self.names.index(name)].strip()
        return shown(cell) if cell else "nothing"

    def time_unit(self, name: str) -> None:
        """Text has no type."""
        return None

    def _require(self, names: Sequence[str]) -> None:
        missing = [name for name in names if name not in self.names]
        # The likeliest causes have a sentence of their own: "no column 't'; known are 0.0, 1.3"
        # leaves a reader puzzled where the file has no header at all.
        if missing and all(_NUMBER.fullmatch(name) for name in self.names):
            raise wrong(
                self.path,
                f"got numbers, expected the names of the columns, {shown(missing[0])} among them",
                f"line {self._body.first_line - 1}",
            )
        if missing and len(self.names) == 1:
            raise wrong(
                self.path,
                f"got no comma, semicolon or tab between names, expected columns,"
                f" {shown(missing[0])} among them",
                f"line {self._body.first_line - 1}",
            )
        require_columns(self.path, self.names, names)

    def _record(self, row: int) -> tuple[int, list[str]]:
        # From the top each time: only a message asks for one, and an index of all rows would be as
        # large as the log.
        for i, record in enumerate(self._body.records()):
            if i == row:
                return record
        raise IndexError(row)

    def _texts(self, indices: Sequence[int]) -> list["pa.ChunkedArray"]:
        """The cells of some columns as pyarrow string arrays (N,)."""
        # pyarrow takes a line break within quotes for one within a cell or for the end of a row, by
        # an option; either way the lines that it counts are not those of the file.
        texts = None if '"' in self._body.text else self._texts_by_pyarrow(indices)
        if texts is None:
            texts = self._texts_row_by_row(indices)
        if texts and not len(texts[0]):
            raise wrong(self.path, "holds a header alone, expected rows of numbers")
        return texts

    def _texts_by_pyarrow(self, indices: Sequence[int]) -> list["pa.ChunkedArray"] | None:
        """As `_texts`; None where pyarrow finds anything wrong."""
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        # By number, since two columns may have one name. As text, since pyarrow's own guess
        # knows no decimal comma, and gives up a column of numbers for one bad cell.
        names = [str(i) for i in range(len(self.names))]
        columns = [names[i] for i in indices]
        ragged: list[Any] = []

        # Called for each row with other than the header's number of cells: so for blank lines too,
        # which are no error. That there is any other is enough: `Body.records` finds its line.
        def skip(row: Any) -> str:
            if not self._body.is_blank(row.text):
                ragged.append(row)
            return "skip"

        try:
            table = arrow_csv.read_csv(
                pa.BufferReader(self._body.text.encode()),
                read_options=arrow_csv.ReadOptions(column_names=names),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=self._body.delimiter,
                    quote_char=False,
                    double_quote=False,
                    invalid_row_handler=skip,
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=dict.fromkeys(columns, pa.string()), include_columns=columns
                ),
            )
        except pa.ArrowException:  # such as a line longer than a block
            return None
        return None if ragged else [table.column(name) for name in columns]

    def _texts_row_by_row(self, indices: Sequence[int]) -> list["pa.ChunkedArray"]:
        """As `_texts`; cells are packed as they come: as objects of Python they take many times
        the file's size."""
        import pyarrow as pa

        # large_string: an array of string() holds 2 GB of text at most.
        width, kind = len(self.names), pa.large_string()
        pieces: list[list[Any]] = [[] for _ in indices]
        cells_of: list[list[str]] = [[] for _ in indices]

        def pack() -> None:
            for piece, cells in zip(pieces, cells_of, strict=True):
                piece.append(pa.array(cells, kind))
                cells.clear()

        for row, (line, cells) in enumerate(self._body.records()):
            if len(cells) != width:
                problem = f"{_count(len(cells))}, expected {width} as in the header"
                raise wrong(self.path, problem, f"line {line}")
            for column_cells, i in zip(cells_of, indices, strict=True):
                column_cells.append(cells[i])
            if row % self._rows_at_once == self._rows_at_once - 1:
                pack()
        pack()
        return [pa.chunked_array(piece, kind) for piece in pieces]

    @property
    def _rows_at_once(self) -> int:
        return max(1, _CELLS_AT_ONCE // len(self.names))


def _count(n: int) -> str:
    return "1 cell" if n == 1 else f"{n} cells"


def _compute() -> Any:
    """pyarrow's functions on columns; they are made at run time, so no checker knows them."""
    import pyarrow.compute

    return pyarrow.compute


class _TwoDecimalSigns(Exception):
    """A file holds both decimal commas and decimal points."""


def _decimal_points(texts: list["pa.ChunkedArray"], delimiter: str) -> list["pa.ChunkedArray"]:
    """The cells with decimal points for commas, where the comma is not the delimiter.

    Raises:
        _TwoDecimalSigns: so that no thousands separator passes for a decimal sign.
    """
    pc = _compute()
    # Over all columns that are read, not one by one: a file has one decimal sign, and a column of
    # 1.500 beside one of 1,5 holds thousands.
    signs = {}
    for sign in (",", ".") if delimiter != "," else ():
        for text in texts:
            matches = pc.match_substring(text, sign)
            # `index` alone would do, and import pandas for its second argument.
            row = pc.index(matches, True).as_py() if pc.any(matches).as_py() else -1
            if row >= 0:
                signs[sign] = shown(text[row].as_py().strip())
                break
    if "," not in signs:
        return texts
    if "." in signs:
        problem = f"got both {signs[',']} and {signs['.']}, expected one decimal sign"
        raise _TwoDecimalSigns(problem)
    return [pc.replace_substring(text, ",", ".") for text in texts]


def _filled(text: "pa.ChunkedArray") -> "pa.ChunkedArray":
    """Cells without the blanks around them, null where nothing is left."""
    import pyarrow as pa

    pc = _compute()
    trimmed = pc.utf8_trim_whitespace(text)
    # Not compared with "": pyarrow imports pandas, a fifth of a second, to take a value of Python.
    nothing = pa.nulls(1, trimmed.type)[0]
    return pc.if_else(pc.cast(pc.utf8_length(trimmed), pa.bool_()), trimmed, nothing)


def _floats(text: "pa.ChunkedArray") -> np.ndarray | int:
    """Cells as float64 (N,), NaN where empty; or the first row that holds no number."""
    import pyarrow as pa

    filled = _filled(text)
    try:
        numbers = filled.cast(pa.float64())
    except pa.ArrowInvalid:  # it does not say which row
        return _floats_one_by_one(filled)
    # As buffers, since to_numpy imports pandas too.
    values = _buffer(numbers, np.float64)
    return np.where(
        _buffer(_compute().is_valid(numbers).cast(pa.uint8()), np.uint8), values, np.nan
    )


def _buffer(numbers: "pa.ChunkedArray", kind: type) -> np.ndarray:
    """The numbers (N,), without regard to which are null."""
    pieces = [
        np.frombuffer(chunk.buffers()[1], kind, len(chunk), chunk.offset * np.dtype(kind).itemsize)
        for chunk in numbers.chunks
        if len(chunk)
    ]
    return np.concatenate([np.zeros(0, kind), *pieces])


def _floats_one_by_one(filled: "pa.ChunkedArray") -> np.ndarray | int:
    # In pieces: as objects of Python all cells at once take many times the file's size.
    values = np.full(len(filled), np.nan)
    pieces = (filled.slice(at, _CELLS_AT_ONCE) for at in range(0, len(filled), _CELLS_AT_ONCE))
    for row, cell in enumerate(cell for piece in pieces for cell in piece.to_pylist()):
        if cell is None:
            continue
        if not _NUMBER.fullmatch(cell):
            return row
        values[row] = float(cell)
    return values
