"""Fits of records whose input moved between the samples; made by scipy, integrated continuously."""

import functools
import importlib
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heli_jax import Flight, fit
from heli_jax.identification.validation.other_hold import _taken


@pytest.fixture(scope="module")
def held_inputs():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[2] / "experiments")
        module = importlib.import_module("coverage_cases.held_inputs")
        # The same records and fits serve several tests.
        for name in ("late_record", "aircraft_fit"):
            patch.setattr(module, name, functools.cache(getattr(module, name)))
        yield module


def other_hold(findings):
    return [f for f in findings if f.code == "timing.other-hold"]


def told(finding, name):
    """What a finding says of one name, as a number of its unit."""
    assert finding.severity == "note"
    return float(re.search(rf"{name} would be about ([-+.\de]+) ", finding.sentence).group(1))


def test_a_fit_doubts_only_what_the_log_let_be_linear(held_inputs):
    record = held_inputs.late_record(0, "linear")
    decided = replace(record, hold_reason={"da": "moves at 100 % of the samples"})
    (note,) = other_hold(fit(held_inputs.late_problem(decided)).findings)
    assert told(note, "time_shift") == pytest.approx(-20.0, abs=4.0)


def test_an_input_of_several_flights_is_named_once():
    """Each hold with the first flight's reason."""
    shares = ((90, 100), (100, 90), (100, 100))
    flights = tuple(
        Flight(
            dt=0.01,
            inputs={"lat": np.zeros(9), "lon": np.zeros(9)},
            outputs={"p": np.zeros(9)},
            hold={"lat": "linear", "lon": "linear" if i < 2 else "zero-order"},
            hold_reason={"lat": f"moves at {a} %", "lon": f"moves at {b} %"},
        )
        for i, (a, b) in enumerate(shares)
    )
    assert _taken(flights, [{"lat", "lon"}] * 3) == [
        "lat is taken as linear (it moves at 90 %)",
        "lon is taken as linear (it moves at 100 %)",
        "lon is taken as zero-order (it moves at 100 %)",
    ]
