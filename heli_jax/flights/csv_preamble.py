"""Where the table of a text begins, below what its writer put above: titles, settings, names in
several lines.

A table is known by its rows: lines of as many cells, most of them numbers, right below a line of
as many names, or a line of units between them.
"""

import dataclasses
import itertools
import re
from collections.abc import Sequence

from heli_jax.errors import InputError
from heli_jax.flights.csv_cells import is_number, row_of_units
from heli_jax.flights.csv_dates import is_date
from heli_jax.flights.csv_lines import (
    Head,
    are_names,
    are_units,
    cells_of,
    is_for_comments,
    is_row,
    names_fit,
)
from heli_jax.flights.csv_text import (
    DELIMITERS,
    LONGEST_HEADER,
    Body,
    Line,
    find_delimiter,
    header_line,
    is_of_blanks,
    lines_in,
)
from heli_jax.flights.table import shown, wrong

_FEWEST = 3
"""rows that make a table"""
_LOOKED_AT = 1 << 20
_MOST_LINES = 20_000
"""bytes and lines in which a table is sought"""
_NEAR = 6
"""lines from a header on, one of which is a row of the table"""
_FIRST = 100
"""rows by which it is told how wide a table is"""
_TYPE = re.compile(r"\s*(?:u?int|long|float|double|single|real|string|bool|boolean)\d*\s*", re.I)
_SEPARATOR = re.compile(r'"?sep=([,;|:\t ])"?\s*', re.IGNORECASE)
_RULE = re.compile(r"([*=#~_-])\1+.*\1\1")
"""a word between signs, such as ***End_of_Header***: for people, and no group of columns"""
_UNIT_LABEL = re.compile(r".*(?:unit|einheit).*", re.IGNORECASE)
_WHOLE = re.compile(r"\s*[+-]?[0-9]+\s*")
_IDENTITY = re.compile(r"[0-9A-Fa-f{}-]{8,}|[0-9]+")
"""of a body, in place of its name"""


def find_head(path: str, data: bytes, blanks: bool) -> Head | None:
    """The header of the table in a text; None where there is none.

    Args:
        path: for messages.
        data: the bytes of the file.
        blanks: whether blanks alone may stand between cells.

    Raises:
        InputError: there are several tables, or commas are decimal signs and delimiters both.
    """
    plain = header_line(data)
    if plain is None:
        return None
    separator = _SEPARATOR.fullmatch(plain.text)
    if separator:
        # Excel's own word for what stands between cells.
        below = header_line(data, Line("", plain.number, plain.after))
        if below is None:
            return None
        return Head(below, separator[1], (), below.number + 1)
    near = [line for line in lines_in(data, plain, _LOOKED_AT, _NEAR) if line.text.strip()]
    _require_one_comma(path, near)
    delimiter = find_delimiter(plain.text, near[1].text if len(near) > 1 else "")
    if _is_header(near, delimiter, blanks):
        return Head(plain, delimiter, (), plain.number + 1)
    lines = [line for line in lines_in(data, plain, _LOOKED_AT, _MOST_LINES) if line.text.strip()]
    unsure = Head(plain, delimiter, (), plain.number + 1, is_fitting=False)
    return _sought(path, lines, blanks) or unsure


def _require_one_comma(path: str, lines: Sequence[Line]) -> None:
    """Refuse rows of numbers that commas cut at their decimal signs too: twice as many cells as
    names at most, whole numbers all of them."""
    names, *rows = [cells_of(line.text, ",") for line in lines]
    width = len(names)
    is_cut = len(rows) >= _FEWEST and all(
        width + 1 < len(row) <= 2 * width and all(map(_WHOLE.fullmatch, row)) for row in rows
    )
    if is_cut and are_names(names) and '"' not in lines[1].text:
        place = f"line {lines[1].number}"
        problem = f"{len(rows[0])} whole numbers below {width} names: its commas are decimal signs"
        remedy = "expected semicolons or tabs between cells, quotes around them, or decimal points"
        raise wrong(path, f"{problem} and stand between cells too, {remedy}", place)


def _is_header(lines: Sequence[Line], delimiter: str, blanks: bool) -> bool:
    """Whether rows, or a line of units and rows, are right below the first line."""
    header, below = lines[0].text, lines[1:]
    if not below or (blanks and is_of_blanks(header, below[0].text)):
        return True
    if delimiter not in header:
        return False
    width = len(cells_of(header, delimiter))
    cells = [cells_of(line.text, delimiter) for line in below]
    # Rows of other lengths are told with their line where the names are above one that fits.
    row = next((i for i, c in enumerate(cells) if len(c) == width and is_row(c)), None)
    if row is None:
        return False
    return all(is_row(c) or are_units(c) for c in cells[:row])


def _sought(path: str, lines: Sequence[Line], blanks: bool) -> Head | None:
    """The table further down."""
    for delimiter in (*DELIMITERS, " ") if blanks else DELIMITERS:
        cells = [cells_of(line.text, delimiter) for line in lines]
        heads = _heads(lines, cells, delimiter)
        if len(heads) > 1:
            first, second = (head.header.number for head in heads[:2])
            problem = f"holds tables with names in line {first} and in line {second}"
            raise wrong(path, f"{problem}, expected one; make a file of each")
        if heads:
            return heads[0]
    return None


