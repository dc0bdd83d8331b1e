"""The R-50's likelihood and Fisher information from the exact filter and from one with frozen gain.

    .venv/bin/python experiments/benchmarks/filter.py

12,000 samples in four records, 19 states, 8 outputs, 47 unknowns (33 derivatives, 6 intensities of
the turbulence, 8 noises; with the correlation times 53). On one thread, cold and warm, in one
process without a cache of compiled programs. The target: 0.5 s warm, 20 s cold.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from r50_record import NOISE, problem, record

from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.unknowns.layout import Layout, Noise, layout_of

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_enable_compilation_cache", False)
TURNS = 3
"""Number of runs; the best counts."""


class Timed(NamedTuple):
    """One way to compute the likelihood, compiled and run."""

    cold: float
    """Time with trace and compilation [s]."""
    warm: float
    """Best time of `TURNS` [s]."""
    cost: float
    gradient: np.ndarray
    fisher: np.ndarray


def timed(layout: Layout, arguments: tuple[Any, ...]) -> Timed:
    def likelihood(*arguments: Any) -> Any:
        at = residual_and_jacobian(layout, *arguments)
        return at.cost, at.J.T @ at.r, at.J.T @ at.J

    cold, program = _seconds(lambda: jax.jit(likelihood).lower(*arguments).compile())
    run = [_seconds(lambda: jax.block_until_ready(program(*arguments))) for _ in range(1 + TURNS)]
    cost, gradient, fisher = jax.device_get(run[-1][1])
    return Timed(cold, min(seconds for seconds, _ in run[1:]), float(cost), gradient, fisher)


def _seconds(do: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    done = do()
    return time.perf_counter() - begin, done


def compared(taus: bool) -> None:
    flights = tuple(record(seed) for seed in range(4))
    of = problem(list(flights), taus=taus)
    layout, data = layout_of(of, flights), data_of(of, flights)
    sd = tuple({n: np.float64(NOISE[n]) for n in sorted(f.outputs)} for f in flights)
    arguments = (data, Noise(sd, np.zeros(())), jnp.asarray(start_vector(layout, data, of)))
    frozen = timed(layout, arguments)
    exact = timed(dataclasses.replace(layout, one_covariance=()), arguments)
    print(f"{layout.size} unknowns, {sum(f.n_samples for f in flights)} samples")
    print("                       cold [s]   warm [s]")
    for name, way in (("exact, each record", exact), ("shared, gain freezes", frozen)):
        print(f"  {name:21} {way.cold:8.1f}   {way.warm:8.3f}")
    size = np.sqrt(np.diag(exact.fisher))
    print(
        f"  {exact.warm / frozen.warm:.1f} times as fast; they differ by "
        f"{abs(frozen.cost / exact.cost - 1):.1e} in the cost, by "
        f"{np.max(np.abs(frozen.gradient - exact.gradient) / size):.1e} sd in the gradient, by "
        f"{np.max(np.abs(frozen.fisher - exact.fisher) / np.outer(size, size)):.1e} in Fisher's "
        "information"
    )


if __name__ == "__main__":
    from script import Size, asked

    TURNS = asked(__doc__, "some minutes", Size("turns", 3, 1, "how often each is timed")).turns
    compared(taus=False)
    compared(taus=True)
