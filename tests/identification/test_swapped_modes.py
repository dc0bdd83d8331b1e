"""A servo's lag before a rate's damping: equal responses with the modes exchanged."""

from typing import Annotated, NamedTuple

import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Model, Nuisance, Problem, check, fit
from heli_jax.naming import Scalar
from tests.identification.test_enough import steps

DT, N = 0.02, 1000
U = steps(np.random.default_rng(11), N)


class Params(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "damping"]
    L: Annotated[Scalar, "rad/s^2", "effect"]
    ts: Annotated[Scalar, "s", "lag of the servo"]


class State(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]
    s: Annotated[Scalar, "1", "what the servo has made of the stick"]


class Inputs(NamedTuple):
    u: Annotated[Scalar, "1", "stick"]


MODEL = Model(
    "servo and damping",
    lambda q, x, i: State(q.Lp * x.p + q.L * x.s, (i.u - x.s) / q.ts),
    lambda q, x, i: State(x.p, x.s),
    Params, State, Inputs, State, linear=True,
)  # fmt: skip
TRUTH = Params(-6.0, 40.0, 0.05)
NUISANCE = Nuisance(bias=False, initial_state=False)


def flight(outputs=("p",), noise=0.05):
    """Return the record by SciPy."""
    M = np.array([[-6.0, 40.0, 0.0], [0.0, -20.0, 20.0], [0.0, 0.0, 0.0]])
    E = np.asarray(scipy.linalg.expm(DT * M))
    X = np.zeros((N, 2))
    for k in range(N - 1):
        X[k + 1] = E[:2, :2] @ X[k] + E[:2, 2] * U[k]
    rng = np.random.default_rng(2)
    measured = {"p": X[:, 0], "s": X[:, 1]}
    sd = noise * np.std(X, axis=0)
    return Flight(
        dt=DT,
        inputs={"u": U},
        outputs={n: measured[n] + sd["ps".index(n)] * rng.standard_normal(N) for n in outputs},
    )


def problem(record, factor=1.0, ts=None, **options):
    free = {
        "Lp": Free(-6.0 * factor),
        "L": Free(40.0 * factor),
        "ts": ts or Free(0.05 * factor, sign="keep"),
    }
    return Problem(MODEL, TRUTH, [record], free, NUISANCE, **options)


def exchanged(values):
    """Test by algebra: L / (ts (s - Lp) (s + 1/ts)) is unchanged."""
    ts = -1.0 / values["Lp"]
    return {"Lp": -1.0 / values["ts"], "L": values["L"] * ts / values["ts"], "ts": ts}


@pytest.mark.parametrize("factor", [3.0, 1.0])
def test_both_solutions_are_told_from_either(factor):
    found = fit(problem(flight(), factor))
    here = {n: found.estimates[n].value for n in Params._fields}
    [other] = found.verdict.second
    assert other.values == pytest.approx(exchanged(here), rel=0.01)
    assert (here["ts"] > 0.1) == (factor == 3.0)
    assert other.changed == ("Lp", "L", "ts")
    assert found.status == "not-identifiable"
    assert found.not_identifiable == ("Lp", "L", "ts")
    assert found.estimates["Lp"].sd is None


def test_what_tells_them_apart_leaves_one():
    """Test a bound, and a measured servo."""
    bounded = fit(problem(flight(), ts=Free(0.05, lower=0.01, upper=0.1)))
    assert (bounded.status, bounded.verdict.second) == ("converged", ())
    measured = check(problem(flight(("p", "s"))))
    assert (measured.verdict.identifiable, measured.verdict.second) == (True, ())


def test_a_check_tells_of_both():
    [other] = check(problem(flight())).verdict.second
    assert other.values == pytest.approx(exchanged(TRUTH._asdict()), rel=1e-4)
