"""Modes above the Nyquist frequency: only the parameters that move them are not determined."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Nuisance, Prior, Problem, fit
from heli_jax.identification.validation.logging_rate import aliased_parameters
from tests.identification.test_enough import DT, SWING, TRUTH, flight, steps

# The true mode, shifted by the sampling frequency.
FAST = 2.0 * np.pi / DT - np.sqrt(35.0)
K = FAST**2 + 1.0
ALIAS = {"k": K, "d": 2.0, "b": 20.0 * K / 36.0}
SD = [{"phi": 0.005}]


def problem(record, **free):
    vehicle = TRUTH._replace(k=K, b=ALIAS["b"])
    return Problem(SWING, vehicle, [record], free, Nuisance(bias=False))


def test_only_what_moves_a_fast_mode_is_blamed_for_it():
    record = flight()
    every = {n: Free(v) for n, v in ALIAS.items()}
    assert aliased_parameters(problem(record, **every), ALIAS, SD) == {"k"}
    # A constant that is given, as a filter's, has no alias, whatever else is free.
    assert not aliased_parameters(problem(record, b=every["b"]), ALIAS, SD)
    assert not aliased_parameters(problem(record, d=every["d"]), ALIAS, SD)
    # A prior tells the aliases apart, and a mode within the noise tells nothing.
    known = problem(record, k=Free(K, prior=Prior(K, 0.1 * K)), b=every["b"])
    assert not aliased_parameters(known, ALIAS, SD)
    assert not aliased_parameters(problem(record, **every), ALIAS, [{"phi": 1e3}])
    assert not aliased_parameters(problem(record, **every), {**ALIAS, "k": 36.0}, SD)


@pytest.mark.slow
def test_an_aliased_optimum_is_neither_determined_nor_adequate():
    record = flight()
    asked = problem(record, k=Free(K, lower=0.9 * K, upper=1.1 * K), b=Free(ALIAS["b"]))
    found = fit(asked)
    assert found.status == "not-identifiable"
    assert found.not_identifiable == ("k",)
    assert found.exit_code in (3, 4)
    [rate] = [f for f in found.findings if f.code == "timing.logging-rate"]
    assert rate.severity == "refuse"


def test_a_swing_far_past_the_samples_is_not_excused_for_being_over_within_one():
    far = {"k": 1e8, "d": 3.0 / DT, "b": 1e8}
    every = {n: Free(v) for n, v in ALIAS.items()}
    assert aliased_parameters(problem(flight(), **every), far, SD) == {"k"}


def test_a_mode_near_nyquist_whose_alias_fits_as_well_is_not_determined():
    # The true mode is at 1.15 times the Nyquist frequency; samples show it at 0.85.
    k, seen = ((part * np.pi / DT) ** 2 + 1.0 for part in (1.15, 0.85))
    rng = np.random.default_rng(1)
    u = steps(rng, 1000)
    b, a, _ = scipy.signal.cont2discrete(([20.0 * k / 36.0], [1.0, 2.0, k]), DT)
    phi = scipy.signal.lfilter(np.ravel(b), a, u) + 0.005 * rng.standard_normal(u.size)
    inputs = {"u": u, "v": np.zeros(u.size)}
    record = Flight(DT, inputs, {"phi": phi}, sd={"phi": 0.005})
    free = {"k": Free(seen), "d": Free(2.0), "b": Free(20.0 * seen / 36.0)}
    found = fit(problem(record, **free))
    assert found.estimates["k"].value == pytest.approx(seen, rel=0.01)
    assert found.not_identifiable == ("k",)
    assert found.exit_code == 3
