"""Standard deviations under autocorrelated residuals: closed forms of AR(1) noise."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax.identification.uncertainty.autocorrelated_residuals import drawn, sandwich

N, DT = 20000, 0.01


def case(r, J):
    """Return the parts of layout, data and evaluation that the correction uses.

    r is NaN if nothing is measured.
    """
    k, n = r.shape
    flight = SimpleNamespace(dt=DT, outputs={str(i): r[i] for i in range(k)})
    layout = SimpleNamespace(outputs=(tuple(str(i) for i in range(k)),))
    rows = J.reshape(k * n, -1)
    return layout, SimpleNamespace(flights=(flight,)), SimpleNamespace(r=r.ravel(), J=rows)


def inflation(layout, data, e):
    return sandwich(layout, data, e).inflation


def ar1(rho, seed=0, n=N):
    rng = np.random.default_rng(seed)
    return scipy.signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], rng.standard_normal(n))


def test_white_residuals_change_little():
    J = np.stack([np.ones(N), np.sin(0.01 * np.arange(N))], axis=1)[None]
    r = np.random.default_rng(1).standard_normal((1, N))
    np.testing.assert_allclose(inflation(*case(r, J)), 1.0, atol=0.25)


@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_a_mean_under_ar1_noise(rho):
    """Test the mean of AR(1) noise: (1 + rho)/(1 - rho) times the white variance."""
    wanted = np.sqrt((1 + rho) / (1 - rho))
    # One record determines the autocorrelation to about a fifth; the mean over several is closer.
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


def test_only_slow_effects_suffer_from_slow_noise():
    rho, rng = 0.95, np.random.default_rng(5)
    r = ar1(rho)[None]
    J = np.stack([np.ones((1, N)), rng.standard_normal((1, N))], axis=-1)
    layout, data, e = case(r, J)
    parts = inflation(layout, data, e)
    # The first column is the mean, which is affected; the second is white and is not.
    assert parts[0] > 4.0
    assert parts[1] == pytest.approx(1.0, abs=0.3)


def test_deviations_and_intervals_hold_with_missing_samples():
    """Test a line and slow waves fitted to AR(0.9) noise of 60 s.

    The sd is 0.9 to 1.1 of the real one, and 95 % of the intervals cover.
    """
    n, runs, rho = 3000, 200, 0.9
    t = np.linspace(-1.0, 1.0, n)
    columns = [np.ones(n), t, *(f(w * t) for w in (40.0, 130.0) for f in (np.sin, np.cos))]
    whole = np.stack(columns, axis=1)
    rng = np.random.default_rng(6)
    errors, sds, quantiles = [], [], []
    for seed in range(runs):
        seen = rng.uniform(size=n) < 0.5
        J = np.where(seen[:, None], whole, 0.0)
        y = np.where(seen, ar1(rho, seed, n), 0.0)
        estimate, *_ = np.linalg.lstsq(J, y, rcond=None)
        r = np.where(seen, y - J @ estimate, np.nan)
        layout, data, e = case(r[None], J[None])
        e.r = np.nan_to_num(e.r)
        found = sandwich(layout, data, e)
        errors.append(estimate)
        sds.append(found.inflation * np.sqrt(np.diag(np.linalg.inv(J.T @ J))))
        quantiles.append(found.quantile)
    errors, sds, quantiles = np.array(errors), np.array(sds), np.array(quantiles)
    # The mean over six columns, since the sd of one over 200 runs is known to only 5 %.
    ratio = np.median(sds, axis=0) / np.sqrt(np.mean(errors**2, axis=0))
    assert 0.9 < np.exp(np.mean(np.log(ratio))) < 1.1
    assert 0.925 < np.mean(np.abs(errors) < quantiles * sds) < 0.975


def test_few_independent_parts_want_a_larger_quantile():
    slow = ar1(0.99, 3, 2000)
    layout, data, e = case(slow[None], np.ones((1, 2000, 1)))
    assert sandwich(layout, data, e).quantile[0] > 2.1
    layout, data, e = case(ar1(0.0, 3)[None], np.ones((1, N, 1)))
    assert sandwich(layout, data, e).quantile[0] == pytest.approx(1.96, abs=0.01)


def test_residuals_and_effects_of_any_size_have_the_same_intervals():
    """Test that no square overflows (warnings are errors) and that units change nothing else."""
    J = np.stack([np.ones(400), np.sin(0.01 * np.arange(400))], axis=1)[None]
    r = ar1(0.9, n=400)[None]
    plain = sandwich(*case(r, J))
    for noise, effect in ((1e60, 1.0), (1e-80, 1.0), (1.0, 1e-80), (1e60, 1e90)):
        found = sandwich(*case(noise * r, effect * J))
        np.testing.assert_allclose(found.inflation, noise * plain.inflation, rtol=1e-9)
        np.testing.assert_allclose(found.quantile, plain.quantile, rtol=1e-5)
    for nothing in (0.0 * r, np.eye(1, 400, 200)):
        found = sandwich(*case(nothing, J))
        assert np.all(np.diag(found.covariance) >= 0.0)
        assert np.isfinite(found.quantile).all()


def test_two_flights_are_independent():
    r = ar1(0.9)
    whole = inflation(*case(r[None], np.ones((1, N, 1))))[0]
    half, other = np.split(r, 2)
    flights = [SimpleNamespace(dt=DT, outputs={"0": part}) for part in (half, other)]
    layout = SimpleNamespace(outputs=(("0",), ("0",)))
    e = SimpleNamespace(r=r, J=np.ones((N, 1)))
    found = sandwich(layout, SimpleNamespace(flights=tuple(flights)), e).inflation[0]
    assert found == pytest.approx(whole, rel=0.1)


def test_curvature_of_the_residuals_widens():
    """Test a Hessian of half of J'J, which moves the estimate twice as far for equal residuals."""
    rng = np.random.default_rng(2)
    r = rng.standard_normal(N)
    J = np.ones((1, N, 1))
    layout, data, e = case(r[None], J)
    plain = sandwich(layout, data, e).inflation[0]
    halved = sandwich(layout, data, e, np.array([[-0.5 * N]])).inflation[0]
    assert halved == pytest.approx(2.0 * plain, rel=1e-9)


@pytest.mark.parametrize("missing", [False, True], ids=["whole", "half missing"])
def test_noise_is_drawn_with_the_covariance_of_the_residuals(missing):
    """Test two outputs: the second is the first one sample later, with separate noise."""
    rng = np.random.default_rng(8)
    slow = ar1(0.9, 4, N + 1)
    residual = np.stack([slow[1:], 2.0 * slow[:-1] + rng.standard_normal(N)])
    if missing:
        residual[:, rng.uniform(size=N) < 0.5] = np.nan
    made = drawn(residual, 20, rng)
    assert made.shape == (20, 2, N)
    np.testing.assert_allclose(made.std(axis=(0, 2)), np.nanstd(residual, axis=1), rtol=0.03)
    for lag in (1, 5, 20):
        theory = 0.9**lag
        found = np.mean(made[:, 0, lag:] * made[:, 0, :-lag]) / np.mean(made[:, 0] ** 2)
        assert found == pytest.approx(theory, abs=0.06)
    # E[first(t - 1) second(t)] is twice the variance.
    cross = np.mean(made[:, 0, :-1] * made[:, 1, 1:]) / np.mean(made[:, 0] ** 2)
    assert cross == pytest.approx(2.0, rel=0.06)
