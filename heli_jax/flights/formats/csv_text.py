"""Logs in delimited text; pyarrow reads the numbers.

In a clean file all columns are read at once as numbers. If a cell is no plain number, the columns
are read as text. If a row has a wrong number of cells, the error names its line.
"""

import codecs
import csv
import functools
import gzip
import hashlib
import io
import itertools
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from heli_jax import units
from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights import progress
from heli_jax.flights.clock import is_date, seconds_of_dates, time_unit
from heli_jax.flights.formats.arrow import floats
from heli_jax.flights.log import (
    Budget,
    Survey,
    column,
    listed,
    require_columns,
    require_few_columns,
    shown,
    wrong,
)
from heli_jax.regular_file import read_regular, size_words

# Imported inside the functions that need it: it takes 0.25 s, which flights made in Python would
# not use.
if TYPE_CHECKING:
    import pyarrow as pa

_LARGEST = 8 * 10**9
"""Largest file [bytes]; the file and the requested columns are held in memory."""
_LARGEST_TEXT = 10**9
"""Largest size of cells that are parsed as text [bytes]."""
_LOOKED_AT, _MOST_LINES = 1 << 20, 20_000
"""Bytes and lines in which the table is searched."""
_FEWEST = 3
"""Fewest rows of a table."""
_FOREIGN = 0.1
"""Largest share of non-ASCII bytes in the text of a log."""
_DELIMITERS = ("\t", "|", ";", ",")
"""Delimiters, the most reliable first: a tab is in no number and hardly any name, a comma may be
decimal."""
_MARK = re.compile(r"\s*(?:#+|//+|%+(?=[\s%]|[^,;\t]*$))\s*")
"""Mark of a comment. A name may begin with a percent sign."""
MISSING = (
    *("NA", "N/A", "n/a", "null", "NULL", "None", "-", "#N/A", "--", "---", "?", "missing"),
    *("1.#QNAN", "-1.#QNAN", "1.#IND", "-1.#IND", "NaT", "<NA>"),
)
"""Cells without a value. NaN is not among them, because it is a number."""
_SIGN = "[+\u2212-]?"
_NUMBER = re.compile(
    rf"{_SIGN}(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eEdD]{_SIGN}[0-9]+)?|{_SIGN}(?:nan|inf|infinity)",
    re.IGNORECASE,
)
"""Text of a number. float() would also accept 1_000 and digits of any script."""
_WITH_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+(?:[eEdD][+-]?[0-9]+)?")


class _Head(NamedTuple):
    """Names of a table and the place where its rows begin."""

    names: tuple[str, ...]
    number: int
    """Line of the names, from 1."""
    delimiter: str
    begin: int
    """Beginning of the rows [bytes]."""
    first_line: int
    """First line of the rows, from 1."""
    units: tuple[str, ...] = ()
    is_fitting: bool = True
    """False if no rows with the same number of cells follow directly."""


class _Line(NamedTuple):
    number: int
    text: str
    """Text without the mark of a comment."""
    after: int
    """Beginning of the next line [bytes]."""
    is_comment: bool


def open_csv(path: Path) -> "CsvTable":
    """Read a text file, find its delimiter and its header."""
    where = str(path)
    packed = read_regular(path, "a log in CSV", _LARGEST)
    data = as_text(where, unpacked(where, packed) if is_gzipped(path) else packed)
    return table_of(where, packed, data, blanks=inner_ending(path) not in (".csv", ".tsv"))


def table_of(where: str, packed: bytes, data: bytes, *, blanks: bool = False) -> "CsvTable":
    """Return the table in a text.

    Args:
        where: name of its file, for messages.
        packed: the file's own bytes.
        data: its text in UTF-8.
        blanks: True if cells may be separated by blanks.
    """
    head = _find_head(where, data, (*_DELIMITERS, " ") if blanks else _DELIMITERS)
    line = f"line {head.number}"
    if not data[head.begin : head.begin + _LOOKED_AT].strip() and not data[head.begin :].strip():
        raise wrong(where, "has only a header, expected rows of numbers", line)
    rows = memoryview(data)[head.begin :]
    if head.delimiter == " ":
        lines = (b"\t".join(row.split()) for row in bytes(rows).split(b"\n"))
        head, rows = head._replace(delimiter="\t"), memoryview(b"\n".join(lines))
    require_few_columns(where, len(head.names), line)
    if any(map(is_date, head.names)) or all(map(_NUMBER.fullmatch, head.names)):
        names = ["time", *(f"column{i}" for i in range(2, len(head.names) + 1))][:6]
        between = ", with tabs between" if head.delimiter == "\t" else ""
        example = shown((" " if between else head.delimiter).join(names))
        problem = "got numbers or times, expected the names of the columns; write a line of names"
        raise wrong(where, f"{problem} above, such as {example}{between}", line)
    rows, notes = _whole(rows, head)
    if any(head.units):
        each = listed(f"{n} [{u}]" for n, u in zip(head.names, head.units, strict=True))
        words = f"units are read from the line below {line}: {each}"
        notes = (*notes, note("text.units-line", words, value=head.first_line - 1))
    return CsvTable(where, packed, rows, head, notes, data.find(b'"', head.begin) >= 0)


