"""Flights held out of fits in frequency: how often they agree, and which faults they reveal.

    .venv/bin/python experiments/held_out_frequency.py [RUNS] [METHOD]

The disturbed bench of frequency_error.py: a record of 120 s is fitted, and four of 60 s, made with
SciPy alone, are held out. They have the same vehicle in equal gusts, double gusts and no gusts, and
one with a tenth more inertia. The table shows how often each gives other estimates (1 % by chance),
and the share of the response to the excitation that the model explains.
"""

import dataclasses

import jax
import numpy as np
from coverage_cases.disturbed import response
from frequency_error import DT, NAMES, NOISE, TAU, VEHICLE, steps

from heli_jax import Flight, Free, Problem, fit, models, naming
from heli_jax.analysis.spectra import ResponseOptions

jax.config.update("jax_enable_x64", True)
HELD = 3000
HEAVY = naming.replace(VEHICLE, Ixx=1.1 * VEHICLE.Ixx)
CASES = {
    "as strong": (VEHICLE, 1.04),
    "twice as strong": (VEHICLE, 2.08),
    "none": (VEHICLE, 0.0),
    "as strong, Ixx a tenth larger": (HEAVY, 1.04),
}


def flight(seed: int, case: str, samples: int) -> Flight:
    """Return a record of one case."""
    rng = np.random.default_rng(seed)
    u = steps(rng)[:samples]
    vehicle, sigma = CASES[case]
    roll = response(vehicle, u, DT, sigma, TAU, rng)[:, 0]
    roll = roll + NOISE * rng.standard_normal(samples)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": roll}, name=case)


def main(runs: int, method: str) -> None:
    free = {n: Free(1.3 * float(getattr(VEHICLE, n))) for n in NAMES}
    found = {case: [] for case in CASES}
    for seed in range(runs):
        held = [flight(1000 * (seed + 1) + k, case, HELD) for k, case in enumerate(CASES)]
        held = [dataclasses.replace(f, hold_out=True) for f in held]
        fitted = flight(seed, "as strong", 2 * HELD)
        problem = Problem(
            models.roll_on_stand, VEHICLE, [fitted, *held], free, method=method,
            frequency=ResponseOptions(window=8.0),
        )  # fmt: skip
        said = fit(problem).held_out_frequency
        for case, one in zip(CASES, said.flights if said else (), strict=True):
            found[case].append(one)
    print("| gusts | estimates differ | explained |")
    print("|---|---|---|")
    for case, each in found.items():
        explained = [v for f in each for v in f.explained.values()]
        cells = (
            case,
            f"{100 * np.mean([f.differs for f in each]):.0f} %",
            f"{100 * np.median(explained):.1f} %" if explained else "",
        )
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "three minutes",
        Size("runs", 100, 3, "fitted records"),
        Size("method", "frequency-error", "frequency-error", "of the fit"),
    )
    main(options.runs, options.method)
