"""Convergence of output error from distant starts, alone and after a fit in frequency.

    .venv/bin/python experiments/frequency_start.py [RUNS]

The stand is lightly damped (60 swings in a record of 60 s, by SciPy). Ixx, If and kappa start up to
FACTOR times off, log-uniformly. The table counts the fits that end within 2 % of the truth.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from heli_jax import Free, Problem, fit, models
from heli_jax.identification.fit import frequency_error_start, started
from tests.identification.bench import BENCH, record, vehicle

jax.config.update("jax_enable_x64", True)
STAND = {**BENCH, "zeta": 0.02, "kappa": 40.0}
NAMES = ("Ixx", "If", "kappa")


def arrives(problem: Problem) -> tuple[bool, int, float]:
    """Return True if output error converges to the truth, its steps, and its time [s]."""
    began = time.perf_counter()
    found = fit(problem)
    near = all(abs(found.estimates[n].value / STAND[n] - 1.0) < 0.02 for n in NAMES)
    return near and found.status == "converged", found.steps, time.perf_counter() - began


def main(runs: int) -> None:
    flight = record(STAND, seed=3, n=3000)
    print("| factor | by itself: arrived, steps, s | start in frequency: arrived, steps, s |")
    print("|---|---|---|")
    for factor in (4.0, 10.0, 30.0):
        rng, rows = np.random.default_rng(int(factor)), []
        for _ in range(runs):
            off = factor ** rng.uniform(-1.0, 1.0, len(NAMES))
            free = {n: Free(float(f * STAND[n])) for n, f in zip(NAMES, off, strict=True)}
            problem = Problem(models.roll_on_stand, vehicle(STAND), [flight], free)
            alone = arrives(problem)
            began = time.perf_counter()
            guess = frequency_error_start(problem)
            seconds = time.perf_counter() - began
            arrived, steps, later = arrives(started(problem, guess))
            rows.append((*alone, arrived, steps, seconds + later))
        a, b, c, d, e, f = np.array(rows, float).T
        print(
            f"| {factor:g} | {a.sum():.0f} of {runs}, {np.median(b):.0f}, {np.median(c):.2f} | "
            f"{d.sum():.0f} of {runs}, {np.median(e):.0f}, {np.median(f):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    from script import Size, asked

    main(asked(__doc__, "three minutes", Size("runs", 20, 1, "starts of each factor")).runs)
