"""Chunks of a sweep, or fits of a study, by dask.distributed: on more processes or hosts.

Workers give their results back, and the process that was started writes them: they need no disk in
common. A worker that dies has its tasks done by another.
"""

import contextlib
import functools
import logging
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import dask
import distributed
import jax
import numpy as np
from distributed import CancelledError, Client, LocalCluster, Security, WorkerPlugin, as_completed
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker

from heli_jax import import_path
from heli_jax.errors import InputError
from heli_jax.sweeps.batching import split_for
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import Split, Worker
from heli_jax.versions import versions

_RETRIES = 5  # of a chunk whose task fails; how often workers may die with it dask counts itself
# Chunks that each thread of a worker has in hand or waiting: with one it would idle while its
# result travels; all at once, the results of a large sweep would wait in this process's memory.
_AHEAD = 3
_CONNECT_S = 20  # [s] without an answer, before an address is taken to be wrong
_ALONE_S = 120.0
"""[s] without any worker, before those that died are taken not to come back: a nanny starts another
in seconds, a queue of jobs may take its time"""
_LOOK_S = 2.0
"""[s] between two looks at whether there are workers"""
_WAIT_S = 0.02
"""[s] between two looks at whether a task has ended"""
_IMPORTS = (
    "expected modules of your own to be there too: begin scheduler and workers with PYTHONPATH set "
    "to their folder"
)

# In a worker process: what is compiled there, by sweep, and who compiles it. Several threads of one
# process would otherwise compile the same program at the same time.
_workers: dict[str, Worker] = {}
_building = threading.Lock()


class Prepared(WorkerPlugin):
    """A worker process that computes as the one that asks does."""

    # dask keeps one plugin of a name: a second sweep on the same scheduler replaces the first's.
    name: Any = "heli_jax"

    def __init__(self, settings: dict[str, Any], folders: tuple[str, ...]) -> None:
        self.settings, self.folders = settings, folders

    def setup(self, worker: distributed.Worker) -> None:
        """Called by dask in every worker, later ones too."""
        # JAX's settings are of a process and are not sent with the job: float32 would come back.
        for name, value in self.settings.items():
            jax.config.update(name, value)
        import_path.search(self.folders)
        import_path.pass_over_style_of_folder()


_SETTINGS = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@contextlib.contextmanager
def connected(
    scheduler: str | None = None,
    workers: int | None = None,
) -> Iterator[Client]:
    """A client of a scheduler at an address, or of a cluster on this machine that ends with it.

    Args:
        scheduler: address, as tcp://HOST:8786; a cluster of one's own unless given.
        workers: processes of that cluster; as many as dask thinks fit unless given.

    Raises:
        InputError: nothing answers there, workers have other versions than this process, or a
            cluster of one's own cannot be protected.
    """
    # pyright knows none of JAX's settings by their names.
    settings: dict[str, Any] = {name: getattr(jax.config, name) for name in _SETTINGS}
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
            # A folder of this machine; theirs may have none of that name.
            del settings["jax_compilation_cache_dir"]
        else:
            client = stack.enter_context(Client(stack.enter_context(_local_cluster(workers))))
        _check_versions(client, scheduler or "--workers")
        client.register_plugin(Prepared(settings, import_path.searched()))
        yield client


def _local_cluster(workers: int | None) -> LocalCluster:
    """A cluster on this machine that this process alone can use.

    Its ports are open to every user of the machine, and whoever dask listens to can run code: it
    listens to holders of a certificate made here, which stays in memory.
    """
    local: Any = LocalCluster  # whose annotations leave out that workers may be None
    # dask starts its HTTP servers whatever it is told. They have no pages then, and are stopped.
    try:
        security = Security.temporary()
    except ImportError as e:
        raise InputError(
            "--workers: cryptography is not installed, by which only this process reaches its "
            "workers, expected the extra distributed: pip install 'heli_jax[distributed]'"
        ) from e
    no_pages = {f"distributed.{who}.http.routes": [] for who in ("scheduler", "worker")}
    # pyright knows no `dask.config`, which dask documents.
    settings: Any = dask
    with _ignore_sigint(), settings.config.set(no_pages):
        # One thread a process: a chunk takes all devices of its process already.
        cluster = local(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
            security=security,
            plugins=(_NoHttp(),),
        )
    cluster.scheduler.http_server.stop()
    return cluster


class _NoHttp(WorkerPlugin):
    """A worker without the HTTP server that dask gives it."""

    def setup(self, worker: distributed.Worker) -> None:
        """Called by dask as the worker begins."""
        worker.http_server.stop()


@contextlib.contextmanager
def _ignore_sigint() -> Iterator[None]:
    """Processes that are started meanwhile do not hear Ctrl-C: they end with this one, which
    does."""
    # A terminal sends it to all of them, and each would print a traceback of its own. They inherit
    # what is ignored here. Python lets only its main thread change this.
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
    """Report dask's lost schedulers and failed workers as a sentence."""
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
        # The scheduler's own word for a class that it cannot import; dask has no error for it.
        if "deserialization" not in str(e):
            raise
        raise InputError(f"dask: the scheduler cannot read the sweep, {_IMPORTS}") from e


