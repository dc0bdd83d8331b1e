"""Errors of responses by instrument, from independent draws."""

import numpy as np
import pytest

from heli_jax.analysis.responses import responses
from heli_jax.analysis.spectra import Spectra

RESPONSE, WINDOWS, DRAWS = 2.0 - 1.0j, 20, 4000


def drawn(strength, seed=0):
    """Return responses at `DRAWS` frequencies.

    The input is `strength` times the excitation, plus as much from feedback as its own size.
    """
    rng = np.random.default_rng(seed)

    def normal():
        return rng.standard_normal((WINDOWS, DRAWS)) + 1j * rng.standard_normal((WINDOWS, DRAWS))

    z, e = normal(), normal()
    u = strength * z + 0.8 * e + 0.6 * normal()
    signals = np.stack([u, RESPONSE * u + e, z])
    spectra = Spectra(np.arange(1.0, DRAWS + 1.0), signals.T, float(WINDOWS), 1.0)
    return responses(spectra, [0], [1], instruments=[2])


@pytest.mark.parametrize("strength", [0.2, 0.8, 1.0, 10.0])
def test_intervals_hold_however_weak_the_excitation_is(strength):
    found = drawn(strength)
    H, sd = found.H[:, 0, 0], found.sd[:, 0, 0]
    given = np.isfinite(sd)
    # If nothing is known, no response is given, and none is counted as a miss.
    inside = np.abs(np.real(H - RESPONSE)) < 1.96 * sd
    outside = np.mean(given & ~inside)
    assert outside < 0.06
    assert np.array_equal(given, np.isfinite(H))
    share = {0.2: (0.0, 0.0), 0.8: (0.9, 1.0), 1.0: (0.99, 1.0), 10.0: (1.0, 1.0)}[strength]
    assert share[0] <= np.mean(given) <= share[1]


def test_a_strong_one_has_the_errors_of_a_mean():
    found = drawn(30.0)
    assert np.std(np.real(found.H[:, 0, 0])) == pytest.approx(np.median(found.sd), rel=0.1)
