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
    model = Point(np.log(np.abs(H)), np.angle(H), zero, zero)
    return FittedPair("lat", "p", OMEGA, H, relative * np.abs(H), coherence, model)


def test_bins_that_are_coherent_by_chance_do_not_widen_the_axis() -> None:
    pair = _pair()
    chart = match(pair, "dB re rad/s", "")
    # Both in Hz, as bands are stated.
    assert chart.x_limits[1] < 6.0
    assert chart.x_limits[0] == pytest.approx(0.1)
    assert chart.x_label == "frequency [Hz]"
    measured = type("Measured", (), {**pair._asdict(), "picture": np.full(OMEGA.size, np.nan)})
    chart = draw_response(("lat", "p"), OMEGA, measured, "rad/s", "", 20.0)
    assert chart.x_limits[1] < 6.0
