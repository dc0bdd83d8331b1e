"""Several disturbances at once, each with its own size and time constant."""

import dataclasses
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import initial_sd_of
from heli_jax.identification.estimation.kalman import innovations
from heli_jax.naming import asdict
from heli_jax.simulation.discretize import process_noise
from heli_jax.simulation.inputs import random_steps

DT, NOISE = 0.02, np.array([0.01, 0.02])
SIGMA, TAU = np.array([2.0, 1.0]), np.array([0.4, 1.2])


class Derivatives(NamedTuple):
    Lp: Annotated[Any, "1/s"] = -5.0
    Mq: Annotated[Any, "1/s"] = -2.0
    Mp: Annotated[Any, "1/s"] = 1.0
    gust: Annotated[Any, "rad/s^1.5"] = 0.0


class Rates(NamedTuple):
    p: Annotated[Any, "rad/s"]
    q: Annotated[Any, "rad/s"]


class Sticks(NamedTuple):
    lat: Annotated[Any, "1"]
    lon: Annotated[Any, "1"]


def field(d, s, u):
    return Rates(d.Lp * s.p + 6.0 * u.lat, d.Mp * s.p + d.Mq * s.q + 3.0 * u.lon)


MODEL = Model("rates", field, lambda d, s, u: s, Derivatives, Rates, Sticks, Rates, linear=True)
OWN = dataclasses.replace(MODEL, noise_intensity=lambda d: Rates(d.gust, 0.0 * d.gust))
BOTH = with_disturbance(MODEL, ("p", "q"))
MACHINE = np.array([[-5.0, 0.0], [1.0, -2.0]])
VALUES = {"sigma_w_p": SIGMA[0], "tau_w_p": TAU[0], "sigma_w_q": SIGMA[1], "tau_w_q": TAU[1]}
OFF = Nuisance(initial_state=False, bias=False)
FREE = {"Lp": Free(-3.0), "Mq": Free(-3.0), "Mp": Free(0.5)}


def discrete(sigma=SIGMA):
    """Return Phi, Gamma, Q of (p, q, w_p, w_q) over a sample, by matrix exponentials."""
    A = np.block([[MACHINE, np.eye(2)], [np.zeros((2, 2)), -np.diag(1 / TAU)]])
    B = np.vstack([np.diag([6.0, 3.0]), np.zeros((2, 2))])
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * DT)
    drive = np.diag([0.0, 0.0, *(2.0 * sigma**2 / TAU)])
    loan = scipy.linalg.expm(np.block([[-A, drive], [np.zeros((4, 4)), A.T]]) * DT)
    return held[:4, :4], held[:4, 4:], loan[4:, 4:].T @ loan[:4, 4:]


def record(seed, n, sigma=SIGMA):
    rng = np.random.default_rng(seed)
    Phi, Gamma, Q = discrete(sigma)
    values, vectors = np.linalg.eigh(Q)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    u = np.stack([0.2 * random_steps(n, DT, rng, (0.3, 1.5)) for _ in range(2)])
    x, ys = np.array([0.0, 0.0, *(sigma * rng.standard_normal(2))]), np.empty((n, 2))
    for k in range(n):
        ys[k] = x[:2] + NOISE * rng.standard_normal(2)
        x = Phi @ x + Gamma @ u[:, k] + root @ rng.standard_normal(4)
    return Flight(dt=DT, inputs={"lat": u[0], "lon": u[1]}, outputs={"p": ys[:, 0], "q": ys[:, 1]})


def params(model=BOTH, **values):
    return model.Params(**{n: jnp.asarray(float(v)) for n, v in values.items()})


def problem(flight, model=BOTH, **options):
    return Problem(model, params(model), [flight], FREE, OFF, method="filter-error", **options)


@pytest.fixture(scope="module")
def whole():
    flight = record(1, 1500)
    return flight, fit(problem(flight))


def test_process_noise_is_that_of_van_loan():
    given = params(**VALUES)
    np.testing.assert_allclose(process_noise(BOTH, given, DT), discrete()[2], atol=1e-14)
    np.testing.assert_allclose(initial_sd_of(BOTH, given, jnp.float64), [0, 0, *SIGMA])


