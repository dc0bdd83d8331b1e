"""Output error on the bench with white noise.

The records come from scipy and the closed form of eq. 23, not from our own simulation.
"""

from typing import Any

import numpy as np
import scipy.signal

from coverage_cases import BENCH, Case, Run, intervals
from heli_jax import Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.simulation.inputs import random_steps

N, DT, NOISE = 4000, 0.02, 2e-3


def one_run(seed: int) -> Run:
    vehicle = load_vehicle(BENCH)
    num, den = roll_transfer_function(vehicle, stand=True)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    b, a = discrete[:2]
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
    y = scipy.signal.lfilter(np.ravel(b), a, u) + NOISE * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    free = {"Ixx": Free(0.05), "If": Free(5e-4)}
    result = fit(Problem(models.roll_on_stand, vehicle, [flight], free))
    return intervals(result, {n: float(getattr(vehicle, n)) for n in free})


def cases() -> list[Case]:
    return [Case("output error, white noise", one_run)]
