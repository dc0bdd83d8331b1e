"""Handling qualities of responses too sharp for local fits over half an octave."""

import numpy as np

from heli_jax.analysis.handling_qualities import handling_qualities
from heli_jax.analysis.response_curves import Curve, integrated, measured_curve

OMEGA = 2.0 * np.pi * np.geomspace(0.1, 6.0, 100)


def _curve(damping: float) -> Curve:
    """Test a roll rate with a load that swings at 1 Hz, and random errors of 4 %."""
    s = 1j * OMEGA
    load = np.polyval([1.0, 2.0 * 5.6 * damping, 5.6**2], s) / np.polyval(
        [1.0, 2.0 * 6.28 * damping, 6.28**2], s
    )
    H = load * 10.0 / (s + 4.0) * np.exp(-0.06 * s)
    noise = np.random.default_rng(3).standard_normal((2, OMEGA.size))
    sd = 0.04 * np.abs(H)
    measured = H + sd * (noise[0] + 1j * noise[1])
    curve = measured_curve(OMEGA, measured, sd, np.full(OMEGA.size, 0.9), 24.0)
    assert isinstance(curve, Curve)
    return integrated(curve)


def test_a_mode_that_the_smoothing_does_not_follow_is_said() -> None:
    sentences = handling_qualities(_curve(0.02)).sentences
    assert any("sharper than the half octave" in s for s in sentences)
    assert not any("sharper" in s for s in handling_qualities(_curve(0.4)).sentences)


def test_few_frequencies_are_not_called_a_low_coherence() -> None:
    few = slice(None, None, 20)
    H = 1.0 / (1j * OMEGA[few] + 4.0)
    said = measured_curve(OMEGA[few], H, 0.05 * np.abs(H), np.full(H.size, 0.9), 24.0)
    assert isinstance(said, str)
    assert said.startswith("5 adjacent frequencies")