def test_likelihood_is_that_of_a_filter_by_hand():
    n = 60
    flight = record(3, n)
    u = np.stack([flight.inputs["lat"], flight.inputs["lon"]])
    y = np.stack([flight.outputs["p"], flight.outputs["q"]], axis=1)
    Phi, Gamma, Q = discrete()
    x, P, C = np.zeros(4), np.diag([0.0, 0.0, *SIGMA**2]), np.eye(2, 4)
    expected = 0.0
    for k in range(n):
        S, e = C @ P @ C.T + np.diag(NOISE**2), y[k] - C @ x
        expected -= 0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
        K = P @ C.T @ np.linalg.inv(S)
        x, P = Phi @ (x + K @ e) + Gamma @ u[:, k], Phi @ (P - K @ C @ P) @ Phi.T + Q
    found = innovations(
        BOTH, params(**VALUES), Sticks(*jnp.asarray(u)),
        {n: jnp.asarray(v) for n, v in flight.outputs.items()},
        {"p": NOISE[0], "q": NOISE[1]}, dt=DT,
    )  # fmt: skip
    total = sum(
        -0.5 * float(jnp.sum(e**2 / found.variance[n] + jnp.log(2 * jnp.pi * found.variance[n])))
        for n, e in found.error.items()
    )
    assert total == pytest.approx(expected, rel=1e-9)


def test_sizes_and_times_are_recovered_within_their_intervals(whole):
    _, found = whole
    assert found.status == "converged"
    assert found.white
    truth = {**VALUES, "Lp": -5.0, "Mq": -2.0, "Mp": 1.0}
    for name, true in truth.items():
        estimate = {**found.nuisance, **found.estimates}[name]
        assert abs(estimate.value - true) < 3.5 * estimate.sd
        assert estimate.sd < 0.5 * abs(true)


def test_one_that_is_not_there_freezes_no_other():
    flight = record(2, 1500, np.array([2.0, 0.0]))
    found = fit(problem(flight))
    assert found.status == "converged"
    assert found.nuisance["sigma_w_q"].value == 0.0
    absent = [f.subjects for f in found.findings if f.code == "noise.no-disturbance"]
    assert absent == [("q",)]
    for name, true in {"sigma_w_p": 2.0, "tau_w_p": 0.4}.items():
        assert abs(found.nuisance[name].value - true) < 3.5 * found.nuisance[name].sd
    # The unknowns are the free parameters, size and time constant of one disturbance, and two
    # noises.
    assert found.unknowns == len(FREE) + 2 + 2


def test_noise_of_the_models_own_is_kept_and_fitted():
    both = with_disturbance(OWN, "q")
    intensity = asdict(both.noise_intensity(params(both, gust=0.3, sigma_w=1.0, tau_w=2.0)))
    assert {n: float(v) for n, v in intensity.items()} == {"p": 0.3, "q": 0.0, "w1_q": 1.0}
    rng = np.random.default_rng(0)
    n, phi = 1000, np.exp(-5.0 * DT)
    lat = 0.2 * random_steps(n, DT, rng, (0.3, 1.5))
    p = np.zeros(n)
    # An exact first-order step: white noise of intensity 0.5 through a lag.
    sd = 0.5 * np.sqrt((1 - phi**2) / 10.0)
    for k in range(n - 1):
        p[k + 1] = phi * p[k] + (1 - phi) / 5.0 * 6.0 * lat[k] + sd * rng.standard_normal()
    y = p + 0.01 * rng.standard_normal(n)
    flight = Flight(dt=DT, inputs={"lat": lat, "lon": 0.0 * lat}, outputs={"p": y})
    free = {"Lp": Free(-3.0), "gust": Free(0.1, sign="keep")}
    found = fit(Problem(OWN, params(OWN), [flight], free, OFF, method="filter-error"))
    assert found.status == "converged"
    for name, true in {"Lp": -5.0, "gust": 0.5}.items():
        estimate = found.estimates[name]
        assert abs(estimate.value - true) < 3.5 * estimate.sd
