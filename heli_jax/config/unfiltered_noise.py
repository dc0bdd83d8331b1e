"""Outputs with noise that a stated low-pass would have taken: did the log go through it at all?

A sensor's noise goes through the filter with the motion. Where it is as strong far above the
cut-off as below, the log was taken before the filter, and a model that has the filter takes its lag
off the machine's.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from heli_jax.config.firmware_filters import logged_filters
from heli_jax.config.onboard import FROM_LOG
from heli_jax.config.schema import OutputConfig
from heli_jax.dynamics.onboard.filters import Filter, cutoff, gain
from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.flights.signal_facts import quantum
from heli_jax.numbers import percent

_BANDS = 12
"""of equal width in the logarithm"""
_LOWEST, _HIGHEST = 0.05, 0.4
"""of the rate, between which noise is looked for: slower is motion, and resampling takes what is
faster"""
_LEFT, _THERE = 0.25, 0.6
"""of its power, what the filter leaves from one band to a faster one at most, and what is there at
least"""
_FOLDS = 20
"""multiples of the rate from which noise folds down"""
_ROUNDED = 10.0
"""times the power of the log's rounding, which is white behind any filter, that is there"""
_SEGMENT, _FEWEST = 256, 1500
"""samples of a spectrum, and of a record to have one: its bands are known to a tenth then"""


def unfiltered_cautions(flight: Flight, outputs: Mapping[str, OutputConfig]) -> tuple[Finding, ...]:
    """A doubt for each output whose noise did not come through its filter.

    Args:
        flight: as read.
        outputs: what is stated of each.
    """
    said = []
    for name, output in outputs.items():
        filters = [f for f in _stated(flight, output) if f.kind != "notch"]
        y = flight.outputs.get(name)
        if not filters or y is None or y.size < _FEWEST or not np.isfinite(y).all():
            continue
        found = _not_taken(y, flight.dt, filters)
        if found is not None:
            slow, fast, there, left = found
            words = (
                f"{name}: its noise at {fast:.3g} Hz has {percent(there, 0)} of its power at "
                f"{slow:.3g} Hz, of which the stated low-pass of {cutoff(filters):.3g} Hz leaves "
                f"{percent(left, 0)}: was it logged before the filter? Then the lag of a filter "
                "that is not there is taken off the machine's; leave the filter out and compare"
            )
            said.append(Finding("filters.not-passed", "doubt", words, there, "power", (name,)))
    return tuple(said)


def _stated(flight: Flight, output: OutputConfig) -> list[Filter]:
    filters: list[Filter] = []
    for config in output.filter or ():
        if config.kind != FROM_LOG:
            filters.append(config.filter)
        elif flight.source is not None:
            source = flight.source
            logged = logged_filters(source.firmware, source.parameters, output.signal)
            filters += logged.filters if logged else ()
    return filters


def _not_taken(
    y: np.ndarray, dt: float, filters: list[Filter]
) -> tuple[float, float, float, float] | None:
    """Of the pair of bands that says most: their frequencies [Hz], how much of the slower one's
    power the faster one has, and how much the filters leave; None where noise falls off."""
    from scipy.signal import welch

    rate = 1.0 / dt
    hz, power = welch(y, rate, nperseg=_SEGMENT)
    edges = np.geomspace(_LOWEST, _HIGHEST, _BANDS + 1) * rate
    folds = np.arange(-_FOLDS, _FOLDS + 1) * rate
    # Medians, since vibration stands in lines.
    rows = [(hz >= low) & (hz < high) for low, high in pairwise(edges)]
    measured = np.array([np.median(power[row]) for row in rows if row.any()])
    centre = np.array([np.mean(hz[row]) for row in rows if row.any()])
    passed = np.array([np.sum(gain(filters, np.abs(c + folds)) ** 2) for c in centre])
    rounding = quantum(y) ** 2 / 12.0 * 2.0 * dt
    best = None
    for i, j in zip(*np.triu_indices(centre.size, 1), strict=True):
        there, left = measured[j] / measured[i], passed[j] / passed[i]
        sure = left <= _LEFT and there >= _THERE and measured[j] >= _ROUNDED * rounding
        if sure and (best is None or left < best[3]):
            best = (float(centre[i]), float(centre[j]), float(there), float(left))
    return best
