"""How far the frequency axis of a Bode figure reaches."""

import numpy as np
import pytest

from heli_jax.analysis.response_curves import Point
from heli_jax.report.figures import draw_response, match
from heli_jax.report.fitted_responses import FittedPair

OMEGA = 2.0 * np.pi * np.geomspace(0.1, 20.0, 120)


def _pair() -> FittedPair:
    """Excited to 4 Hz; above only chance, with one bin in six that has a small random error."""
    hz = OMEGA / (2.0 * np.pi)
    H = 10.0 / (1j * OMEGA + 5.0)
    chance = hz > 4.0
    lucky = chance & (np.arange(hz.size) % 6 == 5)
    relative = np.where(lucky, 0.4, np.where(chance, 2.0, 0.05))
    coherence = np.where(lucky, 0.5, np.where(chance, 0.05, 0.95))
    zero = np.zeros((hz.size, 1))
    slopes = np.zeros(hz.size)
    model = Point(np.log(np.abs(H)), np.angle(H), slopes, slopes, zero, zero)
    return FittedPair("lat", "p", OMEGA, H, relative * np.abs(H), coherence, model)


def test_bins_that_are_coherent_by_chance_do_not_widen_the_axis() -> None:
    pair = _pair()
    axes = match(pair, "dB re rad/s", "")
    # Both in Hz, as bands are stated.
    assert axes[0].get_xlim()[1] < 6.0
    assert axes[0].get_xlim()[0] == pytest.approx(0.1)
    assert axes[-1].get_xlabel() == "frequency [Hz]"
    measured = type("Measured", (), {**pair._asdict(), "picture": np.full(OMEGA.size, np.nan)})
    axes = draw_response(("lat", "p"), OMEGA, measured, "rad/s", "", 20.0)
    assert axes[0].get_xlim()[1] < 6.0


def test_bins_of_a_response_in_gusts_are_within_the_axes() -> None:
    """Their coherence is 0.45 from 2 to 4 Hz, where the gain has fallen by 9 dB more."""
    pair = _pair()
    hz = OMEGA / (2.0 * np.pi)
    H = pair.H / (1.0 + (hz / 2.0) ** 4)
    coherence = np.where(hz > 2.0, np.where(hz > 4.0, pair.coherence, 0.45), 0.9)
    axes = match(pair._replace(H=H, coherence=coherence), "dB re rad/s", "")
    lowest = 20.0 * np.log10(np.min(np.abs(H[hz < 4.0])))
    assert axes[0].get_ylim()[0] < lowest
