"""Worker process that fits its tasks: `python -m heli_jax.studies.worker`, for `processes`.

A line of JSON on standard input is a `Task`. The result on standard output is a line of JSON with
the files' sizes, then their bytes. The process ends when its standard input does, whatever it is
doing, because the requesting process may have been killed.
"""

import json
import os
import queue
import shutil
import signal
import sys
import threading
from typing import IO

from heli_jax import import_path
from heli_jax.studies.point import Outcome, Task, fit_point

SCRATCH = "HELI_JAX_STUDY_SCRATCH"
"""Environment variable: a folder for this process alone, removed when it ends."""


def write_outcome(stream: IO[bytes], outcome: Outcome) -> None:
    """Write an outcome in the format of `read_outcome`."""
    sizes = {name: len(data) for name, data in outcome.files.items()}
    content = {"sentence": outcome.sentence, "files": sizes, "notes": outcome.notes}
    head = json.dumps(content)
    stream.write(head.encode() + b"\n")
    for data in outcome.files.values():
        stream.write(data)
    stream.flush()


def read_outcome(stream: IO[bytes]) -> Outcome | None:
    """Read the next outcome; None if the other process has ended."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    head = json.loads(line)
    files = {name: stream.read(size) for name, size in head["files"].items()}
    # Incomplete if the process died while writing.
    if any(len(files[name]) < size for name, size in head["files"].items()):
        return None
    return Outcome(files, head["sentence"], tuple(head["notes"]))


def main() -> None:
    """Fit until standard input ends."""
    # Output printed by a user's model must not mix with the results.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import_path.ignore_folder_style()
    tasks: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(tasks,), daemon=True).start()
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    while True:
        write_outcome(answers, fit_point(Task(**json.loads(tasks.get()))))


def _read(tasks: "queue.SimpleQueue[bytes]") -> None:
    for line in sys.stdin.buffer:
        tasks.put(line)
    # At once: the result is no longer read.
    if SCRATCH in os.environ:
        shutil.rmtree(os.environ[SCRATCH], ignore_errors=True)
    os._exit(0)


if __name__ == "__main__":
    main()
