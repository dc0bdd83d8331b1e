"""Tables of numbers alone: no line names their columns, which are called by their numbers."""

import re
from collections.abc import Sequence

from heli_jax.flights.csv_cells import is_number
from heli_jax.flights.csv_dates import is_date
from heli_jax.flights.csv_lines import Head, are_names, cells_of
from heli_jax.flights.csv_text import DELIMITERS, Line

FEWEST = 3
"""rows that make a table"""
_COMMENT = re.compile(r"\s*(?:[#%!*;'\"]+|//+|[cC](?=\s))\s*")
"""what begins a line that is for people, in any program: of Fortran, C and a blank"""
_SLIP = 2
"""columns by which a line of names may miss those of its table"""


def nameless_head(data: bytes, lines: Sequence[Line], blanks: bool, fewest: int = 2) -> Head | None:
    """The beginning of a table whose rows are numbers, where the first line is one of them, or
    lines of text without names stand above; None where there is no such table.

    Args:
        data: the bytes of the file.
        lines: of the file, blank ones left out, from the first on that is no comment.
        blanks: whether blanks alone may stand between cells.
        fewest: rows that make a table.
    """
    for delimiter in (*DELIMITERS, " ") if blanks else DELIMITERS:
        cells = [cells_of(line.text, delimiter) for line in lines]
        at = _first_row(cells, delimiter, fewest)
        if at is None or (fewest == 2 and at):
            continue
        head = _head(data, lines, cells, at, delimiter)
        if head is not None:
            return head
    return None


def _first_row(cells: Sequence[Sequence[str]], delimiter: str, fewest: int) -> int | None:
    """The first of so many rows of numbers that have as many cells."""
    at = 0
    while at < len(cells):
        end = at
        while (
            end < len(cells)
            and len(cells[end]) == len(cells[at])
            and _is_sample(cells[end], delimiter)
        ):
            end += 1
        if end - at >= fewest:
            return at
        at = max(end, at + 1)
    return None


def _head(
    data: bytes, lines: Sequence[Line], cells: Sequence[list[str]], at: int, delimiter: str
) -> Head | None:
    row, width = lines[at], len(cells[at])
    above = lines[at - 1] if at else None
    begin = _beginning(data, row)
    if above is not None:
        bare = _COMMENT.sub("", above.text, count=1)
        names = cells_of(bare, delimiter)
        is_comment, is_near = bare != above.text, above.number + 1 == row.number
        if is_comment and len(names) == width and are_names(names):
            header = Line(delimiter.join(names), above.number, begin)
            return Head(header, _kept(delimiter), (), row.number)
        # Names that are one too few are a slip, which is told with both lines.
        alike = abs(len(names) - width) <= _SLIP and len(names) > 1 and are_names(names)
        # And where others have as many cells it is not known what they are.
        is_unsure = any(len(c) == width for c in cells[:at]) and not is_comment
        if is_unsure or (alike and is_near and not is_comment):
            return None
    names = [f"column{i}" for i in range(1, width + 1)]
    header = Line(delimiter.join(names), row.number, begin)
    return Head(header, _kept(delimiter), (), row.number)


def _is_sample(cells: Sequence[str], delimiter: str) -> bool:
    """Whether all cells are numbers, some of them perhaps empty, or dates."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    if len(cells) < 2 or not filled:
        return False
    # Between commas none is decimal.
    if delimiter != ",":
        filled = [cell.replace(",", ".", 1) for cell in filled]
    numbers = sum(map(is_number, filled))
    return numbers > 0 and numbers + sum(map(is_date, filled)) == len(filled)


def _kept(delimiter: str) -> str:
    """Tabs will stand where blanks do."""
    return "\t" if delimiter == " " else delimiter


def _beginning(data: bytes, line: Line) -> int:
    """Where a line begins [bytes]."""
    end = line.after
    while end > line.after - 2 and data[end - 1 : end] in (b"\n", b"\r"):
        end -= 1
    return max(data.rfind(b"\n", 0, end), data.rfind(b"\r", 0, end)) + 1
