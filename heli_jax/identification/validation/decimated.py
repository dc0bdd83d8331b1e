"""Whiteness of what was low-passed on its way to a lower rate.

Where a flight has fewer samples a second than its log, a low-pass has taken away what the new rate
cannot hold, and with it the last fifth of its band: white noise of a sensor comes out with an
autocorrelation of +0.13 at one sample, which a long record tells from none. That is no disturbance
and no dynamics that a model lacks. Below that fifth the spectrum is as it was: sampled as fast as
this band needs and no faster, what is white there is white.
"""

import numpy as np

from heli_jax.flights.band_limited import PASSED
from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.metrics import Whiteness, whiteness

_FEWER = 0.9
"""times the flight's sample time, below which the log's is that of a faster clock"""
_SEEN = 0.95
"""part of the samples that a spectrum needs"""


def is_decimated(flight: Flight, output: str) -> bool:
    """Whether an output was logged at a higher rate than the flight has.

    Args:
        flight: as it is fitted.
        output: one of its outputs.
    """
    facts = None if flight.source is None else flight.source.facts.get((output, "output"))
    return facts is not None and facts.usual < _FEWER * flight.dt


def whiteness_in_band(innovations: np.ndarray, together: int) -> Whiteness:
    """As `whiteness`, of the band that the low-pass of a lower rate passes, where all of it is not.

    Args:
        innovations: (N,) over their standard deviations, NaN where nothing is measured.
        together: how many signals are judged side by side.
    """
    found, seen = whiteness(innovations, together), np.isfinite(innovations)
    if found.white or np.mean(seen) < _SEEN:
        return found
    spectrum = np.fft.rfft(np.where(seen, innovations, 0.0))
    kept = int(PASSED * innovations.size)
    other = whiteness(np.fft.irfft(spectrum[: kept + 1], 2 * kept), together)
    return other if other.white else found
