"""Metrics of agreement and whiteness against their definitions."""

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from heli_jax.identification.validation.metrics import metrics, whiteness
from heli_jax.numerics.white_noise import noise_guess

SIGNAL = np.sin(0.1 * np.arange(500))


@given(st.floats(-2.0, 2.0), st.floats(0.1, 3.0), st.floats(1e-3, 1.0))
def test_theils_parts_make_one(shift, factor, noise):
    rng = np.random.default_rng(0)
    m = metrics(SIGNAL, shift + factor * SIGNAL + noise * rng.standard_normal(500))
    assert m.bias + m.variance + m.covariance == pytest.approx(1.0)
    assert min(m.bias, m.variance, m.covariance) > -1e-12


def test_theils_parts_name_the_error():
    assert metrics(SIGNAL, SIGNAL + 1.0).bias == pytest.approx(1.0)
    centred = SIGNAL - SIGNAL.mean()
    assert metrics(centred, 2.0 * centred).variance == pytest.approx(1.0)
    rng = np.random.default_rng(1)
    noisy = metrics(SIGNAL, SIGNAL + 0.01 * rng.standard_normal(500))
    assert noisy.covariance > 0.95


def test_missing_samples_are_left_out():
    rng = np.random.default_rng(2)
    model = SIGNAL + 0.1 * rng.standard_normal(500)
    gone = rng.uniform(size=500) < 0.2
    assert metrics(np.where(gone, np.nan, SIGNAL), model) == metrics(SIGNAL[~gone], model[~gone])
    noise = rng.standard_normal(5000)
    noise[::7] = np.nan
    assert whiteness(noise).white
    assert not whiteness(np.cumsum(np.nan_to_num(noise))).white
    # With several outputs, each threshold allows for their number.
    alone = 1.0 - whiteness(noise).p_value
    assert whiteness(noise, 50).p_value == pytest.approx(1.0 - alone**50)
    smooth = np.sin(0.01 * np.arange(5000)) + 0.01 * np.nan_to_num(noise)
    smooth[::7] = np.nan
    assert noise_guess(smooth) == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(
    ("missing", "rho", "seen"), [("every second", 0.4, 120), ("a random half", 0.25, 150)]
)
def test_whiteness_is_judged_on_the_pairs_that_are_seen(missing, rho, seen):
    """Test that white noise fails in 2 to 3 % of records, and AR(1) noise is found."""
    n, alarms, found = 2000, 0, 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        gone = np.arange(n) % 2 == 1 if missing == "every second" else rng.uniform(size=n) < 0.5
        noise = rng.standard_normal(n)
        alarms += not whiteness(np.where(gone, np.nan, noise)).white
        slow = scipy.signal.lfilter([1.0], [1.0, -rho], noise)
        found += not whiteness(np.where(gone, np.nan, slow)).white
    assert alarms <= 9
    assert found >= seen


def test_a_whole_record_is_judged_as_by_ljung_and_box():
    noise = np.random.default_rng(3).standard_normal(400)
    centred = noise - noise.mean()
    r = np.array([centred[k:] @ centred[:-k] for k in range(1, 101)]) / (centred @ centred)
    q = 400 * 402 * np.cumsum(r**2 / (400 - np.arange(1, 101)))
    # Its variance is (1 + 2.2 lags / 400) times 2 * lags.
    wide = {lags: 1.0 + 2.2 * lags / 400 for lags in (20, 100)}
    p = [scipy.stats.gamma.sf(q[k - 1], k / (2 * w), scale=2 * w) for k, w in wide.items()]
    found = whiteness(noise)
    assert found.p_value == pytest.approx(1.0 - (1.0 - min(p)) ** 2, rel=1e-9)
    assert found.lag1 == pytest.approx(r[0], rel=1e-9)
    assert found.outside == np.mean(np.abs(r) > 2.5758 / np.sqrt(400))


def test_a_constant_signal_has_no_motion_to_explain():
    # 0.1 has no exact binary form: its mean differs by rounding, which is not motion.
    m = metrics(np.full(1000, 0.1), np.full(1000, 0.2))
    assert np.isnan(m.vaf)
    assert np.isnan(m.nrmse_fit_percent)
    assert m.rmse == pytest.approx(0.1)


def test_free_initial_states_of_short_windows_do_not_colour_residuals_of_a_right_model():
    """Test windows of 25 samples of an oscillator, with free states projected out by QR."""
    n, window, rng = 1500, 25, np.random.default_rng(6)
    t = 0.02 * np.arange(window)
    free = np.exp(-0.4 * t) * np.stack([np.cos(4.5 * t), np.sin(4.5 * t)])
    U = np.linalg.qr(np.kron(np.eye(n // window), free.T))[0]
    alarms, plain, found = 0, 0, 0
    for _ in range(100):
        noise = rng.standard_normal(n)
        slow = np.convolve(noise, 0.3 ** np.arange(8))[:n]
        left, coloured = (e - U @ (U.T @ e) for e in (noise, slow))
        plain += not whiteness(left).white
        alarms += not whiteness(left, fitted=U).white
        found += not whiteness(coloured, fitted=U).white
    assert alarms <= 2
    assert plain > 50
    assert found > 95


def test_white_records_fail_the_whiteness_test_one_time_in_a_hundred():
    # By chi-squared with as many degrees of freedom as lags, 3 % of such records failed.
    rng = np.random.default_rng(5)
    failed = sum(not whiteness(rng.standard_normal(400)).white for _ in range(1500))
    assert 5 <= failed <= 28
