"""Fits of records whose input moved between the samples; made by scipy, integrated continuously."""

import importlib
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def held_inputs():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[2] / "experiments")
        yield importlib.import_module("coverage_cases.held_inputs")


def test_an_unstable_aircraft_with_a_continuous_elevator(held_inputs):
    truth = held_inputs.TRUTH
    found = held_inputs.aircraft_fit(0, "linear", noise=0.3)
    assert found.status == "converged"
    for name in ("Zw", "Mw", "Mq", "Mde"):
        assert found.estimates[name].value == pytest.approx(truth[name], rel=0.02), name
    held = held_inputs.aircraft_fit(0, "zero-order", noise=0.3)
    assert 1.2 < held.estimates["Mq"].value / truth["Mq"] < 1.4


def test_a_delay_of_a_part_of_a_sample(held_inputs):
    shift = held_inputs.late_fit(0, "linear").nuisance["time_shift"]
    assert shift.value == pytest.approx(0.017, abs=2e-3)
    assert shift.lower95 < 0.017 < shift.upper95
    held = held_inputs.late_fit(0, "zero-order").nuisance["time_shift"]
    assert held.value == pytest.approx(-3e-3, abs=2e-3)
