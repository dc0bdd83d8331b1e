"""The text of a delimited log: its encoding, header and delimiter."""

import csv
from collections.abc import Iterator

from heli_jax.flights.table import wrong


def decode(path: str, data: bytes) -> str:
    """The text of a file with `\\n` between its lines."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise wrong(path, "is text in UTF-16, expected UTF-8")
    if b"\x00" in data:
        line = data.count(b"\n", 0, data.index(b"\x00")) + 1
        raise wrong(path, "got binary data, expected text", f"line {line}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = data.count(b"\n", 0, e.start) + 1
        found = f"got the byte 0x{data[e.start]:02x}, expected text in UTF-8"
        raise wrong(path, found, f"line {line}") from e
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

    Raises:
        InputError: naming the line.
    """
    start = 0
    while len(text) - start > _LONGEST_LINE:
        end = text.rfind("\n", start, start + _LONGEST_LINE + 1)
        if end < 0:
            line = first_line + text.count("\n", 0, start)
            raise wrong(path, "is longer than a line of a log can be", f"line {line}")
        start = end + 1


def find_delimiter(header: str, first: str) -> str:
    """The delimiter that header and first row agree on; `;` before `,`, which may be a decimal."""
    for delimiter in ("\t", ";", ","):
        if header.count(delimiter) == first.count(delimiter) > 0:
            return delimiter
    return max((",", ";", "\t"), key=header.count)


def header_names(path: str, header: str, delimiter: str, line: int) -> tuple[str, ...]:
    try:
        return tuple(
            cell.strip()
            for cell in next(csv.reader([header], delimiter=delimiter, skipinitialspace=True))
        )
    except csv.Error as e:
        raise wrong(path, "is no header, expected names of columns", f"line {line}") from e
