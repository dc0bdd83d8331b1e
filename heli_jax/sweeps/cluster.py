"""Chunks of a sweep, or fits of a study, on the workers of a dask scheduler.

Workers return their results, and the main process writes them, so no common disk is needed. If a
worker dies, another one does its tasks.
"""

import contextlib
import functools
import logging
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import distributed
import jax
import numpy as np
from distributed import CancelledError, Client, WorkerPlugin, as_completed
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker

from heli_jax import import_path
from heli_jax.errors import InputError
from heli_jax.sweeps.batching import split_for
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import Split, Worker
from heli_jax.versions import versions

_RETRIES = 5  # retries of a failed chunk; dask itself counts dead workers
# Chunks per worker thread, running or waiting. With one, the thread would idle while its result
# travels; with all, a large sweep's results would wait in this process's memory.
_AHEAD = 3
_CONNECT_S = 20  # [s] without a reply after which an address counts as wrong
_IMPORTS = (
    "your own modules must exist there too: start scheduler and workers with PYTHONPATH set to "
    "their folder"
)

# Compiled programs in a worker process, by sweep, and the lock of their compilation. Without it,
# several threads of one process would compile the same program at once.
_workers: dict[str, Worker] = {}
_building = threading.Lock()


class Prepared(WorkerPlugin):
    """Worker process with the settings of the main process."""

    # dask keeps one plugin per name: a second sweep on the same scheduler replaces the first's.
    name: Any = "heli_jax"

    def __init__(self, settings: dict[str, Any], folders: tuple[str, ...]) -> None:
        self.settings, self.folders = settings, folders

    def setup(self, worker: distributed.Worker) -> None:
        """Set up each worker; dask calls this in later ones too."""
        # JAX's settings belong to a process and are not sent with the job: results would be
        # float32.
        for name, value in self.settings.items():
            jax.config.update(name, value)
        import_path.search(self.folders)
        import_path.ignore_folder_style()


_SETTINGS = (
    "jax_enable_x64",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@contextlib.contextmanager
def connected(scheduler: str) -> Iterator[Client]:
    """Yield a client of the scheduler at an address, as tcp://HOST:8786.

    Raises:
        InputError: nothing replies there, or workers have other versions than this process.
    """
    # pyright knows none of JAX's settings by their names.
    settings: dict[str, Any] = {name: getattr(jax.config, name) for name in _SETTINGS}
    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        try:
            client = stack.enter_context(Client(scheduler, timeout=_CONNECT_S))
        except (OSError, ValueError) as e:
            raise InputError(
                f"--scheduler {scheduler}: no scheduler answers there ({e or type(e).__name__})"
                ", expected the address that `dask scheduler` printed, as tcp://HOST:8786"
            ) from e
        _check_versions(client, scheduler)
        client.register_plugin(Prepared(settings, import_path.searched()))
        yield client


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the client's log of a lost scheduler; `_dask_errors` reports it."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextlib.contextmanager
def _dask_errors() -> Iterator[None]:
    """Report dask's lost schedulers and failed workers as a sentence."""
    try:
        yield
    except (CancelledError, CommClosedError, KilledWorker, TimeoutError) as e:
        raise InputError(
            f"dask: lost the scheduler or its workers ({type(e).__name__}); finished elements are "
            "kept: --resume continues"
        ) from e
    except ImportError as e:
        raise InputError(f"dask: {e} on the scheduler or a worker, {_IMPORTS}") from e
    except RuntimeError as e:
        # The scheduler's text for a class that it cannot import; dask has no error class for it.
        if "deserialization" not in str(e):
            raise
        raise InputError(f"dask: the scheduler cannot read the sweep, {_IMPORTS}") from e


def _versions() -> dict[str, str]:
    """Return the versions of the computing packages; those for reading and figures may differ."""
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


def split_there(client: Client, job: Job, **options: Any) -> Split:
    """Divide a sweep in a worker, whose devices may differ, with `options` of `split_for`."""
    divide = functools.partial(split_for, **options)
    ((_, split),) = mapped(client, divide, [job])
    return split


def _threads(client: Client) -> int:
    """Return the threads of all workers; at least one, because workers may come later."""
    by_worker: Any = client.nthreads()
    return max(1, sum(by_worker.values()))


def computed(
    client: Client, job: Job, split: Split, todo: Sequence[int]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Yield the chunks in the order in which they finish.

    Yields:
        The number of a chunk and its variables, arrays (elements of the chunk, ...).

    Raises:
        InputError: the scheduler or too many workers are gone.
    """
    token = uuid.uuid4().hex
    # A task, not scattered data: if its copies die with their workers, dask makes it again.
    shipped = client.submit(_received, job, key=f"job-{token}")
    for k, results in mapped(client, _chunk, todo, shipped, split, token):
        yield todo[k], results


def mapped(
    client: Client,
    function: Callable[..., Any],
    items: Sequence[Any],
    *shared: Any,
) -> Iterator[tuple[int, Any]]:
    """Apply a function to each item and shared arguments; yield in the order of completion.

    Yields:
        The index of an item and the function's result.

    Raises:
        InputError: the scheduler or its workers are gone.
    """
    # Keys unique to this run: a scheduler caches results by key and could return those of an
    # earlier run.
    token = uuid.uuid4().hex
    waiting, place = iter(range(len(items))), {}

    def submitted(k: int) -> Any:
        future = client.submit(
            function, items[k], *shared, key=f"item-{k}-{token}", retries=_RETRIES, pure=False
        )
        place[future.key] = k
        return future

    # Submit a few tasks ahead.
    ahead = zip(range(_AHEAD * _threads(client)), waiting, strict=False)
    # With results, because fetching one later may block forever if its worker has died.
    running: Any = as_completed([submitted(k) for _, k in ahead], with_results=True)
    while True:
        with _dask_errors():
            ended = next(running, None)
            if ended is None:
                return
            future, value = ended
            if isinstance(value, CancelledError):
                raise value
        # Before it is written, otherwise the worker would keep its results until then.
        future.release()
        following = next(waiting, None)
        if following is not None:
            running.add(submitted(following))
        yield place.pop(future.key), value


def _received(job: Job) -> Job:
    """Return the job as a task, so that each worker gets it once and not with every chunk."""
    return job


def _chunk(chunk: int, job: Job, split: Split, token: str) -> dict[str, np.ndarray]:
    """Compute a chunk in a worker process; the first one compiles the program."""
    with _building:
        if token not in _workers:
            _workers.clear()  # an earlier sweep's programs would stay in memory
            _workers[token] = Worker(job, split)
        worker = _workers[token]
    return worker.run(chunk)
