"""Fits of records whose input moved between the samples; made by scipy, integrated continuously."""

import functools
import importlib
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from heli_jax import Flight, Nuisance, check, fit
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


@pytest.mark.slow
def test_an_unstable_aircraft_with_a_continuous_elevator(held_inputs):
    truth = held_inputs.TRUTH
    found = held_inputs.aircraft_fit(0, "linear", 0.3)
    assert found.status == "converged"
    for name in ("Zw", "Mw", "Mq", "Mde"):
        assert found.estimates[name].value == pytest.approx(truth[name], rel=0.02), name
    held = held_inputs.aircraft_fit(0, "zero-order", 0.3)
    assert 1.2 < held.estimates["Mq"].value / truth["Mq"] < 1.4


@pytest.mark.slow
def test_a_delay_of_a_part_of_a_sample(held_inputs):
    shift = held_inputs.late_fit(0, "linear").nuisance["time_shift"]
    assert shift.value == pytest.approx(0.017, abs=2e-3)
    assert shift.lower95 < 0.017 < shift.upper95
    held = held_inputs.late_fit(0, "zero-order").nuisance["time_shift"]
    assert held.value == pytest.approx(-3e-3, abs=2e-3)


def other_hold(findings):
    return [f for f in findings if f.code == "timing.other-hold"]


def told(finding, name):
    """What a finding says of one name, as a number of its unit."""
    assert finding.severity == "note"
    return float(re.search(rf"{name} would be about ([-+.\de]+) ", finding.sentence).group(1))


@pytest.mark.parametrize("hold", ["linear", "zero-order"])
@pytest.mark.slow
def test_check_tells_what_the_other_hold_would_change(held_inputs, hold):
    """As much as the fits of both holds differ by."""
    record = held_inputs.late_record(0, hold)
    (note,) = other_hold(check(held_inputs.late_problem(record)).notes)
    sign = -1 if hold == "linear" else 1
    assert told(note, "time_shift") == pytest.approx(20.0 * sign, abs=4.0)


@pytest.mark.slow
def test_the_change_told_is_that_between_two_fits(held_inputs):
    found = held_inputs.aircraft_fit(0, "zero-order", 0.3)
    assert not other_hold(found.findings)  # as stated: nothing is in doubt
    (note,) = other_hold(check(held_inputs.aircraft_problem(0, "zero-order", 0.3)).notes)
    other = held_inputs.aircraft_fit(0, "linear", 0.3)
    off = 100 * (other.estimates["Mq"].value / found.estimates["Mq"].value - 1)
    assert off < -15
    assert told(note, "Mq") == pytest.approx(off, rel=0.5)


def test_a_fit_doubts_only_what_the_log_let_be_linear(held_inputs):
    record = held_inputs.late_record(0, "linear")
    decided = replace(record, hold_reason={"da": "moves at 100 % of the samples"})
    (note,) = other_hold(fit(held_inputs.late_problem(decided)).findings)
    assert told(note, "time_shift") == pytest.approx(-20.0, abs=4.0)


@pytest.mark.slow
def test_nothing_is_said_where_it_does_not_matter(held_inputs):
    """A slow stick in much noise: half a sample is nothing."""
    record = held_inputs.late_record(0, "linear")
    noise = np.random.default_rng(1).standard_normal(record.n_samples)
    rough = replace(record, outputs={"p": record.outputs["p"] + 20.0 * noise})
    problem = replace(held_inputs.late_problem(rough), nuisance=Nuisance())
    assert not other_hold(check(problem).notes)


@pytest.mark.slow
def test_an_input_that_is_seen_directly(held_inputs):
    """With feed-through the other hold is a program of its own, and check makes it."""
    roll = held_inputs.ROLL

    class Seen(NamedTuple):
        p: float
        dp: float

    def output(v, s, u):
        return Seen(p=s.p, dp=v.Lp * s.p + v.Lda * u.da)

    model = replace(roll, output=output, Outputs=Seen)
    problem = held_inputs.late_problem(held_inputs.late_record(0, "linear"))
    (note,) = other_hold(check(replace(problem, model=model)).notes)
    assert told(note, "time_shift") < -10


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
