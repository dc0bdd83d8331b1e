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
from heli_jax.flights.table import Survey, Table, listed, shown
from heli_jax.flights.table_view import TableView

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


def restarts(stamps: np.ndarray) -> np.ndarray:
    """The rows (n,) in which the time begins anew; none where it only goes back here or there."""
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
    """The rows (n,) in which a number of a run is another than in the row before."""
    return np.flatnonzero(np.diff(numbers) != 0) + 1


def clock_scale(table: Table, time: Signal) -> float:
    """Of the unit of a clock, or of its counts [s]."""
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
    apart = stamps.copy()
    for start in starts:
        apart[start:] += apart[start - 1] - apart[start] + _BETWEEN / scale
    places = listed(table.place(int(start)) for start in starts)
    why = f"{shown(column)} is another" if column else "the time begins anew"
    words = (
        f"{why} in {places}: {starts.size + 1} runs, put one after another with "
        f"{_BETWEEN:g} s between"
    )
    said = note("clock.runs", words, value=starts.size + 1)
    return TableView(table, columns={clock: apart}, note=said)


def numbering_notes(column: str) -> tuple[Finding, ...]:
    """That a column numbers runs, where one does."""
    if not column:
        return ()
    remedy = f"time: {{..., runs: {column}}} in a configuration makes a flight of each"
    words = f"{shown(column)} seems to number runs, which the time does not part: {remedy}"
    return (note("clock.runs-numbered", words, column),)


def numbering(surveys: Sequence[Survey]) -> str:
    """The column that numbers runs, by its name and numbers; empty without one."""
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
