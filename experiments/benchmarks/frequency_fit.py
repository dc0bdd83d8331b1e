"""Time of a compiled fit in the frequency domain: the bench, and the R-50 in closed loop.

    .venv/bin/python experiments/benchmarks/frequency_fit.py [RUNS]

One problem is the bench of experiments/frequency_error.py: a record of 6000 samples, three
parameters. The other is the R-50 of experiments/closed_loop_frequency.py, directly and with
instruments: four records of 4500 samples, six outputs, 22 parameters. On one thread, the best of
RUNS (5); no record is fitted twice in a row. Search: from the flights to converged estimates, with
the noise's spectrum and their covariance. Whole: with all results of `fit`. Times are processor
time and elapsed time, to which other load adds. The targets: 30 ms for the bench, 0.5 s for the
R-50.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
sys.path.insert(0, str(Path(__file__).parents[1]))

import closed_loop_frequency
import frequency_error
import jax

from heli_jax import Problem, fit
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import relax_noise_covariance
from heli_jax.identification.search import first_guess

jax.config.update("jax_enable_x64", True)
COMPILED = "/jax/core/compile/backend_compile_duration"
compiled: list[float] = []


def listen(event: str, duration_secs: float, **_: str | int) -> None:
    if event == COMPILED:
        compiled.append(duration_secs)


jax.monitoring.register_event_duration_secs_listener(listen)


class Took(NamedTuple):
    """Times of one fit."""

    search: float
    """Processor time [s]."""
    search_passed: float
    """Elapsed time [s]."""
    whole: float
    whole_passed: float
    steps: int
    programs: int
    """Number of compiled programs."""


def search(problem: Problem) -> None:
    """Compute estimates with covariance, as `fit` does from one start, and nothing else."""
    guess = first_guess(problem)
    over = Search(problem, guess.layout, guess.data, 200)
    # With instruments the first search uses other data, as in `fit`.
    first = Search(problem, guess.layout, guess.search_data, 200)
    [begun] = first.run(guess.noise, guess.z[None])
    found = relax_noise_covariance(over, guess.noise, begun)
    assert bool(found.best.converged)
    deviations(evaluate(guess.layout, guess.data, found.noise, found.best.z).J)


def timed(problem: Problem) -> Took:
    compiled.clear()
    times = [(time.process_time(), time.perf_counter())]
    search(problem)
    times.append((time.process_time(), time.perf_counter()))
    # One start: with free delays several would be tried, each as long as this.
    found = fit(problem, starts=1)
    times.append((time.process_time(), time.perf_counter()))
    assert found.status == "converged", found.status
    (a, b), (c, d), (e, f) = times
    return Took(c - a, d - b, e - c, f - d, found.steps, len(compiled))


def r50(method: str) -> Callable[[int], Problem]:
    options = closed_loop_frequency.METHODS[method]
    return lambda seed: closed_loop_frequency.problem(seed, **options)


def main(runs: int) -> None:
    print("| fit | cold [s] | steps | search [s] | passed | whole [s] | passed | compiled |")
    print("|---" * 8 + "|")
    cases = {
        "bench": lambda seed: frequency_error.problem(seed, 1.04, "frequency-error"),
        "R-50, direct": r50("direct"),
        "R-50, by instrument": r50("by instrument"),
    }
    for name, make in cases.items():
        problems = [make(1), make(2)]
        cold = timed(problems[0])
        each = [timed(problems[(k + 1) % 2]) for k in range(runs)]
        best = Took(*(min(values) for values in zip(*each, strict=True)))
        steps = sorted({took.steps for took in each})
        print(
            f"| {name} | {cold.search + cold.whole:.1f} | {' or '.join(map(str, steps))} | "
            f"{best.search:.3f} | {best.search_passed:.3f} | {best.whole:.3f} | "
            f"{best.whole_passed:.3f} | {max(t.programs for t in each[1:])} |",
            flush=True,
        )


if __name__ == "__main__":
    from script import Size, asked

    main(asked(__doc__, "two minutes", Size("runs", 5, 2, "fits of each")).runs)
