"""What is wrong with the times of a table, in words, and what to do about it."""

import math

import numpy as np

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import not_increasing, shared_stamps
from heli_jax.flights.runs import restarts
from heli_jax.flights.table import Table, column, shown, wrong
from heli_jax.flights.time_units import split_unit

_MANY = 0.1
"""part of the stamps that are not later than the one before, which no hand takes out"""
_FEW_ROWS = 10
"""rows out of order that are left out by hand"""


def unit_notes(time: Signal, stated: str | None) -> tuple[Finding, ...]:
    """A note where the file, or the name of its clock, says another unit than the configuration.

    Args:
        time: the clock and its unit, as configured.
        stated: its unit, as the file has it.
    """
    named = split_unit(time.name)[1]
    factor = units.factor(time.unit, "s")
    if stated and not math.isclose(units.factor(stated, "s"), factor):
        words = f"time: {shown(time.name)} is taken in {stated}, as the file says"
        return (note("units.contradicted", f"{words}, and not in {time.unit}"),)
    if not stated and named and not math.isclose(units.factor(named, "s"), factor):
        words = f"time: {shown(time.name)} is taken in {time.unit}, though its name says {named}"
        words += f": if that is right, state unit: {named} beside it"
        return (note("units.contradicted", words),)
    return ()


def require_increasing(table: Table, name: str, stamps: np.ndarray) -> None:
    """Refuse a clock of which a stamp is not later than the one before it.

    Args:
        table: of rows.
        name: the column of times.
        stamps: in any unit (N,).
    """
    back = not_increasing(stamps)
    if back is None:
        return
    row, fault = back
    after, now = table.cell_text(name, row - 1), table.cell_text(name, row)
    problem = f"the time {fault}, got {now} after {after}, expected increasing times"
    words = f"{problem}; {remedy(table, stamps, row)}"
    raise wrong(table.path, words, table.place(row), column(name))


def remedy(table: Table, stamps: np.ndarray, row: int) -> str:
    """What to do about a stamp that is not later than the one before it, in words."""
    # Where the one before is left out the times go on: it is the wrong one.
    if row > 1 and stamps[row - 2] < stamps[row] and stamps[row] < stamps[row - 1]:
        return f"{table.place(row - 1)} is out of order with those around it: leave it out"
    if (starts := restarts(stamps)).size:
        runs = f"{starts.size + 1} runs in one file"
        return f"there are {runs}: gaps: split beside log: makes a flight of each"
    steps = np.diff(stamps)
    if shared := shared_stamps(stamps):
        return shared
    if np.count_nonzero(steps < 0) > _MANY * stamps.size:
        return "sort the rows by time"
    later = np.flatnonzero(stamps[row:] > stamps[row - 1])
    if later.size and later[0] <= _FEW_ROWS:
        last = row + int(later[0]) - 1
        what = table.place(row) if last == row else f"{table.place(row)} to {table.place(last)}"
        return f"leave {what} out"
    return f"make two files of it, the second from {table.place(row)} on"
