"""Held-out flights of nonlinear models: initial states are found, or a note says not.

The records come from SciPy's solve_ivp, not from our own simulation.
"""

import dataclasses
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit
from heli_jax.identification.validation.metrics import diverges


class Pendulum(NamedTuple):
    k: Annotated[Any, "1/s^2"]
    c: Annotated[Any, "1/s"]


class Swing(NamedTuple):
    x: Annotated[Any, "rad"]
    v: Annotated[Any, "rad/s"]


class Push(NamedTuple):
    u: Annotated[Any, "rad/s^2"]


class Angle(NamedTuple):
    x: Annotated[Any, "rad"]


MODEL = Model(
    "pendulum",
    lambda q, s, u: Swing(s.v, u.u - q.k * jnp.sin(s.x) - q.c * s.v),
    lambda q, s, u: Angle(s.x),
    Pendulum,
    Swing,
    Push,
    Angle,
    start=lambda q: Swing(0.0 * q.k, 0.0 * q.k),
)
K, C, DT, N, NOISE = 9.0, 0.1, 0.02, 400, 5e-3


def swing(x0, v0, seed, **how):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, N // 20), 20)
    x, y = np.array([x0, v0]), np.empty(N)
    for k in range(N):
        y[k] = x[0]
        x = scipy.integrate.solve_ivp(
            lambda t, x, k=k: [x[1], u[k] - K * np.sin(x[0]) - C * x[1]],
            (0.0, DT), x, rtol=1e-8, atol=1e-10,
        ).y[:, -1]  # fmt: skip
    y += NOISE * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"u": u}, outputs={"x": y}, **how)


@pytest.fixture(scope="module")
def flights():
    return swing(0.5, 0.0, 0), swing(2.7, 2.0, 1, hold_out=True, name="held")


def problem(flights, k=9.5, **how):
    params = Pendulum(jnp.asarray(k), jnp.asarray(0.05))
    return Problem(
        MODEL, params, flights, {"c": Free(0.05)}, Nuisance(bias=False), substeps=2, **how
    )


def test_the_initial_state_of_a_flight_held_out_is_found(flights):
    # Near the top of its motion, with a speed that no output shows.
    found = fit(problem(flights, k=9.0))
    assert found.validation["x"].vaf > 0.999
    assert found.validation_free_run == {}
    assert not [f for f in found.findings if f.code.startswith("held-out.")]


@pytest.mark.slow
def test_what_cannot_be_simulated_is_said_and_not_raised(flights):
    training, held = flights
    wild = dataclasses.replace(held, known={"c": -400.0})
    problem_ = Problem(
        MODEL,
        Pendulum(jnp.asarray(9.0), jnp.asarray(0.1)),
        [training, wild],
        {"k": Free(8.0)},
        Nuisance(bias=False),
    )
    found = fit(problem_)
    assert found.status == "converged"
    assert np.isnan(found.validation["x"].vaf)
    assert diverges(found.validation["x"])
    [said] = [f for f in found.findings if f.code == "held-out.not-finite"]
    assert said.subjects == ("held",)
