"""Noise size of an integrated sensor, against the restricted likelihood with a full covariance."""

import numpy as np
import pytest
import scipy.optimize

from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.fit import fit
from heli_jax.identification.problem import Free, Nuisance, Problem
from tests.identification.test_noisy_scales import MODEL, Params

DT, N, WALK, NOISE = 0.1, 200, 0.02, 0.1


def record(seed):
    rng, t = np.random.default_rng(seed), DT * np.arange(N)
    shown = np.sin(0.7 * t) + 0.1
    area = np.concatenate([[0.0], np.cumsum(0.5 * DT * (shown[1:] + shown[:-1]))])
    walk = WALK * DT**0.5 * np.concatenate([[0.0], np.cumsum(rng.standard_normal(N - 1))])
    x = area - 0.1 * t + walk + NOISE * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"v": shown}, outputs={"x": x}, hold={"v": "linear"})
    return flight, x - area


def by_matrices(left, *, restricted):
    """Return the walk's intensity at the maximum likelihood of a walk, a line and white noise."""
    n = np.arange(N)
    walk = DT * np.minimum(n[:, None], n[None, :])
    X = np.stack([np.ones(N), n * DT], axis=1)

    def cost(logs):
        q, r = np.exp(2.0 * logs)
        V = q * walk + r * np.eye(N)
        A = np.linalg.solve(V, X)
        M = X.T @ A
        e = left - X @ np.linalg.solve(M, A.T @ left)
        total = np.linalg.slogdet(V)[1] + e @ np.linalg.solve(V, e)
        return total + (np.linalg.slogdet(M)[1] if restricted else 0.0)

    best = scipy.optimize.minimize(
        cost, np.log([WALK, NOISE]), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6}
    )
    return float(np.exp(best.x[0]))


@pytest.mark.slow
def test_what_a_bias_takes_up_of_the_noise_is_given_back():
    flight, left = record(3)
    free = {"bias": Free(0.0, sign="any"), "walk": Free(WALK, sign="keep")}
    nuisance = Nuisance(bias=False, input_offset=False)
    model: Model = MODEL
    problem = Problem(model, Params(), [flight], free, nuisance, method="filter-error")
    found = fit(problem, starts=1).estimates["walk"].value
    plain, restricted = (by_matrices(left, restricted=how) for how in (False, True))
    assert restricted > 1.05 * plain
    # The difference comes from the initial state's weak prior and from finite differences.
    assert abs(np.log(found / restricted)) < 0.2 * np.log(restricted / plain)
