"""How many elements a device computes side by side: measured once where it pays, and remembered."""

import contextlib
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from heli_jax import naming
from heli_jax.regular_file import in_the_way, read_regular
from heli_jax.sweeps.program import Program, arguments, shapes
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import BLOCKS, Split

BACKENDS = ("auto", "xla", "fused")
# Elements side by side where nothing is measured: on a core a few vectors of them, so that their
# states stay in its cache; on a GPU enough for all its threads.
_CPU, _GPU = 64, 1 << 17
_CANDIDATES = {"cpu": (32, 64, 128, 256), "gpu": (1 << 13, 1 << 15, 1 << 17)}
# [s] A sweep that takes less is not worth measuring for: every candidate is compiled.
_WORTH_S = 60.0
# What an element takes may be so many times the guess: with less there is nothing to time.
_OFF_BY = 10.0
# [s] What a chunk should take, about: a kill costs as much, and writing is to be little of it.
_CHUNK_S = 2.0
# [bytes] Results of a chunk: two chunks are held at once, one computed and one written.
_CHUNK_BYTES = 64e6
# Chunks, about, where there are enough elements, so that progress shows; twice as many for each of
# several processes, so that none waits long for the last one.
_CHUNKS = 4
# [bytes] Whole runs held side by side, where a function of the user's sees them.
_RUN_BYTES = {"cpu": 256e6, "gpu": 8e9}
# Elements of a chunk at most.
_MOST_ELEMENTS = {"cpu": 1 << 16, "gpu": 1 << 18}


