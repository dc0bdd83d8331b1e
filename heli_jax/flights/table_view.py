"""A table with fewer rows, or with a column that its file lacks or has otherwise."""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.table import Survey, Table

_NONE: Mapping[str, np.ndarray | None] = MappingProxyType({})


class TableView:
    """A `Table` through which another is seen."""

    def __init__(
        self,
        table: Table,
        rows: np.ndarray | None = None,
        columns: Mapping[str, np.ndarray | None] = _NONE,
        note: Finding | None = None,
    ) -> None:
        """
        Args:
            table: of all rows.
            rows: those that are seen (n,), as numbers of the table's.
            columns: that stand in place of the table's, or beside them (N,); None for the numbers
                of the rows.
            note: of what is seen otherwise.
        """
        self.table, self._rows, self._columns = table, rows, columns
        self.path, self.format, self.size = table.path, table.format, table.size
        self.names = tuple(dict.fromkeys((*table.names, *columns))) if columns else table.names
        self.units = table.units
        self.notes = (*table.notes, *([note] if note else []))

    @property
    def sha256(self) -> str:
        """Of the file."""
        return self.table.sha256

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty."""
        own = [n for n in names if n not in self._columns] or [self.table.names[0]]
        columns = self.table.numbers(list(dict.fromkeys(own)))
        count = columns[own[0]].size
        for name, values in self._columns.items():
            columns[name] = np.arange(count, dtype=np.float64) if values is None else values
        return {n: columns[n] if self._rows is None else columns[n][self._rows] for n in names}

    def survey(self) -> list[Survey]:
        """Every column of the file, in its order."""
        made = []
        for each in self.table.survey():
            values = self._columns.get(each.name)
            values = each.values if values is None else values
            filled = each.n_filled
            if values is not None and self._rows is not None:
                values, filled = values[self._rows], min(filled, self._rows.size)
            made.append(dataclasses.replace(each, values=values, n_filled=filled))
        return made

    def place(self, row: int) -> str:
        """Where a row stands in the file."""
        return self.table.place(row if self._rows is None else int(self._rows[row]))

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        if name not in self.table.names:
            return str(row)
        return self.table.cell_text(name, row if self._rows is None else int(self._rows[row]))

    def time_unit(self, name: str) -> str | None:
        """The unit of a column of time stamps."""
        return self.table.time_unit(name) if name in self.table.names else None


def first_of_copies(stamps: np.ndarray, columns: Sequence[np.ndarray]) -> np.ndarray | None:
    """The rows (n,) without those that repeat an earlier one, its time and all of its numbers; None
    where none does, or the times that are left do not increase.
    """
    if stamps.size < 2 or np.all(stamps[1:] > stamps[:-1]):
        return None
    order = np.argsort(stamps, kind="stable")
    same = stamps[order][1:] == stamps[order][:-1]
    for values in columns:
        one, other = values[order][1:], values[order][:-1]
        same &= (one == other) | (np.isnan(one) & np.isnan(other))
    if not same.any():
        return None
    keep = np.ones(stamps.size, bool)
    keep[order[1:][same]] = False
    left = stamps[keep]
    # Where times stand still with other values too, they have too few digits, and a machine at rest
    # made some rows alike.
    return np.flatnonzero(keep) if np.all(left[1:] > left[:-1]) else None


def seen_once(table: Table, rows: np.ndarray) -> TableView:
    """A table without the rows that are there twice, which is noted."""
    left_out = np.setdiff1d(np.arange(int(rows[-1]) + 1), rows)
    # Behind the last row that is seen there may be more.
    first = int(left_out[0]) if left_out.size else int(rows[-1]) + 1
    words = f"rows are written twice, the first in {table.place(first)}: each is read once"
    return TableView(table, rows, note=note("clock.rows-twice", words))


def without_copies(table: Table, clock: str, surveys: Sequence[Survey]) -> Table:
    """A table without rows that are there twice, all of its numbers being the same."""
    values = [s.values for s in surveys if s.values is not None]
    stamps = next(s.values for s in surveys if s.name == clock)
    # Arrays may have lengths of their own.
    if stamps is None or any(x.size != stamps.size for x in values):
        return table
    rows = first_of_copies(stamps, values)
    return table if rows is None else seen_once(table, rows)


def numbers_once(
    table: Table, clock: str, names: Sequence[str]
) -> tuple[dict[str, np.ndarray], tuple[Finding, ...]]:
    """Columns (N,) of one length, and a note where rows that are there twice were left out."""
    numbers = table.numbers(names)
    rows = first_of_copies(numbers[clock], list(numbers.values()))
    if rows is None:
        return numbers, ()
    return {n: x[rows] for n, x in numbers.items()}, seen_once(table, rows).notes[-1:]
