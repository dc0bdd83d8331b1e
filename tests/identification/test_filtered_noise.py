"""Sensor noise that passed an on-board low-pass, by filter error."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from heli_jax import Free, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.flights.flight import Flight
from heli_jax.models import Filter, with_filters

ROLL = """
name: rotor-roll
states: {p: rad/s, b: rad}
inputs: {lat: "1"}
outputs: {p: rad/s}
parameters:
  Lb: {value: 120, unit: 1/s^2}
  tau_f: {value: 0.06, unit: s, positive: true}
  Blat: {value: 0.14, unit: rad}
A: {p: {b: Lb}, b: {p: -1, b: -1/tau_f}}
B: {b: {lat: Blat/tau_f}}
axes: {roll: {rate: p, stick: lat, flapping: [b]}}
"""
FINE, EVERY = 1e-3, 10


@pytest.fixture(scope="module")
def roll(tmp_path_factory):
    path = tmp_path_factory.mktemp("roll") / "roll.yaml"
    path.write_text(ROLL)
    return linear_model(path)


def record(seed: int, hz: float, behind: float) -> Flight:
    """Return 30 s in gusts, with the gyro's white noise at 1 kHz before a pt1, logged at 100 Hz."""
    rng = np.random.default_rng(seed)
    n = 30_000
    lat = np.repeat(rng.choice([-0.5, 0.0, 0.5], 60), 500)
    a = np.exp(-FINE / 0.5)
    gust = 2.0 * scipy.signal.lfilter([np.sqrt(1 - a * a)], [1, -a], rng.normal(size=n))
    A = np.array([[0, 120.0], [-1, -1 / 0.06]])
    B = np.array([[0, 1.0], [0.14 / 0.06, 0]])
    M = scipy.linalg.expm(FINE * np.block([[A, B], [np.zeros((2, 4))]]))
    sampled = scipy.signal.dlti(M[:2, :2], M[:2, 2:], np.eye(1, 2), np.zeros((1, 2)), dt=FINE)
    p = scipy.signal.dlsim(sampled, np.stack([lat, gust], axis=1))[1][:, 0]
    c = 1 - np.exp(-2 * np.pi * hz * FINE)
    logged = scipy.signal.lfilter([0, c], [1, c - 1], p + 0.15 * rng.normal(size=n))
    logged += behind * rng.normal(size=n)
    return Flight(FINE * EVERY, {"lat": lat[::EVERY]}, {"p": logged[::EVERY]})


def problem(roll, flight: Flight, hz: float) -> Problem:
    model = with_disturbance(with_filters(roll.model, {"p": [Filter("pt1", hz)]}), "roll")
    free = {"Lb": Free(80.0), "tau_f": Free(0.09), "Blat": Free(0.1)}
    params = {n: float(getattr(roll.vehicle().params, n)) for n in free}
    return Problem(model, model.Params(**params), [flight], free, method="filter-error")


@pytest.mark.parametrize(
    ("filters", "zeros", "poles", "gain"),
    [
        ([Filter("pt1", 10.0)], [], [-62.83], 62.83),
        ([Filter("biquad", 10.0)], *scipy.signal.butter(2, 62.83, analog=True, output="zpk")),
        ([Filter("pt2", 10.0)], [], [-62.83 * 1.5538] * 2, (62.83 * 1.5538) ** 2),
        (
            [Filter("pt1", 10.0), Filter("notch", 25.0, 2.0)],
            [157.08j, -157.08j],
            [-62.83, *np.roots([1, 157.08 / 2, 157.08**2])],
            62.83,
        ),
    ],
)
def test_white_noise_before_the_filters_has_its_sd_behind_them(roll, filters, zeros, poles, gain):
    [low_pass] = with_filters(roll.model, {"p": filters}).low_passes

    def power(omega: float) -> float:
        return abs(scipy.signal.freqs_zpk(zeros, poles, gain, [omega])[1][0]) ** 2 / np.pi

    variance = scipy.integrate.quad(power, 0, 600, limit=300)[0]
    variance += scipy.integrate.quad(power, 600, np.inf)[0]
    rate = filters[0].kind == "biquad"
    first = abs(poles[0]) ** (2 if rate else 1)
    assert low_pass.intensity == pytest.approx(first / np.sqrt(variance), rel=2e-4)
    assert low_pass.state == ("p_filter1_rate" if rate else "p_filter1")
    assert low_pass.hz == pytest.approx(10.0, rel=2e-2)


@pytest.mark.slow
def test_noise_before_a_slow_filter_is_no_gust_and_no_faster_rotor(roll):
    # Taken as white after the filter, it gave Lb 129, tau_f 0.045, sd 0.005.
    found = fit(problem(roll, record(2, 10.0, 5e-4), 10.0))
    assert found.adequate is True
    for name, true in (("Lb", 120.0), ("tau_f", 0.06), ("Blat", 0.14)):
        estimate = found.estimates[name]
        assert estimate.lower95 < true < estimate.upper95, name
    noise = found.nuisance["sigma_n_p"]
    c = 1 - np.exp(-2 * np.pi * 10 * FINE)
    true = 0.15 * np.sqrt(c / (2 - c))
    # In its own unit it is known, although the noise after the filter is almost zero.
    assert noise.sd < 0.03 * true
    assert abs(noise.value - true) < 3 * noise.sd


def test_it_is_unknown_only_where_the_samples_bear_it_out(roll):
    assert problem(roll, record(2, 10.0, 5e-4), 10.0).filtered_noise
    # White noise of the same size is added, which dominates the fastest differences.
    assert problem(roll, record(2, 10.0, 0.027), 10.0).filtered_noise
    # White after the filter, at a rate near its cut-off, or with the noise given.
    assert not problem(roll, record(2, 10.0, 0.3), 10.0).filtered_noise
    assert not problem(roll, record(2, 40.0, 5e-4), 40.0).filtered_noise
