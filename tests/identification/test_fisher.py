"""J'J of filter error against the Fisher information of a dense Gaussian, with NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Problem, models
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.problem import Nuisance
from heli_jax.identification.unknowns.layout import layout_of
from heli_jax.naming import asdict
from tests.dynamics.paper import BENCH, matrices

N, DT, SD, SIGMA, TAU = 150, 0.02, 0.02, 1.04, 1.0


def gaussian(u, log_inertia, log_sigma):
    """Return mean (N,) and covariance (N, N) of the measured roll rate, from rest."""
    A, B = np.zeros((5, 5)), np.zeros((5, 1))
    A[:4, :4], B[:4] = matrices({**BENCH, "Ixx": np.exp(log_inertia)}, True)
    A[1, 4], A[4, 4] = 1.0, -1.0 / TAU
    variance = np.exp(2.0 * log_sigma)
    G = np.zeros((5, 5))
    G[4, 4] = 2.0 * variance / TAU
    # Van Loan: transition, input and noise of one sample.
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 6))]]) * DT)
    Ad, Bd = held[:5, :5], held[:5, 5]
    both = scipy.linalg.expm(np.block([[-A, G], [np.zeros((5, 5)), A.T]]) * DT)
    Q = both[5:, 5:].T @ both[:5, 5:]
    x, P, mean, S = np.zeros(5), np.diag([0.0, 0.0, 0.0, 0.0, variance]), np.zeros(N), np.eye(N)
    S *= SD**2
    for k in range(N):
        mean[k] = x[1]
        later = P[:, 1].copy()
        for j in range(k, N):
            S[k, j] += later[1]
            S[j, k] = S[k, j]
            later = Ad @ later
        x, P = Ad @ x + Bd * u[k], Ad @ P @ Ad.T + Q
    return mean, S


def information(u, z):
    """Return the information m_i' S^-1 m_j + 1/2 tr(S^-1 S_i S^-1 S_j) of (log Ixx, log
    sigma_w).
    """
    h = 1e-4
    solve = np.linalg.inv(gaussian(u, *z)[1])
    slopes = []
    for i in range(2):
        step = h * np.eye(2)[i]
        (m1, S1), (m0, S0) = gaussian(u, *(z + step)), gaussian(u, *(z - step))
        slopes.append(((m1 - m0) / (2 * h), solve @ (S1 - S0) / (2 * h)))
    return np.array([[a @ solve @ b + 0.5 * np.sum(A * B.T) for b, B in slopes] for a, A in slopes])


@pytest.mark.slow
def test_the_rows_hold_fishers_information(bench30):
    model = with_disturbance(models.roll_on_stand, "roll")
    truth = np.log([BENCH["Ixx"], SIGMA])
    rng = np.random.default_rng(0)
    u = 3e-6 * np.repeat(rng.uniform(-1.0, 1.0, N // 10), 10)
    mean, S = gaussian(u, *truth)
    factor = np.linalg.cholesky(S)
    vehicle = model.Params(
        **{
            **asdict(bench30),
            "sigma_w": jnp.asarray(SIGMA),
            "tau_w": jnp.asarray(TAU),
            **{n: jnp.asarray(BENCH[n]) for n in ("kappa", "zeta")},
        }
    )
    found = []
    for _ in range(60):
        y = mean + factor @ rng.standard_normal(N)
        flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll_rate": y}, sd={"roll_rate": SD})
        problem = Problem(
            model,
            vehicle,
            [flight],
            {"Ixx": Free(BENCH["Ixx"])},
            Nuisance(initial_state=False, bias=False),
            method="filter-error",
            fixed_noise=("tau_w", "sigma_y"),
        )
        layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
        noise, z = first_noise(problem, problem.training), start_vector(layout, data, problem)
        J = evaluate(layout, data, noise, z).J
        found.append(J.T @ J)
    wanted = information(u, truth)
    error = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    np.testing.assert_array_less(np.abs(np.mean(found, axis=0) - wanted), 4.0 * error)
    # The error must be small enough to reveal a part that is counted twice.
    assert error[1, 1] < 0.05 * wanted[1, 1]
    assert np.mean(found, axis=0)[1, 1] == pytest.approx(wanted[1, 1], rel=0.1)


def test_what_has_no_effect_is_not_known():
    rng = np.random.default_rng(0)
    J = rng.standard_normal((50, 4))
    # The reference: the inverse of the normal equations.
    np.testing.assert_allclose(deviations(J), np.sqrt(np.diag(np.linalg.inv(J.T @ J))), rtol=1e-12)
    # The third is a copy of the second, the last has no effect: only the first is known.
    J[:, 2] = -3.0 * J[:, 1]
    J[:, 3] = 0.0
    sds = deviations(J)
    both = J[:, :2]
    assert sds[0] == pytest.approx(np.sqrt(np.linalg.inv(both.T @ both)[0, 0]), rel=1e-9)
    assert np.isinf(sds[1:]).all()
    assert np.isinf(deviations(np.full((5, 2), np.nan))).all()
