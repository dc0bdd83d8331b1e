"""Intervals by the likelihood where all sizes are relative to a noise that is next to nothing."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from heli_jax import Free, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.flights.flight import Flight
from heli_jax.models import Filter, with_filters

FINE, EVERY, N = 5e-4, 10, 60_000
TRUE = {"Lb": 140.0, "tau_f": 0.06, "Blat": 0.12}


def filtered(x: np.ndarray) -> np.ndarray:
    """Through a pt2 of 20 Hz."""
    a = 1 - np.exp(-2 * np.pi * 20 / np.sqrt(np.sqrt(2) - 1) * FINE)
    return np.asarray(scipy.signal.lfilter([a * a], np.poly([1 - a, 1 - a]), x))


def record() -> Flight:
    """Roll in gusts for 30 s, the gyro's noise before a pt2, logged at 200 Hz."""
    rng = np.random.default_rng(100)
    t, lat, at = np.arange(N // EVERY) * FINE * EVERY, np.zeros(N // EVERY), 0.0
    while at < t[-1]:
        held, value = rng.uniform(0.3, 1.5), rng.uniform(-0.3, 0.3)
        lat[(t >= at) & (t < at + held)] = value
        at += held
    a = np.exp(-FINE / 0.5)
    gust = scipy.signal.lfilter([np.sqrt(1 - a * a)], [1, -a], rng.standard_normal(N))
    A = np.array([[0, TRUE["Lb"]], [-1, -1 / TRUE["tau_f"]]])
    B = np.array([[0, 1.0], [TRUE["Blat"] / TRUE["tau_f"], 0]])
    M = scipy.linalg.expm(FINE * np.block([[A, B], [np.zeros((2, 4))]]))
    sampled = scipy.signal.dlti(M[:2, :2], M[:2, 2:], np.eye(1, 2), np.zeros((1, 2)), dt=FINE)
    u = np.stack([np.repeat(lat, EVERY), gust], axis=1)
    p = scipy.signal.dlsim(sampled, u)[1][:, 0]
    noise = filtered(rng.standard_normal(N))
    p = filtered(p) + 0.05 * noise / np.std(noise[2000:])
    return Flight(FINE * EVERY, {"lat": lat}, {"p": p[::EVERY]})


@pytest.mark.slow
def test_a_profile_does_not_take_the_sizes_of_noises_to_their_limits():
    # It did, from where nothing leads back, and "the data do not determine tau_f" was said of a
    # tau_f that is known to a third.
    roll = linear_model("roll-flybarless")
    model = with_disturbance(with_filters(roll.model, {"p": [Filter("pt2", 20.0)]}), "roll")
    params = model.Params(**TRUE)
    free = {"Lb": Free(120.0), "tau_f": Free(0.05), "Blat": Free(0.1)}
    found = fit(Problem(model, params, [record()], free, method="filter-error"))
    assert found.status == "converged"
    for name, true in TRUE.items():
        estimate = found.estimates[name]
        assert estimate.lower95 < true < estimate.upper95, name
    assert found.estimates["tau_f"].upper95 < 0.12
