"""Recursive least squares against batch least squares."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from heli_jax import rls
from heli_jax.identification.equation_error.rls import (
    regressors,
    rls_init,
    rls_regression,
    rls_step,
    transfer_function,
)

go = jax.jit(rls_regression)


def batch(phi, y, forgetting, p0):
    """Return argmin sum_k f^(N-1-k) (y - phi theta)^2 + f^N |theta|^2 / p0, by QR in float64."""
    n, q = phi.shape
    root = np.sqrt(forgetting) ** np.arange(n - 1, -1, -1)
    keep = root > 1e-30
    prior = np.eye(q) * np.sqrt(forgetting) ** min(n, 100_000) / np.sqrt(p0)
    rows = np.vstack([phi[keep] * root[keep, None], prior])
    return np.linalg.lstsq(rows, np.r_[y[keep] * root[keep], np.zeros(q)], rcond=None)[0]


def run(phi, y, forgetting=1.0, p0=1e6, bound=None, dtype=jnp.float64):
    bound = 100.0 * p0 if bound is None else bound
    arrays = (jnp.asarray(v, dtype) for v in (phi, y, forgetting, p0, bound))
    return go(*arrays)


@pytest.mark.parametrize("p0", [1.0, 1e6])
def test_without_forgetting_it_is_batch_least_squares(p0):
    rng = np.random.default_rng(0)
    phi = rng.standard_normal((6000, 9)) * 10.0 ** np.linspace(-2, 2, 9)
    y = phi @ rng.standard_normal(9) + rng.standard_normal(6000)
    found = run(phi, y, 1.0, p0)
    for n in (1, 5, 9, 100, 6000):
        np.testing.assert_allclose(
            found.history[n - 1], batch(phi[:n], y[:n], 1.0, p0), rtol=1e-8, atol=1e-8
        )
    np.testing.assert_array_equal(found.theta, found.history[-1])


def test_with_forgetting_it_is_weighted_least_squares_after_a_million_samples():
    n, q = 1_000_000, 9
    rng = np.random.default_rng(1)
    phi = rng.standard_normal((n, q))
    truth = np.where(np.arange(n)[:, None] < n // 2, np.arange(q), -np.arange(q))
    y = np.sum(phi * truth, axis=1) + 0.1 * rng.standard_normal(n)
    found = run(phi, y, 0.99)
    for k in (200, n // 2 + 50, n):
        wanted = batch(phi[:k], y[:k], 0.99, 1e6)
        np.testing.assert_allclose(found.history[k - 1], wanted, rtol=1e-8, atol=1e-8)
    assert np.isfinite(found.history).all()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("kind", ["unexcited", "duplicate", "constant", "silent"])
def test_directions_without_news_never_become_nan(kind, dtype):
    rng = np.random.default_rng(2)
    n, q, f, p0, bound = 20_000, 9, 0.95, 1e6, 1e8
    phi = rng.standard_normal((n, q))
    if kind == "unexcited":
        phi[:, [2, 7]] = 0.0
    elif kind == "duplicate":
        phi[:, 3] = phi[:, 4]
    elif kind == "constant":
        phi[:] = rng.standard_normal(q)
    else:
        phi[n // 4 :] = 0.0
    truth = np.arange(1.0, 10.0)
    y = phi @ truth
    found = run(phi, y, f, p0, bound, dtype)
    for leaf in found:
        assert leaf.dtype == dtype
        assert np.isfinite(np.asarray(leaf)).all()
    assert np.max(found.largest) <= 1.01 * bound / f**q
    # Excited directions are still estimated: the prediction fits while there is motion.
    end = n // 4 if kind == "silent" else n
    error = np.asarray(found.error)[end - 1000 : end]
    assert np.abs(error).max() < (1e-7 if dtype == jnp.float64 else 2e-2)


def test_silence_leaves_the_estimate_alone():
    rng = np.random.default_rng(3)
    phi = rng.standard_normal((5000, 4))
    phi[500:] = 0.0
    found = run(phi, phi @ [1.0, 2.0, 3.0, 4.0], 0.95, bound=1e7)
    np.testing.assert_array_equal(found.history[499], found.history[-1])
    assert np.asarray(found.largest)[-1] <= 1.01e7 / 0.95**4


@pytest.mark.parametrize("forgetting", [1.0, 0.95])
def test_equations_31_and_33_agree(forgetting):
    """Test that the gain from the old P equals the new P times the regressor."""
    rng = np.random.default_rng(4)
    state, f = rls_init(5, 10.0), jnp.asarray(forgetting)
    step = jax.jit(rls_step)
    for _ in range(30):
        phi, y = rng.standard_normal(5), rng.standard_normal()
        P = np.asarray(state.S @ state.S.T)
        new, info = step(state, jnp.asarray(phi), jnp.asarray(y), f, jnp.asarray(1e12))
        gain = P @ phi / (forgetting + phi @ P @ phi)
        assert float(info.error) == pytest.approx(y - phi @ np.asarray(state.theta), abs=1e-12)
        used = (np.asarray(new.theta) - np.asarray(state.theta)) / float(info.error)
        np.testing.assert_allclose(used, gain, rtol=1e-8, atol=1e-10)
        P_new = np.asarray(new.S @ new.S.T)
        np.testing.assert_allclose(P_new @ phi, gain, rtol=1e-9, atol=1e-11)
        wanted = (P - np.outer(gain, phi) @ P) / forgetting
        np.testing.assert_allclose(P_new, wanted, rtol=1e-8, atol=1e-9)
        assert float(info.largest) == pytest.approx(np.diag(P_new).max())
        state = new


def test_bound_is_a_pseudo_measurement_of_one_parameter():
    """Test that beyond the bound P shrinks as by a measurement of e_i, with Theta unchanged."""
    rng = np.random.default_rng(5)
    S = jnp.asarray(rng.standard_normal((3, 3)) * [[1.0], [30.0], [2.0]])
    state = rls_init(3)._replace(S=S)
    quiet = jnp.zeros(3), jnp.asarray(0.0), jnp.asarray(1.0)
    new, info = rls_step(state, *quiet, jnp.asarray(100.0))
    P, Q = np.asarray(S @ S.T), np.asarray(new.S @ new.S.T)
    i = np.argmax(np.diag(P))
    assert float(info.largest) == pytest.approx(P[i, i])
    assert Q[i, i] == pytest.approx(100.0)
    r = 1.0 / (1.0 / 100.0 - 1.0 / P[i, i])
    np.testing.assert_allclose(Q, P - np.outer(P[:, i], P[i]) / (P[i, i] + r), rtol=1e-9)
    np.testing.assert_array_equal(new.theta, state.theta)


NUM = [0.0, 0.02, 0.05, -0.01, 0.004]
DEN = np.poly([0.9, 0.7 + 0.4j, 0.7 - 0.4j, -0.3]).real


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_arx_truth_is_found_without_noise(forgetting):
    u = np.random.default_rng(6).uniform(-1.0, 1.0, 2000)
    y = scipy.signal.lfilter(NUM, DEN, u)
    found = rls(jnp.asarray(u), jnp.asarray(y), forgetting=forgetting, p0=1e12)
    np.testing.assert_allclose(found.theta, np.r_[-DEN[1:], NUM], atol=1e-6)
    num, den = transfer_function(found.theta)
    np.testing.assert_allclose(num, NUM, atol=1e-6)
    np.testing.assert_allclose(den, DEN, atol=1e-6)
    assert found.history.shape == (2000, 9)
    np.testing.assert_array_equal(found.history[:4], 0.0)


def test_a_record_that_starts_in_the_middle_of_a_motion_does_not_mislead():
    u = np.random.default_rng(6).uniform(-1.0, 1.0, 2000)
    y = scipy.signal.lfilter(NUM, DEN, u)
    found = rls(jnp.asarray(u[300:]), jnp.asarray(y[300:]), p0=1e12)
    np.testing.assert_allclose(found.theta, np.r_[-DEN[1:], NUM], atol=1e-6)


def test_another_order():
    order = 2
    num, den = NUM[: order + 1], np.poly([0.9, 0.6, -0.4][:order])
    u = np.random.default_rng(7).uniform(-1.0, 1.0, 500)
    y = scipy.signal.lfilter(num, den, u)
    found = rls(jnp.asarray(u), jnp.asarray(y), order=order, p0=1e12)
    np.testing.assert_allclose(found.theta, np.r_[-den[1:], num], atol=1e-6)


def test_regressors_are_equation_25():
    u, y = np.arange(1.0, 8.0), 10.0 * np.arange(1.0, 8.0)
    found = np.asarray(regressors(jnp.asarray(u), jnp.asarray(y), 2))
    np.testing.assert_array_equal(found[4], [40.0, 30.0, 5.0, 4.0, 3.0])
    np.testing.assert_array_equal(found[1], [10.0, 0.0, 2.0, 1.0, 0.0])
    np.testing.assert_array_equal(found[0], [0.0, 0.0, 1.0, 0.0, 0.0])


def test_many_at_once_equal_one_by_one():
    rng = np.random.default_rng(8)
    phi, y = (
        jnp.asarray(rng.standard_normal((3, 200, 4))),
        jnp.asarray(rng.standard_normal((3, 200))),
    )
    many = jax.jit(jax.vmap(lambda p, s: rls_regression(p, s, jnp.asarray(0.98))))(phi, y)
    for k in range(3):
        wanted = batch(np.asarray(phi[k]), np.asarray(y[k]), 0.98, 1e6)
        np.testing.assert_allclose(many.theta[k], wanted, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("u", "y", "order", "named"),
    [
        (np.ones(50), np.ones(50), 0, "order"),
        (np.ones(50), np.ones(49), 4, "(49,)"),
        (np.ones((50, 1)), np.ones((50, 1)), 4, "(N,)"),
        (np.ones(8), np.ones(8), 4, "order 4"),
    ],
)
def test_wrong_arguments(u, y, order, named):
    with pytest.raises(ValueError, match=re.escape(named)):
        rls(jnp.asarray(u), jnp.asarray(y), order=order)
