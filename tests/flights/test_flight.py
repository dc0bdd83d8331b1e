"""Refusal of flights that are not uniform, finite records."""

from typing import Any

import numpy as np
import pytest

from heli_jax.flights import Flight


def test_times_and_duration():
    flight = Flight(0.5, {"x_roll": np.zeros(4)}, {"roll": np.ones(4)}, t0=3.0)
    assert flight.n_samples == 4
    assert flight.duration == 1.5
    assert np.array_equal(flight.times, [0.0, 0.5, 1.0, 1.5])


def test_arrays_are_copied_and_read_only():
    stick = np.zeros(4, dtype=np.float32)
    flight = Flight(0.5, {"x_roll": stick}, {})
    stick[0] = 1.0
    assert flight.inputs["x_roll"][0] == 0.0
    assert flight.inputs["x_roll"].dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        flight.inputs["x_roll"][0] = 1.0


X = np.zeros(4)
BAD = {
    "dt": {"dt": 0.0},
    "negative dt": {"dt": -1.0},
    "nan dt": {"dt": np.nan},
    "t0": {"t0": np.inf},
    "lengths": {"outputs": {"roll": np.zeros(5)}},
    "shape": {"inputs": {"x_roll": np.zeros((4, 1))}},
    "no samples": {"inputs": {"x_roll": np.zeros(0)}},
    "nan input": {"inputs": {"x_roll": np.array([0.0, np.nan, 0.0, 0.0])}},
    "infinite output": {"outputs": {"roll": np.array([0.0, np.inf, 0.0, 0.0])}},
    "no signals": {"inputs": {}, "outputs": {}},
    "sd of an input": {"sd": {"x_roll": 1.0}},
    "sd": {"sd": {"roll": 0.0}},
    "known": {"known": {"Ixx": np.inf}},
}


@pytest.mark.parametrize("case", BAD)
def test_refused(case):
    good = {"dt": 0.1, "inputs": {"x_roll": X}, "outputs": {"roll": X}}
    with pytest.raises(ValueError, match=r"expected|differ|needs|no output"):
        Flight(**(good | BAD[case]))


def test_inputs_stay_between_samples_unless_told():
    flight = Flight(dt=0.1, inputs={"a": np.arange(3.0), "b": np.arange(3.0)}, outputs={})
    assert flight.hold == {"a": "zero-order", "b": "zero-order"}
    with pytest.raises(ValueError, match="hold is stated for 'c'"):
        Flight(dt=0.1, inputs={"a": np.arange(3.0)}, outputs={}, hold={"c": "linear"})
    with pytest.raises(ValueError, match="got 'auto'"):
        Flight(dt=0.1, inputs={"a": np.arange(3.0)}, outputs={}, hold={"a": "auto"})
    bare: Any = "linear"
    with pytest.raises(TypeError, match="hold: expected"):
        Flight(dt=0.1, inputs={"a": np.arange(3.0)}, outputs={}, hold=bare)
