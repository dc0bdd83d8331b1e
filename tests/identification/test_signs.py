"""Parameters of unknown sign converge to the truth from either sign.

The records come from SciPy's exact discretisation, not from our own simulation.
"""

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Nuisance, Prior, Problem, fit
from heli_jax.identification.estimation.starts import _draw_values
from tests.identification.bench import steps


class Derivatives(NamedTuple):
    Lp: Annotated[Any, "1/s"]
    Lr: Annotated[Any, "1/s"]
    Np: Annotated[Any, "1/s"]
    Nr: Annotated[Any, "1/s"]
    Ld: Annotated[Any, "1/s^2"]
    Nd: Annotated[Any, "1/s^2"]


class Rates(NamedTuple):
    p: Annotated[Any, "rad/s"]
    r: Annotated[Any, "rad/s"]


class Stick(NamedTuple):
    d: Annotated[Any, "1"]


def field(q: Any, s: Rates, u: Stick) -> Rates:
    return Rates(
        p=q.Lp * s.p + q.Lr * s.r + q.Ld * u.d,
        r=q.Np * s.p + q.Nr * s.r + q.Nd * u.d,
    )


def at_rest(q: Any) -> Rates:
    return Rates(0.0 * q.Lp, 0.0 * q.Lp)


MODEL = Model(
    "lateral", field, lambda q, s, u: s, Derivatives, Rates, Stick, Rates, linear=True,
    start=at_rest,
)  # fmt: skip
TRUTH = {"Lp": -4.0, "Lr": 0.8, "Np": -0.6, "Nr": -1.5, "Ld": 12.0, "Nd": -3.0}
N, DT, NOISE = 1000, 0.02, 0.02


def flight(truth=TRUTH, seed=0):
    t = truth
    system = (
        np.array([[t["Lp"], t["Lr"]], [t["Np"], t["Nr"]]]),
        np.array([[t["Ld"]], [t["Nd"]]]),
        np.eye(2),
        np.zeros((2, 1)),
    )
    A, B, *_ = scipy.signal.cont2discrete(system, DT)
    rng = np.random.default_rng(seed)
    u = steps(rng, N, DT, 0.3)
    x, y = np.zeros(2), np.empty((N, 2))
    for k in range(N):
        y[k] = x
        x = A @ x + B[:, 0] * u[k]
    y += NOISE * rng.standard_normal(y.shape)
    return Flight(dt=DT, inputs={"d": u}, outputs={"p": y[:, 0], "r": y[:, 1]})


FLIGHT = flight()


def problem(free, base=TRUTH, record=FLIGHT, **how):
    params = Derivatives(**{n: jnp.asarray(v) for n, v in base.items()})
    return Problem(MODEL, params, [record], free, Nuisance(), **how)


@pytest.mark.parametrize(
    "starts",
    [
        {"Lp": -2.0, "Lr": -1.0, "Np": 1.0, "Nr": -1.0, "Ld": -5.0, "Nd": 5.0},
        {"Lp": -1.0, "Lr": 0.0, "Np": 0.0, "Nr": -1.0, "Ld": 1.0, "Nd": 0.0},
    ],
    ids=["wrong", "zero"],
)
def test_a_start_of_the_wrong_sign_ends_at_the_truth(starts):
    found = fit(problem({n: Free(v) for n, v in starts.items()}))
    assert found.status == "converged"
    for name, true in TRUTH.items():
        one = found.estimates[name]
        assert abs(one.value - true) < 4 * one.sd
        assert one.sd < 0.1 * abs(true)
        # The interval is symmetric, not that of a logarithm.
        assert one.upper95 - one.value == pytest.approx(one.value - one.lower95, rel=1e-6)


def test_a_signal_that_is_turned_is_a_doubt():
    turned = Flight(dt=DT, inputs={"d": -FLIGHT.inputs["d"]}, outputs=FLIGHT.outputs)
    free = {"Ld": Free(10.0), "Nd": Free(-2.0)}
    right, wrong = fit(problem(free)), fit(problem(free, record=turned))
    doubts = [
        [f for f in one.findings if f.code == "signs.turned-from-start"] for one in (right, wrong)
    ]
    assert doubts[0] == []
    assert [(f.severity, f.subjects) for f in doubts[1]] == [("doubt", ("Ld", "Nd"))]
    assert wrong.estimates["Ld"].value == pytest.approx(-right.estimates["Ld"].value, rel=1e-4)


@pytest.mark.slow
def test_a_damping_of_the_wrong_sign_is_found_through_windows():
    # Over 20 s the simulation grows by e^60.
    found = fit(problem({"Lp": Free(3.0), "Ld": Free(-1.0)}))
    assert found.status == "converged"
    for name in ("Lp", "Ld"):
        one = found.estimates[name]
        assert abs(one.value - TRUTH[name]) < 4 * one.sd
    assert "search.by-windows" in {f.code for f in found.findings}


def test_one_bound_beyond_zero_is_kept():
    found = fit(problem({"Ld": Free(1.0, upper=10.0), "Nd": Free(1.0, lower=-20.0)}))
    assert found.estimates["Ld"].at_bound
    assert found.estimates["Ld"].value == pytest.approx(10.0, rel=1e-3)
    # Limits of Ld apply to the others.
    assert found.estimates["Nd"].value == pytest.approx(-3.0, abs=0.5)


def test_a_parameter_that_is_zero_is_determined():
    truth = TRUTH | {"Lr": 0.0}
    found = fit(
        problem({"Lp": Free(-2.0), "Lr": Free(-1.0), "Ld": Free(5.0)}, truth, flight(truth))
    )
    one = found.estimates["Lr"]
    assert found.status == "converged"
    assert abs(one.value) < 4 * one.sd
    assert one.sd < 0.2


def test_many_starts_are_of_both_signs():
    rng = np.random.default_rng(0)
    values = _draw_values(Free(2.0, sign="any"), 200, rng)
    assert 60 < np.sum(values > 0) < 140
    assert np.all(_draw_values(Free(2.0, sign="keep"), 50, rng) > 0)
    near = _draw_values(Free(2.0, prior=Prior(2.0, 0.1), sign="any"), 50, rng)
    assert np.all(np.abs(near - 2.0) < 1.0)
