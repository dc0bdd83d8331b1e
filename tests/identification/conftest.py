"""Fits shared by several files."""

import pytest

from heli_jax import Free, Problem, fit, models
from tests.identification.bench import BENCH, record, vehicle


@pytest.fixture(scope="session")
def by_lines():
    """Return 60 s of the bench in white noise, for fits by frequency error."""
    flight = record(BENCH, seed=3, n=3000)
    free = {"Ixx": Free(0.035), "If": Free(1.2e-4), "kappa": Free(7.0)}
    return Problem(models.roll_on_stand, vehicle(BENCH), [flight], free, method="frequency-error")


@pytest.fixture(scope="session")
def fitted_by_lines(by_lines):
    return fit(by_lines)
