"""Errors that windows add to responses at the ends of parts between missing samples."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, flight_responses
from heli_jax.analysis.spectra import OVERLAP, cross_spectra
from heli_jax.report.responses import useful_band

DT, N = 0.02, 6000
B, A, _ = scipy.signal.cont2discrete(([80.0], [1.0, 5.0, 40.0]), DT)


def swept(noise: float, gaps: int) -> Flight:
    """Return a sweep of 120 s with missing parts of half a second."""
    rng = np.random.default_rng(4)
    t = DT * np.arange(N)
    u = scipy.signal.chirp(t, 0.15, t[-1], 6.0, "logarithmic", -90)
    y = scipy.signal.lfilter(B.ravel(), A, u) + noise * rng.standard_normal(N)
    for at in (np.arange(gaps) + rng.uniform(0.2, 0.8, gaps)) * N / max(gaps, 1):
        y[round(at) : round(at) + 25] = np.nan
    return Flight(dt=DT, inputs={"lat": u}, outputs={"p": y}, hold={"lat": "zero-order"})


@pytest.mark.parametrize(("gaps", "noise"), [(0, 0.02), (3, 0.2), (9, 0.2)])
def test_between_missing_samples_intervals_hold_the_truth(gaps, noise):
    """Test coverage: with the ends included, a tenth of the bins lies outside."""
    found = flight_responses([swept(noise, gaps)], Settings((0.3, 5.0), 10.0))
    pair = found.outputs["p"].pairs["lat"]
    off = pair.H - scipy.signal.freqz(B.ravel(), A, found.omega * DT)[1]
    assert isinstance(pair.added, np.ndarray)
    inside, with_ends = (
        np.abs(np.stack([e.real, e.imag])) < pair.half95 * pair.sd for e in (off, off + pair.added)
    )
    assert np.mean(inside) > 0.93
    assert np.mean(with_ends) < 0.9 or not gaps


@pytest.mark.parametrize(
    ("how", "size"), [("linear", 0.2), ("linear", 0.01), ("logarithmic", 0.01)]
)
def test_where_the_sweep_begins_in_a_long_window_errors_do_not_grow(how, size):
    """Test four sweeps of 60 s in windows of 24 s.

    Slow frequencies are at the windows' ends. There the correction of an uncertain response is
    noise. With little noise the error is what a straight line does not remove, also beyond the
    sweep's last frequency.
    """
    t = DT * np.arange(3000)
    u = scipy.signal.chirp(t, 0.15, t[-1], 5.0, how, -90)
    answer, inside = scipy.signal.lfilter(B.ravel(), A, u), []
    for seed in range(8 if size > 0.1 else 2):
        noise = size * np.random.default_rng(seed).standard_normal((4, t.size))
        flights = [Flight(dt=DT, inputs={"lat": u}, outputs={"p": answer + e}) for e in noise]
        found = flight_responses(flights, Settings(window=24.0))
        pair = found.outputs["p"].pairs["lat"]
        off = np.abs(pair.H) - np.abs(scipy.signal.freqz(B.ravel(), A, found.omega * DT)[1])
        seen = np.isfinite(off)
        inside.append(np.mean(np.abs(off[seen]) < pair.half95 * pair.sd[seen]))
    # It was 83 % if errors grow from round to round, or if a whole response is taken for its value
    # at one frequency.
    assert np.mean(inside) > 0.93


@pytest.mark.parametrize("seconds", [6.0, 60.0])
def test_of_one_sine_intervals_hold_the_truth_and_no_band_is_usable_but_around_it(seconds):
    """Test a sine, which the window spreads over its main lobe.

    At most half of the lobe is within errors from noise alone.
    """
    t, rng = DT * np.arange(round(seconds / DT)), np.random.default_rng(1)
    u = np.sin(2.0 * np.pi * 3.4 * t)
    y = scipy.signal.lfilter(B.ravel(), A, u) + 0.01 * rng.standard_normal(t.size)
    found = flight_responses([Flight(dt=DT, inputs={"lat": u}, outputs={"p": y})])
    pair = found.outputs["p"].pairs["lat"]
    off = pair.H - scipy.signal.freqz(B.ravel(), A, found.omega * DT)[1]
    seen = np.isfinite(off)
    held = np.abs(np.stack([off.real, off.imag]))[:, seen] < (pair.half95 * pair.sd)[seen]
    assert np.mean(held) > 0.9
    low, high = (float(hz) for hz in useful_band(found.omega, pair)[1:])
    lines = (np.array([low, high]) - 3.4) * found.window
    assert np.all(np.abs(lines) < 0.6)


@pytest.mark.parametrize("n", [99, 100])
def test_spectra_in_a_window_and_in_its_slope_are_those_of_scipy(n):
    rng = np.random.default_rng(0)
    x, w = 7.0 + rng.standard_normal((2, 500)), np.array([3.0, 7.5])
    found = cross_spectra([x], DT, w, n * DT, OVERLAP, sloped=1)
    at = np.arange(n)
    window = scipy.signal.windows.hann(n, sym=False)
    slope = np.gradient(scipy.signal.windows.hann(64 * n, sym=False), DT / 64)[::64]
    starts = range(0, 500 - n + 1, round(n * (1.0 - OVERLAP)))
    parts = [x[:, s : s + n] - x[:, s : s + n].mean(axis=1, keepdims=True) for s in starts]
    turns = np.exp(-1j * np.outer(at, w * DT))
    S = [np.conj((p * window) @ turns) * ((p[:1] * slope) @ turns) for p in parts]
    density = 2.0 * DT / np.sum(window**2)
    assert found.steep is not None
    slopes = np.einsum("kwc,kw->kc", np.conj(found.X), found.steep[:, :, 0]) / len(parts)
    np.testing.assert_allclose(slopes.T, density * np.mean(S, axis=0), rtol=2e-3)
    S = [np.conj((p * window) @ turns) * ((p[1] * window) @ turns) for p in parts]
    np.testing.assert_allclose(found.density[:, :, 1].T, density * np.mean(S, axis=0), rtol=1e-10)
