"""A mode far from where it is sought is found all the same."""

import dataclasses

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, linear_model
from tests.identification.test_through_inputs import heave, heave_problem

DT, SPRING, DAMPING, GAIN = 0.1, 25.0, 0.5, 20.0
OSCILLATOR = """
name: oscillator
states: {x: m, v: m/s}
inputs: {f: "1"}
outputs: {x: m}
parameters:
  k: {value: 1.0, unit: 1/s^2, positive: true}
  d: {value: 0.1, unit: 1/s, positive: true}
  b: {value: 1.0, unit: m/s^2}
A: {x: {v: 1}, v: {x: -k, v: -d}}
B: {v: {f: b}}
"""


@pytest.fixture
def problem(tmp_path) -> Problem:
    # Random force on a mass and a spring, five times as fast as the model's values have it.
    rng = np.random.default_rng(0)
    f = rng.standard_normal(1000)
    A = np.array([[0.0, 1.0], [-SPRING, -DAMPING]])
    system = (A, np.array([[0.0], [GAIN]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    x = scipy.signal.dlsim(scipy.signal.cont2discrete(system, DT), f)[1]
    path = tmp_path / "oscillator.yaml"
    path.write_text(OSCILLATOR)
    oscillator = linear_model(str(path))
    measured = x[:, 0] + 0.05 * rng.standard_normal(f.size)
    flight = Flight(dt=DT, inputs={"f": f}, outputs={"x": measured})
    free = {"k": Free(1.0, sign="keep"), "d": Free(0.1, sign="keep"), "b": Free(1.0)}
    return Problem(oscillator.model, oscillator.vehicle().params, [flight], free)


@pytest.mark.slow
def test_where_little_is_explained_the_search_begins_again_elsewhere(problem: Problem) -> None:
    found = fit(problem)
    assert found.status == "converged"
    truth = {"k": SPRING, "d": DAMPING, "b": GAIN}
    for name, value in truth.items():
        estimate = found.estimates[name]
        assert estimate.sd is not None
        assert abs(estimate.value - value) < 4.0 * estimate.sd < 0.2 * value
    assert len(found.starts) == 7
    # Who states how many gets as many.
    alone = fit(problem, starts=1)
    assert len(alone.starts) == 1
    assert alone.status != "converged"


def test_a_search_that_left_stability_begins_again():
    # From a stable start frequency error ended with Zw = +0.25, whose mirror image has the same
    # gain: 8.7 in log-likelihood below the stable optimum.
    plain = heave_problem(heave(0, 1.0, False, 0.04))
    found = fit(plain)
    near = fit(dataclasses.replace(plain, free={"Zw": Free(-0.6), "Zcol": Free(-14.0)}))
    assert found.estimates["Zw"].value == pytest.approx(near.estimates["Zw"].value, rel=1e-3)
    assert found.log_likelihood == pytest.approx(near.log_likelihood, abs=0.01)
    assert not found.untrusted
