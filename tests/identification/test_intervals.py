"""Profile, bootstrap and NUTS against the Gaussian interval, and where they part from it."""

import importlib.util

import pytest

from heli_jax import Free, Problem, fit, models
from heli_jax.identification.uncertainty.comparison import apart, intervals
from tests.identification.bench import BENCH, record, vehicle

FREE = {"Ixx": Free(0.03), "If": Free(2e-4), "kappa": Free(3.0)}


@pytest.mark.slow
def test_on_white_noise_all_agree():
    flight = record(BENCH, seed=3, n=400)
    white = fit(Problem(models.roll_on_stand, vehicle(BENCH), [flight], FREE))
    bayes = importlib.util.find_spec("blackjax") is not None
    found = intervals(white, profiles=list(FREE), runs=200, draws=300 if bayes else 0)
    assert found.sentences == ()
    for by in found.by_parameter.values():
        assert set(by) == {"gaussian", "profile", "bootstrap", *(["nuts"] if bayes else [])}
        for interval in by.values():
            assert apart(by["gaussian"], interval) < 0.15
    if bayes:
        assert found.posterior.trusted
