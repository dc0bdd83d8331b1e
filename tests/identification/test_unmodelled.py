"""A mode that is left out and a saturation take the plain yes away; a right model keeps it."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.identification.validation.score_test import NARROW, lines_of, strongest

DT, N = 0.02, 1500
TRUTH = {"Lb": 166.1, "tau_f": 0.04631, "Blat": 0.1398}


def stick(seed):
    return np.repeat(np.random.default_rng(seed).uniform(-0.1, 0.1, N // 25), 25)


def roll_rate(u, saturated=np.inf):
    """Of flapping without a flybar, by Euler steps of a fiftieth of a sample."""
    p = b = 0.0
    out = np.empty(u.size)
    for k, now in enumerate(u):
        out[k] = p
        for _ in range(50):
            moment = TRUTH["Lb"] * np.clip(b, -saturated, saturated)
            b_dot = -p + (TRUTH["Blat"] * now - b) / TRUTH["tau_f"]
            p, b = p + DT / 50 * moment, b + DT / 50 * b_dot
    return out


def problem(u, p, method):
    roll = linear_model("roll-flybarless")
    flight = Flight(dt=DT, inputs={"lat": u}, outputs={"p": p})
    free = {"Lb": Free(100.0), "tau_f": Free(0.08), "Blat": Free(0.1)}
    return Problem(roll.model, roll.vehicle().params, [flight], free, method=method)


METHODS = ("output-error", "frequency-error")


@pytest.mark.parametrize("method", METHODS)
def test_a_right_model_keeps_its_yes(method):
    u = stick(1)
    p = roll_rate(u) + 0.01 * np.random.default_rng(2).standard_normal(N)
    assert fit(problem(u, p, method)).adequacy.summary == "yes"


@pytest.mark.parametrize("method", METHODS)
def test_a_load_that_swings_is_missed(method):
    u = stick(1)
    # A lightly damped mode at 8 rad/s, of a hundredth of the response's power.
    w, damping = 8.0, 0.03
    mode = scipy.signal.cont2discrete(([w**2, 0.0], [1.0, 2 * damping * w, w**2]), DT)
    swing = scipy.signal.lfilter(mode[0].ravel(), mode[1], u)
    clean = roll_rate(u)
    p = clean + 0.1 * np.std(clean) / np.std(swing) * swing
    p = p + 0.03 * np.random.default_rng(2).standard_normal(N)
    found = fit(problem(u, p, method))
    assert found.adequacy.summary.startswith("in size only (the residual of p still follows lat")
    assert any("a mode or a lag near" in r for r in found.adequacy.remarks)


@pytest.mark.parametrize("method", METHODS)
def test_a_saturation_is_an_answer_that_depends_on_amplitude(method):
    u = stick(1)
    clean = roll_rate(u)
    p = roll_rate(u, saturated=0.004) + 0.01 * np.random.default_rng(2).standard_normal(N)
    assert np.std(p - clean) < 0.6 * np.std(clean)
    found = fit(problem(u, p, method))
    assert "the response of p depends on amplitude" in found.adequacy.summary
    assert found.adequacy.summary.startswith("in size only")


def test_chance_is_told_by_the_same_residual_in_other_phases():
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(40):
        e = scipy.signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(800))
        J, u = rng.standard_normal((800, 2)), rng.standard_normal((800, 1))
        lines = lines_of(e, J, u)
        assert lines is not None
        hits += strongest([lines], [0], NARROW).p_value < 0.05
    assert hits <= 6
