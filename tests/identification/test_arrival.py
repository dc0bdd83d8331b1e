"""Whether a search has arrived is asked of its own slopes, not of its last step alone."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from heli_jax import Free, Problem, fit
from heli_jax.identification.diagnostics.search import search_stopped
from heli_jax.identification.estimation import multistart
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.estimation.noise_covariance import gain_left
from tests.identification.test_equation_error import ROLL, Params, record

RNG = np.random.default_rng(0)
J = 30.0 * RNG.standard_normal((400, 3))
NOISE = RNG.standard_normal(400)


def test_what_a_modest_step_would_take_away():
    # At a least-squares optimum the residual is orthogonal to all columns.
    left = NOISE - J @ np.linalg.lstsq(J, NOISE, rcond=None)[0]
    assert gain_left(left, J, 3) is None
    assert gain_left(NOISE, J, 3) is None
    # A step of 0.05 away from it: all of what was added comes off again.
    away = left + J @ np.array([0.0, 0.05, 0.0])
    share = gain_left(away, J, 3)
    assert share == pytest.approx(1.0 - left @ left / (away @ away), rel=1e-6)
    # A time constant on its way to zero has a slope to the end, but a step to there is no modest
    # one: its column is as small as itself.
    late = np.column_stack([J[:, :2], 1e-6 * J[:, 1] + 1e-4 * J[:, 2]])
    assert gain_left(left + 0.1 * J[:, 2], late, 3) is None
    # Of an initial state, whose coordinate is no logarithm, no size of a step is asked.
    assert gain_left(left + 0.1 * J[:, 2], late, 2) is not None
    assert gain_left(np.full(400, np.nan), J, 3) is None
    # Few samples are explained by many unknowns without any meaning.
    assert gain_left(NOISE[:12], J[:12], 3) is None


def _stays(layout, data, noise, z0, max_steps=200, **_):
    at = residual_and_jacobian(layout, data, noise, z0)
    cost = np.mean(np.square(np.asarray(at.r)))
    return multistart.Optimum(z0, cost, np.asarray(9), np.asarray(True))


@pytest.mark.slow
def test_a_search_that_has_not_moved_did_not_converge(monkeypatch):
    flight = record(n=200, noise=2e-3)
    problem = Problem(ROLL, Params(-4.0, 25.0, 0.0), [flight], {"Lp": Free(-2.0), "Lda": Free(9.0)})
    found = fit(problem)
    assert found.status == "converged"

    # The optimiser's word is that it arrived, at its start.
    monkeypatch.setattr(multistart, "optimise", _stays)
    stuck = fit(problem)
    assert stuck.status == "not-converged"
    [said] = [f for f in stuck.findings if f.code == "search.stuck"]
    assert 0.0 < said.value <= 1.0
    assert SimpleNamespace(**{n: e.value for n, e in stuck.estimates.items()}) == SimpleNamespace(
        Lp=pytest.approx(-2.0), Lda=pytest.approx(9.0)
    )


def test_a_search_along_what_the_data_leave_open_is_told_what_to_fix():
    """Next to a start of nearly no effect nothing is told; at the optimum all is."""
    flight = record(n=200, noise=0.3)
    flight = dataclasses.replace(flight, inputs={"da": 1e-7 * flight.inputs["da"]})
    problem = Problem(ROLL, Params(-4.0, 25.0, 0.0), [flight], {"Lp": Free(-2.0), "Lda": Free(9.0)})
    found = fit(problem)
    open_before, told = found.verdict_before, found.verdict
    [note] = open_directions(open_before, open_before)
    assert note.subjects == ("Lp", "Lda")
    assert open_directions(open_before, told) == []
    assert open_directions(told, open_before) == []


def open_directions(before, verdict):
    """What is said of a search that stopped."""
    layout = SimpleNamespace(windows=((1, 200),), continuity=None)
    stopped = SimpleNamespace(
        optimum=SimpleNamespace(trace=((9, 1.0),)),
        arrived=False,
        rounding=False,
        at=SimpleNamespace(layout=layout),
        e=SimpleNamespace(J=J),
        before=before,
        verdict=verdict,
    )
    stop, *rest = search_stopped(stopped)
    assert (stop.code, stop.value) == ("search.stopped", 9.0)
    return rest
