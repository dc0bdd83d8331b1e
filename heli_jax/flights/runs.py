"""Several runs in one table: its time begins anew with each, or a column numbers them.

They are put one after another with some seconds between, as a gap, at which they become flights.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import without_overflow
from heli_jax.flights.table import Survey, Table, shown

_BETWEEN = 10.0
"""s, which no gap that is bridged is long"""
_SHORTEST = 20
"""rows of a run"""
_BEGINNING = 0.1
"""part of the run before, in which the next begins: a stamp that goes back is no new run"""
_NAMES = {
    *("run", "runs", "segment", "seg", "maneuver", "manoeuvre", "experiment", "exp", "trial"),
    *("test", "record", "repetition", "rep", "case", "leg"),
}


class RunsTable:
    """A `Table` whose runs follow one another."""

    def __init__(self, table: Table, clock: str, stamps: np.ndarray, note: Finding) -> None:
        """
        Args:
            table: of all runs.
            clock: the column of times.
            stamps: what stands there in place of the file's (N,).
            note: of the runs.
        """
        self.table, self._clock, self._stamps, self._note = table, clock, stamps, note
        self.path, self.format, self.size = table.path, table.format, table.size
        self.names, self.units = table.names, table.units
        self.notes = (*table.notes, note)

    @property
    def sha256(self) -> str:
        """Of the file."""
        return self.table.sha256

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), the times those of runs that follow one another."""
        columns = self.table.numbers(names)
        self.notes = (*self.table.notes, self._note)
        return columns | ({self._clock: self._stamps} if self._clock in names else {})

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        return self.table.survey()

    def place(self, row: int) -> str:
        """Where a row stands."""
        return self.table.place(row)

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        return self.table.cell_text(name, row)

    def time_unit(self, name: str) -> str | None:
        """The unit of a column of time stamps."""
        return self.table.time_unit(name)


def restarts(stamps: np.ndarray) -> np.ndarray:
    """The rows (n,) in which the time begins anew; none where it only goes back here or there.

    Args:
        stamps: (N,), in any unit.
    """
    none = np.zeros(0, int)
    if stamps.size < 2 * _SHORTEST or not np.isfinite(stamps).all():
        return none
    stamps = without_overflow(stamps)
    steps = np.diff(stamps)
    # A stick that steps stands still in between.
    if np.any(steps == 0):
        return none
    falls = np.flatnonzero(steps < 0) + 1
    bounds = np.concatenate([[0], falls, [stamps.size]])
    if not falls.size or np.diff(bounds).min() < _SHORTEST:
        return none
    # Without one row the clock goes on: that stamp is wrong, and nothing begins.
    if np.any((stamps[falls] > stamps[falls - 2]) | (stamps[falls + 1] > stamps[falls - 1])):
        return none
    first, last = stamps[bounds[:-2]], stamps[falls - 1]
    anew = stamps[falls] <= first + _BEGINNING * (last - first)
    return falls if anew.all() else none


def changes(numbers: np.ndarray) -> np.ndarray:
    """The rows (n,) in which a number of a run is another than in the row before.

    Args:
        numbers: (N,)
    """
    return np.flatnonzero(np.diff(numbers) != 0) + 1


def set_apart(stamps: np.ndarray, starts: np.ndarray, scale: float) -> np.ndarray:
    """Stamps (N,) of runs that follow one another with some seconds between.

    Args:
        stamps: (N,)
        starts: rows in which runs begin, but for the first (n,).
        scale: [s] of a unit of the stamps.
    """
    apart = stamps.copy()
    for start in starts:
        apart[start:] += apart[start - 1] - apart[start] + _BETWEEN / scale
    return apart


def run_note(table: Table, starts: np.ndarray, column: str = "") -> Finding:
    """That a table holds several runs, and where they begin.

    Args:
        table: of all runs.
        starts: rows in which they begin, but for the first (n,).
        column: that numbers them; empty where the time begins anew.
    """
    places = ", ".join(table.place(int(start)) for start in starts[:4])
    more = f" and {starts.size - 4} more" if starts.size > 4 else ""
    why = f"{shown(column)} is another" if column else "the time begins anew"
    words = (
        f"{why} in {places}{more}: {starts.size + 1} runs, put one after another with "
        f"{_BETWEEN:g} s between"
    )
    return note("clock.runs", words, value=starts.size + 1)


def clock_scale(table: Table, time: Signal) -> float:
    """Of the unit of a clock, or of its counts [s].

    Args:
        table: that holds it.
        time: the clock.
    """
    if time.scale != 1.0:
        return time.scale
    # A column of time stamps says by its type what its ticks are, whatever the user thinks.
    return units.factor(table.time_unit(time.name) or time.unit, "s")


def with_runs(
    table: Table, clock: str, numbers: Mapping[str, np.ndarray], scale: float, column: str = ""
) -> Table:
    """A table whose runs follow one another; as it is where it holds one.

    Args:
        table: of rows.
        clock: the column of times.
        numbers: that column (N,), and the one that numbers runs.
        scale: [s] of a unit of the stamps.
        column: that numbers runs; without one they begin where the time does.
    """
    stamps = numbers[clock]
    starts = changes(numbers[column]) if column else restarts(stamps)
    if not starts.size:
        return table
    apart = set_apart(stamps, starts, scale)
    return RunsTable(table, clock, apart, run_note(table, starts, column))


def numbering_notes(column: str) -> tuple[Finding, ...]:
    """That a column numbers runs, where one does.

    Args:
        column: its name, or empty.
    """
    if not column:
        return ()
    remedy = f"time: {{..., runs: {column}}} in a configuration makes a flight of each"
    words = f"{shown(column)} seems to number runs, which the time does not part: {remedy}"
    return (note("clock.runs-numbered", words, column),)


def numbering(surveys: Sequence[Survey]) -> str:
    """The column that numbers runs, by its name and numbers; empty without one.

    Args:
        surveys: of a table's columns.
    """
    for each in surveys:
        if each.values is None or not _NAMES & set(words_in(each.name)):
            continue
        values = each.values
        if not np.isfinite(values).all() or np.any(values != np.rint(values)):
            continue
        bounds = np.concatenate([[0], changes(values), [values.size]])
        if bounds.size > 2 and np.all(np.diff(values) >= 0) and np.diff(bounds).min() >= _SHORTEST:
            return each.name
    return ""
