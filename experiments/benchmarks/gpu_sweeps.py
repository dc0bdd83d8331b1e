"""Sweeps on a GPU: each run as one program of its own against XLA's loop, by batch and precision.

Where JAX finds a GPU, the compiled part alone is timed, whole batches at once, of the roll model
and of the whole helicopter. Without one it says what can be said: what the programs are made of,
and, where CUDA's `ptxas` is installed, how many registers they take and what lies in memory.

    .venv/bin/python experiments/benchmarks/gpu_sweeps.py [--quick] [SAMPLES]
"""

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from heli_jax import Flight, load_vehicle, models, naming
from heli_jax.fused.ptx import ptx
from heli_jax.sweeps import Range, Reduce, sobol
from heli_jax.sweeps.fused_program import FusedProgram, run_of
from heli_jax.sweeps.program import Program, arguments
from heli_jax.sweeps.spec import Job, RunOptions, job

sys.path.insert(0, str(Path(__file__).parents[1]))

from script import Size, asked

jax.config.update("jax_enable_x64", True)
VEHICLES = Path(__file__).parents[2] / "configs" / "vehicles"
BATCHES = (1000, 10_000, 100_000, 1_000_000)


def described(name: str, solver: str, precision: Any, samples: int, n: int) -> Job:
    """A sweep over Ixx, of the roll model on its stand or of a whole helicopter."""
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


def timed(kind: Any, wanted: Job, n: int) -> float:
    """The least seconds of three batches, after one that compiles."""
    program = kind(wanted, 0, jax.local_devices()[:1], n)
    values = arguments(wanted, wanted.design.values(0, n))
    taken = []
    for _ in range(4):
        begin = time.perf_counter()
        jax.block_until_ready(program(values, n))
        taken.append(time.perf_counter() - begin)
    return min(taken[1:])


def on_gpu(samples: int, batches: tuple[int, ...]) -> None:
    print(f"{jax.local_devices()[0].device_kind}, {samples} samples, flights a second")
    print(f"{'':30}{'vehicles':>10}{'one program':>14}{'XLA':>14}{'times':>8}")
    for name, solver, precision in cases():
        for n in batches:
            wanted = described(name, solver, precision, samples, n)
            ours, xla = (n / timed(kind, wanted, n) for kind in (FusedProgram, Program))
            what = f"{name}, {solver}, {precision}"
            print(f"{what:38}{n:>10}{ours:14.3g}{xla:14.3g}{ours / xla:8.1f}", flush=True)


def without(samples: int, capability: int = 90) -> None:
    """What of the programs can be said without a GPU."""
    tool = shutil.which("ptxas")
    print(f"no GPU here: programs for compute capability {capability / 10}, {samples} samples")
    if tool is None:
        print("no ptxas here: registers and memory are not known")
    for name, solver, precision in cases():
        begin = time.process_time()
        run = run_of(described(name, solver, precision, samples, 64), 0)
        text, _ = ptx(run, capability)
        taken = time.process_time() - begin
        line = f"{name}, {solver}, {precision}: {text.count(chr(10))} lines, made in {taken:.1f} s"
        if tool is not None:
            line += assembled(tool, text, capability)
        print(line, flush=True)


def assembled(tool: str, text: str, capability: int) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.ptx"
        path.write_text(text)
        out = Path(folder) / "run.cubin"
        done = subprocess.run(
            [tool, "-v", f"-arch=sm_{capability}", "-o", out, path],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    registers = re.findall(r"Used (\d+) registers", done.stderr)
    spilled = re.findall(r"(\d+) bytes spill stores", done.stderr)
    return f"; {registers[0]} registers, {spilled[0]} bytes of them in memory"


def main() -> None:
    samples = Size("samples", 6000, 200, "samples of a record")
    options = asked(__doc__, "half a minute without a GPU (with one not known)", samples)
    if jax.default_backend() == "cpu":
        without(options.samples)
    else:
        on_gpu(options.samples, BATCHES[:2] if options.quick else BATCHES)


if __name__ == "__main__":
    main()
