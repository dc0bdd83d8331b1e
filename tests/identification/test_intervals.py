"""Profile, bootstrap and NUTS against the Gaussian interval, and their differences."""

import importlib.util
from types import SimpleNamespace

import numpy as np
import pytest

from heli_jax import Free, Problem, fit, models
from heli_jax.identification.uncertainty.bootstrap import Bootstrap
from heli_jax.identification.uncertainty.comparison import _findings, apart, intervals
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


@pytest.mark.parametrize(
    ("others", "code"),
    [
        ({"profile": (1.0, 3.0), "bootstrap": (1.1, 3.0)}, None),
        ({"profile": (1.0, np.nan), "bootstrap": (1.0, 3.0)}, "intervals.unbounded"),
        ({"profile": (1.0, 4.0), "bootstrap": (1.0, 4.0)}, "intervals.differ"),
        ({"profile": (1.0, 4.0), "bootstrap": (1.0, 3.0)}, "intervals.differ"),
        ({"profile": (1.0, 3.0), "bootstrap": (1.0, 4.0)}, "intervals.differ"),
        ({"profile": (1.0, 3.0), "nuts": (1.0, 4.0)}, "intervals.differ"),
    ],
)
def test_the_code_tells_which_interval_to_use(others, code):
    layout = SimpleNamespace(noise_model="white")
    made = SimpleNamespace(coloured=False, nuisance={}, reached=SimpleNamespace(layout=layout))
    booted = Bootstrap({"Lp": np.zeros(900)}, 0)
    found = _findings(made, {"Lp": {"gaussian": (1.0, 3.0), **others}}, booted, None)
    assert [f.code for f in found] == ([] if code is None else [code])
    assert all(f.subjects == ("Lp",) for f in found)
    made.coloured = True
    found = _findings(made, {"Lp": {"gaussian": (1.0, 3.0), **others}}, booted, None)
    assert [f.code for f in found] == ["intervals.residuals-coloured"]
