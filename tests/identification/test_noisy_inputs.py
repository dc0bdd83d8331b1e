"""An input that was measured with noise is told from a command, whose noise acts.

Records are made by SciPy: w' = Zw w + Zo om, sampled exactly for om that follows straight lines.
"""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Problem, fit

DT, N, NOISE = 0.02, 3000, 0.2
ZW, ZO = -0.7, -0.22


class Params(NamedTuple):
    Zw: float
    Zo: float


class State(NamedTuple):
    w: float


class Inputs(NamedTuple):
    om: float


class Outputs(NamedTuple):
    w: float
    az: float


heave = Model(
    "heave by rotor speed",
    lambda q, x, u: State(w=q.Zw * x.w + q.Zo * u.om),
    lambda q, x, u: Outputs(w=x.w, az=q.Zw * x.w + q.Zo * u.om),
    Params, State, Inputs, Outputs, linear=True,
)  # fmt: skip


def record(*, felt: bool, gain: float = 0.0) -> Flight:
    """Rotor speed with noise that the machine felt or not; `gain`: of a controller on measured w,
    whose command the input is then."""
    rng = np.random.default_rng(4)
    slow = scipy.signal.lfilter([0.02], [1.0, -0.98], rng.standard_normal(N)) * 8.0
    noise = NOISE * rng.standard_normal(N)
    w, seen, om = 0.0, np.zeros((N, 2)), np.zeros(N)
    system = [np.array([[v]]) for v in (ZW, ZO, 1.0, 0.0)]
    A, B, _, D, _ = scipy.signal.cont2discrete(tuple(system), DT, method="foh")
    # SciPy's form has the state x = w - D om, at the sample itself.
    x = 0.0
    for k in range(N):
        error = 0.01 * rng.standard_normal()
        om[k] = slow[k] + (noise[k] if felt else 0.0) + gain * (x + error)
        w = x + D[0, 0] * om[k]
        seen[k] = w + error, ZW * w + ZO * om[k] + 0.05 * rng.standard_normal()
        x = A[0, 0] * x + B[0, 0] * om[k]
    return Flight(
        dt=DT,
        inputs={"om": om if felt or gain else om + noise},
        outputs={"w": seen[:, 0], "az": seen[:, 1]},
        hold={"om": "linear"},
    )


def fitted(flight: Flight):
    free = {"Zw": Free(-0.4), "Zo": Free(-0.1)}
    return fit(Problem(heave, Params(-0.4, -0.1), [flight], free))


def test_noise_of_a_sensor_is_said_with_what_it_does():
    found = fitted(record(felt=False))
    [noisy] = [f for f in found.findings if f.code == "dynamics.noisy-input"]
    assert noisy.subjects == ("om",)
    # The motion itself is not all slow.
    assert noisy.value == pytest.approx(NOISE, rel=0.2)
    share = -noisy.shifts["Zo"] / found.estimates["Zo"].value
    # Of six records like this the mean of Zo is 0.83 % too small; a single one has an sd of 0.8 %.
    assert share == pytest.approx(-0.009, abs=0.004)
    one = found.estimates["Zo"]
    assert one.value / ZO - 1.0 == pytest.approx(share, abs=3 * one.sd / abs(ZO))


@pytest.mark.parametrize("gain", [0.0, 3.0], ids=["open", "controller"])
def test_noise_that_acts_is_none(gain):
    found = fitted(record(felt=not gain, gain=gain))
    assert not [f for f in found.findings if f.code == "dynamics.noisy-input"]
    assert found.adequate
    for name, true in (("Zw", ZW), ("Zo", ZO)):
        one = found.estimates[name]
        assert abs(one.value - true) < 3.5 * one.sd
