"""What an input does between samples, where its log leaves it open: the record tells."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.identification.likelier_hold import with_likelier_hold

TRUTH = {"Lp": -5.0, "Lda": 30.0}
RATE = """
name: rate
states: {p: rad/s, phi: rad}
inputs: {da: rad}
outputs: {p: rad/s}
parameters:
  Lp: {value: -5.0, unit: 1/s}
  Lda: {value: 30.0, unit: 1/s^2}
A: {p: {p: Lp}, phi: {p: 1}}
B: {p: {da: Lda}}
"""
DT, SAMPLES = 0.02, 1000
OPEN = {"da": "moves at 100 % of the samples"}


def _flight(*, held: bool) -> Flight:
    """20 s of a chirp; p by SciPy with the input as it was held or on straight lines."""
    t = np.arange(SAMPLES) * DT
    da = 0.1 * np.sin(2.0 * np.pi * (0.2 + 0.1 * t) * t)
    M = np.array([[TRUTH["Lp"], TRUTH["Lda"], 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    step = scipy.linalg.expm(M * DT)[0]
    slopes = np.zeros(SAMPLES) if held else np.diff(da, append=da[-1]) / DT
    p = np.zeros(SAMPLES)
    for k in range(SAMPLES - 1):
        p[k + 1] = step @ np.array([p[k], da[k], slopes[k]])
    p += 0.003 * np.random.default_rng(1).standard_normal(SAMPLES)
    return Flight(
        dt=DT, inputs={"da": da}, outputs={"p": p}, hold={"da": "linear"}, hold_reason=OPEN
    )


@pytest.mark.parametrize("held", [True, False])
def test_an_input_is_held_where_the_record_says_so(tmp_path, held):
    (tmp_path / "rate.yaml").write_text(RATE)
    rate = linear_model(tmp_path / "rate.yaml")
    free = {"Lp": Free(-2.0), "Lda": Free(10.0)}
    problem = Problem(rate.model, rate.vehicle({}).params, [_flight(held=held)], free)
    asked, found = with_likelier_hold(problem, fit(problem), fit)
    taken = asked.flights[0].hold["da"]
    assert taken == ("zero-order" if held else "linear")
    assert ("timing.likelier-hold" in {f.code for f in found.findings}) is held
    for name, e in found.estimates.items():
        assert e.sd is not None
        assert e.value == pytest.approx(TRUTH[name], abs=3.5 * e.sd)


def test_what_was_stated_stays(tmp_path):
    (tmp_path / "rate.yaml").write_text(RATE)
    rate = linear_model(tmp_path / "rate.yaml")
    stated = dataclasses.replace(_flight(held=True), hold_reason={})
    free = {"Lp": Free(-2.0), "Lda": Free(10.0)}
    problem = Problem(rate.model, rate.vehicle({}).params, [stated], free)
    found = fit(problem)
    assert with_likelier_hold(problem, found, fit) == (problem, found)