def _versions() -> dict[str, str]:
    """Return the versions of the packages that compute; those that read and draw may differ."""
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
    """Divide a sweep as a worker would, with `options` of `split_for`: its devices may be others
    than this process's."""
    divide = functools.partial(split_for, shares=_threads(client), **options)
    ((_, split),) = mapped(client, divide, [job])
    return split


def _threads(client: Client) -> int:
    """Threads of all workers; at least one, since workers may come later."""
    by_worker: Any = client.nthreads()
    return max(1, sum(by_worker.values()))


def computed(
    client: Client, job: Job, split: Split, todo: Sequence[int]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """The chunks as they are done, in any order.

    Yields:
        The number of a chunk and its variables, arrays (elements of the chunk, ...).

    Raises:
        InputError: the scheduler or too many workers are gone.
    """
    token = uuid.uuid4().hex
    # A task and no scattered data: where its copies die with their workers, dask makes it again.
    shipped = client.submit(_received, job, key=f"job-{token}")
    for k, results in mapped(client, _chunk, todo, shipped, split, token):
        yield todo[k], results


# Any: dask's futures and as_completed have no types.
def _gathered(futures: list[Any]) -> Any:
    """Futures as they are done and their results are here: to fetch one may wait without end, where
    the worker that holds it has died."""
    return as_completed(futures, with_results=True, raise_errors=False)


def _as_they_end(client: Client, running: Any) -> Iterator[tuple[Any, Callable[[], Any]]]:
    """The futures as they end, in any order, each with what gives its result or raises its error;
    more may be added meanwhile.
    """
    seen = looked = time.monotonic()
    while not running.is_empty():
        if running.has_ready():
            future, result = next(running)
            yield future, functools.partial(_value, future, result)
            seen = looked = time.monotonic()
            continue
        time.sleep(_WAIT_S)
        now = time.monotonic()
        if now - looked < _LOOK_S:
            continue
        looked = now
        with _answering():
            there = client.scheduler_info()["workers"].values()
        seen = now if any(map(_works, there)) else seen
        if now - seen > _ALONE_S:
            paused = f"no worker but {len(there)} that lack memory" if there else "no worker"
            raise InputError(
                f"dask: the scheduler has had {paused} for {now - seen:.0f} s, expected one at "
                "least to run to the end; what is finished is kept: --resume goes on"
            )


def _value(future: Any, result: Any) -> Any:
    """The result of a future that ended, or its error raised."""
    if future.status == "error":
        raise result[1]
    if isinstance(result, CancelledError):
        raise result
    return result


def _works(worker: Mapping[str, Any]) -> bool:
    """True if a worker takes tasks or is at one: dask pauses those that are short of memory."""
    counts = worker.get("metrics", {}).get("task_counts", {})
    return worker.get("status") != "paused" or bool(counts.get("executing"))


def mapped(
    client: Client,
    function: Callable[..., Any],
    items: Sequence[Any],
    *shared: Any,
    may_die: bool = False,
) -> Iterator[tuple[int, Any]]:
    """A function of each item, and of what they share, as they are done, in any order.

    Yields:
        The place of an item, and what the function gave; None where workers died over it and
        it `may_die`.

    Raises:
        InputError: the scheduler or its workers are gone.
    """
    # Keys of this run alone: a scheduler remembers results by key, and one that still holds those
    # of an earlier run would give them.
    token = uuid.uuid4().hex
    waiting, place = iter(range(len(items))), {}

    def submitted(k: int) -> Any:
        future = client.submit(
            function, items[k], *shared, key=f"item-{k}-{token}", retries=_RETRIES, pure=False
        )
        place[future.key] = k
        return future

    # A few ahead of those that end.
    ahead = zip(range(_AHEAD * _threads(client)), waiting, strict=False)
    running = _gathered([submitted(k) for _, k in ahead])
    for future, result in _as_they_end(client, running):
        with _answering():
            try:
                value = result()
            # dask counts how many workers died over one task: the others go on.
            except KilledWorker:
                if not may_die:
                    raise
                value = None
        # Before it is written, or the worker would keep its results for as long.
        future.release()
        following = next(waiting, None)
        if following is not None:
            running.add(submitted(following))
        yield place.pop(future.key), value


def _received(job: Job) -> Job:
    """A task that gives the job, so that each worker gets it once and not with every chunk."""
    return job


def _chunk(chunk: int, job: Job, split: Split, token: str) -> dict[str, np.ndarray]:
    """Compute a chunk in a worker process; the first one compiles the program."""
    with _building:
        if token not in _workers:
            _workers.clear()  # of an earlier sweep: its programs would stay in memory
            _workers[token] = Worker(job, split)
        worker = _workers[token]
    return worker.run(chunk)
