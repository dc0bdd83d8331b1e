"""Inflow in any flow, against bracketing, long double and W. Johnson's measured curve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.dynamics.aerodynamics import induced_velocity, mass_flow
from tests.dynamics import whole_helicopter as oracle

solve = jax.jit(jax.vmap(induced_velocity))


def scattered(n, least_b=-1.5):
    """Return flows of rotors of any loading, from a fast climb to a descent at five times v_h."""
    rng = np.random.default_rng(0)
    h = np.exp(rng.uniform(-2.0, 2.0, n))
    mu = np.where(rng.random(n) < 0.3, 0.0, np.exp(rng.uniform(-4.0, 2.0, n)))
    W, b = h * rng.uniform(-5.0, 3.0, n), h * np.exp(rng.uniform(least_b, 1.5, n))
    return (mu * h) ** 2, W, 2 * h**2 * np.exp(rng.uniform(-3.0, 1.0, n)), b


def off(v, V2, W, T0, b):
    """Return the relative error of roots v (n,), by a Newton step in long double."""
    v, V2, W, T0, b = (np.asarray(x, np.longdouble) for x in (v, V2, W, T0, b))

    def surplus(v):
        q = np.maximum(0.0, (-W - v / 2) * (v * 11 / 5 + W))
        k, kV, rest = np.longdouble("0.37"), np.longdouble("5.8"), np.longdouble("1e-16")
        s2 = V2 + (W + v) ** 2 + k * q**2 / (v**2 + kV * V2 + rest) + rest
        return 2 * v * np.sqrt(s2) + b * v - T0

    h = 1e-6 * v
    return np.abs(surplus(v) * 2 * h / (surplus(v + h) - surplus(v - h)) / v).astype(float)


def johnson(c, mu):
    """Return induced velocity, with c and mu the speeds through and along, all over hover's."""
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
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    # A negative thrust is a positive one seen from below.
    V2, W, T0, b = map(jnp.asarray, flows)
    np.testing.assert_array_equal(np.asarray(solve(V2, -W, -T0, b)), -found)


@pytest.mark.parametrize(("dtype", "most"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_every_root_has_its_last_digits_however_it_is_compiled(dtype, most):
    flows = [jnp.asarray(x.astype(dtype)) for x in scattered(200_000, least_b=-14.0)]

    def fused(V2, W, T0, b):
        v = induced_velocity(V2 * 1.1, W - b, T0 + b * b, b)
        return v, T0 - b * v, mass_flow(v, V2, W) * jnp.sin(v)

    def scanned(*flows):
        return jax.lax.scan(lambda c, z: (c, induced_velocity(*z)), 0, flows)[1]

    V2, W, T0, b = flows
    for found in (solve(*flows), jax.jit(scanned)(*flows), -solve(V2, -W, -T0, b)):
        assert found.dtype == dtype
        assert off(found, *flows).max() < most
    found = jax.jit(jax.vmap(fused))(*flows)[0]
    assert off(found, V2 * 1.1, W - b, T0 + b * b, b).max() < most


def test_every_root_is_the_only_one():
    V2, W, T0, b = (x[:100, None] for x in scattered(100))
    v = np.geomspace(1e-4, 1e2, 4000)
    left = jax.vmap(jax.vmap(mass_flow, (0, None, None)))(
        jnp.asarray(np.broadcast_to(v, (100, 4000))), jnp.asarray(V2[:, 0]), jnp.asarray(W[:, 0])
    )
    assert np.all(np.diff(2 * v * np.asarray(left) + b * v, axis=1) > 0)
    assert T0.min() > 0


@pytest.mark.parametrize("mu", [0.0, 0.25, 0.5, 0.8])
def test_descents_are_those_that_were_measured(mu):
    """Test at a given thrust, b = 0, without the discontinuity of momentum theory at c = -2."""
    c = np.setdiff1d(np.round(np.arange(-4.0, 1.01, 0.1), 1), [-2.0])
    ones = jnp.ones(c.size)
    found = solve(mu**2 * ones, jnp.asarray(c), 2.0 * ones, 1e-6 * ones)
    np.testing.assert_allclose(found, [johnson(x, mu) for x in c], rtol=0.08)


def test_derivatives_are_those_of_the_root():
    mode = jax.jacrev
    V2, W, T0, b = scattered(60)
    # Below V2 = 0 there is no root for a difference.
    flows = np.stack([V2 + 1e-2, W, T0, b], axis=1)
    f = lambda z: induced_velocity(*z)  # noqa: E731
    first, second = jax.vmap(mode(f)), np.asarray(jax.vmap(mode(mode(f)))(flows))
    slopes = np.asarray(first(flows))
    np.testing.assert_allclose(second, np.swapaxes(second, 1, 2), rtol=1e-9, atol=1e-11)
    V2, W, _, _ = flows.T
    v = np.asarray(solve(*flows.T))
    # The second derivative jumps at both ends of the wake.
    smooth = (np.abs(W + 0.5 * v) > 1e-2 * v) & (np.abs(W + 2.2 * v) > 1e-2 * v)
    assert smooth.sum() > 50
    for k in range(4):
        h = np.zeros_like(flows)
        h[:, k] = 1e-6 * np.maximum(np.abs(flows[:, k]), 1e-2)
        ends = [[oracle.induced_velocity(*z) for z in flows + s * h] for s in (1, -1)]
        wanted = (np.array(ends[0]) - np.array(ends[1])) / (2 * h[:, k])
        np.testing.assert_allclose(slopes[:, k], wanted, rtol=1e-4, atol=1e-6)
        wanted = np.asarray(first(flows + h) - first(flows - h)) / (2 * h[:, k, None])
        np.testing.assert_allclose(second[smooth, k], wanted[smooth], rtol=1e-3, atol=1e-5)


def test_a_rotor_at_rest_is_an_ordinary_point():
    zero = jnp.zeros(())
    assert float(induced_velocity(zero, zero, zero, zero)) == 0.0
    slopes = jax.grad(induced_velocity, argnums=(0, 1, 2, 3))(zero, zero, zero, zero)
    assert np.isfinite(np.asarray(slopes)).all()
