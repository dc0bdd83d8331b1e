"""Range of the frequency axis of Bode figures."""

import numpy as np
import pytest

from heli_jax.analysis.response_curves import Point
from heli_jax.report.figures import draw_response, match
from heli_jax.report.fitted_responses import FittedPair

OMEGA = 2.0 * np.pi * np.geomspace(0.1, 20.0, 120)


def _pair() -> FittedPair:
    """Return a response excited up to 4 Hz; above it one bin in six has a small error by chance."""
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
    chart = match(pair, "rad/s", "")
    # Both in Hz, as the bands.
    assert chart.x_limits[1] < 6.0
    assert chart.x_limits[0] == pytest.approx(0.1)
    assert chart.x_label == "frequency [Hz]"
    measured = type("Measured", (), {**pair._asdict(), "picture": np.full(OMEGA.size, np.nan)})
    chart = draw_response(("lat", "p"), OMEGA, measured, "rad/s", "", 20.0)
    assert chart.x_limits[1] < 6.0
