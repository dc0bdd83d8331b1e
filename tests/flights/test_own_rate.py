"""Outputs with uneven stamps on a grid of their own rate: noise and motion are unchanged."""

import numpy as np
import pytest

from heli_jax.flights.resample import Timed, at_own_rate

DT = 0.01
TIMES = DT * np.arange(2000)


def stamps(jitter: float, phase: float) -> np.ndarray:
    uneven = np.random.default_rng(4).uniform(-jitter, jitter, TIMES.size)
    return TIMES + DT * (phase + uneven)


@pytest.mark.parametrize(("jitter", "phase"), [(0.2, 0.0), (0.0, 0.4), (0.1, -0.3)])
def test_noise_stays_white_and_motion_is_in_time(jitter, phase):
    at = stamps(jitter, phase)
    noise = np.random.default_rng(5).standard_normal(at.size)
    made = at_own_rate(Timed(at, noise), TIMES)[5:-5]
    # Linear interpolation gives up to +0.5.
    for lag in (1, 2, 3):
        r, own = (float(np.mean(x[lag:] * x[:-lag]) / np.var(x)) for x in (made, noise[5:-5]))
        assert abs(r - own) < 0.06, lag
    assert np.std(made) == pytest.approx(np.std(noise), rel=0.07)
    motion = at_own_rate(Timed(at, np.sin(2 * np.pi * 2.0 * at)), TIMES)[5:-5]
    error = motion - np.sin(2 * np.pi * 2.0 * TIMES[5:-5])
    assert np.abs(error).max() < 0.5 * (2 * np.pi * 2.0 * 0.75 * DT) ** 2


def test_samples_on_the_grid_stay_and_gaps_are_bridged_by_lines():
    y = np.random.default_rng(6).standard_normal(TIMES.size)
    np.testing.assert_array_equal(at_own_rate(Timed(TIMES, y), TIMES), y)
    kept = np.ones(TIMES.size, bool)
    kept[100:103] = False
    made = at_own_rate(Timed(TIMES[kept], y[kept]), TIMES)
    np.testing.assert_allclose(made[100:103], np.interp(TIMES[100:103], TIMES[kept], y[kept]))
    y[50] = np.nan
    made = at_own_rate(Timed(TIMES, y), TIMES)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(made)), [50])