def is_gzipped(path: Path) -> bool:
    """True if the file's name ends in `.gz`."""
    return path.suffix.lower() == ".gz"


def inner_ending(path: Path) -> str:
    """Return the ending of the unpacked file: `.csv` for `log.csv.gz` and for `log.csv`."""
    return Path(path.stem if is_gzipped(path) else path.name).suffix.lower()


def unpacked(path: str, data: bytes) -> bytes:
    """Unpack bytes packed by gzip (RFC 1952)."""
    budget = Budget(path, len(data))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            text = file.read(budget.most + 1)
    except (OSError, EOFError, zlib.error) as e:
        raise wrong(path, f"is no whole file of gzip ({type(e).__name__})") from e
    # The numbers take memory too: eight bytes for two characters, a digit and its delimiter.
    budget.require(len(text) + 8 * sum(map(text.count, (b"\n", b",", b";", b"\t"))))
    return text


def as_text(path: str, data: bytes) -> bytes:
    """Return a file's text in UTF-8 with `\\n` between its lines.

    Spreadsheets save "Unicode text" as UTF-16 with a mark. Older programs write one byte a letter;
    the degree sign in a header is the most common case.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            data = data.decode("utf-16").encode()
        except UnicodeDecodeError as e:
            raise wrong(path, "begins as UTF-16 text but is damaged, expected whole text") from e
    data = data.removeprefix(codecs.BOM_UTF8)
    if (null := data.find(b"\0")) >= 0:  # valid in UTF-8, but in no log
        at = data.count(b"\n", 0, null) + 1
        raise wrong(path, "got binary data, expected text", f"line {at}")
    try:
        if not data.isascii():
            codecs.utf_8_decode(data, "strict", True)
    except UnicodeDecodeError as e:
        foreign = len(data) - len(data.decode("ascii", "ignore"))
        if foreign > _FOREIGN * len(data):
            at = data.count(b"\n", 0, e.start) + 1
            problem = f"got the byte 0x{data[e.start]:02x}, expected text in UTF-8"
            raise wrong(path, problem, f"line {at}") from e
        data = data.decode("cp1252", "replace").encode()
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


# The table is located by a line of names directly above rows with as many cells, most of them
# numbers.


def _find_head(path: str, data: bytes, delimiters: Sequence[str]) -> _Head:
    """Find the header of the table, below titles, settings and comments."""
    lines = list(_lines(data))
    plain = [line for line in lines if not line.is_comment]
    if not plain:
        raise wrong(path, "holds no header, expected names of columns and rows of numbers")
    for delimiter in delimiters:
        if (head := _head(lines, delimiter)) is not None:
            return head
    header = plain[0]
    delimiter = max(reversed(delimiters), key=header.text.count)
    names = tuple(cell.strip() for cell in _cells_of(header.text, delimiter))
    return _Head(names, header.number, delimiter, header.after, header.number + 1, (), False)


def _lines(data: bytes) -> Iterator[_Line]:
    """Yield the lines at the beginning of a text that are not blank."""
    at = 0
    for number in range(1, _MOST_LINES):
        if at >= min(len(data), _LOOKED_AT):
            return
        end = data.find(b"\n", at)
        after = len(data) if end < 0 else end + 1
        text = data[at : min(after, at + _LOOKED_AT)].decode("utf-8", "ignore").rstrip("\n")
        at = after
        if text.strip():
            mark = _MARK.match(text)
            yield _Line(number, text[mark.end() :] if mark else text, after, mark is not None)


def _head(lines: Sequence[_Line], delimiter: str) -> _Head | None:
    """Return the names above the first run of rows with the same number of cells."""
    if not any(delimiter in line.text for line in lines):
        return None
    cells = [_cells_of(line.text, delimiter) for line in lines]

    @functools.cache
    def width(i: int) -> int:
        return 0 if lines[i].is_comment or not _is_row(cells[i]) else len(cells[i])

    # A short file may end before `_FEWEST` rows.
    for row in range(1, len(lines)):
        run = range(row, min(row + _FEWEST, len(lines)))
        if width(row) < 2 or any(width(i) != width(row) for i in run):
            continue
        # A ruler or a remark may be between the names and the rows.
        at = row - 1 - (row > 1 and len(cells[row - 1]) == 1)
        stated: tuple[str, ...] = ()
        # The list of all units takes 0.25 s to load, so units are searched last.
        if at > 0 and _names_fit(cells[at - 1], cells[row]):
            stated = row_of_units(cells[at])
            at -= bool(stated)
        if not _names_fit(cells[at], cells[row]):
            continue
        # Rows may end with a delimiter, or lack the cell of a column for comments.
        names, units_of = (
            (*(cell.strip() for cell in one), *[""] * width(row))[: width(row)]
            for one in (cells[at], stated)
        )
        last = lines[row - 1]
        units_of = units_of if stated else ()
        return _Head(names, lines[at].number, delimiter, last.after, last.number + 1, units_of)
    return None


def _cells_of(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    if '"' in line:
        try:
            return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
        except (csv.Error, StopIteration):
            pass
    return line.split(delimiter)


def _is_value(cell: str) -> bool:
    """True if a cell belongs to a sample: a number, a time, or a mark for a missing value."""
    number = _NUMBER.fullmatch(cell) or _WITH_COMMA.fullmatch(cell)
    return number is not None or cell in MISSING or is_date(cell)


def _is_row(cells: Sequence[str]) -> bool:
    """True for the cells of a sample: the first is a number or a time, or most are."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    values = sum(map(_is_value, filled))
    return 2 * values > len(filled) or (3 * values >= len(filled) > 0 and _is_value(filled[0]))


