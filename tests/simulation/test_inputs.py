"""Stick inputs: amplitudes, holds and frequencies."""

import math

import numpy as np
import pytest

from heli_jax.config import StickConfig
from heli_jax.simulation.inputs import (
    KINDS,
    ardupilot_chirp,
    betaflight_chirp,
    chirp,
    excitation,
    multisine,
    multistep,
    prbs,
    random_steps,
)


def lengths(u):
    """Return the number of samples of each level."""
    ends = np.flatnonzero(np.diff(u)) + 1
    return np.diff([0, *ends, u.size])


@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_random_steps(dt):
    u = random_steps(5000, dt, np.random.default_rng(1), (0.2, 1.5))
    assert u.shape == (5000,)
    assert np.abs(u).max() <= 1.0
    held = lengths(u)[:-1] * dt
    assert held.min() >= 0.2 - 0.5 * dt - 1e-12
    assert held.max() <= 1.5 + 0.5 * dt + 1e-12
    again = random_steps(5000, dt, np.random.default_rng(1), (0.2, 1.5))
    np.testing.assert_array_equal(u, again)


def test_3211():
    u = multistep(1000, 0.02, np.random.default_rng(0), 0.1, 1.0)
    assert set(np.unique(u)) == {-1.0, 0.0, 1.0}
    assert list(lengths(u)[:6]) == [50, 15, 10, 5, 5, 50]
    first = u[50:85]
    assert first[0] * first.sum() == pytest.approx(5.0)  # 3 - 2 + 1 - 1 units of 5 samples


def test_sweep_runs_from_low_to_high():
    n, dt, low, high = 20_000, 0.001, 0.5, 20.0
    u = chirp(n, dt, low, high)
    assert u[0] == 0.0
    assert np.abs(u).max() == pytest.approx(1.0, abs=1e-3)
    up = np.flatnonzero((u[:-1] < 0) & (u[1:] >= 0)) * dt
    assert 1.0 / (up[-1] - up[-2]) == pytest.approx(high, rel=0.03)
    # Integral of an exponential frequency: (high - low) T / ln(high / low) turns.
    assert len(up) == pytest.approx((high - low) * n * dt / np.log(high / low), abs=2)


def test_a_chirp_fades():
    u, whole = chirp(3000, 0.01, 0.1, 2.0, fade=3.0), chirp(3000, 0.01, 0.1, 2.0)
    t = np.arange(3000) * 0.01
    np.testing.assert_array_equal(u[300:-300], whole[300:-300])
    assert np.all(np.abs(u) <= np.minimum(t, t[-1] - t) / 3.0 + 1e-12)


def test_a_binary_sequence_has_the_autocorrelation_of_one_of_maximum_length():
    # 2^9 - 1 levels, one period: minus one over the length beside the peak.
    u = prbs(511, 0.01, np.random.default_rng(0), 0.01)
    assert set(np.unique(u)) == {-1.0, 1.0}
    periodic = np.fft.ifft(np.abs(np.fft.fft(u)) ** 2).real / u.size
    np.testing.assert_allclose(periodic[1:], -1.0 / u.size, atol=1e-12)


def test_a_multisine_has_a_low_crest_factor():
    u = multisine(2000, 0.01, (0.05, 1.0))
    power = np.abs(np.fft.rfft(u)) ** 2
    lines = np.flatnonzero(power > 1e-9 * power.max())
    assert lines.tolist() == list(range(1, 21))
    np.testing.assert_allclose(power[lines], power[1], rtol=1e-9)
    assert np.max(np.abs(u)) == 1.0
    assert 1.0 / np.sqrt(np.mean(u**2)) < 1.45
    with pytest.raises(ValueError, match="band"):
        multisine(200, 0.01, (0.1, 0.3))


def test_multisines_of_several_inputs_are_orthogonal():
    each = np.array([multisine(2000, 0.01, (0.1, 1.5), (k, 3)) for k in range(3)])
    products = each @ each.T
    size = np.sqrt(np.diag(products))
    np.testing.assert_allclose(products / np.outer(size, size), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("kind", [k.name for k in KINDS])
def test_every_kind_keeps_its_limits(kind):
    assert StickConfig(kind=kind, amplitude=1.0).kind == kind
    rng = np.random.default_rng(0)
    settings = {**dict(StickConfig(amplitude=1.0, band=(0.2, 2.0))), "place": (0, 1)}
    u = excitation(kind, 2000, 0.01, rng, settings, amplitude=0.3, rate=1.5)
    assert u.shape == (2000,)
    assert np.max(np.abs(u)) <= 0.3 + 1e-12
    assert np.max(np.abs(np.diff(u))) <= 1.5 * 0.01 + 1e-12
    if kind != "neutral" and "chirp" not in kind and kind != "multisine":
        assert np.max(np.abs(u)) > 0.25


def test_ardupilots_chirp():
    # `Chirp::update`, sample by sample.
    n, dt, low, high, fade = 1000, 0.01, 0.5, 5.0, 0.4
    u, record, dwell = ardupilot_chirp(n, dt, (low, high), fade), n * dt, 2.0 / low
    first, B = 2 * math.pi * low, math.log(high / low)
    for k in range(1, n):
        t = k * dt
        window = 1.0
        if t <= fade:
            window = 0.5 - 0.5 * math.cos(math.pi * t / fade)
        elif t > record - fade:
            window = 0.5 - 0.5 * math.cos(math.pi * (t - (record - fade)) / fade + math.pi)
        if t <= dwell:
            expected = math.sin(first * t - first * dwell)
        else:
            rise = math.exp(B * (t - dwell) / (record - dwell)) - 1
            expected = math.sin(first * (record - dwell) / B * rise)
        assert u[k] == pytest.approx(window * expected, abs=1e-9)
    assert u[0] == 0.0
    with pytest.raises(ValueError, match="two periods"):
        ardupilot_chirp(300, 0.01, (0.5, 5.0), 0.0)


def test_betaflights_chirp():
    # `chirpUpdate`, sample by sample; the last part of a second is not played.
    n, dt, low, high = 550, 0.01, 0.5, 5.0
    u, beta = betaflight_chirp(n, dt, (low, high)), (high / low) ** (1 / 5.0)
    for k in range(n):
        frequency = low * beta ** (k * dt)
        k0 = 2 * math.pi / math.log(beta)
        expected = math.cos(k0 * frequency - k0 * low) * min(frequency, 1.0)
        assert u[k] == pytest.approx(expected if k < 500 else 0.0, abs=1e-9)
