"""The filter with one covariance and a frozen gain, against NumPy and the exact filter."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Problem, models
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.filter_error import filtered_flights
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.estimation.shared_covariance import Gaussian, Records, filtered_records
from heli_jax.identification.unknowns.layout import layout_of, unpack
from heli_jax.naming import asdict

# Two states, the second driven by noise; one input, two outputs, two records.
N = 700
FAST = {"decay": 0.9, "noise": 0.3}
SLOW = {"decay": 0.998, "noise": 1e-3}
"""A mode known only after hundreds of samples."""
NEVER = {"decay": 1.0, "noise": 0.0}
"""A constant: its variance falls like that of a mean, and the gain never freezes."""
CASES = {
    "fast": FAST,
    "slow mode": SLOW,
    "never steady": NEVER,
    "unstable": {"decay": 1.02, "noise": 0.1},
    "unstable and not seen": {"decay": 1.02, "noise": 0.1, "seen": 0.0},
}


def gaussian(decay, noise, seen=1.0, R: Any = 0.04):
    """Return a system in which everything that may depend on an unknown does."""
    return Gaussian(
        Ad=jnp.asarray([[0.95, 0.1 * seen], [0.0, 1.0]]).at[1, 1].set(decay),
        B=jnp.asarray([[0.2], [0.0]]) * decay,
        C=jnp.asarray([[1.0, 0.0], [0.5, 0.2 * seen]]) * decay,
        D=jnp.asarray([[0.1], [0.0]]),
        Q=jnp.asarray([[0.0, 0.0], [0.0, 1.0]]) * noise**2,
        R=jnp.asarray([1.0, 3.0]) * R,
        P0=jnp.asarray([[0.0, 0.0], [0.0, 2.0]]),
    )


def records():
    rng = np.random.default_rng(3)
    u, y, x0 = (rng.standard_normal(shape) for shape in ((N, 2, 1), (N, 2, 2), (2, 2)))
    return Records(*(jnp.asarray(v) for v in (u, u, y, x0)))


def by_hand(system):
    """Return the log-likelihood of the records by a textbook filter in NumPy."""
    Ad, B, C, D, Q, R, P0 = (np.asarray(v) for v in system)
    U, acting, y, x0 = (np.asarray(v) for v in records())
    total = 0.0
    for j in range(2):
        x, P = x0[j], P0
        for k in range(N):
            nu = y[k, j] - C @ x - D @ acting[k, j]
            S = C @ P @ C.T + np.diag(R)
            K = P @ C.T @ np.linalg.inv(S)
            total -= 0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
            x = Ad @ (x + K @ nu) + B @ U[k, j]
            P = Ad @ (P - K @ C @ P) @ Ad.T + Q
    return total


def likelihood(system):
    error, variance = filtered_records(system, records())
    s = variance[:, None, :]
    return -0.5 * jnp.sum(jnp.square(error) / s + jnp.log(2 * jnp.pi * s)), variance


def at(z):
    """Return the unknowns: logarithms of noise and R, and the decay."""
    return gaussian(z[0], jnp.exp(z[1]), 1.0, jnp.exp(z[2]))


def point(decay, noise):
    return jnp.asarray([decay, np.log(noise), np.log(0.04)])


VALUE = jax.jit(likelihood)
VALUE_AND_GRADIENT = jax.jit(
    lambda z: (jax.jacfwd(lambda z: likelihood(at(z))[0])(z), likelihood(at(z))[0])
)
BATCH = jax.jit(jax.vmap(lambda z: jax.jacfwd(lambda z: likelihood(at(z))[0])(z)))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_log_likelihood_is_that_of_the_textbook(case):
    system = gaussian(**case)
    assert float(VALUE(system)[0]) == pytest.approx(by_hand(system), rel=1e-10)


def test_the_gain_freezes_where_the_covariance_converges_and_only_there():
    def constant_at_the_end(case):
        variance = np.asarray(VALUE(gaussian(**case))[1])
        return bool((variance[-100:] == variance[-1]).all())

    assert constant_at_the_end(FAST)
    assert not constant_at_the_end(NEVER)


@pytest.mark.parametrize("case", [FAST, SLOW], ids=["fast", "slow mode"])
def test_derivatives_are_those_of_finite_differences(case):
    z = point(**case)
    gradient, _ = VALUE_AND_GRADIENT(z)
    for i in range(3):
        h = 1e-4 * (1.0 - case["decay"] if i == 0 else 1.0)
        step = h * np.eye(3)[i]
        up, down = (by_hand(at(z + jnp.asarray(s * step))) for s in (1, -1))
        assert float(gradient[i]) == pytest.approx((up - down) / (2 * h), rel=1e-5)


def test_side_by_side_each_is_what_it_is_alone():
    # One freezes early, one later, and one never.
    points = [point(**FAST), point(**SLOW), point(1.0, 1e-9)]
    together = BATCH(jnp.stack(points))
    for z, gradient in zip(points, together, strict=True):
        alone, _ = VALUE_AND_GRADIENT(z)
        np.testing.assert_allclose(gradient, alone, rtol=1e-7)


def flight(seed, samples=300, **more):
    rng = np.random.default_rng(seed)
    u = 3e-6 * np.repeat(rng.uniform(-1, 1, samples // 10), 10)
    outputs = {"roll": 0.02 * rng.standard_normal(samples).cumsum() / 10}
    outputs["roll_rate"] = 0.03 * rng.standard_normal(samples)
    return Flight(dt=0.02, inputs={"x_roll": u}, outputs=outputs, **more)


def problem(bench30, flights, model=None, **more):
    model = with_disturbance(models.roll_on_stand, "roll") if model is None else model
    params = model.Params(**asdict(bench30), sigma_w=jnp.asarray(1.0), tau_w=jnp.asarray(0.5))
    free = {"Ixx": Free(0.03), "If": Free(2.5e-4)}
    return Problem(model, params, flights, free, **{"method": "filter-error", **more})


@pytest.mark.slow
def test_flights_together_have_the_innovations_of_the_exact_filter_and_their_derivatives(bench30):
    flights = (flight(1), flight(2, 240))
    of = problem(bench30, flights)
    layout, data, noise = layout_of(of, flights), data_of(of, flights), first_noise(of, flights)
    z = start_vector(layout, data, of)
    direction = jnp.asarray(np.random.default_rng(4).standard_normal(z.size))

    def along(layout, noise):
        """Return the innovations, and their derivative along a direction in all unknowns."""

        def found(z):
            return filtered_flights(layout, data, noise, unpack(layout, data, z))

        return jax.jvp(found, (z,), (direction,))

    together = jax.jit(along, static_argnums=0)
    apart = dataclasses.replace(layout, one_covariance=())
    found, expected = together(layout, noise), jax.jit(along, static_argnums=0)(apart, noise)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
    # A noise that differs between flights has no single covariance: the result is NaN.
    noise.sd[1]["roll"] = 2.0 * noise.sd[1]["roll"]
    assert all(np.isnan(v).all() for v in jax.tree.leaves(together(layout, noise)[0]))


def test_flights_that_differ_in_what_the_covariance_depends_on_are_apart(bench30):
    gap = flight(3)
    y = {**gap.outputs, "roll": np.where(np.arange(300) == 7, np.nan, gap.outputs["roll"])}
    flights = (
        flight(1),
        dataclasses.replace(gap, outputs=y),
        flight(2, 240),
        flight(4, known={"Omega": 150.0}),
        flight(5, hold={"x_roll": "linear"}),
        flight(6, sd={"roll": 1e-3}),
        dataclasses.replace(flight(7), dt=0.01),
        dataclasses.replace(flight(8), outputs={"roll": flight(8).outputs["roll"]}),
    )
    of = problem(bench30, flights)
    assert layout_of(of, flights).one_covariance == ((0, 2), (3,), (4,), (5,), (6,), (7,))
    nonlinear = dataclasses.replace(of.model, linear=False)
    assert layout_of(problem(bench30, flights, nonlinear), flights).one_covariance == ()
    simulated = problem(bench30, flights, method="output-error")
    assert layout_of(simulated, flights).one_covariance == ()
