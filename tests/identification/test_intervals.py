"""Profile, bootstrap and NUTS against the Gaussian interval, and where they part from it."""

import dataclasses
import importlib.util

import pytest

from heli_jax import Free, Problem, fit, models
from heli_jax.identification.uncertainty.bootstrap import bootstrap
from heli_jax.identification.uncertainty.comparison import apart, intervals
from tests.identification.bench import BENCH, record, vehicle

FREE = {"Ixx": Free(0.03), "If": Free(2e-4), "kappa": Free(3.0)}


def made(*, n=400, noise=2e-3, free=FREE, **how):
    flight = record(BENCH, seed=3, n=n, noise=noise)
    return fit(Problem(models.roll_on_stand, vehicle(BENCH), [flight], free, **how))


@pytest.fixture(scope="module")
def white():
    return made()


@pytest.mark.slow
def test_on_white_noise_all_agree(white):
    bayes = importlib.util.find_spec("blackjax") is not None
    found = intervals(white, profiles=list(FREE), runs=200, draws=300 if bayes else 0)
    assert found.sentences == ()
    for by in found.by_parameter.values():
        assert set(by) == {"gaussian", "profile", "bootstrap", *(["nuts"] if bayes else [])}
        for interval in by.values():
            assert apart(by["gaussian"], interval) < 0.15
    if bayes:
        assert found.posterior is not None
        assert found.posterior.trusted


def test_nothing_is_computed_where_the_data_leave_a_parameter_open(white):
    open_ = {n: e._replace(sd=None) if n == "If" else e for n, e in white.estimates.items()}
    poor = dataclasses.replace(white, estimates=open_, status="not-identifiable")
    found = intervals(poor, profiles=["Ixx"], runs=5)
    assert found.profiles == {}
    assert found.bootstrap is None
    with pytest.raises(ValueError, match="If"):
        bootstrap(poor, 5)
