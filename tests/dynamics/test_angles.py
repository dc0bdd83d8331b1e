"""Joint sine and cosine against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.dynamics.helicopter_equations import sincos


@pytest.mark.parametrize("size", [1e-6, 1.0, 10.0, 1e3, 1e6])
def test_to_the_last_digit(size):
    x = np.append(np.random.default_rng(0).uniform(-size, size, 20000), [0.0, size, -size])
    s, c = jax.jit(sincos)(x)
    np.testing.assert_allclose(s, np.sin(x), rtol=0, atol=3e-16)
    np.testing.assert_allclose(c, np.cos(x), rtol=0, atol=3e-16)


def test_near_the_multiples_of_a_right_angle():
    """Test small sines and cosines, whose digits are those of the reduced argument."""
    k = np.arange(-4000, 4001)
    x = k * (np.pi / 2) + np.random.default_rng(1).normal(0, 1e-6, k.size)
    s, c = sincos(x)
    np.testing.assert_allclose(s, np.sin(x), rtol=1e-14)
    np.testing.assert_allclose(c, np.cos(x), rtol=1e-14)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives(mode):
    for x in (-4.0, -0.3, 0.0, 0.7, 1.6, 9.0):
        ds, dc = mode(sincos)(x)
        assert float(ds) == pytest.approx(np.cos(x), abs=1e-15)
        assert float(dc) == pytest.approx(-np.sin(x), abs=1e-15)
        assert float(mode(mode(sincos))(x)[0]) == pytest.approx(-np.sin(x), abs=1e-15)


def test_single_precision_and_what_is_no_number():
    s, c = sincos(jnp.float32(1.0))
    assert s.dtype == c.dtype == jnp.float32
    assert float(s) == pytest.approx(np.sin(1.0), rel=1e-6)
    for x in (np.nan, np.inf):
        assert all(np.isnan(float(v)) for v in sincos(x))
