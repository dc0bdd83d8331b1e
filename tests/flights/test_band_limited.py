"""Resampling to a lower rate: lower frequencies remain, higher ones do not fold."""

import numpy as np
import pytest

from heli_jax.flights.resample import decimate

FS, NEW = 200, 50


def logged(jitter, lost, n=40 * FS):
    rng = np.random.default_rng(1)
    t = np.arange(n) / FS + rng.uniform(-jitter, jitter, n) / FS
    return t[rng.random(n) >= lost]


def new_times(t):
    times = np.arange(int(39 * NEW)) / NEW + 0.3
    return times[(times > t[0]) & (times < t[-1])]


@pytest.mark.parametrize(("jitter", "lost"), [(0.0, 0.0), (0.2, 0.05)])
def test_a_chirp_comes_back(jitter, lost):
    t = logged(jitter, lost)
    times = new_times(t)

    def chirp(s):
        return 3 + np.sin(2 * np.pi * (0.1 * s + 9.9 / 80 * s**2))  # 0.1 to 10 Hz in 40 s

    error = decimate(t, chirp(t), times) - chirp(times)
    assert np.sqrt(np.mean(error**2)) < 0.005 * np.sqrt(0.5)


@pytest.mark.parametrize(
    ("jitter", "lost", "tones"), [(0, 0, (26, 40, 60, 75, 97)), (0.2, 0.05, (26, 40, 60, 70))]
)
def test_what_the_new_rate_cannot_hold_folds_nowhere(jitter, lost, tones):
    t = logged(jitter, lost)
    for tone in tones:
        left = decimate(t, np.sin(2 * np.pi * tone * t), new_times(t))[50:-50]
        assert 20 * np.log10(np.std(left) * np.sqrt(2)) < -60, tone


def test_lines_stay_lines_to_their_ends():
    t = logged(0.2, 0.05, 2000)
    times = np.arange(t[0], t[-1], 1 / NEW)
    np.testing.assert_allclose(decimate(t, 5 + 3 * t, times), 5 + 3 * times, atol=1e-3)


def test_missing_samples_are_bridged_while_few():
    t = np.arange(2000) / FS
    x = np.sin(2 * np.pi * t)
    x[1000:1003] = np.nan
    x[400:460] = np.nan  # 0.3 s
    times = np.arange(450) / NEW
    y = decimate(t, x, times)
    inside = (times > 399 / FS) & (times < 460 / FS)
    assert np.all(np.isnan(y[inside]))
    far = np.abs(times - 2.15) > 1.0
    np.testing.assert_allclose(y[far], np.sin(2 * np.pi * times[far]), atol=2e-3)
    assert np.all(np.isnan(decimate(t, np.full(2000, np.nan), times)))


@pytest.mark.parametrize(("jitter", "lost"), [(0.2, 0.05), (0.0, 0.2), (0.45, 0.2)])
def test_noise_passes_as_the_filter_lets_it(jitter, lost):
    """Test white noise of sd 1 at 200 Hz, which has 0.47 at 50 Hz, also with lost samples."""
    rng = np.random.default_rng(5)
    t = (np.arange(6000) + jitter * rng.uniform(-1.0, 1.0, 6000)) / 200.0
    t = t[rng.random(6000) > lost]
    noise = rng.standard_normal(t.size)
    at = t[0] + 0.02 + np.arange(1450) / 50.0
    found = decimate(t, noise, at)
    assert 0.4 < np.nanstd(found) < 0.6
    assert np.nanmax(np.abs(found)) < 3.0
    # A slow motion below the noise is unchanged within the remaining noise.
    moved = decimate(t, np.sin(2.0 * np.pi * t) + 0.01 * noise, at)
    assert np.nanstd(moved - np.sin(2.0 * np.pi * at)) < 0.008
