"""How far the axis of frequency of a Bode figure reaches; without matplotlib."""

import numpy as np

from heli_jax.analysis.response_curves import octave_mean

SEEN, BEYOND_CHANCE = 0.1, 0.3
"""mean coherence over an octave: below the first it is chance, the second is hardly made by it, of
three or four averages either, and up to the last such bin frequencies are drawn"""


def last_of(omega: np.ndarray, coherence: np.ndarray, known: np.ndarray) -> int:
    """The place of the last frequency that the axes hold.

    Single bins are coherent by chance up to the end of the band, far above what was excited.

    Args:
        omega: (k,) [rad/s]
        coherence: (k,) partial.
        known: (k,) bool, bins that are drawn where there is room.
    """
    mean = octave_mean(omega, coherence)
    for bins in (known & (mean >= BEYOND_CHANCE), known & (mean >= SEEN), known):
        if bins.any():
            return int(np.flatnonzero(bins)[-1])
    return omega.size - 1
