"""A record of the bench, and a small user's model."""

import numpy as np
import pytest

from heli_jax import Flight


@pytest.fixture(scope="session")
def record():
    """Return 400 samples at 50 Hz with a measured output, partly missing."""
    rng = np.random.default_rng(5)
    roll = 0.1 * rng.standard_normal(400)
    roll[[3, 77, 200]] = np.nan
    stick = 3e-6 * np.repeat(rng.uniform(-1.0, 1.0, 40), 10)
    return Flight(dt=0.02, inputs={"x_roll": stick}, outputs={"roll": roll}, name="bench")
