"""Detection of a stick whose steps are logged at the next stamp, with the delay.

Records are made by SciPy at 1 kHz and logged at 50 Hz.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.flights.holds import decide
from heli_jax.identification.fit import context_of
from heli_jax.identification.validation.shifts import shift_in_time
from heli_jax.naming import Scalar
from tests.identification.lag import LAG, Inputs, Params, response

FINE, EVERY = 0.001, 20
LOGGED = FINE * EVERY
N = 40_000


def problem(grid, *, shift=False, start=(-6.0, 20.0)):
    """Return steps at multiples of `grid` [ms]; the stick is read at the logger's samples."""
    rng = np.random.default_rng(5)
    u, k = np.zeros(N), 0
    while k < N:
        n = grid * int(rng.integers(150 // grid, 600 // grid))
        u[k : k + n] = rng.uniform(-0.1, 0.1)
        k += n
    p = response(-12.0, 60.0, u, FINE)[::EVERY]
    p = p + 0.002 * rng.standard_normal(p.size)
    stick = u[::EVERY]
    taken = decide(stick)
    flight = Flight(
        dt=LOGGED, inputs={"d": stick}, outputs={"p": p},
        hold={"d": taken.hold}, hold_reason={"d": taken.reason},
    )  # fmt: skip
    free = {"Lp": Free(start[0]), "Ld": Free(start[1])}
    return Problem(LAG, Params(*start), [flight], free, Nuisance(time_shift=shift))


def late_ones(found):
    return [f for f in found.findings if f.code == "timing.late-input"]


def test_a_stick_that_is_late_takes_the_interval_that_it_moves():
    found = fit(problem(1))
    [late] = late_ones(found)
    assert late.subjects == ("d",)
    # Half of the logger's 20 ms on average, from the derivative at the optimum.
    assert 0.005 < late.value < 0.014
    # The true shift is -12; the estimate moves towards it.
    lp = found.estimates["Lp"]
    assert lp.value + late.shifts["Lp"] == pytest.approx(-12.0, rel=0.1)
    assert abs(late.shifts["Lp"]) > 1.96 * lp.sd
    assert found.distrusts["Lp"].code == late.code
    assert (lp.lower95, lp.upper95) == (None, None)
    assert found.exit_code == 3


def test_a_free_shift_is_the_mean_time_by_which_steps_were_late():
    found = fit(problem(1, shift=True))
    assert found.nuisance["time_shift"].value == pytest.approx(-0.01, abs=0.002)
    assert not late_ones(found)


def test_a_stick_whose_steps_fall_on_samples_is_not():
    found = fit(problem(EVERY))
    assert not late_ones(found)
    assert found.exit_code == 0
    assert found.interval == "95 % interval"
    assert found.estimates["Lp"].value == pytest.approx(-12.0, rel=0.02)


class Roll(NamedTuple):
    p: Scalar
    phi: Scalar


ROLL = Model(
    "roll with its angle",
    lambda p, s, u: Roll(p=p.Lp * s.p + p.Ld * u.d, phi=s.p),
    lambda p, s, u: s,
    Params, Roll, Inputs, Roll, linear=True,
)  # fmt: skip


def roll_and_angle(noise, *, late=0):
    """Return steps at 50 Hz by SciPy, from rest; the angle is logged late by some samples."""
    rng = np.random.default_rng(8)
    stick = np.repeat(rng.uniform(-1.0, 1.0, 80), 20)
    exact = [[-4.0, 0.0], [1.0, 0.0]], [[30.0], [0.0]], np.eye(2), [[0.0], [0.0]]
    A, B, C, D, _ = scipy.signal.cont2discrete(tuple(map(np.array, exact)), LOGGED)
    _, y, _ = scipy.signal.dlsim((A, B, C, D, LOGGED), stick)
    p, phi = (y + noise * rng.standard_normal(y.shape)).T
    phi = np.concatenate([np.full(late, phi[0]), phi[: phi.size - late]])
    sd = {"p": noise, "phi": noise}
    return Flight(LOGGED, {"d": stick}, {"p": p, "phi": phi}, hold={"d": "zero-order"}, sd=sd)


@pytest.mark.parametrize("late", [0, 3])
def test_an_angle_that_is_logged_late_is_named_with_its_delay(late):
    free = {"Lp": Free(-2.0), "Ld": Free(15.0)}
    flight = dataclasses.replace(roll_and_angle(0.05, late=late), sd={})
    found = fit(Problem(ROLL, Params(-2.0, 15.0), [flight], free))
    said = [(f.subjects, f.value) for f in found.findings if f.code == "timing.late-output"]
    assert said == ([(("phi",), pytest.approx(late * LOGGED))] if late else [])
    assert found.exit_code == (3 if late else 0)


@pytest.mark.parametrize(("late", "lost"), [(0, 0), (0, 100), (5, 100)])
def test_samples_that_move_out_of_the_record_are_no_gain(late, lost):
    flight = roll_and_angle(1.0, late=late)
    phi = flight.outputs["phi"].copy()
    phi[phi.size - lost :] = np.nan
    flight = dataclasses.replace(flight, outputs={**flight.outputs, "phi": phi})
    free = {"Lp": Free(-4.0), "Ld": Free(30.0)}
    c = context_of(Problem(ROLL, Params(-4.0, 30.0), [flight], free))
    found = shift_in_time(c.problem, c.at, c.e, ["phi"])
    assert (found and (found.names, found.seconds)) == (
        (("phi",), pytest.approx(late * LOGGED, abs=LOGGED)) if late else None
    )


def in_a_loop(*, late=0, delayed=0, seed=1):
    """Fit by filter error a rate in gusts, with feedback to the stick.

    Args:
        late: delay of the logged stick [samples].
        delayed: delay of the vehicle's response [samples].
        seed: of stick, gusts and noise.
    """
    rng, dt, n = np.random.default_rng(seed), LOGGED, 1000
    steps = np.repeat(rng.uniform(-0.15, 0.15, n // 25), 25)
    # Exact for an input and a gust that are held over a sample.
    grow, tau, gust, rate = np.exp(-4.0 * dt), 0.5, 0.0, 0.0
    stick, p = np.zeros(n), np.zeros(n)
    for k in range(n):
        p[k] = rate
        stick[k] = steps[k] - 0.15 * rate
        acts = stick[k - delayed] if k >= delayed else 0.0
        rate = grow * rate + (1.0 - grow) / 4.0 * (20.0 * acts + gust)
        part = np.exp(-dt / tau)
        gust = part * gust + 0.5 * np.sqrt(1.0 - part**2) * rng.standard_normal()
    p += 0.02 * rng.standard_normal(n)
    logged = np.concatenate([np.zeros(late), stick[: n - late]])
    model = with_disturbance(LAG, "p")
    vehicle = model.Params(Lp=-2.0, Ld=10.0, sigma_w=1.0, tau_w=1.0)
    flight = Flight(dt, {"d": logged}, {"p": p})
    free = {"Lp": Free(-2.0), "Ld": Free(10.0)}
    return fit(Problem(model, vehicle, [flight], free, method="filter-error"))


@pytest.mark.parametrize(
    ("late", "delayed", "code"),
    [(3, 0, "timing.late-input"), (0, 3, "timing.late-response")],
)
def test_in_a_closed_loop_an_input_at_another_time_takes_the_intervals(late, delayed, code):
    found = in_a_loop(late=late, delayed=delayed)
    [finding] = [f for f in found.findings if f.code == code]
    assert finding.value == pytest.approx(3 * LOGGED)
    # The true values are -4 and 20.
    assert abs(found.estimates["Ld"].value - 20.0) > 3.0
    assert finding.shifts["Ld"] > 0
    assert found.distrusts["Ld"].code == code
    assert found.exit_code == 3


def test_in_a_closed_loop_a_sound_record_stays_sound():
    found = in_a_loop()
    assert found.exit_code == 0
    for name, true in (("Lp", -4.0), ("Ld", 20.0)):
        estimate = found.estimates[name]
        assert abs(estimate.value - true) < 3.0 * estimate.sd
