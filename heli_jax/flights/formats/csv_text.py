"""Logs in delimited text, of which pyarrow reads the numbers.

A clean file takes the fast way, all columns at once as numbers. Where a cell is no plain number the
columns are read as text; where a row has another number of cells, its line is told.
"""

import codecs
import csv
import functools
import gzip
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
from heli_jax.flights.progress import Digest
from heli_jax.regular_file import read_regular, size_words

# Imported again within the functions that need it: it takes a quarter of a second, which
# flights made in Python need not wait for.
if TYPE_CHECKING:
    import pyarrow as pa

_LARGEST = 8 * 10**9
"""bytes: the file is held in memory, and the columns that are asked for"""
_LARGEST_TEXT = 10**9
"""bytes of cells that are looked at as text"""
_LOOKED_AT, _MOST_LINES = 1 << 20, 20_000
"""bytes and lines in which a table is sought"""
_FEWEST = 3
"""rows that make a table"""
_FOREIGN = 0.1
"""part of the bytes that are none of ASCII, from which on they are no text of a log"""
_DELIMITERS = ("\t", "|", ";", ",")
"""the surest first: a tab stands in no number and in hardly any name, a comma may be decimal"""
_MARK = re.compile(r"\s*(?:#+|//+|%+(?=[\s%]|[^,;\t]*$))\s*")
"""of a comment. A name may begin with a percent sign"""
_SEPARATOR = re.compile(r'"?sep=([,;|:\t ])"?\s*', re.IGNORECASE)
MISSING = (
    *("NA", "N/A", "n/a", "null", "NULL", "None", "-", "#N/A", "--", "---", "?", "missing"),
    *("1.#QNAN", "-1.#QNAN", "1.#IND", "-1.#IND", "NaT", "<NA>"),
)
"""cells that say that there is no value, beside NaN, which is a number"""
_SIGN = "[+\u2212-]?"
_NUMBER = re.compile(
    rf"{_SIGN}(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eEdD]{_SIGN}[0-9]+)?|{_SIGN}(?:nan|inf|infinity)",
    re.IGNORECASE,
)
"""float() would also take 1_000, and digits of any script"""
_WITH_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+(?:[eEdD][+-]?[0-9]+)?")


class _Head(NamedTuple):
    """The names of a table, and where its rows begin."""

    names: tuple[str, ...]
    number: int
    """of the line of names, from 1"""
    delimiter: str
    begin: int
    """of the rows [bytes]"""
    first_line: int
    """of the rows, from 1"""
    units: tuple[str, ...] = ()
    is_fitting: bool = True
    """False where no rows of as many cells were found right below"""


class _Line(NamedTuple):
    number: int
    text: str
    """without the mark of a comment"""
    after: int
    """where the next begins [bytes]"""
    is_comment: bool


def open_csv(path: Path) -> "CsvTable":
    """Read a text file, find its delimiter and its header."""
    where = str(path)
    packed = read_regular(path, "a log in CSV", _LARGEST)
    digest, size = Digest(packed), len(packed)
    data = as_text(where, unpacked(where, packed) if is_gzipped(path) else packed)
    blanks = inner_ending(path) not in (".csv", ".tsv")
    head = _find_head(where, data, (*_DELIMITERS, " ") if blanks else _DELIMITERS)
    line = f"line {head.number}"
    if not data[head.begin : head.begin + _LOOKED_AT].strip() and not data[head.begin :].strip():
        raise wrong(where, "holds a header alone, expected rows of numbers", line)
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
    return CsvTable(where, size, digest, rows, head, notes, data.find(b'"', head.begin) >= 0)


def is_gzipped(path: Path) -> bool:
    """True if a file's name says so."""
    return path.suffix.lower() == ".gz"


def inner_ending(path: Path) -> str:
    """Return the ending of the unpacked file: `.csv` of `log.csv.gz`, of `log.csv` too."""
    return Path(path.stem if is_gzipped(path) else path.name).suffix.lower()


def unpacked(path: str, data: bytes) -> bytes:
    """Unpack the bytes that were packed by gzip (RFC 1952)."""
    text, budget = bytearray(), Budget(path, len(data))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            while piece := file.read(1 << 22):
                # And its numbers: of two letters, a digit and what is behind it, eight bytes.
                ends = sum(map(piece.count, (b"\n", b",", b";", b"\t")))
                budget.take(len(piece) + 8 * ends)
                text += piece
    except (OSError, EOFError, zlib.error) as e:
        raise wrong(path, f"is no whole file of gzip ({type(e).__name__})") from e
    return bytes(text)


