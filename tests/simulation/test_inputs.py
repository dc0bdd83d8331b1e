"""Stick inputs: amplitudes, holds and frequencies."""

import numpy as np
import pytest

from heli_jax.simulation.inputs import chirp, multistep, random_steps


def lengths(u):
    """Return the number of samples of each level."""
    ends = np.flatnonzero(np.diff(u)) + 1
    return np.diff([0, *ends, u.size])


@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_random_steps(dt):
    u = random_steps(5000, dt, np.random.default_rng(1), (0.2, 1.5))
    assert u.shape == (5000,)
    assert np.abs(u).max() <= 1.0
    held = lengths(u)[:-1] * dt
    assert held.min() >= 0.2 - 0.5 * dt - 1e-12
    assert held.max() <= 1.5 + 0.5 * dt + 1e-12
    again = random_steps(5000, dt, np.random.default_rng(1), (0.2, 1.5))
    np.testing.assert_array_equal(u, again)


def test_3211():
    u = multistep(1000, 0.02, np.random.default_rng(0), 0.1, 1.0)
    assert set(np.unique(u)) == {-1.0, 0.0, 1.0}
    assert list(lengths(u)[:6]) == [50, 15, 10, 5, 5, 50]
    first = u[50:85]
    assert first[0] * first.sum() == pytest.approx(5.0)  # 3 - 2 + 1 - 1 units of 5 samples


def test_sweep_runs_from_low_to_high():
    n, dt, low, high = 20_000, 0.001, 0.5, 20.0
    u = chirp(n, dt, low, high)
    assert u[0] == 0.0
    assert np.abs(u).max() == pytest.approx(1.0, abs=1e-3)
    up = np.flatnonzero((u[:-1] < 0) & (u[1:] >= 0)) * dt
    assert 1.0 / (up[-1] - up[-2]) == pytest.approx(high, rel=0.03)
    # Integral of an exponential frequency: (high - low) T / ln(high / low) turns.
    assert len(up) == pytest.approx((high - low) * n * dt / np.log(high / low), abs=2)
