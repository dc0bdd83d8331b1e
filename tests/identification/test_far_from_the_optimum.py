"""Facts that slopes at one point do not show.

Sums that look like products, exchangeable parameters, bounds, and modes hardly visible in the
samples.
"""

from typing import Annotated, NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.problem import MAX_TIME_SHIFT
from heli_jax.identification.uncertainty.estimates import StandardErrors, estimates_of
from heli_jax.identification.validation.excitation import excitation_of
from heli_jax.naming import Scalar
from heli_jax.numerics.white_noise import noise_guess, white_part
from tests.identification.test_enough import steps

DT, N = 0.02, 1000
U = steps(np.random.default_rng(5), N)


class Params(NamedTuple):
    La: Annotated[Scalar, "1/s", "a part of the damping"]
    Lb: Annotated[Scalar, "1/s", "the other part"]
    T1: Annotated[Scalar, "s", "first lag"]
    T2: Annotated[Scalar, "s", "second lag"]
    K: Annotated[Scalar, "1/s^2", "effect"]
    M: Annotated[Scalar, "1", "factor of the effect"]


class Rate(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]


class Two(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]
    s: Annotated[Scalar, "rad/s", "what the servo has made of the stick"]


class Inputs(NamedTuple):
    u: Annotated[Scalar, "1", "stick"]


SUM = Model(
    "sum",
    lambda q, x, i: Rate((q.La + q.Lb) * x.p + q.K * q.M * i.u),
    lambda q, x, i: Rate(x.p),
    Params, Rate, Inputs, Rate, linear=True,
)  # fmt: skip
LAGS = Model(
    "lags",
    lambda q, x, i: Two((x.s - x.p) / q.T1, (q.K * i.u - x.s) / q.T2),
    lambda q, x, i: Rate(x.p),
    Params, Two, Inputs, Rate, linear=True,
)  # fmt: skip
TRUTH = Params(-1.5, -1.5, 0.3, 0.06, 10.0, 1.0)


def lagged(A, B, C):
    """Return the output for the held stick, from rest, by SciPy."""
    F, G, *_ = scipy.signal.cont2discrete((A, B, C, [[0.0]]), DT)
    x, y = np.zeros(len(A)), np.empty(N)
    for k, u in enumerate(U):
        y[k] = (C @ x).item()
        x = F @ x + G[:, 0] * u
    return y


def flight(p, noise=0.02, seed=0):
    y = p + noise * np.random.default_rng(seed).standard_normal(N)
    return Flight(dt=DT, inputs={"u": U}, outputs={"p": y})


FIRST = flight(lagged(np.array([[-3.0]]), np.array([[10.0]]), np.array([[1.0]])))
SECOND = flight(
    lagged(
        np.array([[-1 / 0.3, 1 / 0.3], [0.0, -1 / 0.06]]),
        np.array([[0.0], [10.0 / 0.06]]),
        np.array([[1.0, 0.0]]),
    )
)


def fitted(model, record, **free):
    return fit(Problem(model, TRUTH, [record], free, Nuisance(bias=False)))


def test_of_a_sum_nothing_but_the_sum_is_determined():
    found = fitted(SUM, FIRST, La=Free(-1.0), Lb=Free(-1.0), K=Free(3.0))
    assert found.status == "not-identifiable"
    [c] = found.verdict.combinations
    assert (c.name, c.kind, c.exponents) == ("La + Lb", "sum", {"La": 1.0, "Lb": 1.0})
    assert c.lower95 < -3.0 < c.upper95
    # The reference: with one of the two known, the other is as certain as the sum.
    alone = fitted(SUM, FIRST, La=Free(-1.0), K=Free(3.0)).estimates["La"]
    assert c.value == pytest.approx(alone.value + TRUTH.Lb, rel=1e-4)
    assert c.sd == pytest.approx(alone.sd, rel=0.02)
    # Along an exact valley rounding must decide nothing: without damping it led to +240 and -243.
    near = fitted(SUM, FIRST, La=Free(-1.0 + 1e-6), Lb=Free(-1.0), K=Free(3.0)).estimates
    assert near["La"].value == pytest.approx(near["Lb"].value, rel=1e-3)


