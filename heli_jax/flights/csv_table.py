"""Logs in delimited text: fast through pyarrow, and line by line where something is wrong.

pyarrow neither names the line of a bad cell nor keeps lines apart inside quotes. So a clean file
takes the fast way, and `Body.records` walks the text again to say where an error is.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights import progress
from heli_jax.flights.csv_arrow import likely_numbers, number_columns, text_columns
from heli_jax.flights.csv_cells import row_of_units
from heli_jax.flights.csv_comments import without_comments
from heli_jax.flights.csv_dates import is_date, is_day, seconds_of_dates
from heli_jax.flights.csv_encoding import as_utf8
from heli_jax.flights.csv_lines import Head
from heli_jax.flights.csv_on_disk import plain_beginning
from heli_jax.flights.csv_preamble import as_wide, find_head, qualified, require_names
from heli_jax.flights.csv_signs import TwoDecimalSigns, decimal_points, decimal_signs
from heli_jax.flights.csv_text import (
    LONGEST_HEADER,
    Body,
    check_text,
    first_row,
    header_names,
    is_of_blanks,
    require_short_lines,
    tabs_for_blanks,
)
from heli_jax.flights.csv_texts import (
    CELLS_AT_ONCE,
    compute,
    few_strays,
    filled_cells,
    text_floats,
)
from heli_jax.flights.digest import Digest
from heli_jax.flights.gzipped import inner_ending, is_gzipped, unpacked
from heli_jax.flights.table import (
    Survey,
    column,
    require_columns,
    require_few_columns,
    shown,
    wrong,
)
from heli_jax.flights.time_units import time_unit
from heli_jax.regular_file import read_regular, size_words

# Imported again within the functions that need it: it takes a quarter of a second, which
# flights made in Python need not wait for.
if TYPE_CHECKING:
    import pyarrow as pa

_LARGEST = 16 * 10**9
"""bytes: the file is held in memory, and the columns that are asked for"""
_SOUGHT = "no line of names stands right above rows of as many cells, most of them numbers"
"""of a file in whose first 1 MB a table was sought"""
_FIRST = 100
"""rows in which a column's first filled cell is looked for"""
_LARGEST_SEARCHED = 250 * 10**6
"""bytes of rows among which comments are looked for, which needs them twice in memory"""
_LARGEST_TEXT = 2 * 10**9
"""bytes of cells that are looked at as text, in which they take many times as much"""


def open_csv(path: Path) -> "CsvTable":
    """Read a text file, find its delimiter and its header.

    Raises:
        InputError: it is no UTF-8 text, or holds no header or no rows.
        OSError: it cannot be read.
    """
    where = str(path)
    plain = None if is_gzipped(path) else plain_beginning(path, _LARGEST)
    # Of a plain file the beginning stands for all of it in what follows.
    data = plain.data if plain else read_regular(path, "a log in CSV", _LARGEST)
    digest, size = (Digest(path), plain.size) if plain else (Digest(data), len(data))
    if is_gzipped(path):
        data = unpacked(where, data)
    data = as_utf8(where, data)
    check_text(where, data)
    blanks = inner_ending(path) not in (".csv", ".tsv")
    head = find_head(where, data, blanks)
    if head is None:
        raise wrong(where, "holds no header, expected names of columns and rows of numbers")
    (header, number, after), delimiter = head.header, head.delimiter
    line = f"line {number}"
    first = first_row(data, after)
    if first is None:
        raise wrong(where, "holds a header alone, expected rows of numbers", line)
    if len(header) > LONGEST_HEADER:
        raise wrong(where, "is longer than a line of a log can be", line)
    require_short_lines(where, data, after, head.first_line)
    rows = plain.rows(after) if plain else memoryview(data)[after:]
    if blanks and is_of_blanks(header, first):
        text = Body(where, rows, delimiter, 1, False).text
        header, delimiter = tabs_for_blanks(header), "\t"
        rows = memoryview(tabs_for_blanks(text).encode())
    # Before the names are parsed, so that a line of commas makes no million names.
    require_few_columns(where, header.count(delimiter) + 1, line)
    names = header_names(where, header, delimiter, number)
    require_names(where, names, delimiter, line)
    quotes = data.find(b'"', after) >= 0
    body = Body(where, rows, delimiter, head.first_line, quotes)
    groups = [header_names(where, text, delimiter, number) for text in head.above]
    names = as_wide(qualified(names, groups), body)
    body, cut = body.filled().whole(len(names))
    notes, units = cut, _units_below(body, names)
    if units is None:
        stated = dict(zip(names[1:], head.units, strict=False))
        return CsvTable(size, digest, names, body, head, notes, stated)
    body, number_of_line = _below(body)
    listed = ", ".join(f"{n} [{u}]" for n, u in list(zip(names, units, strict=True))[:6])
    words = f"line {number_of_line} was taken for units and not for a sample: {listed}"
    notes = (*notes, note("text.units-line", words, value=number_of_line))
    stated = dict(zip(names, units, strict=True))
    return CsvTable(size, digest, names, body, head, notes, stated)


