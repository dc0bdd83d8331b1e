"""An angle at 5 Hz beside a rate at 50 Hz has the information of its own samples."""

import dataclasses

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, models
from heli_jax.flights.resample import Timed, at_nearest
from heli_jax.identification.equation_error.rls import baseline
from heli_jax.identification.equation_error.start import bridged
from heli_jax.identification.validation.follows_response import feedback
from heli_jax.identification.validation.metrics import whiteness

from .bench import BENCH, amplitude_for, denominators, steps, vehicle

N, DT, FINE = 1500, 0.02, 20
"""Samples of the flight, their step [s], and steps of the true motion in one of them."""
NOISE = {"roll": 2e-3, "roll_rate": 1e-2}
FREE = {"Ixx": Free(0.03), "If": Free(2.5e-4)}


def truth(seed):
    """Return stick (N,), roll and its rate (N FINE,) by scipy: eq. 23, and the same times s."""
    rng = np.random.default_rng(seed)
    u = steps(rng, N, DT, amplitude_for(BENCH, DT, True))
    num, den = denominators(BENCH, True)
    held = np.repeat(u, FINE)
    made = {}
    for name, numerator in (("roll", num), ("roll_rate", np.polymul(num, [1.0, 0.0]))):
        b, a, _ = scipy.signal.cont2discrete((numerator, den), DT / FINE)
        made[name] = scipy.signal.lfilter(np.ravel(b), a, held)
    return u, made


def record(seed, *, slow):
    """Return a flight whose roll is measured every 0.2 s with jitter, if `slow`."""
    u, made = truth(seed)
    rng = np.random.default_rng(seed + 1000)
    rate = made["roll_rate"][::FINE] + NOISE["roll_rate"] * rng.standard_normal(N)
    roll = made["roll"][::FINE] + NOISE["roll"] * rng.standard_normal(N)
    if slow:
        at = 200 * np.arange(1, 149) + rng.integers(-20, 21, 148)
        values = made["roll"][at] + NOISE["roll"] * rng.standard_normal(at.size)
        roll = at_nearest(Timed(at * DT / FINE, values), DT * np.arange(N))
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": roll, "roll_rate": rate})


def problem(flight, **more):
    return Problem(models.roll_on_stand, vehicle(BENCH), [flight], FREE, **more)


@pytest.fixture(scope="module")
def fits():
    return {slow: fit(problem(record(0, slow=slow))) for slow in (False, True)}


def test_the_estimates_are_those_of_the_full_rate(fits):
    full, slow = fits[False], fits[True]
    assert slow.status == "converged"
    assert slow.n_samples == N + 148
    for name, one in slow.estimates.items():
        # With less information the two differ by about the slow one's sd.
        assert one.value == pytest.approx(full.estimates[name].value, abs=1.5 * one.sd)
        assert abs(one.value - BENCH[name]) < 3.0 * one.sd
        assert full.estimates[name].sd < one.sd
    assert slow.noise["flight 1/roll"] == pytest.approx(NOISE["roll"], rel=0.2)
    assert slow.whiteness["flight 1/roll"].white
    assert slow.adequate
    assert slow.metrics["roll"].vaf > 0.99


def test_slow_residuals_that_are_not_white_are_told(fits):
    residual = fits[True].signals[0].residual("roll")
    drifting = residual + 4e-3 * np.sin(0.8 * DT * np.arange(N))
    # With jitter few lags of the grid have many pairs, so lags count samples.
    assert not whiteness(drifting).white
    assert whiteness(residual).white
    assert whiteness(drifting).lag1 > 0.5


def test_feedback_is_not_tested_by_an_output_that_is_mostly_missing():
    flight = record(0, slow=True)
    assert not feedback(dataclasses.replace(flight, outputs={"roll": flight.outputs["roll"]}))


def test_an_equation_error_start_has_something_to_smooth():
    flight = record(0, slow=True)
    filled = bridged(flight.outputs["roll"])
    seen = np.isfinite(filled)
    assert seen.sum() > 0.97 * N
    truth_there = truth(0)[1]["roll"][::FINE][seen]
    assert np.std(filled[seen] - truth_there) < 0.1 * np.std(truth_there)
    # A gap that is long for the slow sensor too stays.
    roll = np.where(abs(np.arange(N) - 700) < 30, np.nan, flight.outputs["roll"])
    assert np.isnan(bridged(roll)[680:720]).all()


def test_recursive_least_squares_takes_what_is_whole(bench30):
    flight = record(0, slow=True)
    made = baseline(models.roll_on_stand, bench30, flight, order=2)
    assert made.output == "roll_rate"
