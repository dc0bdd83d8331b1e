"""Common rate for the signals of a log."""

from collections.abc import Collection, Mapping

import numpy as np

from heli_jax.flights.derived import sources
from heli_jax.flights.preset import model_inputs, model_outputs, preset
from heli_jax.flights.resample import SLOWER, usual_step
from heli_jax.new_config.guess import Series

_FASTEST = 100.0
"""Fastest grid [Hz]. A small helicopter's attitude dynamics are below 10 Hz, so faster grids only
cost time."""
_SLOW = 20.0
"""Rate [Hz] below which a channel is slow and keeps its own samples if others are faster."""


def two_digits(rate: float) -> float:
    """Round a rate to two digits, such as 99.98 Hz to 100 Hz.

    Args:
        rate: [Hz].
    """
    return float(f"{rate:.2g}")


def common_rate(series: Mapping[str, Series], outputs: Collection[str]) -> float | None:
    """Return the slowest clock of the used outputs [Hz], at most 100; None without outputs."""
    rates = [1.0 / usual_step(series[n].times) for n in outputs if n in series]
    rates = [rate for rate in rates if rate >= _SLOW] or rates
    return two_digits(min(_FASTEST, *rates)) if rates else None


def rate_of_outputs(series: Mapping[str, Series], outputs: Collection[str]) -> float | None:
    """Return the rate [Hz] of the fastest output by its own samples, at most 100.

    It is None unless a table's rows are faster because they belong to several topics.
    """
    rates, rows = [], 0.0
    for times, values, *_ in (series[n] for n in outputs if n in series):
        rates.append(1.0 / usual_step(times[~np.isnan(values)]))
        rows = max(rows, 1.0 / usual_step(times), (times.size - 1) / float(np.ptp(times)))
    if not rates or rows < SLOWER * max(rates):
        return None
    return two_digits(min(_FASTEST, max(rates)))


def channels_of_preset(name: str, series: Collection[str], signals: Collection[str]) -> list[str]:
    """Return the log's channels that a preset may use for signals of a model."""
    inputs, outputs, table = model_inputs(), model_outputs(), preset(name).signals
    meant = [outputs.get(n, inputs[n].command if n in inputs else n) for n in signals]
    # The first of several channels in the log is used.
    channels = []
    for signal in meant:
        for alternative in table.get(signal, ()):
            needed = sources(alternative.channel, frozenset(series))
            if set(needed) <= set(series):
                channels += needed
                break
    return channels
