"""A rate at which the signals of a log can be brought onto one grid."""

from collections.abc import Collection, Mapping

import numpy as np

from heli_jax.flights.derived import sources
from heli_jax.flights.preset import model_inputs, model_outputs, preset
from heli_jax.flights.resample import SLOWER, usual_step
from heli_jax.new_config.guess import Series

_FASTEST = 100.0
"""[Hz] a small helicopter's attitude is over below 10 Hz: faster grids cost time alone"""
_SLOW = 20.0
"""[Hz] a channel below is taken as a slower one, at its own samples, where others are faster"""


def two_digits(rate: float) -> float:
    """A rate of 99.98 Hz is one of 100.

    Args:
        rate: [Hz].
    """
    return float(f"{rate:.2g}")


def common_rate(series: Mapping[str, Series], outputs: Collection[str]) -> float | None:
    """The slowest clock of the outputs that are used [Hz], 100 at most; None of none."""
    rates = [1.0 / usual_step(series[n].times) for n in outputs if n in series]
    rates = [rate for rate in rates if rate >= _SLOW] or rates
    return two_digits(min(_FASTEST, *rates)) if rates else None


def rate_of_outputs(series: Mapping[str, Series], outputs: Collection[str]) -> float | None:
    """The rate [Hz] of the fastest output by its own samples, 100 at most, where a table's rows
    come faster than that since they are those of several topics; else None.
    """
    rates, rows = [], 0.0
    for times, values, *_ in (series[n] for n in outputs if n in series):
        rates.append(1.0 / usual_step(times[~np.isnan(values)]))
        rows = max(rows, 1.0 / usual_step(times), (times.size - 1) / float(np.ptp(times)))
    if not rates or rows < SLOWER * max(rates):
        return None
    return two_digits(min(_FASTEST, max(rates)))


def channels_of_preset(name: str, series: Collection[str], signals: Collection[str]) -> list[str]:
    """The log's channels that a preset may take for signals of a model."""
    inputs, outputs, table = model_inputs(), model_outputs(), preset(name).signals
    meant = [outputs.get(n, inputs[n].command if n in inputs else n) for n in signals]
    # Of several channels the first that the log has is taken.
    channels = []
    for signal in meant:
        for alternative in table.get(signal, ()):
            needed = sources(alternative.channel, frozenset(series))
            if set(needed) <= set(series):
                channels += needed
                break
    return channels