def test_a_product_is_one_far_from_the_optimum_too():
    found = fitted(SUM, FIRST, La=Free(-1.0), K=Free(3.0), M=Free(2.0))
    [c] = found.verdict.combinations
    assert (c.name, c.kind) == ("K * M", "product")
    assert c.lower95 < 10.0 < c.upper95


def test_two_lags_in_series_are_told_to_be_exchangeable():
    T1, T2 = (Free(s, sign="keep") for s in (0.4, 0.03))
    found = fitted(LAGS, SECOND, T1=T1, T2=T2, K=Free(3.0))
    assert [other.changed for other in found.verdict.second] == [("T1", "T2")]
    assert found.status == "not-identifiable"
    assert found.not_identifiable == ("T1", "T2")
    assert sorted(found.estimates[n].value for n in ("T1", "T2")) == pytest.approx(
        [0.06, 0.3], rel=0.1
    )


def test_a_parameter_at_its_bound_is_not_determined_and_no_failure():
    found = fitted(SUM, FIRST, La=Free(-0.1, lower=-0.5), K=Free(3.0))
    assert found.status == "converged"
    bound = found.findings[0]
    assert (bound.code, bound.subjects) == ("fit.at-bound", ("La",))
    assert bound.value == pytest.approx(-0.5)
    # The others depend on a bound that the data do not support.
    assert "K" in found.untrusted
    assert found.exit_code == 3
    estimate = found.estimates["La"]
    assert estimate.at_bound
    assert estimate.lower95 in (None, -0.5)


def test_no_interval_of_a_time_shift_is_wider_than_its_search():
    # Likelihood and slopes are continued beyond the last possible value of a shift.
    problem = Problem(
        SUM, TRUTH, [FIRST], {"La": Free(-1.0)}, Nuisance(bias=False, time_shift=True)
    )
    found, ones = fit(problem), np.ones(8)
    e = evaluate(*found.reached)
    for wider, limits in ((1.0, {"time_shift": (0.003, 1.26)}), (1e4, {})):
        errors = StandardErrors(found.verdict, wider * ones, 2.0 * ones, False, limits)
        shift = estimates_of(problem, found.reached, e, errors)["time_shift"]
        assert (shift.lower95, shift.upper95) == (
            0.003 if limits else -MAX_TIME_SHIFT,
            MAX_TIME_SHIFT,
        )


def test_a_fast_swing_is_no_white_noise():
    rng = np.random.default_rng(1)
    white = rng.standard_normal(4000)
    assert white_part(white) == pytest.approx(1.0, rel=0.1)
    swing = scipy.signal.lfilter([1.0], [1.0, 1.8, 0.9], white)
    # Its spectrum at zero is (1 / 3.7)^2, which may all be white.
    assert white_part(swing) == pytest.approx(1.0 / 3.7, rel=0.3)
    assert noise_guess(swing) > 3.0
    # Slow motion is not noise either, and was not before.
    slow = scipy.signal.lfilter([1.0], [1.0, -1.8, 0.9], white)
    assert white_part(slow) == noise_guess(slow)


@pytest.mark.slow
def test_an_output_that_does_not_follow_the_stick_makes_no_model_adequate():
    rng = np.random.default_rng(3)
    drift = scipy.signal.lfilter([0.05], [1.0, -0.95], rng.standard_normal(N))
    record = flight(drift, noise=0.0)
    free = {"La": Free(-1.0), "K": Free(3.0)}
    problem = Problem(SUM, TRUTH, [record], free, Nuisance(bias=False), method="frequency-error")
    assert excitation_of(problem)["p"] > 0.01
    found = fit(problem, starts=1)
    assert not found.adequate
    assert found.adequacy.by_chance
    [none] = [f for f in found.findings if f.denies]
    assert (none.code, none.severity) == ("excitation.nothing-follows", "refuse")
    assert "loop.no-instrument" not in {f.code for f in found.findings}
    assert excitation_of(Problem(SUM, TRUTH, [FIRST], free))["p"] < 1e-10
