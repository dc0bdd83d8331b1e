"""The optimiser compared with optimistix's plain Levenberg-Marquardt: steps, time and optima.

    .venv/bin/python experiments/benchmarks/optimiser.py [WORDS]

Both repeat the optimiser's first run in fits of the zoo and of the rigs in corpus_cases.py,
compiled and from the same point. WORDS select cases by their names. A case is listed if one of them
fails, ends at another cost, or takes twice the other's steps. Fits by filter error are left out:
their likelihood is no sum of squares.
"""

import contextlib
import functools
import io
import sys
import tempfile
import time
import unittest.mock
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

sys.path.insert(0, str(Path(__file__).parents[1]))
from corpus_cases import rig_cases, zoo_cases

from heli_jax.identification.estimation import multistart
from heli_jax.identification.estimation.residual import cost_of, rows_of
from heli_jax.identification.estimation.simulated_flights import measured_count

jax.config.update("jax_enable_x64", True)

SAME = 1e-3
"""Relative difference of the costs of two distinct optima."""
TURNS = 5
MAX_STEPS = 200


class Run(NamedTuple):
    """Result of one optimiser."""

    steps: int
    seconds: float
    cost: float
    converged: bool


class _Recorded(BaseException):
    """Raised to end a fit once its arguments are recorded."""


def recorded(case: Any) -> list[tuple[Any, ...]]:
    """Return the arguments (layout, data, noise, z0) of the optimiser's first run in a case's fit.

    The fit ends there.
    """
    calls: list[tuple[Any, ...]] = []
    optimise = multistart.optimise

    @functools.wraps(optimise)
    def keep(*args: Any, **options: Any) -> Any:
        # A search over initial states alone is a different one.
        if options.get("held") is None:
            calls.append((*args[:3], jnp.asarray(args[3])))
            raise _Recorded
        return optimise(*args, **options)

    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        unittest.mock.patch.object(multistart, "optimise", keep),
        contextlib.suppress(_Recorded),
    ):
        case.run(Path(folder))
    return calls


def timed(run: Callable[[], tuple[int, float, bool]]) -> Run:
    """Return the best of some runs, without the first, which compiles."""
    steps, cost, converged = run()
    seconds = []
    for _ in range(TURNS):
        began = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - began)
    return Run(steps, min(seconds), cost, converged and bool(np.isfinite(cost)))


def ours(layout: Any, data: Any, noise: Any, z0: Any) -> tuple[int, float, bool]:
    """Run heli_jax's optimiser."""
    end = multistart.optimise(layout, data, noise, z0, MAX_STEPS)
    cost = float(cost_of(layout, data, noise, jnp.asarray(end.z)))
    return int(end.steps), cost / measured_count(data), bool(end.converged)


@functools.cache
def _plain_program(layout: Any) -> Any:
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def program(data: Any, noise: Any, z0: Any) -> Any:
        return optx.least_squares(
            lambda z, _: rows_of(layout, data, noise, z),
            solver,
            z0,
            options={"jac": "fwd"},
            max_steps=MAX_STEPS,
            throw=False,
        )

    return eqx.filter_jit(program)


def plain(layout: Any, data: Any, noise: Any, z0: Any) -> tuple[int, float, bool]:
    """Run optimistix's optimiser, with its defaults, on the same residuals."""
    end = _plain_program(layout)(data, noise, z0)
    cost = float(cost_of(layout, data, noise, end.value))
    done = bool(end.result == optx.RESULTS.successful)
    return int(end.stats["num_steps"]), cost / measured_count(data), done


def main(words: str = "") -> None:
    """Run and print the comparison."""
    cases = [c for c in (*zoo_cases(), *rig_cases()) if words in c.name]
    pairs: list[tuple[Run, Run]] = []
    print(f"{'':42}{'ours':>34}{'plain':>34}")
    for case in cases:
        if case.name.startswith("rig") and not case.name.endswith("fit"):
            continue
        # Each compiled program takes memory regions, whose number per process is limited.
        jax.clear_caches()
        for call in recorded(case):
            if call[0].noise_model == "disturbance":
                continue
            pair = timed(lambda call=call: ours(*call)), timed(lambda call=call: plain(*call))
            pairs.append(pair)
            a, b = pair
            if (
                not (a.converged and b.converged and abs(a.cost / b.cost - 1.0) < SAME)
                or not 0.5 < a.steps / b.steps < 2.0
            ):
                print(f"{case.name:42}" + "".join(_words(r) for r in pair), flush=True)
    steps, seconds, costs = (
        np.array([[getattr(r, n) for r in p] for p in pairs]) for n in ("steps", "seconds", "cost")
    )
    for i, name in enumerate(("ours", "plain")):
        failed = sum(not p[i].converged for p in pairs)
        lower = np.sum(costs[:, i] < (1.0 - SAME) * costs[:, 1 - i])
        print(
            f"{name}: {np.exp(np.mean(np.log(steps[:, i]))):.1f} steps and "
            f"{1e3 * np.exp(np.mean(np.log(seconds[:, i]))):.1f} ms (geometric means); {failed} of "
            f"{len(pairs)} did not converge, {lower} ended lower than the other"
        )


def _words(run: Run) -> str:
    end = "" if run.converged else " failed"
    return f"{run.steps:5d} {1e3 * run.seconds:8.2f} ms {run.cost:10.4g}{end:>7}"


if __name__ == "__main__":
    main(" ".join(sys.argv[1:]))
