"""Division of a sweep into chunks, and of chunks into elements computed side by side."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax

from heli_jax import naming
from heli_jax.sweeps.program import shapes
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import BLOCKS, Split

BACKENDS = ("auto", "xla", "fused")
# Elements side by side: on a core a few vectors of them, so that their
# states stay in its cache; on a GPU enough for all its threads.
_CPU, _GPU = 64, 1 << 17
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
    say: Callable[[str], None] = lambda _: None,
) -> Split:
    """Divide a sweep into chunks that are written at once, and these into batches of the device.

    Args:
        devices: of JAX; those of this process unless given.

    Raises:
        ValueError: no such backend, or fused where it cannot be.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    devices = tuple(jax.local_devices() if devices is None else devices)
    kind = "cpu" if devices[0].platform == "cpu" else "gpu"
    share = math.ceil(job.design.size / len(devices))
    if lanes is None:
        # A small sweep still has BLOCKS blocks a device, or XLA would write other code for it.
        lanes = min(_default(job, kind), _power(share / BLOCKS))
    chosen = "xla" if backend == "xla" else _fused_or_xla(job, devices, lanes, backend, say)
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
    each = (jax.tree.leaves(shapes(job, i)) for i in range(len(job.flights)))
    heaviest = max(sum(v.size * v.dtype.itemsize for v in leaves) for leaves in each)
    room = min(_MOST_ELEMENTS[kind], 1 << int(math.log2(max(1.0, _CHUNK_BYTES / heaviest))))
    # The guess of the time is for a core; a GPU is done with any chunk that fits sooner than that.
    in_time = room if kind == "gpu" else _power(_CHUNK_S * n_devices / _guess(job))
    chunks = _CHUNKS if shares == 1 else 2 * _CHUNKS * shares
    each = _power(job.design.size / chunks)
    return max(step, math.ceil(min(in_time, room, each) / step) * step)


def _power(n: float) -> int:
    """The power of two at or above n."""
    return 1 << max(0, math.ceil(math.log2(max(1, n))))


def _guess(job: Job) -> float:
    """Seconds an element takes on a core, within a factor of five: a nanosecond for each state,
    sample and stage."""
    # Not timed: a sweep shall be cut in the same way each time, or its last digits would differ
    # from one day to the next.
    samples = sum(f.n_samples for f in job.flights) if job.simulated else 1
    # The exact step is one product of matrices; the others are taken for Runge-Kutta of order 4.
    stages = 1 if job.solver == "exact" else 4 * job.substeps
    return 1e-9 * samples * stages * len(naming.names(job.model.State))


def _default(job: Job, kind: str) -> int:
    """Elements side by side on a device."""
    most = _CPU if kind == "cpu" else _GPU
    if job.streamed:
        return most
    # Whole runs are held, a block of them at a time on each device.
    model = job.model
    kept = sum(len(naming.names(c)) for c in (model.State, model.Outputs, model.Inputs))
    run = 8 * kept * max(f.n_samples for f in job.flights)
    return min(most, 1 << max(0, int(math.log2(max(1.0, _RUN_BYTES[kind] / run)))))