def _names_fit(names: Sequence[str], row: Sequence[str]) -> bool:
    """True if a line names the cells of a row."""
    filled = [name.strip() for name in names if name.strip()]
    surplus = len(names) - len(row)
    fits = (
        surplus == 0
        or (surplus == 1 and names[-1].strip().lower() in ("", "comment", "comments"))
        or (surplus == -1 and not row[-1].strip())
    )
    # A sample in which all but the time is text is no line of names.
    if not fits or not filled or _is_value(filled[0]):
        return False
    return 2 * sum(map(_is_value, filled)) < len(filled)


def row_of_units(cells: Sequence[str]) -> tuple[str, ...]:
    """Return the units in a row below the names, without brackets; empty if it is no such row."""
    bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell.strip().strip('"')).strip() for cell in cells]
    # A row of missing values gives no units.
    words = [word for word in bare if word not in ("", "-", "1", "--", *MISSING)]
    if not words or any(map(_NUMBER.fullmatch, words)):
        return ()
    # Lower case is tried second, as for DEG/SEC. Single letters are excluded because they are
    # ambiguous: P is pressure, rate and pitch.
    known = {}
    for word in words:
        if time_unit(word) or units.is_unit(word):
            known[word] = word
        elif len(word) > 1 and units.is_unit(word.casefold()):
            known[word] = word.casefold()
    # Some units may be written in a way that is not known.
    if 2 * sum(word in known for word in words) < len(words):
        return ()
    return tuple(known.get(word, word) for word in bare)


def _whole(rows: memoryview, head: _Head) -> tuple[memoryview, tuple[Finding, ...]]:
    """Return the rows without incomplete ones at the end, and a note.

    Spreadsheets append rows of empty cells. A logger that lost its power leaves a last line without
    its last cells.
    """
    end = bytes(rows[-(1 << 16) :])
    kept = len(end.rstrip(b" \t\n" + head.delimiter.encode()))
    if kept and (after := end.find(b"\n", kept)) >= 0:
        return rows[: len(rows) - len(end) + after + 1], ()
    at = end.rfind(b"\n") + 1
    cells = end[at:].count(head.delimiter.encode()) + 1
    # A delimiter may be inside quotes. A single line is kept, so that its own error is reported.
    if at == 0 or cells >= len(head.names) or b'"' in end[at:]:
        return rows, ()
    words = f"the last line is cut off ({cells} of {len(head.names)} cells): it is left out"
    return rows[: len(rows) - len(end) + at], (note("text.line-cut-off", words, value=cells),)


