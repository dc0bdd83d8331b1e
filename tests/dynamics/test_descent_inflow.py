"""Inflow in any descent: against a bracketing solver, W. Johnson's measured curve, and itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.dynamics import descent_inflow, inflow
from heli_jax.dynamics.descent_inflow import induced_velocity
from tests.dynamics import full_helicopter as oracle

solve = jax.jit(jax.vmap(induced_velocity))


def scattered(n):
    """Flows of rotors of any loading, from a fast climb to a descent at five times v_h."""
    rng = np.random.default_rng(0)
    h = np.exp(rng.uniform(-2.0, 2.0, n))
    mu = np.where(rng.random(n) < 0.3, 0.0, np.exp(rng.uniform(-4.0, 2.0, n)))
    W, b = h * rng.uniform(-5.0, 3.0, n), h * np.exp(rng.uniform(-1.5, 1.5, n))
    return (mu * h) ** 2, W, 2 * h**2 * np.exp(rng.uniform(-3.0, 1.0, n)), b


def johnson(c, mu):
    """Induced velocity over that of hover, c and mu the speeds through and along over the same."""
    if 1.5 * mu**2 + (2 * c + 3) ** 2 < 1:
        return c * (0.373 * c**2 + 0.598 * mu**2 - 0.991) - c
    v = np.linspace(1e-3, 4.0, 40001)
    left = v * np.hypot(mu, c + v) - 1.0
    roots = v[1:][left[1:] * left[:-1] <= 0]
    return roots[0] if c < -1.5 else roots[-1]


def test_the_root_is_that_of_a_bracketing_solver():
    flows = scattered(400)
    found = np.asarray(solve(*map(jnp.asarray, flows)))
    wanted = [oracle.induced_velocity(*one) for one in zip(*flows, strict=True)]
    np.testing.assert_allclose(found, wanted, rtol=1e-11)
    # A negative thrust is a positive one seen from below.
    V2, W, T0, b = map(jnp.asarray, flows)
    np.testing.assert_array_equal(np.asarray(solve(V2, -W, -T0, b)), -found)


def test_every_root_is_the_only_one():
    V2, W, T0, b = (x[:100, None] for x in scattered(100))
    v = np.geomspace(1e-4, 1e2, 4000)
    left = jax.vmap(jax.vmap(descent_inflow.mass_flow, (0, None, None)))(
        jnp.asarray(np.broadcast_to(v, (100, 4000))), jnp.asarray(V2[:, 0]), jnp.asarray(W[:, 0])
    )
    assert np.all(np.diff(2 * v * np.asarray(left) + b * v, axis=1) > 0)
    assert T0.min() > 0


def test_it_is_momentum_theory_in_climb_hover_and_slow_descent():
    V2, W, T0, b = map(jnp.asarray, scattered(400))
    plain = jax.vmap(inflow.induced_velocity)(V2, W, T0, b)
    slow = -0.5 * plain < W
    assert 100 < slow.sum() < 300
    np.testing.assert_allclose(solve(V2, W, T0, b)[slow], plain[slow], rtol=1e-11)


@pytest.mark.parametrize("mu", [0.0, 0.25, 0.5, 0.8])
def test_descents_are_those_that_were_measured(mu):
    """At a given thrust, b = 0; momentum theory's own cliff at c = -2 is left out."""
    c = np.setdiff1d(np.round(np.arange(-4.0, 1.01, 0.1), 1), [-2.0])
    ones = jnp.ones(c.size)
    found = solve(mu**2 * ones, jnp.asarray(c), 2.0 * ones, 1e-6 * ones)
    np.testing.assert_allclose(found, [johnson(x, mu) for x in c], rtol=0.08)


def test_derivatives_are_those_of_the_root():
    V2, W, T0, b = (jnp.asarray(x) for x in scattered(60))
    flows = [V2 + 1e-2, W, T0, b]  # a difference to below V2 = 0 has no root
    slopes = jax.vmap(jax.grad(induced_velocity, argnums=(0, 1, 2, 3)))(*flows)
    for k in range(4):
        h = 1e-6 * jnp.maximum(jnp.abs(flows[k]), 1e-2)
        up, down = (
            solve(*[x + s * h if i == k else x for i, x in enumerate(flows)]) for s in (1, -1)
        )
        np.testing.assert_allclose(slopes[k], (up - down) / (2 * h), rtol=1e-4, atol=1e-6)
    mixed = jax.vmap(jax.grad(jax.grad(induced_velocity, 1), 2))(*flows)
    assert np.isfinite(np.asarray(mixed)).all()


def test_a_rotor_at_rest_is_an_ordinary_point():
    zero = jnp.zeros(())
    assert float(induced_velocity(zero, zero, zero, zero)) == 0.0
    slopes = jax.grad(induced_velocity, argnums=(0, 1, 2, 3))(zero, zero, zero, zero)
    assert np.isfinite(np.asarray(slopes)).all()
