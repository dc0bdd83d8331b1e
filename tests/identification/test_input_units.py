"""Sticks in another unit than is stated are doubted by their size, rough start values are not."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Signal
from heli_jax.flights.flight import Source
from heli_jax.identification.validation.signal_signs import inputs_in_other_units

N, DT, FULL = 500, 0.02, 0.5


def lagged(u):
    """A first-order answer to (N,) samples."""
    return np.asarray(scipy.signal.lfilter([0.2], [1.0, -0.9], u))


def doubts(unit, si, per_full, off=1.5, stick="lat"):
    """Of a stick whose full travel is FULL in `si` and `per_full` in the log, read as `unit`, and
    an effect that is `off` times too large at the start values."""
    rng = np.random.default_rng(1)
    moved = np.repeat(rng.uniform(-1.0, 1.0, N // 25), 25)
    p = lagged(FULL * moved) + 0.002 * rng.standard_normal(N)
    signal = Signal("ail", unit, si)
    read = signal.to_si(per_full * moved)
    start = off * lagged(read)
    source = Source("log.csv", "", inputs={"lat": signal})
    flight = Flight(dt=DT, inputs={"lat": read}, outputs={"p": p}, source=source)
    return list(inputs_in_other_units([("one", flight)], [{"p": start}], {"p": stick}))


@pytest.mark.parametrize("off", [0.5, 1.5])
@pytest.mark.parametrize(
    ("unit", "si", "per_full", "other", "factor"),
    [
        ("1", "1", 50.0, "%", 0.01), ("%", "1", 0.5, "1", 100.0),
        ("rad", "rad", np.degrees(FULL), "deg", np.pi / 180.0),
        ("deg", "rad", FULL, "rad", 180.0 / np.pi),
    ],
)  # fmt: skip
def test_a_stick_in_another_unit_is_doubted(unit, si, per_full, other, factor, off):
    [found] = doubts(unit, si, per_full, off)
    assert (found.name, found.stated, found.unit) == ("lat", unit, other)
    assert found.factor == pytest.approx(factor)
    # How far p moves over what the start values make of the stick as it is read.
    assert found.moved == {"p": pytest.approx(factor / off, rel=0.05)}
    # The effect of another stick is no evidence.
    assert doubts(unit, si, per_full, off, stick="lon") == []


@pytest.mark.parametrize(
    ("unit", "si", "per_full"),
    [("1", "1", 0.5), ("%", "1", 50.0), ("rad", "rad", FULL), ("deg", "rad", np.degrees(FULL))],
)
def test_a_stick_in_its_own_unit_is_not_however_rough_the_start_values(unit, si, per_full):
    for off in (0.01, 0.1, 1.0, 10.0, 100.0):
        assert doubts(unit, si, per_full, off) == []


def test_counts_that_a_model_is_made_for_are_no_per_cent():
    signal = Signal("ail", "1", "1")
    u = np.repeat(np.random.default_rng(2).uniform(-50.0, 50.0, N // 25), 25)
    p = lagged(u)
    source = Source("log.csv", "", inputs={"lat": signal})
    flight = Flight(dt=DT, inputs={"lat": u}, outputs={"p": p}, source=source)
    for off in (0.2, 1.0, 5.0):
        at_start = [("one", flight)], [{"p": off * p}], {"p": "lat"}
        assert list(inputs_in_other_units(*at_start)) == []