class CsvTable:
    """`Table` of delimited text."""

    format = "csv"

    def __init__(
        self,
        path: str,
        packed: bytes,
        rows: memoryview,
        head: _Head,
        notes: tuple[Finding, ...],
        has_quotes: bool,
    ) -> None:
        self.path, self.size, self.names, self.notes = path, len(packed), head.names, notes
        self.sha256 = hashlib.sha256(packed).hexdigest()
        self.units: Mapping[str, str] = dict(zip(head.names, head.units, strict=False))
        self._rows, self._head = rows, head
        self._dates: set[str] = set()
        self._quote = '"' if has_quotes else False
        # The first rows decide the decimal sign of the whole file: otherwise `1.577` beside `0,25`
        # would be read as one and a half. Between commas, a decimal comma is in quotes.
        lines = bytes(rows[:_LOOKED_AT]).decode("utf-8", "ignore").split("\n")[:2000]
        lines = [line for line in lines if "," in line and (head.delimiter != "," or '"' in line)]
        cells = (cell.strip() for line in lines for cell in _cells_of(line, head.delimiter))
        self._sign = "," if any(map(_WITH_COMMA.fullmatch, cells)) else "."

    @property
    def begin(self) -> int:
        """Beginning of the rows in the text [bytes]."""
        return self._head.begin

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return the columns as float64 (N,), NaN where a cell is empty."""
        require_columns(self.path, self.names, names)
        with progress.reading(self.path, self.size):
            columns = self._columns([self.names.index(name) for name in names])
        numbers = {}
        for name, (values, _, _) in zip(names, columns, strict=True):
            if isinstance(values, int):
                cell = self.cell_text(name, values)
                sign = " with a decimal comma" if self._sign == "," else ""
                problem = f"got {cell}, expected a number{sign}"
                if ":" in cell:
                    problem += ", or a time such as 2024-03-01T23:59:55.01 or 23:59:55.01"
                raise wrong(self.path, problem, self.place(values), column(name))
            numbers[name] = values
        return numbers

    def survey(self) -> list[Survey]:
        """Survey every column, in the file's order."""
        with progress.reading(self.path, self.size):
            columns = self._columns(range(len(self.names)))
        surveys = []
        for name, (values, filled, odd) in zip(self.names, columns, strict=True):
            strays = ""
            if isinstance(values, int):
                if 2 * odd < filled:
                    words = "is no number" if odd == 1 else "are no numbers, the first"
                    place = f"{self.cell_text(name, values)} in {self.place(values)}"
                    strays = f"{odd} of {filled} {words}: {place}"
                values = None
            # A delimiter at the end of every row makes no column.
            if name or filled:
                surveys.append(Survey(name, values, filled, strays))
        return surveys

    def place(self, row: int) -> str:
        """Return `line 12`, counted from the top of the file with comments and blank lines."""
        return f"line {self._record(row)[0]}"

    def cell_text(self, name: str, row: int) -> str:
        """Return the text of a cell."""
        cell = self._record(row)[1][self.names.index(name)].strip()
        return shown(cell) if cell else "nothing"

    def time_unit(self, name: str) -> str | None:
        """Return seconds for a column of dates, else the unit of time in a row of units, if any."""
        return "s" if name in self._dates else time_unit(self.units.get(name, ""))

    def _columns(self, indices: Sequence[int]) -> list["_Column"]:
        """Return columns by index: as numbers at once if possible, else through their text."""
        import pyarrow as pa

        table = self._arrow(indices, pa.float64())
        if table is not None:
            columns = [table.column(str(i)) for i in indices]
            return [(floats(c), len(c) - c.null_count, 0) for c in columns]
        if len(self._rows) > _LARGEST_TEXT:
            problem = "has quotes, a row with another number of cells, or a cell that"
            problem += f" is no plain number, expected at most {size_words(_LARGEST_TEXT)} then"
            raise wrong(self.path, f"{problem}, got {size_words(len(self._rows))}")
        table = self._arrow(indices, pa.string())
        if table is None:
            raise self._ragged()
        return [self._parsed(self.names[i], table.column(str(i))) for i in indices]

    def _parsed(self, name: str, texts: "pa.ChunkedArray") -> "_Column":
        """Parse a column of texts."""
        import pyarrow as pa
        from pyarrow import compute

        pc: Any = compute  # its functions are made on import
        cells: Any = pc.utf8_trim(texts, ' \t"')
        nothing = pc.is_in(cells, pa.array(["", *MISSING]))
        cells = pc.if_else(nothing, pa.scalar(None, pa.string()), cells)
        filled = len(cells) - cells.null_count
        plain = cells
        if self._sign == ",":
            # A point beside decimal commas would be a thousands separator or a slip.
            mixed = pc.match_substring(plain, ".")
            plain = pc.if_else(mixed, pa.scalar("x"), pc.replace_substring(plain, ",", "."))
        is_number = pc.match_substring_regex(plain, f"^(?:{_NUMBER.pattern})$", ignore_case=True)
        odd = filled - pc.sum(is_number).as_py() if filled else 0
        if not odd:
            # Fortran writes 1.0D+00, some programs a true minus sign; pyarrow accepts no leading
            # plus.
            plain = pc.replace_substring(plain, "\u2212", "-")
            plain = pc.replace_substring_regex(plain, r"^\+", "")
            plain = pc.replace_substring_regex(plain, r"([0-9.])[dD]", r"\1e")
            return floats(pc.cast(plain, pa.float64())), filled, 0
        if is_date(cells.drop_null()[0].as_py()):
            self._dates.add(name)
            seconds = seconds_of_dates(cells.to_pylist())
            return seconds, filled, odd if isinstance(seconds, int) else 0
        return pc.index(is_number, False).as_py(), filled, odd

    def _arrow(self, indices: Sequence[int], kind: Any) -> "pa.Table | None":
        """Return columns by index, in one type; None if pyarrow cannot read them."""
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        ragged: list[Any] = []

        # Called for each row with a wrong number of cells. Blank lines are no error. Any other row
        # is; `_ragged` finds its line.
        def skip(row: Any) -> str:
            if not _is_blank(row.text, self._head.delimiter):
                ragged.append(row)
            return "skip"

        # By number, because two columns may have the same name.
        names = [str(i) for i in dict.fromkeys(indices)]
        try:
            table = arrow_csv.read_csv(
                pa.BufferReader(pa.py_buffer(self._rows)),
                read_options=arrow_csv.ReadOptions(
                    column_names=[str(i) for i in range(len(self.names))]
                ),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=self._head.delimiter,
                    quote_char=self._quote,
                    invalid_row_handler=skip,
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=dict.fromkeys(names, kind),
                    include_columns=names,
                    # pyarrow's own list has more words, such as #N/A N/A.
                    null_values=["", *MISSING],
                    decimal_point=self._sign,
                ),
            )
        except pa.ArrowException:  # e.g. a line longer than a block, or a cell that is no number
            return None
        return None if ragged or not table.num_rows else table

    def _ragged(self) -> InputError:
        """Return the error for a row with a different number of cells than the header."""
        delimiter = self._head.delimiter
        for line, text in self._records():
            # Counted, not split: a damaged line may have millions of cells.
            plain = '"' not in text
            count = text.count(delimiter) + 1 if plain else len(self._cells(line, text))
            if count != len(self.names):
                problem = f"{count} cell{'' if count == 1 else 's'}, expected"
                problem += f" {len(self.names)} as in the header in line {self._head.number}"
                if not self._head.is_fitting:
                    problem += "; no line of names is directly above rows with as many cells"
                if delimiter == "," and count > len(self.names):
                    problem += "; if these are decimal commas, separate the cells by semicolons"
                return wrong(self.path, problem, f"line {line}")
        return wrong(self.path, "holds no rows that can be read, expected rows of numbers")

    def _record(self, row: int) -> tuple[int, list[str]]:
        """Return a row's line number and cells."""
        # Read from the top each time: only error messages need this, and an index of all rows would
        # be as large as the log.
        line, text = next(itertools.islice(self._records(), row, None))
        return line, self._cells(line, text)

    def _records(self) -> Iterator[tuple[int, str]]:
        """Yield each row's line number and text, without blank lines, as pyarrow's reader does."""
        # newline: Python ends a line at more characters than spreadsheets and pyarrow do.
        lines = io.TextIOWrapper(io.BytesIO(self._rows), "utf-8", newline="\n")
        for number, line in enumerate(lines, self._head.first_line):
            if not _is_blank(line, self._head.delimiter):
                yield number, line.rstrip("\n")

    def _cells(self, line: int, text: str) -> list[str]:
        delimiter = self._head.delimiter
        if '"' not in text:
            return text.split(delimiter)
        try:
            return next(csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True))
        except csv.Error as e:
            problem = "a quotation mark is not closed in its line, expected numbers"
            raise wrong(self.path, problem, f"line {line}") from e


type _Column = tuple[np.ndarray | int, int, int]
"""Numbers (N,) or the first row without one; count of filled cells; count of cells without a
number."""


def _is_blank(line: str, delimiter: str) -> bool:
    """True for a line without a cell; a line of delimiters alone is a row of empty cells."""
    return not line.strip() and delimiter not in line
