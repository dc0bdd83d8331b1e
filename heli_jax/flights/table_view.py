"""A table with fewer rows, or with a column that its file lacks or has otherwise."""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from heli_jax.finding import Finding
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
            rows: those that are seen (n,), as numbers of the table's.
            columns: that stand in place of the table's, or beside them (N,); None for the numbers
                of the rows.
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
