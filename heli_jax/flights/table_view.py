"""A table with fewer rows, or with a clock that its file has in several columns."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.clock_parts import ClockParts, CompactClock, clock_parts
from heli_jax.flights.table import Survey, Table


class TableView:
    """A `Table` through which another is seen."""

    def __init__(
        self,
        table: Table,
        rows: np.ndarray | None = None,
        clock: ClockParts | CompactClock | None = None,
        note: Finding | None = None,
    ) -> None:
        """
        Args:
            table: of all rows.
            rows: those that are seen, as numbers of the table's.
            clock: which stands in front of the columns.
            note: of what is seen otherwise.
        """
        self.table, self._rows, self._clock, self._note = table, rows, clock, note
        self.path, self.format, self.size = table.path, table.format, table.size
        self.names = table.names if clock is None else (clock.name, *table.names)
        self.units = table.units
        self.notes = self._all_notes()

    def _all_notes(self) -> tuple[Finding, ...]:
        return (*self.table.notes, *([self._note] if self._note else []))

    @property
    def sha256(self) -> str:
        """Of the file."""
        return self.table.sha256

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty."""
        clock = self._clock
        needed = [n for n in names if clock is None or n != clock.name]
        if clock is not None and clock.name in names:
            needed += clock.columns
        columns = self.table.numbers(list(dict.fromkeys(needed)))
        self.notes = self._all_notes()
        if clock is not None and clock.name in names:
            columns[clock.name] = clock.seconds(columns)
        return {n: columns[n] if self._rows is None else columns[n][self._rows] for n in names}

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        surveys = self.table.survey()
        self.notes = self._all_notes()
        if self._clock is not None:
            values = {s.name: s.values for s in surveys if s.values is not None}
            times = self._clock.seconds({n: values[n] for n in self._clock.columns})
            surveys = [Survey(self._clock.name, times, times.size), *surveys]
        return surveys if self._rows is None else [_of_rows(s, self._rows) for s in surveys]

    def place(self, row: int) -> str:
        """Where a row stands in the file."""
        return self.table.place(row if self._rows is None else int(self._rows[row]))

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words; of a joined clock the number."""
        if self._clock is not None and name == self._clock.name:
            return f"{self.numbers([name])[name][row]:.9f}"
        return self.table.cell_text(name, row if self._rows is None else int(self._rows[row]))

    def time_unit(self, name: str) -> str | None:
        """The unit of a column of time stamps."""
        if self._clock is not None and name == self._clock.name:
            return "s"
        return self.table.time_unit(name)


def _of_rows(survey: Survey, rows: np.ndarray) -> Survey:
    if survey.values is None:
        return survey
    filled = min(survey.n_filled, rows.size)
    return dataclasses.replace(survey, values=survey.values[rows], n_filled=filled)


def first_of_copies(stamps: np.ndarray, columns: Sequence[np.ndarray]) -> np.ndarray | None:
    """The rows (n,) without those that repeat an earlier one, its time and all of its numbers; None
    where none does, or the times that are left do not increase.

    Args:
        stamps: (N,)
        columns: each (N,).
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
    """A table without the rows that are there twice, which is noted.

    Args:
        table: of all rows.
        rows: those to be seen, of `first_of_copies`.
    """
    left_out = np.setdiff1d(np.arange(int(rows[-1]) + 1), rows)
    # Behind the last row that is seen there may be more.
    first = int(left_out[0]) if left_out.size else int(rows[-1]) + 1
    words = f"rows are written twice, the first in {table.place(first)}: each is read once"
    twice = note("clock.rows-twice", words)
    return TableView(table, rows, note=twice)


def without_copies(table: Table, clock: str, surveys: Sequence[Survey]) -> Table:
    """A table without rows that are there twice, all of its numbers being the same.

    Args:
        table: of rows.
        clock: the column of times.
        surveys: of all columns.
    """
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
    """Columns (N,) of one length, and a note where rows that are there twice were left out.

    Args:
        table: of rows.
        clock: the column of times.
        names: of the columns, the clock's among them.
    """
    numbers = table.numbers(names)
    rows = first_of_copies(numbers[clock], list(numbers.values()))
    if rows is None:
        return numbers, ()
    return {n: x[rows] for n, x in numbers.items()}, seen_once(table, rows).notes[-1:]


def with_joined_clock(table: Table) -> Table:
    """A table with a clock in front of its columns, where several of them make one: `secs` and
    `nsecs` of ROS, a time of day in whole seconds beside milliseconds, or hours, minutes, seconds.

    Args:
        table: of rows.
    """
    clock = clock_parts(table.names)
    if clock is None:
        return table
    try:
        columns = table.numbers(clock.columns)
    # What is wrong with them is told to whom asks for them.
    except InputError:
        return table
    if not clock.fits(columns):
        return table
    return TableView(table, clock=clock)