def as_text(path: str, data: bytes) -> bytes:
    """Return a file's text in UTF-8 with `\\n` between its lines.

    Spreadsheets save "Unicode text" as UTF-16 with a mark, and older programs write one byte a
    letter, of which the degree sign in a header is the commonest.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            data = data.decode("utf-16").encode()
        except UnicodeDecodeError as e:
            raise wrong(path, "begins as UTF-16 text but is damaged, expected whole text") from e
    data = data.removeprefix(codecs.BOM_UTF8)
    if (null := data.find(b"\0")) >= 0:  # valid in UTF-8, and in no log
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


# Where the table is: a line of names right above rows of as many cells, most of them numbers.


def _find_head(path: str, data: bytes, delimiters: Sequence[str]) -> _Head:
    """Find the header of the table, below what stands above it: titles, settings, comments."""
    lines = list(_lines(data))
    if lines and (separator := _SEPARATOR.fullmatch(lines[0].text)):
        # Excel's own word for what stands between cells.
        delimiters, lines = (separator[1],), lines[1:]
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
    """The lines at the beginning of a text that are not blank."""
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
    """The names above the first run of rows with as many cells."""
    if not any(delimiter in line.text for line in lines):
        return None
    cells = [_cells_of(line.text, delimiter) for line in lines]

    @functools.cache
    def width(i: int) -> int:
        return 0 if lines[i].is_comment or not _is_row(cells[i]) else len(cells[i])

    # A file may end before there are so many.
    for row in range(1, len(lines)):
        run = range(row, min(row + _FEWEST, len(lines)))
        if width(row) < 2 or any(width(i) != width(row) for i in run):
            continue
        # A rule, or a word on what follows, between names and rows.
        at = row - 1 - (row > 1 and len(cells[row - 1]) == 1)
        stated: tuple[str, ...] = ()
        # To know all units takes a quarter of a second, so that they are looked for last.
        if at > 0 and _names_fit(cells[at - 1], cells[row]):
            stated = row_of_units(cells[at])
            at -= bool(stated)
        if not _names_fit(cells[at], cells[row]):
            continue
        # A delimiter at the end of each row, or a column for comments that rows need not have.
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
    """True for a cell of a sample: a number, a time, or a mark for nothing."""
    number = _NUMBER.fullmatch(cell) or _WITH_COMMA.fullmatch(cell)
    return number is not None or cell in MISSING or is_date(cell)


def _is_row(cells: Sequence[str]) -> bool:
    """True for the cells of a sample: the first is a number or a time, or most are."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    values = sum(map(_is_value, filled))
    return 2 * values > len(filled) or (3 * values >= len(filled) > 0 and _is_value(filled[0]))


def _names_fit(names: Sequence[str], row: Sequence[str]) -> bool:
    """True where a line names the cells of a row."""
    filled = [name.strip() for name in names if name.strip()]
    surplus = len(names) - len(row)
    fits = (
        surplus == 0
        or (surplus == 1 and names[-1].strip().lower() in ("", "comment", "comments"))
        or (surplus == -1 and not row[-1].strip())
    )
    # A sample of which all but the time is text is no line of names.
    if not fits or not filled or _is_value(filled[0]):
        return False
    return 2 * sum(map(_is_value, filled)) < len(filled)


def row_of_units(cells: Sequence[str]) -> tuple[str, ...]:
    """The units in a row below the names, brackets taken off; empty where it is no such row."""
    bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell.strip().strip('"')).strip() for cell in cells]
    # A row of marks for nothing says nothing of units.
    words = [word for word in bare if word not in ("", "-", "1", "--", *MISSING)]
    if not words or any(map(_NUMBER.fullmatch, words)):
        return ()
    # As it is known, in small letters where it is by these alone, as of DEG/SEC. Of one letter
    # there are too many: P is pressure, rate and pitch.
    known = {}
    for word in words:
        if time_unit(word) or units.is_unit(word):
            known[word] = word
        elif len(word) > 1 and units.is_unit(word.casefold()):
            known[word] = word.casefold()
    # Some of them may be written as only their author does.
    if 2 * sum(word in known for word in words) < len(words):
        return ()
    return tuple(known.get(word, word) for word in bare)


def _whole(rows: memoryview, head: _Head) -> tuple[memoryview, tuple[Finding, ...]]:
    """The rows without those of empty cells at the end, as spreadsheets write them, and without a
    last line that ends before its last cells, as where a logger lost its power; and a note."""
    end = bytes(rows[-(1 << 16) :])
    kept = len(end.rstrip(b" \t\n" + head.delimiter.encode()))
    if kept and (after := end.find(b"\n", kept)) >= 0:
        return rows[: len(rows) - len(end) + after + 1], ()
    at = end.rfind(b"\n") + 1
    cells = end[at:].count(head.delimiter.encode()) + 1
    # Of quotes a delimiter may stand within; an only line is told as what it is.
    if at == 0 or cells >= len(head.names) or b'"' in end[at:]:
        return rows, ()
    words = f"the last line is cut off ({cells} of {len(head.names)} cells): it is left out"
    return rows[: len(rows) - len(end) + at], (note("text.line-cut-off", words, value=cells),)


