"""Sweeps on a GPU by XLA compared with the processor, by batch and precision.

It runs the compiled part of batches of the roll model and of the whole helicopter: on the GPU by
XLA, and on the processor by XLA and by the fused kernel. Without a GPU it ends with a message.

    .venv/bin/python experiments/benchmarks/gpu_sweeps.py [--quick] [SAMPLES]
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from heli_jax import Flight, load_vehicle, models, naming
from heli_jax.sweeps import Range, Reduce, sobol
from heli_jax.sweeps.fused_program import FusedProgram
from heli_jax.sweeps.program import Program, arguments
from heli_jax.sweeps.spec import Job, RunOptions, job

sys.path.insert(0, str(Path(__file__).parents[1]))

from script import Size, asked

jax.config.update("jax_enable_x64", True)
VEHICLES = Path(__file__).parents[2] / "configs" / "vehicles"
BATCHES = (1000, 10_000, 100_000, 1_000_000)


def described(name: str, solver: str, precision: Any, samples: int, n: int) -> Job:
    """Return a sweep over Ixx, of the roll model on its stand or of a whole helicopter."""
    stand = name == "roll"
    model = models.roll_on_stand if stand else models.by_name(name)
    file, Ixx = ("bench-30.yaml", (0.02, 0.05)) if stand else ("x-cell-60.yaml", (0.15, 0.25))
    vehicle = load_vehicle(VEHICLES / file, model.Params)
    rng = np.random.default_rng(0)
    inputs = {
        u: 2e-6 * np.repeat(rng.uniform(-1, 1, -(-samples // 100)), 100)[:samples]
        for u in naming.names(model.Inputs)
    }
    flight = Flight(dt=0.02, inputs=inputs, outputs={})
    reduce = {"rms": Reduce("rms", "roll")}
    options = RunOptions(solver, 4, precision)
    return job(model, vehicle, flight, sobol({"Ixx": Range(*Ixx)}, n), reduce, options)


def cases() -> Iterator[tuple[str, str, str]]:
    for precision in ("float32", "float64"):
        yield from (("roll", s, precision) for s in ("exact", "rk4"))
        yield from ((f"helicopter{k}", "rk4", precision) for k in ("", "-paper", "-consistent"))


def timed(kind: Any, wanted: Job, n: int, platform: str) -> float:
    """Return the least time of three batches [s], after one that compiles."""
    devices = jax.devices(platform)
    program = kind(wanted, 0, devices[:1] if platform != "cpu" else devices, n // len(devices))
    values = arguments(wanted, wanted.design.values(0, n))
    taken = []
    for _ in range(4):
        begin = time.perf_counter()
        jax.block_until_ready(program(values, n))
        taken.append(time.perf_counter() - begin)
    return min(taken[1:])


def main() -> None:
    samples = Size("samples", 6000, 200, "samples of a record")
    options = asked(__doc__, "not known with a GPU", samples)
    if jax.default_backend() == "cpu":
        print("no GPU here")
        return
    print(f"{jax.local_devices()[0].device_kind}, {options.samples} samples, flights a second")
    print(f"{'':38}{'vehicles':>10}{'GPU, XLA':>14}{'CPU, XLA':>14}{'CPU, fused':>14}")
    ways = ((Program, jax.default_backend()), (Program, "cpu"), (FusedProgram, "cpu"))
    for name, solver, precision in cases():
        for n in BATCHES[:2] if options.quick else BATCHES:
            wanted = described(name, solver, precision, options.samples, n)
            rates = [n / timed(kind, wanted, n, platform) for kind, platform in ways]
            what = f"{name}, {solver}, {precision}"
            print(f"{what:38}{n:>10}{''.join(f'{r:14.3g}' for r in rates)}", flush=True)


if __name__ == "__main__":
    main()
