"""Logs in delimited text: fast through pyarrow, and line by line where something is wrong.

pyarrow neither names the line of a bad cell nor keeps lines apart inside quotes. So a clean file
takes the fast way, and `_records` walks the text again to say where an error is.
"""

import csv
import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.flights.csv_text import (
    LONGEST_HEADER,
    decode,
    find_delimiter,
    find_header,
    header_names,
    lines_of,
    require_short_lines,
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

_NUMBER = re.compile(
    r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
    r"|[+-]?(?:nan|inf|infinity)",
    re.IGNORECASE,
)
_LARGEST = 10**9
"""bytes: a log in text is read as a whole, and takes about ten times its size meanwhile"""
_ROWS_AT_ONCE = 1 << 16


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
    end = text.find("\n", start)
    end = len(text) if end < 0 else end
    body = text[end + 1 :]
    if not body.strip():
        raise wrong(str(path), "holds a header alone, expected rows of numbers", f"line {line}")
    header = text[start:end]
    if len(header) > LONGEST_HEADER:
        raise wrong(str(path), "is longer than a line of a log can be", f"line {line}")
    require_short_lines(str(path), body, line + 1)
    delimiter = find_delimiter(header, body.lstrip("\n").split("\n", 1)[0])
    require_few_columns(str(path), header.count(delimiter) + 1, f"line {line}")
    names = header_names(str(path), header, delimiter, line)
    return CsvTable(
        path=str(path),
        size=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
        names=names,
        delimiter=delimiter,
        body=body,
        first_line=line + 1,
    )


class CsvTable:
    """A `Table` on delimited text."""

    format = "csv"

    def __init__(
        self,
        *,
        path: str,
        size: int,
        sha256: str,
        names: tuple[str, ...],
        delimiter: str,
        body: str,
        first_line: int,
    ) -> None:
        self.path, self.size, self.sha256 = path, size, sha256
        self.names, self.delimiter = names, delimiter
        self._body, self._first_line = body, first_line

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty.

        Raises:
            InputError: a column is missing or there twice, a row has more or fewer cells than
                the header, a cell is no number.
        """
        self._require(names)
        indices = [self.names.index(name) for name in names]
        try:
            texts = _decimal_points(self._texts(indices), self.delimiter)
        except _TwoDecimalSigns as e:
            raise wrong(self.path, str(e)) from e
        result = {}
        for name, text in zip(names, texts, strict=True):
            values = _floats(text)
            if isinstance(values, int):
                found = f"got {self.found(name, values)}, expected a number"
                raise wrong(self.path, found, self.place(values), column(name))
            result[name] = values
        return result

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        result = []
        for name, text in zip(self.names, self._texts(range(len(self.names))), strict=True):
            try:
                values = _floats(_decimal_points([text], self.delimiter)[0])
            except _TwoDecimalSigns:
                values = 0
            filled = len(text) - _filled(text).null_count
            result.append(Survey(name, None if isinstance(values, int) else values, filled))
        return result

    def place(self, row: int) -> str:
        """`line 12`, counted from the top of the file, comments and blank lines included."""
        return f"line {self._record(row)[0]}"

    def found(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        cell = self._record(row)[1][self.names.index(name)].strip()
        return shown(cell) if cell else "nothing"

    def time_unit(self, name: str) -> None:
        """Text has no type."""
        return None

    def _require(self, names: Sequence[str]) -> None:
        missing = [name for name in names if name not in self.names]
        if missing and all(_NUMBER.fullmatch(name) for name in self.names):
            raise wrong(
                self.path,
                f"got numbers, expected the names of the columns, {shown(missing[0])} among them",
                f"line {self._first_line - 1}",
            )
        if missing and len(self.names) == 1:
            raise wrong(
                self.path,
                f"got no comma, semicolon or tab between names, expected columns,"
                f" {shown(missing[0])} among them",
                f"line {self._first_line - 1}",
            )
        require_columns(self.path, self.names, names)

    def _record(self, row: int) -> tuple[int, list[str]]:
        for i, record in enumerate(self._records()):
            if i == row:
                return record
        raise IndexError(row)

    def _records(self) -> Iterator[tuple[int, list[str]]]:
        """Each row's line and cells. Blank lines are passed over, as in pyarrow's reader."""
        if '"' not in self._body:
            for number, line in enumerate(lines_of(self._body), self._first_line):
                if not _is_blank(line, self.delimiter):
                    yield number, line.split(self.delimiter)
            return
        lines = (f"{line}\n" for line in lines_of(self._body))
        reader = csv.reader(lines, delimiter=self.delimiter, skipinitialspace=True, strict=True)
        start = self._first_line
        try:
            for cells in reader:
                if cells and not (len(cells) == 1 and _is_blank(cells[0], self.delimiter)):
                    yield start, cells
                start = self._first_line + reader.line_num
        except csv.Error as e:
            problem = "a quotation mark that closes nothing or is never closed, expected numbers"
            raise wrong(self.path, problem, f"line {start}") from e

    def _texts(self, indices: Sequence[int]) -> list[Any]:
        """The cells of some columns as pyarrow string arrays (N,)."""
        texts = None if '"' in self._body else self._texts_by_pyarrow(indices)
        if texts is None:
            texts = self._texts_row_by_row(indices)
        if texts and not len(texts[0]):
            raise wrong(self.path, "holds a header alone, expected rows of numbers")
        return texts

    def _texts_by_pyarrow(self, indices: Sequence[int]) -> list[Any] | None:
        """As `_texts`; None where pyarrow finds anything wrong."""
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        names = [str(i) for i in range(len(self.names))]
        wanted = [names[i] for i in indices]
        ragged: list[Any] = []

        def skip(row: Any) -> str:
            if not _is_blank(row.text, self.delimiter):
                ragged.append(row)
            return "skip"

        try:
            table = arrow_csv.read_csv(
                pa.BufferReader(self._body.encode()),
                read_options=arrow_csv.ReadOptions(column_names=names),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=self.delimiter,
                    quote_char=False,
                    double_quote=False,
                    invalid_row_handler=skip,
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=dict.fromkeys(wanted, pa.string()), include_columns=wanted
                ),
            )
        except pa.ArrowException:  # such as a line longer than a block
            return None
        return None if ragged else [table.column(name) for name in wanted]

    def _texts_row_by_row(self, indices: Sequence[int]) -> list[Any]:
        """As `_texts`; cells are packed as they come: as objects of Python they take many times
        the file's size."""
        import pyarrow as pa

        width, kind = len(self.names), pa.large_string()
        pieces: list[list[Any]] = [[] for _ in indices]
        cells_of: list[list[str]] = [[] for _ in indices]

        def pack() -> None:
            for piece, cells in zip(pieces, cells_of, strict=True):
                piece.append(pa.array(cells, kind))
                cells.clear()

        for row, (line, cells) in enumerate(self._records()):
            if len(cells) != width:
                problem = f"{_count(len(cells))}, expected {width} as in the header"
                raise wrong(self.path, problem, f"line {line}")
            for one, i in zip(cells_of, indices, strict=True):
                one.append(cells[i])
            if row % self._rows_at_once == self._rows_at_once - 1:
                pack()
        pack()
        return [pa.chunked_array(piece, kind) for piece in pieces]

    @property
    def _rows_at_once(self) -> int:
        return max(1, _ROWS_AT_ONCE // len(self.names))


def _count(n: int) -> str:
    return "1 cell" if n == 1 else f"{n} cells"


def _is_blank(line: str, delimiter: str) -> bool:
    return not line.strip() and delimiter not in line


def _compute() -> Any:
    """pyarrow's functions on columns; they are made at run time, so no checker knows them."""
    import pyarrow.compute

    return pyarrow.compute


class _TwoDecimalSigns(Exception):
    """A file holds both decimal commas and decimal points."""


def _decimal_points(texts: list[Any], delimiter: str) -> list[Any]:
    """The cells with decimal points for commas, where the comma is not the delimiter.

    Raises:
        _TwoDecimalSigns: so that no thousands separator passes for a decimal sign.
    """
    pc = _compute()
    signs = {}
    for sign in (",", ".") if delimiter != "," else ():
        for text in texts:
            row = pc.index(pc.match_substring(text, sign), True).as_py()
            if row >= 0:
                signs[sign] = shown(text[row].as_py().strip())
                break
    if "," not in signs:
        return texts
    if "." in signs:
        problem = f"got both {signs[',']} and {signs['.']}, expected one decimal sign"
        raise _TwoDecimalSigns(problem)
    return [pc.replace_substring(text, ",", ".") for text in texts]


def _filled(text: Any) -> Any:
    """Cells without the blanks around them, null where nothing is left."""
    pc = _compute()
    trimmed = pc.utf8_trim_whitespace(text)
    return pc.if_else(pc.equal(trimmed, ""), None, trimmed)


def _floats(text: Any) -> np.ndarray | int:
    """Cells as float64 (N,), NaN where empty; or the first row that holds no number."""
    import pyarrow as pa

    filled = _filled(text)
    try:
        return np.asarray(filled.cast(pa.float64()).to_numpy(zero_copy_only=False))
    except pa.ArrowInvalid:
        return _floats_one_by_one(filled)


def _floats_one_by_one(filled: Any) -> np.ndarray | int:
    values = np.full(len(filled), np.nan)
    pieces = (filled.slice(at, _ROWS_AT_ONCE) for at in range(0, len(filled), _ROWS_AT_ONCE))
    for row, cell in enumerate(cell for piece in pieces for cell in piece.to_pylist()):
        if cell is None:
            continue
        if not _NUMBER.fullmatch(cell):
            return row
        values[row] = float(cell)
    return values
