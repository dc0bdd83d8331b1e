"""Free roll with an offset of the stick that is not in the log.

The records come from scipy and the closed form of eq. 23.
"""

import functools
from typing import Any

import numpy as np
import scipy.signal

from coverage_cases import BENCH, Case, Run, intervals
from heli_jax import Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.simulation.inputs import random_steps

N, DT, NOISE, AMPLITUDE = 2000, 0.02, 2e-3, 3e-6


def one_run(seed: int, share: float) -> Run:
    vehicle = load_vehicle(BENCH)
    num, den = roll_transfer_function(vehicle)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    rng = np.random.default_rng(seed)
    u = AMPLITUDE * random_steps(N, DT, rng, (0.2, 1.5))
    acting = u + share * AMPLITUDE
    roll = scipy.signal.lfilter(np.ravel(discrete[0]), discrete[1], acting)
    y = roll + NOISE * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    free = {"Ixx": Free(0.05), "If": Free(5e-4)}
    truth = {n: float(getattr(vehicle, n)) for n in free}
    truth["flight 1/offset x_roll"] = share * AMPLITUDE
    return intervals(fit(Problem(models.roll, vehicle, [flight], free)), truth)


def cases() -> list[Case]:
    return [
        Case(f"free roll, stick off by {100 * s:g} %", functools.partial(one_run, share=s))
        for s in (0.007, 0.03)
    ]
