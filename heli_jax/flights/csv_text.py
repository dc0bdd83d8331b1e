"""The text of a delimited log: its encoding, header, delimiter and rows."""

import csv
from collections.abc import Iterator
from typing import NamedTuple

from heli_jax.flights.table import wrong


class Body(NamedTuple):
    """The text below the header."""

    path: str
    text: str
    delimiter: str
    first_line: int
    """its number in the file, from 1: comments and blank lines above count"""

    def is_blank(self, line: str) -> bool:
        """Whether a line holds no cell; one of delimiters alone is a row of empty cells."""
        return not line.strip() and self.delimiter not in line

    def records(self) -> Iterator[tuple[int, list[str]]]:
        """Each row's line and cells. Blank lines are passed over, as in pyarrow's reader.

        Raises:
            InputError: a quotation mark that closes nothing or is never closed.
        """
        # Without quotes a split is all that is needed, and several times as fast as csv.reader.
        if '"' not in self.text:
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


def decode(path: str, data: bytes) -> str:
    """The text of a file with `\\n` between its lines.

    Raises:
        InputError: it is no text in UTF-8.
    """
    # Spreadsheets save "Unicode text" like this; its null bytes would else be called binary data.
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise wrong(path, "is text in UTF-16, expected UTF-8")
    if b"\x00" in data:  # valid in UTF-8, and in no log
        line = data.count(b"\n", 0, data.index(b"\x00")) + 1
        raise wrong(path, "got binary data, expected text", f"line {line}")
    try:
        text = data.decode("utf-8-sig")  # Excel's byte order mark would belong to the first name
    except UnicodeDecodeError as e:
        line = data.count(b"\n", 0, e.start) + 1
        problem = f"got the byte 0x{data[e.start]:02x}, expected text in UTF-8"
        raise wrong(path, problem, f"line {line}") from e
    # Not splitlines: it breaks at form feeds and Unicode separators as well, which no spreadsheet
    # and no pyarrow takes for the end of a row.
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


LONGEST_HEADER = 1_000_000
"""characters"""
_LONGEST_LINE = 10_000_000
"""characters of a row, in which a cell may hold a text"""
_LONGEST_PREAMBLE = 1_000_000
"""characters of blank lines and comments before the header"""
_BLOCK = 1 << 20


def find_header(text: str) -> tuple[int | None, int]:
    """Where the first line that is neither blank nor a comment starts, and its number; None where
    there is none within the first 1 MB."""
    start, line = 0, 1
    while start < min(len(text), _LONGEST_PREAMBLE):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        content = text[start:end].strip()
        # Comments may say anything, a list of names with commas too.
        if content and not content.startswith("#"):
            return start, line
        start, line = end + 1, line + 1
    return None, line


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


def require_short_lines(path: str, text: str, first_line: int) -> None:
    """Refuse a line longer than any of a log: its cells alone would fill the memory.

    Args:
        path: for the message.
        text: lines, ended by `\\n`.
        first_line: the number of the first in the file.

    Raises:
        InputError: naming the line.
    """
    start = 0
    while len(text) - start > _LONGEST_LINE:
        # Backwards from the limit: where any line ends within it, all up to there are short, so a
        # file of 1 GB takes a hundred searches and not one a line.
        end = text.rfind("\n", start, start + _LONGEST_LINE + 1)
        if end < 0:
            line = first_line + text.count("\n", 0, start)
            raise wrong(path, "is longer than a line of a log can be", f"line {line}")
        start = end + 1


def find_delimiter(header: str, first: str) -> str:
    """The delimiter that header and first row agree on; `;` before `,`, which may be a decimal."""
    # A tab stands in no number and in hardly any name, so it is the surest of the three.
    for delimiter in ("\t", ";", ","):
        if header.count(delimiter) == first.count(delimiter) > 0:
            return delimiter
    return max((",", ";", "\t"), key=header.count)


def is_of_blanks(header: str, first: str) -> bool:
    """Whether blanks alone stand between the cells of header and first row."""
    # Names may hold blanks: only where nothing else is between them, and as many cells below.
    alone = not any(delimiter in header.strip() + first.strip() for delimiter in ("\t", ";", ","))
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
