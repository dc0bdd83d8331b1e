"""Directions determined only by weak priors of initial states and biases are not identifiable.

The reference is a recurrence in NumPy, differentiated by finite differences.
"""

from typing import NamedTuple

import numpy as np
import pytest

from heli_jax import Flight, Free, Model, Nuisance, Problem, check, fit, models
from heli_jax.identification.identifiability.analysis import analyse, projected
from heli_jax.identification.identifiability.verdict import Unknown
from tests.identification.bench import BENCH, record, vehicle

DT, N, SD = 0.05, 200, 0.02
TRUTH = {"Lp": -2.0, "Ld": 5.0, "L0": 0.0}


class Params(NamedTuple):
    Lp: float
    Ld: float
    L0: float = 0.0


class State(NamedTuple):
    p: float
    unseen: float


class Inputs(NamedTuple):
    d: float


class Outputs(NamedTuple):
    p: float


def field(params, s, u):
    return State(p=params.Lp * s.p + params.Ld * u.d + params.L0, unseen=s.p - s.unseen)


roll_rate = Model("own", field, lambda p, s, u: Outputs(p=s.p), Params, State, Inputs, Outputs)


def by_recurrence(values, d):
    """Return p (N,) from rest in steps of DT, exact for a held input; then a bias."""
    Lp, Ld, L0, begin, bias = values
    decay, p = np.exp(Lp * DT), [begin]
    for one in d[:-1]:
        p.append(decay * p[-1] + (Ld * one + L0) * (decay - 1.0) / Lp)
    return np.array(p) + bias


def made(seed):
    rng = np.random.default_rng(seed)
    d = np.repeat(rng.uniform(-1.0, 1.0, N // 8), 8)
    p = by_recurrence([*TRUTH.values(), 0.0, 0.0], d) + SD * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"d": d}, outputs={"p": p}, sd={"p": SD})


def problem(L0, nuisance=Nuisance(), flights=1, **how):
    free = {"Lp": Free(-1.5, -10.0, -0.1), "Ld": Free(3.0, 0.1, 50.0), "L0": L0}
    many = [made(seed) for seed in range(flights)]
    return Problem(roll_rate, Params(-1.5, 3.0), many, free, nuisance, **how)


BOUNDED = Free(0.1, -5.0, 5.0)


def oracle(estimates, columns):
    """Return the sd of Lp, Ld, L0 with the unknowns at `columns` of the recurrence."""
    d = made(0).inputs["d"]
    at = np.array([*(estimates[n].value for n in TRUTH), 0.0, 0.0])
    J = np.stack(
        [
            (by_recurrence(at + h, d) - by_recurrence(at - h, d)) / 2e-5
            for h in 1e-5 * np.eye(5)[columns]
        ],
        axis=1,
    )
    return J, np.sqrt(np.diag(np.linalg.pinv(J.T @ J, rcond=1e-12))) * SD


@pytest.mark.slow
def test_a_constant_term_is_exchangeable_with_bias_and_initial_state():
    found = fit(problem(BOUNDED))
    J, sd = oracle(found.estimates, [0, 1, 2, 3, 4])
    assert np.linalg.matrix_rank(J, tol=1e-6 * np.linalg.norm(J)) == 4
    assert found.status == "not-identifiable"
    v = found.verdict
    assert (v.rank, v.rank_without_priors) == (2, 2)
    assert v.undetermined == ("L0",)
    assert v.prior_share["L0"] == 1.0
    assert found.estimates["L0"].sd is None
    assert found.nuisance["flight 1/initial unseen"].prior_share == pytest.approx(1.0)
    assert v.exchangeable == ("flight 1/initial p", "flight 1/bias p")
    for name, wanted in zip(("Lp", "Ld"), sd, strict=False):
        assert found.estimates[name].sd == pytest.approx(wanted, rel=0.15)  # of the residual's sd
        assert found.estimates[name].prior_share < 1e-6


@pytest.mark.parametrize("off", ["bias", "initial_state"])
def test_without_one_of_the_two_it_is_determined(off):
    found = fit(problem(BOUNDED, Nuisance(**{off: False})))
    assert found.status == "converged"
    assert found.verdict.rank_without_priors == 3
    _, sd = oracle(found.estimates, [0, 1, 2, 3 if off == "bias" else 4])
    assert found.estimates["L0"].sd == pytest.approx(sd[2], rel=0.15)
    assert found.estimates["L0"].prior_share < 1e-4


def test_two_flights_have_a_bias_and_a_start_each():
    verdict = check(problem(BOUNDED, flights=2)).verdict
    assert not verdict.identifiable
    assert len(verdict.exchangeable) == 4


@pytest.mark.slow
def test_what_no_output_shows_does_no_harm():
    """Test the paper's free roll: bias and initial angle are one unknown, on the stand two."""
    for model, stand in ((models.roll, False), (models.roll_on_stand, True)):
        flight = record(BENCH, seed=3, n=1000 if stand else 4000, stand=stand)
        free = {"Ixx": Free(0.03), "If": Free(2e-4)}
        verdict = check(Problem(model, vehicle(BENCH), [flight], free)).verdict
        assert verdict.identifiable
        assert verdict.rank_without_priors == 2
        assert max(verdict.prior_share.values()) < 0.05


def test_dependent_nuisances_are_projected_out():
    rng = np.random.default_rng(0)
    N, S = rng.standard_normal((60, 3)), rng.standard_normal((60, 2))
    # Columns of very different sizes: one twice, one combination of others, one without effect.
    sizes = np.diag([1e6, 1.0, 1e-3])
    nuisances = np.hstack([N @ sizes, N[:, :1], N[:, 1:2] - N[:, 2:], np.zeros((60, 1))])
    Q, _ = np.linalg.qr(N)
    wanted = np.linalg.svd(S - Q @ (Q.T @ S), compute_uv=False)
    found = np.linalg.svd(projected(S, nuisances), compute_uv=False)[:2]
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
    # Effects of the nuisances are removed completely.
    within = N @ rng.standard_normal((3, 2))
    assert np.linalg.norm(projected(within, nuisances)) < 1e-8 * np.linalg.norm(within)


def test_the_prior_share_is_the_variance_that_all_priors_explain():
    """Test redrawn prior means and data, for unknowns that one prior alone separates."""
    rng = np.random.default_rng(4)
    B = rng.standard_normal((40, 3)) @ np.array([[1, 0, -1], [0, 1, -1], [0.1, 0, 0.1]])
    B = np.column_stack([B, rng.standard_normal(40)])
    own = np.array([0.0, 0.0, 2.0, 1.0])
    unknowns = tuple(Unknown(n, 1.0, True, 1.0, w) for n, w in zip("abcd", own, strict=True))
    P = np.linalg.inv(B.T @ B + np.diag(own**2))
    by_priors = (P @ np.diag(own)) @ rng.standard_normal((4, 200_000))
    by_data = (P @ B.T) @ rng.standard_normal((40, 200_000))
    np.testing.assert_allclose(np.cov(by_priors + by_data), P, atol=0.02 * P.max())
    share = analyse(B, unknowns).prior_share
    wanted = by_priors.var(axis=1) / (by_priors + by_data).var(axis=1)
    np.testing.assert_allclose([share[n] for n in "abcd"], wanted, atol=0.01)
    assert min(share[n] for n in "ab") > 0.3
    assert share["d"] < 0.1
