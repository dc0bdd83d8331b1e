"""Latitudes and longitudes, which are called as the lateral and the longitudinal stick are."""

from collections.abc import Mapping

import numpy as np

from heli_jax.flights.channel_names import words_in
from heli_jax.new_config.guess import Series

_CALLED = {"lat", "lon", "lng", "long", "latitude", "longitude"}
_STEADY = 50.0
"""times what a flight goes over, by which a place is away from zero at least"""
_PARTS, _DEGREES, _INTEGERS = 1.5, 180.0, 1e6
"""of full travel, of half a circle, and of the parts of a degree in which receivers of GPS count"""


def is_place(name: str, log: Mapping[str, Series]) -> bool:
    """Whether a channel is a latitude or a longitude, by its name and its numbers, or by a `Lng`
    that stands beside it.

    Args:
        name: of the channel.
        log: the channels.
    """
    words = words_in(name)
    if not words or words[-1] not in _CALLED:
        return False
    beside = {other for other in log if other.rpartition(".")[0] == name.rpartition(".")[0]}
    if any(words_in(other)[-1:] in (("lng",), ("longitude",)) for other in beside):
        return True
    values = log[name].values[np.isfinite(log[name].values)]
    if not values.size:
        return False
    smallest, largest = float(np.min(np.abs(values))), float(np.max(np.abs(values)))
    # Pulse widths of a stick at rest are between the two.
    scaled = _PARTS < largest <= _DEGREES or largest > _INTEGERS
    return scaled and smallest > _STEADY * float(np.ptp(values))