def _heads(lines: Sequence[Line], cells: Sequence[list[str]], delimiter: str) -> list[Head]:
    """The headers above runs of rows of as many cells."""
    heads, at = [], 0
    while at < len(lines):
        end = at
        while end < len(lines) and is_row(cells[end]) and len(cells[end]) == len(cells[at]):
            end += 1
        if end - at >= _FEWEST and (head := _head_above(lines, cells, at, delimiter)):
            heads.append(head)
        at = max(end, at + 1)
    return heads


def _head_above(
    lines: Sequence[Line], cells: Sequence[list[str]], row: int, delimiter: str
) -> Head | None:
    """The header of rows that begin at a line; None where no names stand above them."""
    width, begin = len(cells[row]), row
    if row and len(cells[row - 1]) == width and are_units(cells[row - 1]):
        begin = row - 1
    header = begin - 1
    # A rule, a word on what follows, or types of the columns, between names and rows.
    if header > 0 and (len(cells[header]) == 1 or all(map(_TYPE.fullmatch, cells[header]))):
        header -= 1
    if header < 0 or not names_fit(cells[header], cells[row]):
        return None
    if delimiter == " " and not is_of_blanks(lines[header].text, lines[row].text):
        return None
    top = header
    while top and _is_group(lines, cells, top - 1, width) and delimiter != " ":
        top -= 1
    head_line = lines[header]
    return Head(
        Line(head_line.text, head_line.number, lines[begin - 1].after),
        "\t" if delimiter == " " else delimiter,
        tuple(line.text for line in reversed(lines[top:header])),
        lines[begin - 1].number + 1,
        units=_units_above(cells[:top], cells[header]),
    )


def _units_above(above: Sequence[Sequence[str]], names: Sequence[str]) -> tuple[str, ...]:
    """The units in the last line above that begins with such a word, as LabVIEW's Y_Unit_Label:
    those of the columns behind the first, empty where there is no such line."""
    # Where each signal has a column of times of its own, it is not known which has which.
    if names.count(names[0]) > 1:
        return ()
    for cells in reversed(above):
        if len(cells) > 1 and _UNIT_LABEL.fullmatch(cells[0].strip()):
            units = row_of_units(cells[1 : len(names)])
            return units or ()
    return ()


def _is_group(lines: Sequence[Line], cells: Sequence[list[str]], at: int, width: int) -> bool:
    """Whether a line may hold names of groups of the columns, or their numbers."""
    filled = [cell for cell in cells[at] if cell.strip()]
    together = lines[at].number + 1 == lines[at + 1].number
    alike = len(cells[at]) == width and not are_units(cells[at])
    is_rule = len(filled) == 1 and _RULE.fullmatch(filled[0].strip()) is not None
    return together and alike and bool(filled) and not is_rule and not is_date(filled[0])


def qualified(names: Sequence[str], above: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Names with those of the groups above them, where it takes them to tell columns apart.

    Args:
        names: of the columns.
        above: names of groups, the nearest line first; a blank goes with the group on its left.
    """
    for line in above:
        groups, group = [], ""
        for cell in line:
            group = cell.strip() or group
            groups.append(group)
        repeated = len(set(names)) < len(names)
        spans = len(set(groups)) < len(groups)
        if not (repeated or (spans and line is above[0])):
            break
        if all(_IDENTITY.fullmatch(group) for group in groups if group):
            continue
        names = [f"{g}.{n}" if g and n else n or g for g, n in zip(groups, names, strict=True)]
    return tuple(names)


def require_names(path: str, names: Sequence[str], delimiter: str, line: str) -> None:
    """Refuse a first line that holds a sample, of which some cells are no numbers.

    Args:
        path: for the message.
        names: what stands in it.
        delimiter: between them.
        line: which it is, in words.

    Raises:
        InputError: with what to write above.
    """
    numbers = [name for name in names if is_number(name)]
    if len(numbers) < len(names) and not any(map(is_date, names)):
        return
    listed = delimiter.join(["time", *(f"column{i}" for i in range(2, len(names) + 1))][:6])
    what = "numbers" if len(numbers) == len(names) else f"{shown(next(filter(is_date, names)))}"
    problem = f"got {what}, expected the names of the columns; write a line of names above"
    raise wrong(path, f"{problem}, such as {shown(listed)}", line)


def as_wide(names: tuple[str, ...], body: Body) -> tuple[str, ...]:
    """The names as many as rows have cells, where only a delimiter at the end, or a column for
    comments, makes the difference.

    Args:
        names: in the header.
        body: the rows.
    """
    first = body.beginning(LONGEST_HEADER)
    if body.size > len(first):
        first = first[: first.rfind(b"\n") + 1]
    rows = dataclasses.replace(body, rows=memoryview(first))
    try:
        cells = [cells for _, cells in itertools.islice(rows.records(), _FIRST)]
    # What is wrong with the quotes is told where the cells are read.
    except InputError:
        return names
    widths = {len(row) for row in cells}
    if widths == {len(names) + 1} and not any(row[-1].strip() for row in cells):
        return (*names, "")
    if widths == {len(names) - 1} and is_for_comments(names[-1]):
        return names[:-1]
    return names