class CsvTable:
    """A `Table` on delimited text."""

    format = "csv"

    def __init__(
        self,
        path: str,
        size: int,
        digest: Digest,
        rows: memoryview,
        head: _Head,
        notes: tuple[Finding, ...],
        has_quotes: bool,
    ) -> None:
        self.path, self.size, self.names, self.notes = path, size, head.names, notes
        self.units: Mapping[str, str] = dict(zip(head.names, head.units, strict=False))
        self._digest, self._rows, self._head = digest, rows, head
        self._dates: set[str] = set()
        self._quote = '"' if has_quotes else False
        # The decimal sign of the file, by its first rows: `1.577` beside `0,25` would else be one
        # and a half. Between commas a decimal one stands within quotes.
        lines = bytes(rows[:_LOOKED_AT]).decode("utf-8", "ignore").split("\n")[:2000]
        lines = [line for line in lines if "," in line and (head.delimiter != "," or '"' in line)]
        cells = (cell.strip() for line in lines for cell in _cells_of(line, head.delimiter))
        self._sign = "," if any(map(_WITH_COMMA.fullmatch, cells)) else "."

    @property
    def sha256(self) -> str:
        """Fingerprint of the file."""
        return self._digest.hex()

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty."""
        require_columns(self.path, self.names, names)
        with progress.reading(self.path, self.size):
            columns = self._columns([self.names.index(name) for name in names])
        self._digest.begin()
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
        """Every column, in the file's order."""
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
            # What stands behind a delimiter at the end of every row is no column.
            if name or filled:
                surveys.append(Survey(name, values, filled, strays))
        return surveys

    def place(self, row: int) -> str:
        """`line 12`, counted from the top of the file, comments and blank lines included."""
        return f"line {self._record(row)[0]}"

    def cell_text(self, name: str, row: int) -> str:
        """Text of a cell."""
        cell = self._record(row)[1][self.names.index(name)].strip()
        return shown(cell) if cell else "nothing"

    def time_unit(self, name: str) -> str | None:
        """Seconds of a column of dates; else what a row of units says, where it is one of time."""
        return "s" if name in self._dates else time_unit(self.units.get(name, ""))

    def _columns(self, indices: Sequence[int]) -> list["_Column"]:
        """Columns by index: as numbers at once where that will do, else through their text."""
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
        """A column of texts."""
        import pyarrow as pa
        from pyarrow import compute

        pc: Any = compute  # whose functions are made when it is imported
        cells: Any = pc.utf8_trim(texts, ' \t"')
        nothing = pc.is_in(cells, pa.array(["", *MISSING]))
        cells = pc.if_else(nothing, pa.scalar(None, pa.string()), cells)
        filled = len(cells) - cells.null_count
        plain = cells
        if self._sign == ",":
            # A point beside decimal commas would be one between thousands, or a slip.
            mixed = pc.match_substring(plain, ".")
            plain = pc.if_else(mixed, pa.scalar("x"), pc.replace_substring(plain, ",", "."))
        is_number = pc.match_substring_regex(plain, f"^(?:{_NUMBER.pattern})$", ignore_case=True)
        odd = filled - pc.sum(is_number).as_py() if filled else 0
        if not odd:
            # Fortran writes 1.0D+00, some a true minus; pyarrow knows no plus in front.
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
        """Columns by index, in one type; None where pyarrow cannot read them."""
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        ragged: list[Any] = []

        # Called for each row with other than the header's number of cells: so for blank lines too,
        # which are no error. That there is any other is enough: `_ragged` finds its line.
        def skip(row: Any) -> str:
            if not _is_blank(row.text, self._head.delimiter):
                ragged.append(row)
            return "skip"

        # By number, since two columns may have one name.
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
                    # Not its own list, which has words such as #N/A N/A.
                    null_values=["", *MISSING],
                    decimal_point=self._sign,
                ),
            )
        except pa.ArrowException:  # such as a line longer than a block, or a cell that is no number
            return None
        return None if ragged or not table.num_rows else table

    def _ragged(self) -> InputError:
        """The error of a row that has another number of cells than the header."""
        delimiter = self._head.delimiter
        for line, text in self._records():
            # Counted and not split: a damaged line may hold millions.
            plain = '"' not in text
            count = text.count(delimiter) + 1 if plain else len(self._cells(line, text))
            if count != len(self.names):
                problem = f"{count} cell{'' if count == 1 else 's'}, expected"
                problem += f" {len(self.names)} as in the header in line {self._head.number}"
                if not self._head.is_fitting:
                    problem += "; no line of names is right above rows of as many cells"
                return wrong(self.path, problem, f"line {line}")
        return wrong(self.path, "holds no rows that can be read, expected rows of numbers")

    def _record(self, row: int) -> tuple[int, list[str]]:
        """A row's line and cells."""
        # From the top each time: only a message asks for one, and an index of all rows would be as
        # large as the log.
        line, text = next(itertools.islice(self._records(), row, None))
        return line, self._cells(line, text)

    def _records(self) -> Iterator[tuple[int, str]]:
        """Each row's line and text. Blank lines are passed over, as in pyarrow's reader."""
        # newline: what else Python takes for the end of a line, no spreadsheet and no pyarrow does.
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
"""numbers (N,), or the first row that holds none; cells that are filled, and those of no number"""


def _is_blank(line: str, delimiter: str) -> bool:
    """True for a line without a cell; one of delimiters alone is a row of empty cells."""
    return not line.strip() and delimiter not in line
