"""A roll angle at 5 Hz with jitter beside a roll rate at 50 Hz, by output error.

The truth is scipy's, at a twentieth of the sample time, from the closed form of eq. 23 (and the
same times s for the rate). The angle is resampled as a log's slow channel; for comparison it is
interpolated linearly, as a user might.
"""

from typing import Any

import numpy as np
import scipy.signal

from coverage_cases import BENCH, Case, Run, intervals
from heli_jax import Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.flights.resample import Timed, at_nearest
from heli_jax.simulation.inputs import random_steps

N, DT, FINE = 1500, 0.02, 20
NOISE, RATE_NOISE = 2e-3, 5e-2


def _flight(seed: int, interpolated: bool) -> Flight:
    vehicle = load_vehicle(BENCH)
    num, den = (np.array(x) for x in roll_transfer_function(vehicle, stand=True))
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
    made = []
    for numerator in (num, np.polymul(num, [1.0, 0.0])):
        discrete: Any = scipy.signal.cont2discrete((numerator, den), DT / FINE)
        b, a = discrete[:2]
        made.append(scipy.signal.lfilter(np.ravel(b), a, np.repeat(u, FINE)))
    at = 200 * np.arange(1, 149) + rng.integers(-20, 21, 148)
    roll, grid = made[0][at] + NOISE * rng.standard_normal(at.size), DT * np.arange(N)
    slow = Timed(at * DT / FINE, roll)
    samples = at_nearest(slow, grid)
    if interpolated:
        samples = np.interp(grid, *slow, left=np.nan, right=np.nan)
    rate = made[1][::FINE] + RATE_NOISE * rng.standard_normal(N)
    outputs = {"roll": samples, "roll_rate": rate}
    return Flight(dt=DT, inputs={"x_roll": u}, outputs=outputs)


def one_run(seed: int, interpolated: bool = False) -> Run:
    vehicle = load_vehicle(BENCH)
    free = {"Ixx": Free(0.05), "If": Free(5e-4)}
    flight = _flight(seed, interpolated)
    result = fit(Problem(models.roll_on_stand, vehicle, [flight], free))
    return intervals(result, {n: float(getattr(vehicle, n)) for n in free})


def cases() -> list[Case]:
    return [
        Case("output error, angle at 5 Hz", one_run),
        Case("output error, angle at 5 Hz interpolated", lambda seed: one_run(seed, True)),
    ]
