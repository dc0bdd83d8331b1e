"""Output error with autocorrelated residuals: AR(1) noise with missing samples, or gusts.

The response to gusts is as large as the driven one (the disturbed bench). The records come from
scipy and the closed form of eq. 23, not from our own simulation.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.signal

from coverage_cases import BENCH, Case, Run, intervals
from coverage_cases.disturbed import response
from heli_jax import Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.simulation.inputs import random_steps

DT, RHO, NOISE = 0.02, 0.9, 2e-3
Missing = Callable[[int, np.random.Generator], np.ndarray]

MISSING: dict[str, Missing] = {
    "complete": lambda n, rng: np.zeros(n, bool),
    "every second sample missing": lambda n, rng: np.arange(n) % 2 == 1,
    "a random half missing": lambda n, rng: rng.permutation(n) < n // 2,
}


def ar_run(missing: Missing, seed: int) -> Run:
    """Fit 60 s of the bench with AR(0.9) measurement noise."""
    n = 3000
    vehicle = load_vehicle(BENCH)
    num, den = roll_transfer_function(vehicle, stand=True)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(n, DT, rng, (0.2, 1.5))
    y = scipy.signal.lfilter(np.ravel(discrete[0]), discrete[1], u)
    noise = np.sqrt(1.0 - RHO**2) * NOISE * rng.standard_normal(n + 500)
    y = y + scipy.signal.lfilter([1.0], [1.0, -RHO], noise)[500:]
    y = np.where(missing(n, rng), np.nan, y)
    return fitted(vehicle, u, y, {"Ixx": Free(0.05), "If": Free(5e-4)})


def disturbed_run(seed: int) -> Run:
    """Fit records of monte_carlo.py: 120 s, with an acceleration of 1 s correlation time."""
    n = 6000
    vehicle = load_vehicle(BENCH)
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(n, DT, rng, (0.2, 1.5))
    y = response(vehicle, u, DT, 1.04, 1.0, rng)[:, 0] + NOISE * rng.standard_normal(n)
    free = {"Ixx": Free(0.03), "If": Free(2.5e-4), "kappa": Free(3.0)}
    return fitted(vehicle, u, y, free)


def fitted(vehicle: Any, u: np.ndarray, y: np.ndarray, free: dict[str, Free]) -> Run:
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    result = fit(Problem(models.roll_on_stand, vehicle, [flight], free))
    run = intervals(result, {n: float(getattr(vehicle, n)) for n in free})
    undetermined = bool(result.not_identifiable)
    flags = {"taken for white": not result.coloured, "not determined": undetermined}
    return dataclasses.replace(run, flags=flags)


def cases() -> list[Case]:
    ar = [Case(f"output error, AR(0.9), {n}", partial(ar_run, m)) for n, m in MISSING.items()]
    return [*ar, Case("output error, disturbed bench", disturbed_run)]
