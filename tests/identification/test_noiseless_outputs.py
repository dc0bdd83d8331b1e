"""Outputs that were low-passed before the log are named, those with a sensor's noise are not."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax.flights.flight import Flight
from heli_jax.identification.diagnostics.quality import smoothed
from heli_jax.numerics.white_noise import highest_frequency

DT, N = 0.01, 3000


def filtered(y, hz):
    """As a sensor's own filter does: second order, forwards."""
    return np.asarray(scipy.signal.sosfilt(scipy.signal.butter(2, hz, fs=1 / DT, output="sos"), y))


def rate(rng, noise):
    """Two lags of random accelerations, logged with noise or without."""
    p = filtered(rng.standard_normal(N), 1.0)
    return p + noise * np.std(p) * rng.standard_normal(N)


def low_passed(y, hz):
    """As smoothed after the flight: both ways, far down at ten times the corner."""
    return scipy.signal.sosfiltfilt(scipy.signal.butter(4, hz, fs=1 / DT, output="sos"), y)


def found_of(process_noise, **outputs):
    flight = Flight(dt=DT, inputs={"lat": np.zeros(N)}, outputs=outputs)
    layout = SimpleNamespace(noise_model="disturbance" if process_noise else "white")
    asked = SimpleNamespace(flights=[("flight 1", flight)], at=SimpleNamespace(layout=layout))
    return list(smoothed(asked))


def test_a_low_passed_log_is_named_with_its_band():
    p = low_passed(rate(np.random.default_rng(0), 0.05), 2.2)
    [found] = found_of(False, p=p)
    assert found.severity == "note"
    # SciPy's own spectrum says below which frequency all but a thousandth of the power lies.
    f, power = scipy.signal.periodogram(p, 1 / DT, window="hann", detrend="linear")
    band = f[np.searchsorted(np.cumsum(power), 0.999 * np.sum(power))]
    assert highest_frequency(p, DT) == pytest.approx(band, rel=0.15)
    [by_filter] = found_of(True, p=p)
    assert by_filter.bad


@pytest.mark.parametrize("noise", [0.003, 0.02, 0.2])
def test_a_sensor_with_noise_is_not_named(noise):
    """Nor one behind a filter of its own that leaves its noise in the band that is logged."""
    rng = np.random.default_rng(4)
    p = rate(rng, noise)
    q = filtered(rate(rng, noise), 20.0)
    assert found_of(True, p=p, q=q) == []


def test_a_band_is_that_of_a_sine_and_of_gaps_nothing_is_said():
    t = DT * np.arange(N)
    y = np.sin(2 * np.pi * 3.3 * t) + 0.5 * np.sin(2 * np.pi * 0.2 * t)
    assert highest_frequency(y, DT) == pytest.approx(3.3, abs=0.15)
    y[100:1000] = np.nan
    assert highest_frequency(y, DT) is None
