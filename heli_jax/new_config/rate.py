"""A rate at which the signals of a log can be brought onto one grid."""

from collections.abc import Collection, Mapping

from heli_jax.flights.derived import sources
from heli_jax.flights.preset import model_inputs, model_outputs, preset
from heli_jax.flights.slower import usual_step
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


def common_rate(series: Mapping[str, Series], used: Collection[str]) -> float | None:
    """The slowest clock of the channels that are used [Hz], 100 at most; None of none.

    Args:
        series: of the log by channel.
        used: names of channels.
    """
    rates = [1.0 / usual_step(series[n].times) for n in used if n in series]
    rates = [rate for rate in rates if rate >= _SLOW] or rates
    return two_digits(min(_FASTEST, *rates)) if rates else None


def channels_of_preset(name: str, series: Collection[str], signals: Collection[str]) -> list[str]:
    """The log's channels that a preset may take for signals of a model.

    Args:
        name: of the preset.
        series: the log's channels.
        signals: the model's inputs and outputs.
    """
    inputs, outputs, table = model_inputs(), model_outputs(), preset(name).signals
    meant = [outputs.get(n, inputs[n].command if n in inputs else n) for n in signals]
    # Of several channels the first that the log has is taken.
    found = []
    for signal in meant:
        for alternative in table.get(signal, ()):
            needed = sources(alternative.channel, frozenset(series))
            if set(needed) <= set(series):
                found += needed
                break
    return found
