"""Deviations under coloured residuals: closed forms of AR(1) noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from heli_jax.identification.coloured import inflation

N, DT = 20000, 0.01


def case(r, J):
    """The parts of a layout, its data and an evaluation that the correction looks at."""
    k, n = r.shape
    flight = SimpleNamespace(dt=DT, outputs={str(i): r[i] for i in range(k)})
    layout = SimpleNamespace(outputs=(tuple(str(i) for i in range(k)),))
    rows = J.reshape(k * n, -1)
    return layout, SimpleNamespace(flights=(flight,)), SimpleNamespace(r=r.ravel(), J=rows)


def ar1(rho, seed=0, n=N):
    rng = np.random.default_rng(seed)
    e = np.sqrt(1 - rho**2) * rng.standard_normal(n)
    for i in range(1, n):
        e[i] += rho * e[i - 1]
    return e


def test_white_residuals_change_little():
    J = np.stack([np.ones(N), np.sin(0.01 * np.arange(N))], axis=1)[None]
    r = np.random.default_rng(1).standard_normal((1, N))
    np.testing.assert_allclose(inflation(*case(r, J)), 1.0, atol=0.25)


@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_a_mean_under_ar1_noise(rho):
    """The mean of AR(1) noise has (1 + rho)/(1 - rho) times the white variance."""
    wanted = np.sqrt((1 + rho) / (1 - rho))
    # One record tells the memory to a fifth or so; the mean over several is closer.
    found = [
        inflation(*case(ar1(rho, seed)[None], np.ones((1, N, 1))))[0] ** 2 for seed in range(12)
    ]
    assert np.sqrt(np.mean(found)) == pytest.approx(wanted, rel=0.15)


def test_a_fast_regressor_gains_from_slow_noise():
    J = np.cos(np.pi * np.arange(N))[None, :, None]
    rho = 0.9
    found = inflation(*case(ar1(rho)[None], J))[0]
    assert found == pytest.approx(np.sqrt((1 - rho) / (1 + rho)), rel=0.3)


def test_two_outputs_with_the_same_noise_are_one():
    r = ar1(0.0)[None].repeat(2, axis=0)
    found = inflation(*case(r, np.ones((2, N, 1))))[0]
    alone = inflation(*case(r[:1], np.ones((1, N, 1))))[0]
    assert found == pytest.approx(np.sqrt(2.0) * alone, rel=1e-6)


def test_prior_rows_keep_their_weight():
    layout, data, e = case(ar1(0.9)[None], 1e-9 * np.ones((1, N, 1)))
    e.J, e.r = np.vstack([e.J, [[1.0]]]), np.append(e.r, 0.3)
    assert inflation(layout, data, e)[0] == pytest.approx(1.0, rel=1e-6)


def test_a_combination_may_be_wider_than_its_parts():
    rho, rng = 0.95, np.random.default_rng(5)
    r = ar1(rho)[None]
    J = np.stack([np.ones((1, N)), rng.standard_normal((1, N))], axis=-1)
    layout, data, e = case(r, J)
    parts = inflation(layout, data, e)
    # The first column is the mean, which suffers; the second is white and does not.
    assert parts[0] > 4.0
    assert parts[1] == pytest.approx(1.0, abs=0.3)
    np.testing.assert_allclose(inflation(layout, data, e, np.eye(2)), parts)
    both = inflation(layout, data, e, np.array([[1.0, 1.0]]))[0]
    assert parts[1] < both < parts[0]
