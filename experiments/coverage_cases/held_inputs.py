"""Inputs that move between samples, as records of a stick or a surface do.

An unstable aircraft (short period of Jategaonkar, 2006, chapter 9: speed 44.57 m/s) is flown with a
continuous elevator: a pilot's smooth commands and a feedback of the vertical speed. scipy
integrates it, and it is logged at 20 Hz. A second case is a roll with a delay of 17 ms, logged at
25 Hz.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.integrate
import scipy.interpolate

from coverage_cases import Case, Run, intervals
from heli_jax import Fit, Flight, Free, Model, Nuisance, Problem, fit

SPEED = 44.57
TRUTH = {"Zw": -1.4249, "Zq": -1.4768, "Zde": -6.2632, "Mw": 0.2163, "Mq": -3.7067, "Mde": -12.784}
NOISE = {"w": 0.1, "q": 0.004}
FEEDBACK = 0.025
DT, DURATION = 0.05, 20.0


class Params(NamedTuple):
    Zw: float
    Zq: float
    Zde: float
    Mw: float
    Mq: float
    Mde: float


class State(NamedTuple):
    w: float
    q: float


class Inputs(NamedTuple):
    de: float


class Outputs(NamedTuple):
    w: float
    q: float


def short_period(p: Params, s: State, u: Inputs) -> State:
    return State(
        w=p.Zw * s.w + (SPEED + p.Zq) * s.q + p.Zde * u.de,
        q=p.Mw * s.w + p.Mq * s.q + p.Mde * u.de,
    )


AIRCRAFT = Model(
    "short-period", short_period, lambda p, s, u: Outputs(s.w, s.q), Params, State, Inputs, Outputs,
    linear=True,
)  # fmt: skip


def smooth(rng: np.random.Generator, duration: float, pace: float) -> Callable[[float], float]:
    """Return a pilot's command of unit size: a cubic spline of random points `pace` [s] apart."""
    knots = np.arange(-2.0 * pace, duration + 3.0 * pace, pace)
    spline = scipy.interpolate.CubicSpline(knots, rng.uniform(-1.0, 1.0, knots.size))
    return lambda t: float(spline(t))


def aircraft_record(seed: int, hold: str = "linear", noise: float = 1.0) -> Flight:
    """Return one flight, logged at 20 Hz with a multiple of `NOISE`."""
    rng = np.random.default_rng(seed)
    command = smooth(rng, DURATION, 1.2)

    def elevator(t: float, w: float) -> float:
        return 0.1 * command(t) + FEEDBACK * w

    def rates(t: float, x: np.ndarray) -> list[float]:
        w, q = x
        de, v = elevator(t, w), TRUTH
        return [
            v["Zw"] * w + (SPEED + v["Zq"]) * q + v["Zde"] * de,
            v["Mw"] * w + v["Mq"] * q + v["Mde"] * de,
        ]

    t = DT * np.arange(round(DURATION / DT) + 1)
    run = scipy.integrate.solve_ivp(rates, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-9)
    w, q = run.y
    de = np.array([elevator(*point) for point in zip(t, w, strict=True)])
    measured = {
        n: x + noise * NOISE[n] * rng.standard_normal(t.size) for n, x in (("w", w), ("q", q))
    }
    return Flight(dt=DT, inputs={"de": de}, outputs=measured, hold={"de": hold})


def aircraft_problem(seed: int, hold: str = "linear", noise: float = 1.0) -> Problem:
    """Return a problem with all derivatives except Zq, in windows of 2 s.

    w and q cannot separate Zq from the speed. Over a whole record, an unstable aircraft diverges
    with any error of its initial state.
    """
    starts = {"Zw": -1.2, "Zde": -5.0, "Mw": 0.2, "Mq": -3.0, "Mde": -11.0}
    free = {n: Free(v) for n, v in starts.items()}
    record = aircraft_record(seed, hold, noise)
    return Problem(AIRCRAFT, Params(**TRUTH), [record], free, window=2.0)


def aircraft_fit(seed: int, hold: str = "linear", noise: float = 1.0) -> Fit:
    return fit(aircraft_problem(seed, hold, noise))


def aircraft(seed: int) -> Run:
    names = ("Zw", "Zde", "Mw", "Mq", "Mde")
    return intervals(aircraft_fit(seed), {n: TRUTH[n] for n in names})


LATE = {"Lp": -4.0, "Lda": 20.0, "time_shift": 0.017}


class RollParams(NamedTuple):
    Lp: float
    Lda: float


class RollState(NamedTuple):
    p: float


class Aileron(NamedTuple):
    da: float


ROLL = Model(
    "roll", lambda v, s, u: RollState(v.Lp * s.p + v.Lda * u.da), lambda v, s, u: s, RollParams,
    RollState, Aileron, RollState, linear=True,
)  # fmt: skip


def late_record(seed: int, hold: str = "linear") -> Flight:
    """Return a roll rate 17 ms after a smooth stick, logged at 25 Hz."""
    rng = np.random.default_rng(seed)
    stick = smooth(rng, 120.0, 0.9)

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        return LATE["Lp"] * x + LATE["Lda"] * stick(t - LATE["time_shift"])

    t = 0.04 * np.arange(3001)
    run = scipy.integrate.solve_ivp(rates, (0.0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-9)
    p = run.y[0] + 0.05 * rng.standard_normal(t.size)
    da = np.array([stick(time) for time in t])
    return Flight(dt=0.04, inputs={"da": da}, outputs={"p": p}, hold={"da": hold})


def late_problem(record: Flight) -> Problem:
    free = {"Lp": Free(-3.0), "Lda": Free(15.0)}
    return Problem(ROLL, RollParams(-4.0, 20.0), [record], free, Nuisance(time_shift=True))


def late_fit(seed: int, hold: str = "linear") -> Fit:
    return fit(late_problem(late_record(seed, hold)))


def late(seed: int) -> Run:
    result = late_fit(seed)
    run = intervals(result, LATE)
    off = abs(result.nuisance["time_shift"].value - LATE["time_shift"])
    return Run(run.status, run.parameters, {"delay wrong by more than 2 ms": off > 2e-3})


def cases() -> list[Case]:
    return [
        Case("unstable aircraft at 20 Hz, linear elevator", aircraft),
        Case("delay of 17 ms at 25 Hz, linear stick", late),
    ]