def split_for(
    job: Job,
    *,
    devices: Sequence[Any] | None = None,
    chunk: int | None = None,
    lanes: int | None = None,
    backend: str = "auto",
    shares: int = 1,
    memory: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Split:
    """How to cut a sweep: into chunks that are written at once, and those into what a device
    computes side by side.

    Args:
        job: the sweep.
        devices: of JAX; those of this process unless given.
        chunk: elements written at a time; taken as it is where it is given, up to the sweep's.
        lanes: elements computed side by side on a device; likewise.
        backend: "xla", "fused" (a run as one program of machine code), or "auto": fused on
            CPUs where it can be.
        shares: how many processes take chunks side by side; each shall have several.
        memory: a file that keeps what was measured.
        say: called with a sentence where measuring takes a while, or a run has no fused program.

    Raises:
        ValueError: no such backend, or fused where it cannot be.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    devices = tuple(jax.local_devices() if devices is None else devices)
    kind = "cpu" if devices[0].platform == "cpu" else "gpu"
    share = math.ceil(job.design.size / len(devices))
    asked = lanes
    if lanes is None:
        # A small sweep still has BLOCKS blocks a device, or XLA would write other code for it.
        lanes = min(_default(job, kind), _power(share / BLOCKS))
    chosen = "xla" if backend == "xla" else _fused_or_xla(job, devices, lanes, backend, say)
    # A fused program has its own number of vehicles in flight.
    if asked is None and chosen == "xla" and share > 8 * max(_CANDIDATES[kind]):
        lanes = _measured(job, devices, kind, lanes, memory, say)
    if chunk is None:
        chunk = _chunk_for(job, kind, len(devices), lanes, shares)
    # No larger than the sweep: what a chunk lacks in elements is computed all the same.
    step = BLOCKS * lanes * len(devices)
    return Split(min(chunk, math.ceil(job.design.size / step) * step), lanes, chosen)


def _fused_or_xla(
    job: Job, devices: tuple[Any, ...], lanes: int, backend: str, say: Callable[[str], None]
) -> str:
    # Here, since it loads another compiler.
    from heli_jax.sweeps.fused_program import refusal

    why = refusal(job, devices, lanes)
    if why is None:
        return "fused"
    if backend == "fused":
        raise ValueError(f"backend: this sweep cannot be fused: {why}; expected auto or xla")
    if job.streamed and job.simulated:
        say(f"each run is computed by XLA step by step, not as one program: {why}")
    return "xla"


def _chunk_for(job: Job, kind: str, n_devices: int, lanes: int, shares: int) -> int:
    """Elements of a chunk: whole blocks of all devices, of a few seconds and not much memory."""
    step = BLOCKS * lanes * n_devices
    heaviest = max(_bytes(shapes(job, i)) for i in range(len(job.flights)))
    room = min(_MOST_ELEMENTS[kind], 1 << int(math.log2(max(1.0, _CHUNK_BYTES / heaviest))))
    # The guess of the time is for a core; a GPU is done with any chunk that fits sooner than that.
    in_time = room if kind == "gpu" else _power(_CHUNK_S * n_devices / _guess(job))
    chunks = _CHUNKS if shares == 1 else 2 * _CHUNKS * shares
    each = _power(job.design.size / chunks)
    return max(step, math.ceil(min(in_time, room, each) / step) * step)


def _power(n: float) -> int:
    """The power of two at or above n."""
    return 1 << max(0, math.ceil(math.log2(max(1, n))))


def _bytes(tree: Any) -> int:
    """Of all arrays in a pytree, or of arrays of these shapes."""
    return sum(v.size * v.dtype.itemsize for v in jax.tree.leaves(tree))


def _guess(job: Job) -> float:
    """Seconds an element takes on a core, within a factor of five: a nanosecond for each state,
    sample and stage."""
    # Not measured: a sweep shall be cut in the same way each time, or its last digits would differ
    # from one day to the next.
    samples = sum(f.n_samples for f in job.flights) if job.simulated else 1
    # The exact step is one product of matrices; the others are taken for Runge-Kutta of order 4.
    stages = 1 if job.solver == "exact" else 4 * job.substeps
    return 1e-9 * samples * stages * len(naming.names(job.model.State))


def _default(job: Job, kind: str) -> int:
    """Elements side by side on a device, unless something faster is measured."""
    most = _CPU if kind == "cpu" else _GPU
    if job.streamed:
        return most
    # Whole runs are held, a block of them at a time on each device.
    model = job.model
    kept = sum(len(naming.names(c)) for c in (model.State, model.Outputs, model.Inputs))
    run = 8 * kept * max(f.n_samples for f in job.flights)
    return min(most, 1 << max(0, int(math.log2(max(1.0, _RUN_BYTES[kind] / run)))))


def _measured(
    job: Job,
    devices: tuple[Any, ...],
    kind: str,
    default: int,
    memory: Path | None,
    say: Callable[[str], None],
) -> int:
    """The fastest of some numbers, or the default where the whole sweep is over sooner."""
    # All that what is fastest may depend on; the vehicle and the axes' values are not of it.
    key = "|".join(
        [
            devices[0].device_kind,
            job.model.name,
            f"{job.solver}x{job.substeps}",
            job.precision,
            "streamed" if job.streamed else "whole",
            ",".join(sorted(str(r.how) for r in job.reduce.values() if isinstance(r.how, str))),
        ]
    )
    known = _remembered(memory)
    if isinstance(known.get(key), int) and known[key] >= 1:
        return known[key]
    # To time it is to compile it at a size of its own, which takes longer than most sweeps do.
    if _OFF_BY * _guess(job) * job.design.size < _WORTH_S * len(devices):
        return default
    first = _time(job, devices, default)
    if first * job.design.size < _WORTH_S:
        return default
    say("measuring how many elements to compute side by side")
    # Where whole runs are held the default is what memory has room for: no more are tried.
    limit = max(default, max(_CANDIDATES[kind])) if job.streamed else default
    seconds = {default: first}
    for lanes in _CANDIDATES[kind]:
        if lanes not in seconds and lanes <= limit:
            seconds[lanes] = _time(job, devices, lanes)
    best = min(seconds, key=lambda lanes: seconds[lanes])
    if memory is not None and in_the_way(memory) is None:
        # A cache folder that cannot be written to costs the next sweep a minute, and no more.
        with contextlib.suppress(OSError):
            memory.parent.mkdir(parents=True, exist_ok=True)
            memory.write_text(json.dumps({**known, key: best}, indent=1), encoding="utf-8")
    return best


def _remembered(memory: Path | None) -> dict[str, Any]:
    if memory is None:
        return {}
    try:
        remembered = json.loads(read_regular(memory, "what was measured", 10**6))
    except ValueError:  # InputError is one
        return {}
    # Somebody may have edited the file: what is no dictionary is as good as no file.
    return remembered if isinstance(remembered, dict) else {}


def _time(job: Job, devices: tuple[Any, ...], lanes: int) -> float:
    """Seconds an element takes, the best of three runs of as few blocks as a device has."""
    program = Program(job, 0, devices, lanes)
    count = min(BLOCKS * lanes * len(devices), job.design.size)
    values = arguments(job, job.design.values(0, count))
    jax.block_until_ready(program(values, count))  # compiles
    best = math.inf
    for _ in range(3):
        begin = time.perf_counter()
        jax.block_until_ready(program(values, count))
        best = min(best, time.perf_counter() - begin)
        if best > 5.0:  # [s] long enough for a clock, and three would try the user's patience
            break
    return best / count
