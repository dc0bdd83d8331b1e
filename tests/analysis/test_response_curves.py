"""Reasons why a measured response has no curve."""

import numpy as np

from heli_jax.analysis.response_curves import measured_curve

OMEGA = 2.0 * np.pi * np.geomspace(0.1, 6.0, 100)


def test_few_frequencies_are_not_called_a_low_coherence() -> None:
    few = slice(None, None, 20)
    H = 1.0 / (1j * OMEGA[few] + 4.0)
    said = measured_curve(OMEGA[few], H, 0.05 * np.abs(H), np.full(H.size, 0.9), 24.0)
    assert isinstance(said, str)
    assert said.startswith("5 adjacent frequencies")
