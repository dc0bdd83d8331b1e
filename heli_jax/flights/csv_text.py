"""The text of a delimited log: its encoding, header, delimiter and rows."""

import codecs
import csv
import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from heli_jax.finding import Finding, note
from heli_jax.flights.csv_cells import row_of_units
from heli_jax.flights.table import wrong


class OnDisk(NamedTuple):
    """Rows that were left in their file: plain text from a byte on to its end."""

    path: Path
    begin: int
    end: int
    """the size of the file [bytes]"""
    first: bytes
    """some of the lines, from the first on"""


_LAST = 1 << 16
"""bytes in which the last line is looked for"""


@dataclass(frozen=True, eq=False)
class Body:
    """The bytes below the header; they are text in UTF-8."""

    path: str
    rows: memoryview | OnDisk
    delimiter: str
    first_line: int
    """its number in the file, from 1: comments and blank lines above count"""
    has_quotes: bool

    @property
    def size(self) -> int:
        """In bytes."""
        if isinstance(self.rows, OnDisk):
            return self.rows.end - self.rows.begin
        return len(self.rows)

    @functools.cached_property
    def data(self) -> memoryview:
        """The bytes in memory, where those of a large file are not without need."""
        if not isinstance(self.rows, OnDisk):
            return self.rows
        with self.rows.path.open("rb") as file:
            file.seek(self.rows.begin)
            return memoryview(file.read(self.size))

    def beginning(self, size: int) -> bytes:
        """The first `size` bytes, or fewer: of rows on the disk whole lines."""
        return bytes((self.rows.first if isinstance(self.rows, OnDisk) else self.rows)[:size])

    def below(self, size: int, lines: int) -> "Body":
        """The body without its first `size` bytes, which are so many lines."""
        rows = self.rows
        if isinstance(rows, OnDisk):
            rows = rows._replace(begin=rows.begin + size, first=rows.first[size:])
        else:
            rows = rows[size:]
        return replace(self, rows=rows, first_line=self.first_line + lines)

    def whole(self, width: int) -> tuple["Body", tuple[Finding, ...]]:
        """The body without a last line that ends before its last cells, as where a logger lost its
        power, and a note of it.

        Args:
            width: cells of a row.
        """
        tail = self._end(_LAST)
        at = max(tail.rfind(b"\n"), tail.rfind(b"\r")) + 1
        cells = tail[at:].count(self.delimiter.encode()) + 1
        # Of quotes a delimiter may stand within; an only line is told as what it is.
        if at in (0, len(tail)) or cells >= width or self.has_quotes:
            return self, ()
        # In memory from here on: a file on the disk is read to its end.
        words = f"the last line is cut off ({cells} of {width} cells): it is left out"
        cut = note("text.line-cut-off", words, value=cells)
        return replace(self, rows=self.data[: at - len(tail)]), (cut,)

    def filled(self) -> "Body":
        """The body without the rows of empty cells behind the last that holds something, as
        spreadsheets write them."""
        size, of_nothing = _LAST, b" \t\r\n" + self.delimiter.encode()
        while not (end := self._end(size)).rstrip(of_nothing) and size < self.size:
            size *= 16
        kept = end.rstrip(of_nothing)
        # To the end of its line, which may be of empty cells.
        _, at = _line_end(end, len(kept))
        if not kept or self.delimiter not in end[at:].decode():
            return self
        # In memory from here on, as in `whole`.
        return replace(self, rows=self.data[: at - len(end)])

    def _end(self, size: int) -> bytes:
        """The last `size` bytes, or fewer."""
        if not isinstance(self.rows, OnDisk):
            return bytes(self.rows[-size:])
        with self.rows.path.open("rb") as file:
            begin = max(self.rows.begin, self.rows.end - size)
            file.seek(begin)
            return file.read(self.rows.end - begin)

    @functools.cached_property
    def text(self) -> str:
        """The same as text with `\\n` between lines: made only where something is wrong with the
        numbers, or cells are quoted."""
        return with_line_feeds(str(self.data, "utf-8"))

    def is_blank(self, line: str) -> bool:
        """Whether a line holds no cell; one of delimiters alone is a row of empty cells."""
        return not line.strip() and self.delimiter not in line

    def records(self) -> Iterator[tuple[int, list[str]]]:
        """Each row's line and cells. Blank lines are passed over, as in pyarrow's reader.

        Raises:
            InputError: a quotation mark that closes nothing or is never closed.
        """
        # Without quotes a split is all that is needed, and several times as fast as csv.reader.
        if not self.has_quotes:
            for number, line in enumerate(lines_of(self.text), self.first_line):
                if not self.is_blank(line):
                    yield number, line.split(self.delimiter)
            return
        lines = (f"{line}\n" for line in lines_of(self.text))
        reader = csv.reader(lines, delimiter=self.delimiter, skipinitialspace=True, strict=True)
        # The line where a record starts, not where it ends: a quoted cell may span several.
        start = self.first_line
        try:
            for cells in reader:
                if cells and not (len(cells) == 1 and self.is_blank(cells[0])):
                    yield start, cells
                start = self.first_line + reader.line_num
        except csv.Error as e:
            problem = "a quotation mark that closes nothing or is never closed, expected numbers"
            raise wrong(self.path, problem, f"line {start}") from e


