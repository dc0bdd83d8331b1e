"""Fits computed by processes of this machine, each of which fits one after the other.

Processes of our own and not `multiprocessing`: that would run a user's script once more in each of
them, and its pools end as a whole where one process dies.
"""

import contextlib
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from heli_jax import import_path
from heli_jax.studies.point import Outcome, Task, failure
from heli_jax.studies.worker import SCRATCH, read_outcome

_ATTEMPTS = 2
"""processes that a fit may end before it is given up: one may have died by lack of memory"""
_WORDS = 300
"""characters of a dead process's last line"""


class _Process:
    """One worker."""

    def __init__(self, cache: str) -> None:
        self.scratch = tempfile.mkdtemp(prefix="heli_jax-study-")
        environment = import_path.environment() | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "TMPDIR": self.scratch,
            SCRATCH: self.scratch,
        }
        # Not a pipe: nobody reads it as long as all goes well, and a full one would stop the fit.
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "heli_jax.studies.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env=environment,
            # Ctrl-C is for the one that asked, with which this one ends.
            process_group=0 if os.name == "posix" else None,
        )

    def run(self, task: Task) -> Outcome | None:
        """The outcome of a fit; None where the process ended over it."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        line = json.dumps(task._asdict()).encode() + b"\n"
        try:
            self.process.stdin.write(line)
            self.process.stdin.flush()
            return read_outcome(self.process.stdout)
        except (OSError, ValueError):  # ValueError: closed by `end` meanwhile
            return None

    def last_words(self) -> str:
        """How it ended, and the last line that it wrote on standard error."""
        code = self.process.wait()
        ended = f"by signal {-code}" if code < 0 else f"with {code}"
        self.errors.seek(0)
        lines = self.errors.read().decode(errors="replace").strip().splitlines()
        return ended + (f" ({lines[-1][:_WORDS]})" if lines else "")

    def end(self) -> None:
        """End it, whatever it is doing."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.errors):
            # What was not yet written to a process that is gone.
            with contextlib.suppress(OSError):
                if stream is not None:
                    stream.close()
        shutil.rmtree(self.scratch, ignore_errors=True)


class _Pool:
    """Threads of this process, each with a worker of its own."""

    def __init__(self, tasks: Sequence[Task], cache: str) -> None:
        self.cache, self.over = cache, threading.Event()
        self.todo: queue.SimpleQueue[tuple[int, Task]] = queue.SimpleQueue()
        for item in enumerate(tasks):
            self.todo.put(item)
        # Any: an error of ours, which is raised where the outcomes are taken.
        self.done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.processes: set[_Process] = set()
        self.lock = threading.Lock()

    def work(self) -> None:
        """Have one task after the other computed, until there is none."""
        worker: _Process | None = None
        try:
            while not self.over.is_set():
                try:
                    number, task = self.todo.get_nowait()
                except queue.Empty:
                    return
                worker, outcome = self._attempt(worker, task)
                self.done.put((number, outcome))
        except Exception as e:
            self.done.put(e)
        finally:
            self._end(worker)

    def _attempt(self, worker: _Process | None, task: Task) -> tuple[_Process | None, Outcome]:
        words = ""
        for _ in range(_ATTEMPTS):
            worker = worker or self._started()
            outcome = worker.run(task)
            if outcome is not None:
                return worker, outcome
            words = "" if self.over.is_set() else worker.last_words()
            self._end(worker)
            worker = None
            if self.over.is_set():
                break
        return None, failure(f"the process that fitted it ended {words}", task)

    def _started(self) -> _Process:
        with self.lock:
            worker = _Process(self.cache)
            self.processes.add(worker)
            # Begun as the others were being ended.
            if self.over.is_set():
                worker.process.kill()
        return worker

    def _end(self, worker: _Process | None) -> None:
        if worker is not None:
            worker.end()
            with self.lock:
                self.processes.discard(worker)

    def end(self) -> None:
        """End all processes."""
        self.over.set()
        with self.lock:
            for worker in self.processes:
                worker.process.kill()


def computed(tasks: Sequence[Task], workers: int) -> Iterator[tuple[int, Outcome]]:
    """The fits as they are done, in any order.

    Args:
        tasks: what to fit.
        workers: processes.

    Yields:
        The place of a task in `tasks`, and its outcome.
    """
    with contextlib.ExitStack() as stack:
        pool = _Pool(tasks, _cache(stack))
        threads = [threading.Thread(target=pool.work, daemon=True) for _ in range(workers)]
        stack.callback(_join, threads)
        stack.callback(pool.end)
        for thread in threads:
            thread.start()
        for _ in tasks:
            done = pool.done.get()
            if isinstance(done, Exception):
                raise done
            yield done


def _join(threads: Sequence[threading.Thread]) -> None:
    for thread in threads:
        thread.join()


def _cache(stack: contextlib.ExitStack) -> str:
    """The folder of compiled programs that all workers share, so that each is compiled once."""
    folder: Any = jax.config.jax_compilation_cache_dir  # pyright: ignore
    if folder:
        return str(Path(folder).absolute())
    return stack.enter_context(tempfile.TemporaryDirectory(prefix="heli_jax-compiled-"))
