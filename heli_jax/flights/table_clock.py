"""The clock of a table: as a user states it, as the file does, or as its columns look."""

from collections.abc import Sequence

import numpy as np

from heli_jax import units
from heli_jax.errors import nearest
from heli_jax.flights.clock_guess import counter_of, guess_clock
from heli_jax.flights.flight import Signal
from heli_jax.flights.row_clock import by_rate, stated_rate
from heli_jax.flights.table import Survey, Table, column, require_columns, shown, wrong
from heli_jax.flights.time_units import SECONDS


def table_clock(
    table: Table,
    surveys: Sequence[Survey],
    time: str | Signal | None,
    unit: str | None,
    rate: float | None,
) -> tuple[Signal | None, bool, str]:
    """The clock, None without one, whether its unit or rate is a guess, and what the file says of
    its rate.

    Args:
        table: of rows.
        surveys: of its columns.
        time: the column of time stamps, where it is stated.
        unit: of the time stamps.
        rate: samples a second [Hz], of rows or of what `time` counts.

    Raises:
        InputError: there is no such column, or the unit or the rate is none.
    """
    said = ""
    if rate is not None:
        if not (rate > 0 and np.isfinite(rate)):
            raise wrong(table.path, f"expected a positive number of samples a second, got {rate:g}")
        name = time.name if isinstance(time, Signal) else time
        name = counter_of(surveys) if name is None else asked_time(table, surveys, name).name
        signal, guessed, unit = by_rate(rate, name), False, None
    elif time is None:
        # A rate in the file goes before what merely increases, as a distance may.
        stated = stated_rate(surveys)
        signal, guessed = guess_clock(table, surveys, by_name=stated is not None)
        if signal is None and stated is not None:
            (clock, said), unit = stated, None
            signal, guessed = by_rate(clock, counter_of(surveys)), True
    else:
        signal, guessed = asked_time(table, surveys, time), False
    # A stated unit goes with whatever column is the clock, the guessed one too: then nothing is a
    # guess.
    if signal is not None and unit is not None:
        signal, guessed = asked_time(table, surveys, Signal(signal.name, unit, "s")), False
    return signal, guessed, said


def asked_time(table: Table, surveys: Sequence[Survey], time: str | Signal) -> Signal:
    """A column of times as a user names it.

    Raises:
        InputError: there is none, or its unit is none of time.
    """
    signal = Signal(time, "s", "s") if isinstance(time, str) else time
    require_columns(table.path, table.names, [signal.name])
    if all(s.values is None for s in surveys if s.name == signal.name):
        raise wrong(table.path, "holds text, expected times", column(signal.name))
    if signal.unit not in SECONDS:
        if not units.is_unit(signal.unit):
            # Of the units of time alone: the nearest of all units may be one of capacity.
            problem = f"unknown unit of time {shown(signal.unit)}{nearest(signal.unit, SECONDS)}"
            raise wrong(table.path, problem, column(signal.name))
        try:
            units.factor(signal.unit, "s")
        except ValueError as e:
            raise wrong(table.path, str(e), column(signal.name)) from e
    return signal