def check_text(path: str, data: bytes) -> None:
    """Refuse bytes that are no text in UTF-8.

    Raises:
        InputError: naming the line.
    """
    # Spreadsheets save "Unicode text" like this; its null bytes would else be called binary data.
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise wrong(path, "is text in UTF-16, expected UTF-8")
    null = data.find(b"\x00")
    if null >= 0:  # valid in UTF-8, and in no log
        line = data.count(b"\n", 0, null) + 1
        raise wrong(path, "got binary data, expected text", f"line {line}")
    if data.isascii():
        return
    decoder, done = codecs.getincrementaldecoder("utf-8")(), 0
    # A block at a time: the text of all is not needed, and takes up to four times the bytes.
    while done < len(data):
        block = data[done : done + _BLOCK]
        pending = len(decoder.getstate()[0])
        try:
            decoder.decode(block, final=done + _BLOCK >= len(data))
        except UnicodeDecodeError as e:
            at = done - pending + e.start
            line = data.count(b"\n", 0, at) + 1
            problem = f"got the byte 0x{data[at]:02x}, expected text in UTF-8"
            raise wrong(path, problem, f"line {line}") from e
        done += _BLOCK


def with_line_feeds(text: str) -> str:
    """Text with `\\n` between its lines, whatever stood there."""
    # Not splitlines: it breaks at form feeds and Unicode separators as well, which no spreadsheet
    # and no pyarrow takes for the end of a row.
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


LONGEST_HEADER = 1_000_000
"""characters"""
_LONGEST_LINE = 10_000_000
"""bytes of a row, in which a cell may hold a text"""
_LONGEST_PREAMBLE = 1_000_000
"""bytes of blank lines and comments before the header"""
_BLOCK = 1 << 20
_PLAIN = re.compile(r"[+-]?[0-9]*\.?[0-9]+(?:\.|[eEdD][+-]?[0-9]+)?|nan", re.IGNORECASE)
_COMMENT = re.compile(r"\s*(#|//|%(\s|%|[^,;\t]*$))")
"""A name may begin with a percent sign, so that of MATLAB's comments those are known which go on
with a blank or have no cells."""
DELIMITERS = ("\t", "|", ";", ",")
"""the surest first: a tab stands in no number and in hardly any name, a comma may be decimal"""
_SOMETHING = re.compile(rb"[^ \t\n\r\v\f]")


class Line(NamedTuple):
    """A line of a file: its text, its number from 1, and where the next begins [bytes]."""

    text: str
    number: int
    after: int


def header_line(data: bytes, above: Line | None = None) -> Line | None:
    """The first line that is neither blank nor a comment, or the comment above it where that names
    columns of numbers; None where there is none within the first 1 MB.

    Args:
        data: the bytes of the file.
        above: a line below which it is looked for.
    """
    # Excel's byte order mark would belong to the first name.
    start, number = 3 if data.startswith(codecs.BOM_UTF8) else 0, 1
    if above is not None:
        start, number = above.after, above.number + 1
    comment = names = Line("", 0, 0)
    while start < min(len(data), _LONGEST_PREAMBLE):
        line = _line(data, start, number)
        # Comments may say anything, a list of names with commas too.
        mark = _COMMENT.match(line.text)
        if line.text.strip() and mark is None:
            # MATLAB's and NumPy's writers of text put the names into a comment.
            if not _names_columns(comment.text, line.text):
                return line
            if _is_of_units(comment, names, line.text):
                return names
            return Line(comment.text, comment.number, start)
        text = line.text.lstrip().lstrip("#%/") if mark else ""
        # Of a line of units below names the rows begin behind its mark.
        cells = start + len(line.text.encode()) - len(text.encode())
        names, comment = comment._replace(after=cells), Line(text.strip(), number, start)
        start, number = line.after, number + 1
    return None


def lines_in(data: bytes, first: Line, size: int, most: int | None = None) -> list[Line]:
    """A line and those below it.

    Args:
        data: the bytes of the file.
        first: where to begin.
        size: within how many bytes.
        most: how many of them.
    """
    lines, end = [first], min(len(data), first.after + size)
    while lines[-1].after < end and len(lines) != most:
        lines.append(_line(data, lines[-1].after, lines[-1].number + 1))
    return lines


