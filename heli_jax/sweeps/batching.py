"""Division of a sweep into chunks, and of chunks into batches of elements."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax

from heli_jax import naming
from heli_jax.sweeps.program import shapes
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import BLOCKS, Split

BACKENDS = ("auto", "xla", "fused")
# Batch sizes: on a core a few vectors, so that their states stay in its cache; on a GPU enough for
# all its threads.
_CPU, _GPU = 64, 1 << 17
# [s] Approximate time of a chunk: a kill loses as much, and writing should be a small part of it.
_CHUNK_S = 2.0
# [bytes] Results of a chunk; two chunks are held at once, one in computation and one being written.
_CHUNK_BYTES = 64e6
# [bytes] Whole runs held at once, for a user's function.
_RUN_BYTES = {"cpu": 256e6, "gpu": 8e9}
# Most elements of a chunk.
_MOST_ELEMENTS = {"cpu": 1 << 16, "gpu": 1 << 18}


def split_for(
    job: Job,
    *,
    devices: Sequence[Any] | None = None,
    chunk: int | None = None,
    lanes: int | None = None,
    backend: str = "auto",
    say: Callable[[str], None] = lambda _: None,
) -> Split:
    """Divide a sweep into chunks that are written at once, and these into batches of the device.

    Args:
        devices: devices of JAX; by default those of this process.
        chunk: elements written at a time; chosen by default.
        lanes: batch size; chosen by default.
        backend: one of `BACKENDS`.
        say: function that reports a note.

    Raises:
        ValueError: unknown backend, or fused where it is impossible.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    devices = tuple(jax.local_devices() if devices is None else devices)
    kind = "cpu" if devices[0].platform == "cpu" else "gpu"
    share = math.ceil(job.design.size / len(devices))
    if lanes is None:
        # A small sweep also has BLOCKS blocks per device, or XLA would generate different code for
        # it.
        lanes = min(_default(job, kind), _power(share / BLOCKS))
    chosen = "xla" if backend == "xla" else _fused_or_xla(job, devices, lanes, backend, say)
    if chunk is None:
        chunk = _chunk_for(job, kind, len(devices), lanes)
    # No larger than the sweep, because missing elements of a chunk are computed all the same.
    step = BLOCKS * lanes * len(devices)
    return Split(min(chunk, math.ceil(job.design.size / step) * step), lanes, chosen)


def _fused_or_xla(
    job: Job, devices: tuple[Any, ...], lanes: int, backend: str, say: Callable[[str], None]
) -> str:
    # Here, because it loads another compiler.
    from heli_jax.sweeps.fused_program import refusal

    why = refusal(job, devices, lanes)
    if why is None:
        return "fused"
    if backend == "fused":
        raise ValueError(f"backend: this sweep cannot be fused: {why}; expected auto or xla")
    if job.streamed and job.simulated:
        say(f"each run is computed by XLA step by step, not as one program: {why}")
    return "xla"


def _chunk_for(job: Job, kind: str, n_devices: int, lanes: int) -> int:
    """Return the elements of a chunk: whole blocks of all devices, limited by time and memory."""
    step = BLOCKS * lanes * n_devices
    each = (jax.tree.leaves(shapes(job, i)) for i in range(len(job.flights)))
    heaviest = max(sum(v.size * v.dtype.itemsize for v in leaves) for leaves in each)
    room = min(_MOST_ELEMENTS[kind], 1 << int(math.log2(max(1.0, _CHUNK_BYTES / heaviest))))
    # The estimate is for a core; a GPU finishes any chunk that fits sooner.
    in_time = room if kind == "gpu" else _power(_CHUNK_S * n_devices / _guess(job))
    return max(step, math.ceil(min(in_time, room) / step) * step)


def _power(n: float) -> int:
    """Return the power of two at or above n."""
    return 1 << max(0, math.ceil(math.log2(max(1, n))))


def _guess(job: Job) -> float:
    """Return the estimated seconds per element on a core, within a factor of five.

    It assumes a nanosecond for each state, sample and stage.
    """
    # Not measured: a sweep must be divided in the same way each time, or its last digits would
    # change from day to day.
    samples = sum(f.n_samples for f in job.flights) if job.simulated else 1
    # The exact step is one product of matrices; the others are assumed to be Runge-Kutta of order
    # 4.
    stages = 1 if job.options.solver == "exact" else 4 * (job.options.substeps or 1)
    return 1e-9 * samples * stages * len(naming.names(job.model.State))


def _default(job: Job, kind: str) -> int:
    """Return the batch size of a device."""
    most = _CPU if kind == "cpu" else _GPU
    if job.streamed:
        return most
    # Whole runs are held, a block of them at a time on each device.
    model = job.model
    kept = sum(len(naming.names(c)) for c in (model.State, model.Outputs, model.Inputs))
    run = 8 * kept * max(f.n_samples for f in job.flights)
    return min(most, 1 << max(0, int(math.log2(max(1.0, _RUN_BYTES[kind] / run)))))
