"""Correlations with sums over past samples: against explicit sums, and without correlation."""

import numpy as np
import pytest
import scipy.stats

from heli_jax.identification.validation.follows_response import correlations_with_sums, lag_blocks


def autocorrelation(x: np.ndarray, lags: int) -> np.ndarray:
    c = np.correlate(x, x, "full")[x.size - 1 :]
    return c[: lags + 1] / c[0]


def test_every_block_is_as_by_hand():
    rng = np.random.default_rng(0)
    e, u = rng.standard_normal((2, 700))
    u = u + 0.3 * np.roll(e, 5)
    u[100:110] = np.nan
    blocks = lag_blocks(60)
    found = correlations_with_sums(u, e[:, None], blocks)
    seen = np.isfinite(u)
    v, w = np.where(seen, u, 0.0), np.where(seen, e, 0.0)
    for (first, last), p, correlation in zip(blocks, *(v[0] for v in found), strict=True):
        past = np.array(
            [sum(w[t - k] for k in range(first, last + 1) if t >= k) for t in range(700)]
        )
        # The sum begins at the first whole block of lags.
        past[:last] = 0.0
        expected = v @ past / np.sqrt(v @ v * (past @ past))
        lags = 4 * (last - first + 1) + 20
        a, b = autocorrelation(v, lags), autocorrelation(past, lags)
        sd = np.sqrt((1.0 + 2.0 * (a[1:] @ b[1:])) / seen.sum())
        assert correlation == pytest.approx(expected, rel=1e-10)
        assert p == pytest.approx(2.0 * scipy.stats.norm.sf(abs(expected) / sd), rel=1e-8)


def test_a_signal_that_is_zero_follows_nothing():
    for u, e in ((np.zeros(50), np.ones(50)), (np.ones(50), np.zeros(50))):
        found = correlations_with_sums(u, e[:, None], [(1, 1)])
        assert (found.p_value[0, 0], found.correlation[0, 0]) == (1.0, 0.0)


def test_blocks_as_long_as_the_record_are_as_by_hand():
    u, e = np.random.default_rng(1).standard_normal((2, 30))
    found = correlations_with_sums(u, np.stack([e, 2.0 * e], axis=1), [(3, 14)])
    past = np.array([sum(e[t - k] for k in range(3, 15)) if t >= 14 else 0.0 for t in range(30)])
    expected = u @ past / np.sqrt(u @ u * (past @ past))
    a, b = autocorrelation(u, 29), autocorrelation(past, 29)
    sd = np.sqrt(max(1.0 + 2.0 * (a[1:] @ b[1:]), 0.1) / 30)
    np.testing.assert_allclose(found.correlation[:, 0], expected, rtol=1e-10)
    np.testing.assert_allclose(
        found.p_value[:, 0], 2.0 * scipy.stats.norm.sf(abs(expected) / sd), rtol=1e-8
    )
