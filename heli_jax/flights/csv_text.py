"""The text of a delimited log: its encoding, header and delimiter."""

import csv

from heli_jax.flights.table import wrong


def decode(path: str, data: bytes) -> str:
    """The text of a file with `\\n` between its lines."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise wrong(path, "is text in UTF-16, wanted is UTF-8")
    if b"\x00" in data:
        line = data.count(b"\n", 0, data.index(b"\x00")) + 1
        raise wrong(path, "found binary data, wanted is text", f"line {line}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = data.count(b"\n", 0, e.start) + 1
        found = f"found the byte 0x{data[e.start]:02x}, wanted is text in UTF-8"
        raise wrong(path, found, f"line {line}") from e
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def find_header(text: str) -> tuple[int | None, int]:
    """Where the first line that is neither blank nor a comment starts, and its number."""
    start, line = 0, 1
    while start < len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        content = text[start:end].strip()
        if content and not content.startswith("#"):
            return start, line
        start, line = end + 1, line + 1
    return None, line


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
        raise wrong(path, "is no header, wanted are names of columns", f"line {line}") from e