def _line(data: bytes, start: int, number: int) -> Line:
    end, after = _line_end(data, start)
    # Cut: what is refused for its length need not be decoded as a whole.
    text = data[start : min(end, start + 4 * LONGEST_HEADER + 4)].decode("utf-8", "ignore")
    return Line(text, number, after)


def _names_columns(comment: str, row: str) -> bool:
    """Whether a comment names as many columns as the row of numbers below it has."""
    cells = re.split(r"[,;\s]+", row.strip(" \t\r\n,;"))
    if not all(_PLAIN.fullmatch(cell) for cell in cells) or _PLAIN.match(comment):
        return False
    if any(comment.count(d) == row.count(d) > 0 for d in DELIMITERS):
        return True
    return is_of_blanks(comment, row)


def _is_of_units(comment: Line, above: Line, row: str) -> bool:
    """Whether a comment holds the units of columns that the comment right above it names."""
    if above.number != comment.number - 1 or not _names_columns(above.text, row):
        return False
    delimiter = next((d for d in DELIMITERS if comment.text.count(d) == row.count(d) > 0), None)
    return all(
        (row_of_units(line.text.split(delimiter)) is not None) == is_units
        for line, is_units in ((comment, True), (above, False))
    )


def first_row(data: bytes, at: int) -> str | None:
    """The first line from `at` on with anything in it; None where nothing follows."""
    match = _SOMETHING.search(data, at)
    if match is None:
        return None
    begin = max(data.rfind(b"\n", at, match.start()), data.rfind(b"\r", at, match.start()), at - 1)
    end, _ = _line_end(data, match.start())
    return data[begin + 1 : min(end, begin + _LONGEST_LINE)].decode("utf-8", "ignore")


def _line_end(data: bytes, start: int) -> tuple[int, int]:
    """Where a line ends, and where the next begins."""
    end = data.find(b"\n", start)
    end = len(data) if end < 0 else end
    # A carriage return ends a line too, alone or with the line feed behind it.
    feed = data.find(b"\r", start, end)
    if feed < 0:
        return end, end + 1
    return feed, feed + 2 if data[feed + 1 : feed + 2] == b"\n" else feed + 1


def lines_of(text: str) -> Iterator[str]:
    """As `text.split("\\n")`, a block at a time: all lines at once take many times the text."""
    start = 0
    while (end := text.rfind("\n", start, start + _BLOCK)) >= 0 or start + _BLOCK < len(text):
        if end < 0:  # a line longer than a block
            end = text.find("\n", start)
            if end < 0:
                break
        yield from text[start:end].split("\n")
        start = end + 1
    yield text[start:]


def require_short_lines(path: str, data: bytes, start: int, first_line: int) -> None:
    """Refuse a line longer than any of a log: its cells alone would fill the memory.

    Args:
        path: for the message.
        data: the bytes of the file.
        start: where the rows begin.
        first_line: the number of the first in the file.

    Raises:
        InputError: naming the line.
    """
    begin = start
    while len(data) - start > _LONGEST_LINE:
        # Backwards from the limit: where any line ends within it, all up to there are short, so a
        # file of 1 GB takes a hundred searches and not one a line.
        limit = start + _LONGEST_LINE + 1
        end = data.rfind(b"\n", start, limit)
        if end < 0:
            end = data.rfind(b"\r", start, limit)
        if end < 0:
            line = first_line + with_line_feeds(data[begin:start].decode("latin-1")).count("\n")
            raise wrong(path, "is longer than a line of a log can be", f"line {line}")
        start = end + 1


def find_delimiter(header: str, first: str) -> str:
    """The delimiter that header and first row agree on; `;` before `,`, which may be a decimal."""
    for delimiter in DELIMITERS:
        if header.count(delimiter) == first.count(delimiter) > 0:
            return delimiter
    return max(reversed(DELIMITERS), key=header.count)


def is_of_blanks(header: str, first: str) -> bool:
    """Whether blanks alone stand between the cells of header and first row."""
    # Names may hold blanks: only where nothing else is between them, and as many cells below.
    alone = not any(delimiter in header.strip() + first.strip() for delimiter in DELIMITERS)
    return alone and len(header.split()) == len(first.split()) > 1


def tabs_for_blanks(text: str) -> str:
    """Lines whose cells have any number of blanks around them, with one tab between cells."""
    return "\n".join("\t".join(line.split()) for line in lines_of(text))


def header_names(path: str, header: str, delimiter: str, line: int) -> tuple[str, ...]:
    """The names in a header, quotation marks and blanks around them taken off.

    Args:
        path: for the message.
        header: one line.
        delimiter: between the names.
        line: its number in the file.

    Raises:
        InputError: a quotation mark is out of place.
    """
    try:
        return tuple(
            cell.strip()
            for cell in next(csv.reader([header], delimiter=delimiter, skipinitialspace=True))
        )
    except csv.Error as e:
        raise wrong(path, "is no header, expected names of columns", f"line {line}") from e
