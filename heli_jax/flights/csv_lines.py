"""What a line of a delimited text is: names of columns, units, or a sample."""

import csv
import re
from collections.abc import Sequence
from typing import NamedTuple

from heli_jax.flights.csv_cells import MISSING, is_number, row_of_units
from heli_jax.flights.csv_dates import is_date, is_day
from heli_jax.flights.csv_text import Line

_NUMBER = re.compile(r"[+\u2212-]?[0-9][0-9.,' \u00a0\u2009\u202f]*(?:[eEdD][+-]?[0-9]+)?")
"""with any decimal sign, and with marks between thousands"""


class Head(NamedTuple):
    """The names of a table and where its rows begin.

    Attributes:
        header: the line of names.
        delimiter: between them; a tab of a file whose cells have blanks between them.
        above: lines of names above the header, the nearest first.
        first_line: the number of the first line of rows or units.
        is_fitting: whether rows of as many cells were found right below.
        units: of the columns behind the first, where a line above names them.
    """

    header: Line
    delimiter: str
    above: tuple[str, ...]
    first_line: int
    is_fitting: bool = True
    units: tuple[str, ...] = ()


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of a line."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        try:
            return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
        except (csv.Error, StopIteration):
            pass
    return line.split(delimiter)


def is_value(cell: str) -> bool:
    """Whether a cell is one of a sample: a number, a date, or a mark for nothing."""
    numbers = bool(_NUMBER.fullmatch(cell)) or is_number(cell) or cell in MISSING
    return numbers or is_date(cell) or is_day(cell)


def is_row(cells: Sequence[str]) -> bool:
    """Whether cells are those of a sample: the first is a number or a time, or most are."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    if len(cells) < 2 or not filled:
        return False
    values = sum(map(is_value, filled))
    return 2 * values > len(filled) or (is_value(filled[0]) and 3 * values >= len(filled))


def are_names(cells: Sequence[str]) -> bool:
    """Whether cells are names of columns."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    # A sample of which all but the time is text is no line of names.
    if len(cells) < 2 or not filled or is_value(filled[0]):
        return False
    return 2 * sum(map(is_value, filled)) < len(filled)


def are_units(cells: Sequence[str]) -> bool:
    """Whether cells are units of columns."""
    return row_of_units(cells) is not None


def names_fit(names: Sequence[str], row: Sequence[str]) -> bool:
    """Whether a line names the cells of a row; one name more may stand there for comments."""
    surplus = len(names) - len(row)
    return surplus in (0, 1) and (not surplus or is_for_comments(names[-1])) and are_names(names)


def is_for_comments(name: str) -> bool:
    """Whether a name is that of a column which rows need not have, as LabVIEW's."""
    return name.strip().lower() in ("", "comment", "comments")
