"""Hold of an input that its log leaves open, decided by the record."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from heli_jax import Fit, Flight, Free, Problem, fit, linear_model
from heli_jax.flights.holds import decide

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
    """Return 20 s of a chirp; p by SciPy, with the input held or linear."""
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


def _fitted(tmp_path, flight: Flight) -> Fit:
    (tmp_path / "rate.yaml").write_text(RATE)
    rate = linear_model(tmp_path / "rate.yaml")
    free = {"Lp": Free(-2.0), "Lda": Free(10.0)}
    return fit(Problem(rate.model, rate.vehicle({}).params, [flight], free))


def test_inputs_that_the_record_shows_to_be_held(tmp_path):
    found = _fitted(tmp_path, _flight(held=True))
    [doubt] = [f for f in found.findings if f.code == "timing.likelier-hold"]
    assert found.exit_code == 3
    assert set(doubt.shifts) == set(found.untrusted) == set(TRUTH)
    # The finding's remedy is to state the hold.
    stated = dataclasses.replace(_flight(held=True), hold={"da": "zero-order"}, hold_reason={})
    right = _fitted(tmp_path, stated)
    assert right.exit_code == 0
    assert right.log_likelihood - found.log_likelihood > 10.0
    for name, e in right.estimates.items():
        assert e.value == pytest.approx(TRUTH[name], abs=3.5 * e.sd)


def test_inputs_on_straight_lines(tmp_path):
    found = _fitted(tmp_path, _flight(held=False))
    assert found.exit_code == 0
    for name, e in found.estimates.items():
        assert e.value == pytest.approx(TRUTH[name], abs=3.5 * e.sd)


def _on_a_test_card(stepped: bool, chirped: bool, seed: int) -> Flight:
    """Return held doublets and a chirp sampled in motion, with p 60 ms late.

    SciPy simulates it at ten times the rate.
    """
    dt, fine, n = 0.02, 10, 2000
    t = np.arange(n * fine) * dt / fine
    steps = np.zeros(t.size)
    doublets = ((1.0, 0.4, 3.0), (4.0, 0.3, -4.0), (7.0, 0.24, 5.0), (11.0, 0.6, -3.0))
    for begin, width, size in doublets if stepped else ():
        for sign, at in ((1.0, begin), (-1.0, begin + width)):
            first = fine * round(at / dt)
            steps[first : first + fine * round(width / dt)] += sign * size
    at = np.maximum(t - 15.0, 0.0)
    chirp = 3.0 * np.sin(2.0 * np.pi * (0.2 + 0.07 * at) * at) * chirped
    da, p = np.zeros(t.size), np.zeros(n)
    for part, method in ((np.radians(steps), "zoh"), (np.radians(chirp), "foh")):
        num, den, _ = scipy.signal.cont2discrete(([40.0], [1.0, 8.0]), dt / fine, method=method)
        p += scipy.signal.lfilter(num.ravel(), den, np.r_[np.zeros(30), part[:-30]])[::fine]
        da += part
    p += 0.005 * np.random.default_rng(seed).standard_normal(n)
    u = da[::fine]
    decided = decide(u)
    return Flight(
        dt=dt,
        inputs={"da": u},
        outputs={"p": p},
        hold={"da": decided.hold},
        hold_reason={"da": decided.reason},
    )


@pytest.mark.parametrize(
    ("stepped", "chirped", "hold"),
    [(True, True, "mixed"), (True, False, "zero-order"), (False, True, "linear")],
)
def test_the_delay_of_a_test_card(tmp_path, stepped, chirped, hold):
    (tmp_path / "late.yaml").write_text(
        RATE.replace("B: {p", "delays: {da: tau}\nB: {p").replace(
            "A: {", "  tau: {value: 0.02, unit: s}\nA: {"
        )
    )
    late = linear_model(tmp_path / "late.yaml")
    free = {"Lp": Free(-2.0), "Lda": Free(10.0), "tau": Free(0.02)}
    flight = _on_a_test_card(stepped, chirped, 3)
    assert flight.hold["da"] == hold
    found = fit(Problem(late.model, late.vehicle({}).params, [flight], free))
    assert found.exit_code == 0
    for name, truth in {"Lp": -8.0, "Lda": 40.0, "tau": 0.060}.items():
        e = found.estimates[name]
        assert e.value == pytest.approx(truth, abs=3.5 * e.sd)
    assert found.estimates["tau"].sd < 0.0006
