"""Fits computed by processes of this computer, one fit after the other in each.

Our own processes instead of `multiprocessing`: that would run a user's script again in each of
them, and its pool ends as a whole if one process dies.
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import jax

from heli_jax import import_path
from heli_jax.studies.point import Outcome, Task, failure
from heli_jax.studies.worker import SCRATCH, read_outcome

_ATTEMPTS = 2
"""Processes that a fit may end before it fails: one may have died by lack of memory."""
_WORDS = 300
"""Longest quoted last line of a dead process [characters]."""


class _Process:
    """One worker."""

    def __init__(self, cache: str) -> None:
        self.scratch = tempfile.mkdtemp(prefix="heli_jax-study-")
        environment = import_path.environment() | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "TMPDIR": self.scratch,
            SCRATCH: self.scratch,
        }
        # Not a pipe: nobody reads it unless something fails, and a full one would stop the fit.
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "heli_jax.studies.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env=environment,
            # Ctrl-C goes to the main process, with which this one ends.
            process_group=0 if os.name == "posix" else None,
        )

    def run(self, task: Task) -> Outcome | None:
        """Return the outcome of a fit; None if the process died."""
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
        """Return how it ended, and the last line that it wrote on standard error."""
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
            # Buffered data cannot be written to a dead process.
            with contextlib.suppress(OSError):
                if stream is not None:
                    stream.close()
        shutil.rmtree(self.scratch, ignore_errors=True)


class _Pool:
    """Workers of this process, one per thread."""

    def __init__(self, cache: str) -> None:
        self.cache, self.over = cache, False
        self.own = threading.local()
        self.processes: set[_Process] = set()
        self.lock = threading.Lock()

    def fit(self, task: Task) -> Outcome:
        """Return the outcome of a task by the worker of the calling thread."""
        words = ""
        for _ in range(_ATTEMPTS):
            process = getattr(self.own, "process", None) or self._started()
            outcome = process.run(task)
            if outcome is not None:
                return outcome
            words = "" if self.over else process.last_words()
            self.own.process = None
            with self.lock:
                self.processes.discard(process)
            process.end()
            if self.over:
                break
        return failure(f"the process that fitted it ended {words}", task)

    def _started(self) -> _Process:
        with self.lock:
            self.own.process = process = _Process(self.cache)
            self.processes.add(process)
            # It was started while the others were being ended.
            if self.over:
                process.process.kill()
        return process

    def end(self) -> None:
        """End all processes, whatever they are doing."""
        self.over = True
        with self.lock:
            for process in self.processes:
                process.end()


def computed(tasks: Sequence[Task], workers: int) -> Iterator[tuple[int, Outcome]]:
    """Fit tasks in `workers` processes; yield the index and outcome of each when it is done."""
    with contextlib.ExitStack() as stack:
        pool, threads = _Pool(_cache(stack)), ThreadPoolExecutor(workers)
        stack.callback(threads.shutdown, cancel_futures=True)
        stack.callback(pool.end)
        places = {threads.submit(pool.fit, task): k for k, task in enumerate(tasks)}
        for done in as_completed(places):
            yield places[done], done.result()


def _cache(stack: contextlib.ExitStack) -> str:
    """Return the folder of compiled programs that all workers share, to compile each only once."""
    folder: Any = jax.config.jax_compilation_cache_dir  # pyright: ignore
    if folder:
        return str(Path(folder).absolute())
    return stack.enter_context(tempfile.TemporaryDirectory(prefix="heli_jax-compiled-"))
