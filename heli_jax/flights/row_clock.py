"""Clocks of tables that hold no times: rows, or counts of a column, at a rate that is known."""

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import Finding
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.flight import Signal
from heli_jax.flights.table import Survey, Table, shown
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
