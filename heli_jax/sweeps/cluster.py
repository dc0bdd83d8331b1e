"""Chunks of a sweep computed by dask.distributed: on more processes or more machines.

Workers give their results back, and the process that was started writes them: they need no disk in
common. A worker that dies has its chunks computed by another.
"""

import contextlib
import logging
import signal
import sys
import threading
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from distributed import CancelledError, Client, LocalCluster, WorkerPlugin, as_completed
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker

from heli_jax.errors import InputError
from heli_jax.sweeps.batching import split_for
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import Split, Worker
from heli_jax.versions import versions

_RETRIES = 5
_AHEAD = 3
"""chunks that each thread of a worker has in hand or waiting"""
_CONNECT_S = 20
_IMPORTS = (
    "expected modules of your own to be there too: begin scheduler and workers with PYTHONPATH set "
    "to their folder"
)

_workers: dict[str, Worker] = {}
_building = threading.Lock()


class Prepared(WorkerPlugin):
    """A worker process that computes as the one that asks does."""

    name: Any = "heli_jax"

    def __init__(self, x64: bool, folder: str | None, cache: str | None) -> None:
        self.x64, self.folder, self.cache = x64, folder, cache

    def setup(self, worker: Any) -> None:
        """Called by dask in every worker, later ones too."""
        jax.config.update("jax_enable_x64", self.x64)
        if self.cache:
            jax.config.update("jax_compilation_cache_dir", self.cache)
        if self.folder and self.folder not in sys.path:
            sys.path.insert(0, self.folder)


@contextlib.contextmanager
def connected(
    scheduler: str | None = None,
    workers: int | None = None,
    folder: Path | None = None,
) -> Iterator[Client]:
    """A client of a scheduler at an address, or of a cluster of `workers` processes on this
    machine that ends with it. `folder` is where modules of one's own lie.

    Raises:
        InputError: nothing answers there, or workers have other versions than this process.
    """
    cache: Any = jax.config.jax_compilation_cache_dir  # pyright: ignore
    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        if scheduler is not None:
            try:
                client = stack.enter_context(Client(scheduler, timeout=_CONNECT_S))
            except (OSError, ValueError) as e:
                raise InputError(
                    f"--scheduler {scheduler}: no scheduler answers there ({e or type(e).__name__})"
                    ", expected the address that `dask scheduler` printed, as tcp://HOST:8786"
                ) from e
            cache = None
        else:
            made: Any = LocalCluster  # which takes None too
            with _ignore_sigint():
                cluster = made(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
            client = stack.enter_context(Client(stack.enter_context(cluster)))
        x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
        _check_versions(client, scheduler or "--workers")
        client.register_plugin(Prepared(x64, None if folder is None else str(folder), cache))
        yield client


@contextlib.contextmanager
def _ignore_sigint() -> Iterator[None]:
    """Processes that are started meanwhile do not hear Ctrl-C: they end with this one, which
    does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The client does not log a lost scheduler at length: `_answering` says it."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextlib.contextmanager
def _answering() -> Iterator[None]:
    """What dask says of lost schedulers and of workers that cannot compute, as a sentence.

    Raises:
        InputError: the scheduler or too many workers are gone, or one's own modules are not there.
    """
    try:
        yield
    except (CancelledError, CommClosedError, KilledWorker, TimeoutError) as e:
        raise InputError(
            f"dask: the scheduler or its workers are lost ({type(e).__name__}), expected "
            "them to run to the end; what is finished is kept: --resume goes on"
        ) from e
    except ImportError as e:
        raise InputError(f"dask: {e} on the scheduler or a worker, {_IMPORTS}") from e
    except RuntimeError as e:
        if "deserialization" not in str(e):
            raise
        raise InputError(f"dask: the scheduler cannot read the sweep, {_IMPORTS}") from e


def _versions() -> dict[str, str]:
    return {n: v for n, v in versions().items() if n in ("heli_jax", "jax", "jaxlib")}


def _check_versions(client: Client, where: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        raise InputError(
            f"{where}: the scheduler has no worker, expected `dask worker ADDRESS` on each host"
        ) from None
    here = _versions()
    run: Any = client.run
    try:
        there = run(_versions)
    except ImportError as e:
        needed = ", ".join(f"{n} {v}" for n, v in here.items())
        raise InputError(f"{where}: a worker has no heli_jax ({e}), expected {needed}") from e
    for address, installed in there.items():
        other = [n for n, v in here.items() if installed.get(n) != v]
        if other:
            expected = ", ".join(f"{n} {here[n]}" for n in other)
            got = ", ".join(f"{n} {installed.get(n)}" for n in other)
            raise InputError(
                f"{where}: the worker {address}: expected {expected} as in this process, got "
                f"{got}: the last digits may differ"
            )


def split_there(client: Client, job: Job, **asked: Any) -> Split:
    """How a worker would cut the sweep: it may have other devices than this process."""
    asked.pop("memory", None)  # a file of this machine
    asked["shares"] = _threads(client)
    with _answering():
        return Split(*client.submit(_split, job, asked, pure=False).result())


def _threads(client: Client) -> int:
    found: Any = client.nthreads()
    return max(1, sum(found.values()))


def _split(job: Job, asked: dict[str, Any]) -> tuple[int, int]:
    return tuple(split_for(job, **asked))  # pyright: ignore[reportReturnType]


def computed(
    client: Client, job: Job, split: Split, todo: list[int]
) -> Iterable[tuple[int, dict[str, np.ndarray]]]:
    """The chunks as they are done, in any order."""
    token = uuid.uuid4().hex
    # A task and no scattered data: where its copies die with their workers, dask makes it again.
    shipped = client.submit(_received, job, key=f"job-{token}")
    threads = _threads(client)
    waiting = iter(todo)

    def submitted(chunk: int) -> Any:
        key = f"chunk-{chunk}-{token}"
        return client.submit(_chunk, shipped, tuple(split), chunk, token, key=key, retries=_RETRIES)

    first = [submitted(k) for _, k in zip(range(_AHEAD * threads), waiting, strict=False)]
    running = as_completed(first)
    for future in running:
        with _answering():
            chunk, results = future.result()
        future.release()
        following = next(waiting, None)
        if following is not None:
            running.add(submitted(following))
        yield chunk, results


def _received(job: Job) -> Job:
    return job


def _chunk(
    job: Job, split: tuple[int, int], chunk: int, token: str
) -> tuple[int, dict[str, np.ndarray]]:
    """In a worker process: a chunk, with the program compiled at the first."""
    with _building:
        if token not in _workers:
            _workers.clear()
            _workers[token] = Worker(job, Split(*split))
        worker = _workers[token]
    return chunk, worker.run(chunk)
