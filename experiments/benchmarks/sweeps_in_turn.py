"""Processor time of sweeps and the best C kernel in turn, for a busy computer.

Work, kernels and threads are those of `sweeps.py`. Each number is again the slope between a small
and a large number of vehicles, here the median of some rounds; ratios are within a round. Waiting
(for the disk, the other thread) does not count.

    .venv/bin/python experiments/benchmarks/sweeps_in_turn.py [exact | rk4] [ROUNDS]
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["JAX_NUM_CPU_DEVICES"] = str(len(os.sched_getaffinity(0)))

import jax
import numpy as np
from kernels import compiled
from sweeps import BACKENDS, BUILDS, arrays, check, in_c, ours, record

SIZES = {"exact": (65_536, 131_072), "rk4": (8192, 16_384)}
"""Numbers of vehicles; whole chunks of a sweep."""


def ways(solver: str) -> dict[str, list[Callable[[], Any]]]:
    """Return by name the runs of a small and of a large number of vehicles."""
    flight, devices, sizes = record(6000), jax.local_devices(), SIZES[solver]
    large = arrays(sizes[1])
    some = [(large[0][:, :n], large[1][:, :n]) for n in sizes]
    found: dict[str, list[Callable[[], Any]]] = {}
    for backend in BACKENDS:
        found[backend] = [
            lambda n=n, backend=backend: ours(flight, n, solver, devices=devices, backend=backend)
            for n in sizes
        ]
        found[backend][0]()  # compiles
    for name, flags in BUILDS.items():
        kernel = compiled("kernel.c", flags)
        found[f"C, {name}"] = [in_c(kernel, flight, solver, v, len(devices)) for v in some]
        check(flight, solver, found[f"C, {name}"][0]())
    return found


def processor_time(run: Callable[[], Any]) -> float:
    begin = time.process_time()
    run()
    return time.process_time() - begin


def main(solver: str, rounds: int) -> None:
    few, many = SIZES[solver]
    found = ways(solver)
    taken = np.array(
        [
            [
                1e6 * (processor_time(large) - processor_time(small)) / (many - few)
                for small, large in found.values()
            ]
            for _ in range(rounds)
        ]
    )
    in_c = [name.startswith("C") for name in found]
    best = np.flatnonzero(in_c)[np.argmin(np.median(taken[:, in_c], axis=0))]
    print(f"{solver}, {len(jax.local_devices())} threads, medians of {rounds} rounds")
    for k, name in enumerate(found):
        ratio = np.median(taken[:, k] / taken[:, best])
        print(f"{name:24} {np.median(taken[:, k]):8.2f} us a vehicle, {ratio:.2f} of the best C")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from script import Size, asked

    sizes = (
        Size("solver", "exact", "exact", "exact or rk4"),
        Size("rounds", 5, 1, "of all programs in turn"),
    )
    options = asked(__doc__, "some minutes", *sizes)
    main(options.solver, options.rounds)
