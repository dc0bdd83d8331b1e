"""Clocks of tables that hold no times, or the times of several runs.

Rows, or counts of a column, are samples at a rate that is known. Where the time begins anew with
each run, or a column numbers them, the runs are put one after another with some seconds between, as
a gap, at which they become flights.
"""

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax import units
from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import without_overflow
from heli_jax.flights.table import Survey, Table, listed, shown
from heli_jax.flights.table_view import TableView

ROWS = "row number"
"""what the numbers of rows are called, from 0, as a column"""
_STEPS = {"ts", "dt", "tsample", "tsamp", "tsampling"}
_RATES = {"fs", "hz"}
_OF_SAMPLES = {"sample", "samples", "sampling", "time"}
_STEP_WORDS, _RATE_WORDS = {"time", "step", "period", "interval"}, {"rate", "freq", "frequency"}
_OTHER_RATE = 0.01
"""by which a stated rate differs from that of the times at least: less is a clock's own error"""
FASTEST, SLOWEST = 1e5, 0.2
"""Hz: no record of a flight is outside of these"""


def by_rate(rate: float, counter: str | None = None) -> Signal:
    """The clock of rows that were sampled at a rate.

    Args:
        rate: [Hz]
        counter: a column that counts samples; the rows themselves without one.
    """
    return Signal(counter or ROWS, "s", "s", scale=1.0 / rate)


def counted(table: Table) -> Table:
    """A table of which the numbers of the rows can be asked for as a column, `ROWS`."""
    return TableView(table, columns={ROWS: None})


def stated_rate(surveys: Sequence[Survey]) -> tuple[float, str] | None:
    """The rate [Hz] that a file states in a single number beside its samples (`Ts`, `dt`, `fs`),
    and what says so; None where there is none, or are several.
    """
    rates: dict[float, str] = {}
    for each in surveys:
        rate = rate_of(each.name, each.values)
        if rate is not None and each.values is not None:
            number = float(each.values[np.isfinite(each.values)][0])
            rates.setdefault(rate, f"{shown(each.name)} = {number:g}")
    if len(rates) != 1:
        return None
    rate, words = next(iter(rates.items()))
    # 1/0.02 is 50 in numbers of the machine, 1/0.033 is what it is.
    near = round(rate, 6)
    return (near if math.isclose(rate, near, rel_tol=1e-9) else rate), words


def contradicted_rate(table: Table, clock: str, rate: float) -> tuple[Finding, ...]:
    """A caution where a file states another rate than that of its times."""
    stated: dict[float, str] = {}
    for name in table.names:
        # Of another clock than this one its path tells.
        if _is_step(name) is not None and _group(name) == _group(clock):
            stated |= _one_rate(table, name)
    return rate_cautions(stated, clock, rate)


def rate_cautions(stated: Mapping[float, str], clock: str, rate: float) -> tuple[Finding, ...]:
    """A caution for each rate that is neither that of times nor a whole multiple, of which every
    second or tenth sample may have been logged.
    """
    if not (math.isfinite(rate) and rate > 0):
        return ()
    return tuple(
        Finding(
            "clock.rate-contradicted",
            "doubt",
            f"the file states {other:.6g} Hz ({words}), and its times {shown(clock)} are at "
            f"{rate:.6g} Hz: one of the two clocks is wrong, and rates that follow from it are off "
            f"by {abs(other / rate - 1):.0%}.",
            other / rate,
            f"stated rate over that of the times, whole numbers to {_OTHER_RATE:g}",
        )
        for other, words in stated.items()
        if abs(other / rate / max(round(other / rate), 1) - 1.0) > _OTHER_RATE
    )


def _group(name: str) -> str:
    return re.split(r"[./][^./]*$", name)[0] if re.search(r"[./]", name) else ""


def _one_rate(table: Table, name: str) -> dict[float, str]:
    """The rate [Hz] in a column or an array, where it holds a single number."""
    try:
        values = table.numbers([name])[name]
    except InputError:
        return {}
    rate = rate_of(name, values)
    return {} if rate is None else {rate: f"{shown(name)} = {values[np.isfinite(values)][0]:g}"}


def rate_of(name: str, values: np.ndarray | None) -> float | None:
    """The rate [Hz] that a single number states, or one that stands in every row; None of others.

    Args:
        name: by which it is a step or a rate.
        values: (N,)
    """
    step = _is_step(name)
    if values is None or step is None:
        return None
    values = values[np.isfinite(values)]
    # In a table a number may stand in the first row alone, or in each.
    if not values.size or np.ptp(values) > 0 or values[0] <= 0:
        return None
    rate = 1.0 / float(values[0]) if step else float(values[0])
    return rate if SLOWEST <= rate <= FASTEST else None


def _is_step(name: str) -> bool | None:
    """Whether a name is that of a time step, or of a rate (False); None of anything else."""
    words = words_in(name.rpartition(".")[2].rpartition("/")[2])
    joined = "".join(words)
    if joined in _STEPS or (
        len(words) == 2 and words[0] in (*_OF_SAMPLES, "delta") and words[1] in _STEP_WORDS
    ):
        return True
    if joined in _RATES or (
        len(words) == 2 and words[0] in _OF_SAMPLES and words[1] in _RATE_WORDS
    ):
        return False
    return None


_BETWEEN = 10.0
"""s, which no gap that is bridged is long"""
_SHORTEST = 20
"""rows of a run"""
_BEGINNING = 0.1
"""part of the run before, in which the next begins: a stamp that goes back is no new run"""
_RUN_NAMES = {
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
        if each.values is None or not _RUN_NAMES & set(words_in(each.name)):
            continue
        values = each.values
        if not np.isfinite(values).all() or np.any(values != np.rint(values)):
            continue
        bounds = np.concatenate([[0], changes(values), [values.size]])
        if bounds.size > 2 and np.all(np.diff(values) >= 0) and np.diff(bounds).min() >= _SHORTEST:
            return each.name
    return ""
