"""The induced velocity against scipy's brentq and finite differences; where its range ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from heli_jax.dynamics.inflow import induced_velocity, vortex_ring

N = 4096


def scattered(seed):
    """(V2, W, T0, b) of a rotor like the X-Cell's, its speed from rest to 200 rad/s."""
    rng = np.random.default_rng(seed)
    tip, theta0 = 0.686 * rng.uniform(0, 200, N), rng.uniform(-0.05, 0.25, N)
    V, W = np.abs(rng.normal(0, 8, N)), rng.normal(0, 6, N)
    half = 0.5 * 6.0 * 0.056
    b = 0.47 * half * tip
    return V**2, W, half * 0.3 * theta0 * tip**2 - b * W, b


def roots(V2, W, T0, b):
    """All roots by a scan and brentq."""
    end = T0 / b if b > 0 else np.sign(T0) * 100.0

    def surplus(x):
        return 2 * x * np.sqrt(V2 + (W + x) ** 2) + b * x - T0

    grid = np.sort(np.linspace(0, end, 801))
    f = surplus(grid)
    return [
        scipy.optimize.brentq(surplus, grid[i], grid[i + 1], xtol=1e-300, rtol=1e-15)
        for i in np.flatnonzero(np.sign(f[:-1]) * np.sign(f[1:]) < 0)
    ]


def test_4096_random_points_against_brentq():
    args = scattered(0)
    v = np.asarray(jax.jit(jax.vmap(induced_velocity))(*args))
    out = np.asarray(jax.vmap(vortex_ring)(*args[:3], v))
    assert np.isfinite(v).all()
    checked = 0
    for i in range(N):
        found = roots(*(a[i] for a in args))
        if out[i] or not found:
            continue
        # Outside the vortex ring there is one root, and so none to jump to.
        assert len(found) == 1
        assert v[i] == pytest.approx(found[0], rel=1e-12, abs=1e-13)
        checked += 1
    assert checked > 2500


def test_several_roots_are_always_told():
    """Straight down at hover's thrust: three roots beyond 3.5 times hover's induced velocity."""
    T0, b = 48.0 + 9.0 * 4.9, 9.0  # hover at 4.9 m/s
    for sink in np.linspace(0.6, 8.0, 60):
        W = -sink * 4.9
        found = roots(1e-6, W, T0 - b * W, b)
        v = induced_velocity(1e-6, W, T0 - b * W, b)
        assert bool(vortex_ring(1e-6, W, T0 - b * W, v))
        assert v == pytest.approx(max(found), rel=1e-6)  # the branch that began in hover
    assert len(found) == 3


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_root(mode):
    args = np.stack(scattered(1), axis=1)[:200]
    v = np.asarray(jax.vmap(lambda z: induced_velocity(*z))(args))
    inside = ~np.asarray(jax.vmap(lambda z, v: vortex_ring(*z[:3], v))(args, v))
    args = args[inside & (np.abs(v) > 0.1)]
    slopes = np.asarray(jax.vmap(mode(lambda z: induced_velocity(*z)))(args))
    second = np.asarray(jax.vmap(mode(mode(lambda z: induced_velocity(*z))))(args))
    for i, z in enumerate(args):
        for j in range(4):
            h = 1e-4 * max(1.0, abs(z[j]))
            up, down = z.copy(), z.copy()
            up[j], down[j] = z[j] + h, z[j] - h
            ends = [max(roots(*w), key=abs) for w in (up, down)]
            size = np.abs(slopes[i]).max()
            assert slopes[i, j] == pytest.approx(
                (ends[0] - ends[1]) / (2 * h), rel=1e-6, abs=1e-6 * size + 1e-9
            )
        if i < 20:
            np.testing.assert_allclose(second[i], second[i].T, rtol=1e-9, atol=1e-12)
            h = 1e-5 * max(1.0, abs(z[2]))
            up, down = z.copy(), z.copy()
            up[2], down[2] = z[2] + h, z[2] - h
            grads = [np.asarray(mode(lambda w: induced_velocity(*w))(w)) for w in (up, down)]
            wanted = (grads[0] - grads[1]) / (2 * h)
            np.testing.assert_allclose(second[i, 2], wanted, rtol=1e-4, atol=1e-7)


def test_a_rotor_at_rest_is_an_ordinary_point():
    zero = jnp.zeros(())
    assert float(induced_velocity(zero, zero, zero, zero)) == 0.0
    slopes = jax.grad(induced_velocity, argnums=(0, 1, 3))(zero, zero, zero, zero)
    assert all(np.isfinite(float(s)) for s in slopes)