def _units_below(body: Body, names: tuple[str, ...]) -> tuple[str, ...] | None:
    """The units in the first row of the body; None where it holds none."""
    first = first_row(body.beginning(LONGEST_HEADER), 0) or ""
    cells = first.split(body.delimiter)
    return row_of_units(cells) if len(cells) == len(names) else None


def _below(body: Body) -> tuple[Body, int]:
    """The body without its first row, and that row's line."""
    data = body.beginning(LONGEST_HEADER)
    lines, at = 0, 0
    while not data[at : (end := _end_of_line(data, at))].strip():
        lines, at = lines + 1, end
    end = _end_of_line(data, at)
    if end >= body.size:
        raise wrong(body.path, "holds a header and units alone, expected rows of numbers")
    return body.below(end, lines + 1), body.first_line + lines


def _end_of_line(data: bytes, at: int) -> int:
    """Where the next line begins."""
    ends = [i for i in (data.find(b"\n", at), data.find(b"\r", at)) if i >= 0]
    end = min(ends, default=len(data) - 1)
    return end + 2 if data[end : end + 2] == b"\r\n" else end + 1


class CsvTable:
    """A `Table` on delimited text."""

    format = "csv"

    def __init__(
        self,
        size: int,
        digest: Digest,
        names: tuple[str, ...],
        body: Body,
        head: Head,
        notes: tuple[Finding, ...] = (),
        units: Mapping[str, str] | None = None,
    ) -> None:
        self.path, self.size, self.names = body.path, size, names
        self.notes = notes
        self.units: Mapping[str, str] = dict(units or {})
        self._digest, self._body, self._head = digest, body, head
        self._dates: set[str] = set()
        self._signs = decimal_signs(body)
        self._is_searched = False
        """for comments among the rows"""

    @property
    def sha256(self) -> str:
        """Of the file."""
        return self._digest.hex()

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty.

        Raises:
            InputError: a column is missing or there twice, a row has more or fewer cells than
                the header, a cell is no number.
        """
        self._require(names)
        with progress.reading(self.path, self.size):
            numbers = self._numbers(names)
        self._digest.begin()
        return numbers

    def _numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        indices = [self.names.index(name) for name in names]
        numbers = number_columns(self._body, len(self.names), indices, self._signs)
        if numbers is None and self._passed_over():
            numbers = number_columns(self._body, len(self.names), indices, self._signs)
        if numbers is not None:
            return {n: numbers[i].values for n, i in zip(names, indices, strict=True)}
        result = {}
        for name, text in zip(names, self._texts(indices), strict=True):
            try:
                values = self._values(name, text)
            except TwoDecimalSigns as e:
                raise wrong(self.path, str(e), column(name)) from e
            if isinstance(values, int):
                self._require_no_names(values)
                problem = f"got {self.cell_text(name, values)}, expected a number"
                raise wrong(self.path, problem, self.place(values), column(name))
            result[name] = values
        return result

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        with progress.reading(self.path, self.size):
            return self._survey()

    def _survey(self) -> list[Survey]:
        width = len(self.names)
        likely = likely_numbers(self._body, width, self._signs)
        plain = number_columns(self._body, width, likely, self._signs) or {}
        rest = [i for i in range(width) if i not in plain]
        if rest and self._passed_over():
            return self._survey()
        by_column = {i: Survey(self.names[i], c.values, c.filled) for i, c in plain.items()}
        if rest:
            texts = zip(rest, self._texts(rest), strict=True)
            by_column |= {i: self._surveyed(self.names[i], text) for i, text in texts}
        # What stands behind a delimiter at the end of every row is no column.
        surveys = [by_column[i] for i in range(width)]
        return [s for s in surveys if s.name or s.n_filled]

    def _surveyed(self, name: str, text: "pa.ChunkedArray") -> Survey:
        try:
            values = self._values(name, text)
        # Neither commas nor points are decimal for sure: a survey calls it text, row 0 on.
        except TwoDecimalSigns:
            values = 0
        filled = len(text) - filled_cells(text).null_count
        if not isinstance(values, int):
            return Survey(name, values, filled)
        count = few_strays(text)
        if not count:
            return Survey(name, None, filled)
        words = "is no number" if count == 1 else "are no numbers, the first"
        place = f"{self.cell_text(name, values)} in {self.place(values)}"
        return Survey(name, None, filled, f"{count} of {filled} {words}: {place}")

    def place(self, row: int) -> str:
        """`line 12`, counted from the top of the file, comments and blank lines included."""
        return f"line {self._record(row)[0]}"

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        cell = self._record(row)[1][self.names.index(name)].strip()
        return shown(cell) if cell else "nothing"

    def time_unit(self, name: str) -> str | None:
        """Seconds of a column of dates; else what a row of units says, where it is one of time."""
        if name in self._dates:
            return "s"
        return time_unit(self.units.get(name, ""))

    def _values(self, name: str, text: "pa.ChunkedArray") -> np.ndarray | int:
        """A column's numbers (N,), or the first row that holds none.

        Raises:
            TwoDecimalSigns: a number has the other sign than the file.
        """
        filled = filled_cells(text)
        # Before signs are changed, which dates and times of day have of their own.
        first = next((c for c in filled[:_FIRST].to_pylist() if c is not None), "")
        if not is_date(first):
            # Both may be tried where no row at the beginning has a sign.
            has_commas = len(self._signs) > 1 and _has_comma(filled)
            sign = "," if has_commas else self._signs[0]
            points, example = decimal_points(filled, sign)
            values = text_floats(points)
            if example and not isinstance(values, int):
                other = "commas" if sign == "," else "points"
                words = f"{shown(name)} has marks between thousands, as in {shown(example)}"
                self._note(note("text.thousands", f"{words}: {other} are decimal", name))
            return values
        cells = filled.to_pylist()
        dates = seconds_of_dates(cells, self._days(name))
        if isinstance(dates, int):
            return dates
        self._dates.add(name)
        if dates.note:
            self._note(note("clock.dates", f"{shown(name)}: {dates.note}", name))
        return dates.seconds

    def _days(self, name: str) -> list[str | None] | None:
        """The cells of the one column of dates beside a time of day."""
        _, first = self._record(0)
        columns = [i for i, cell in enumerate(first) if is_day(cell.strip())]
        if len(columns) != 1 or self.names[columns[0]] == name:
            return None
        return filled_cells(self._texts(columns)[0]).to_pylist()

    def _passed_over(self) -> bool:
        """Whether comments stood among the rows, which are without them from now on."""
        if self._is_searched or self._body.size > _LARGEST_SEARCHED:
            return False
        self._is_searched = True
        stripped = without_comments(self._body)
        if stripped is None:
            return False
        self._body, passed_over = stripped
        self._signs = decimal_signs(self._body)
        self._note(passed_over)
        return True

    def _note(self, finding: Finding) -> None:
        if finding not in self.notes:
            self.notes = (*self.notes, finding)

    def _require_no_names(self, row: int) -> None:
        """Refuse a header between the rows: a logger began anew there."""
        line, cells = self._record(row)
        if tuple(cell.strip().strip('"') for cell in cells) == self.names:
            problem = "holds the names of the columns again, as where a logger began anew, expected"
            raise wrong(self.path, f"{problem} numbers; make two files of it here", f"line {line}")

    def _require(self, names: Sequence[str]) -> None:
        missing = [name for name in names if name not in self.names]
        # The likeliest cause has a sentence of its own.
        if missing and len(self.names) == 1:
            raise wrong(
                self.path,
                f"got no comma, semicolon or tab between names, expected columns,"
                f" {shown(missing[0])} among them",
                f"line {self._head.header.number}",
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
        size = self._body.size
        if size > _LARGEST_TEXT:
            problem = (
                "has quotes, a row of other than the header's number of cells, or a cell that is "
                f"no plain number, which is looked at in files of at most "
                f"{size_words(_LARGEST_TEXT)}, got {size_words(size)}"
            )
            raise wrong(self.path, problem)
        texts = text_columns(self._body, len(self.names), indices)
        if texts is None:
            texts = self._texts_row_by_row(indices)
        if texts and not len(texts[0]):
            raise wrong(self.path, "holds a header alone, expected rows of numbers")
        return texts

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
                problem += f" in line {self._head.header.number}"
                if not self._head.is_fitting:
                    problem += f"; {_SOUGHT}"
                raise wrong(self.path, problem, f"line {line}")
            for column_cells, i in zip(cells_of, indices, strict=True):
                column_cells.append(cells[i])
            if row % self._rows_at_once == self._rows_at_once - 1:
                pack()
        pack()
        return [pa.chunked_array(piece, kind) for piece in pieces]

    @property
    def _rows_at_once(self) -> int:
        return max(1, CELLS_AT_ONCE // len(self.names))


def _count(n: int) -> str:
    return "1 cell" if n == 1 else f"{n} cells"


def _has_comma(text: "pa.ChunkedArray") -> bool:
    pc = compute()
    return bool(pc.any(pc.match_substring(text, ",")).as_py())
