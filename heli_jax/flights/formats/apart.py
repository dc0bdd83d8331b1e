"""Reading with a library in a separate process, within limits of time and memory.

With a damaged file a library may loop, crash or fill the memory, and it does not react to Ctrl-C.
Therefore this module starts itself as a program. It calls one reader, writes a line of JSON and
then the arrays as bytes to standard output, and ends.
"""

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax import import_path
from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.log import Budget, wrong

_SECONDS, _RATE = 20, 10**6
"""Processor time [s] for any file, and the number of bytes that add one second."""
_PATIENCE = 10
"""Ratio of the wall-clock limit to the processor time."""
_BESIDE = 10**9
"""Memory for Python and its libraries [bytes]."""
_COPIES = 4
"""Copies of the numbers in memory during unpacking."""


class Content(NamedTuple):
    """Result of a reader: facts for JSON, vectors in the order that the facts state, and notes."""

    facts: dict[str, Any]
    arrays: Sequence[np.ndarray]
    notes: Sequence[Finding] = ()


type Reader = Callable[[Path, Budget], Content]


def read_apart(path: Path, reader: Reader, what: str, size: int) -> Content:
    """Return the result of a reader on a file, from a separate process.

    Args:
        path: path of the file.
        reader: a function of a module in this package.
        what: kind of the file in words, without an article.
        size: size of the file [bytes].

    Raises:
        InputError: as the reader raises, or the file is incomplete or damaged.
    """
    seconds = _SECONDS + size // _RATE
    arguments = (reader.__module__, reader.__name__, str(path), what, str(size), str(seconds))
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "heli_jax.flights.formats.apart", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=import_path.environment() | {"OPENBLAS_NUM_THREADS": "1"},
    )
    # For systems that cannot limit processor time.
    watch = threading.Timer(_PATIENCE * seconds, process.kill)
    watch.daemon = True
    watch.start()
    try:
        with process:
            answer: Any = process.stdout
            head = json.loads(answer.readline() or "{}")
            arrays = [np.empty(count, dtype) for dtype, count in head.get("arrays", ())]
            for values in arrays:
                answer.readinto(values.view(np.uint8))
    finally:
        watch.cancel()
    if "error" in head:
        raise InputError(head["error"])
    if process.returncode or not head:
        slow = f"took more than {seconds} s to read: it is damaged, or save it without compression"
        ended = process.returncode in (-signal.SIGKILL, -getattr(signal, "SIGXCPU", 0))
        raise wrong(str(path), slow if ended else f"is no whole {what} (its reader crashed)")
    notes = [note(code, words, *names, value=value) for code, words, names, value in head["notes"]]
    return Content(head["facts"], arrays, notes)


def guarded[T](path: Path, what: str, read: Callable[[], T]) -> T:
    """Read with a library; any exception on a damaged file becomes an `InputError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    # Each library raises its parser's own errors: KeyError, TypeError, zlib.error, ...
    except (Exception, MemoryError) as e:
        if isinstance(e, InputError):
            raise
        raise wrong(str(path), f"is no whole {what} ({type(e).__name__})") from e


def main() -> None:
    """Call the reader that the arguments name.

    The arguments are module, function, the file's path, kind and size [bytes], and a limit [s].
    """
    module, function, where, what, size, seconds = sys.argv[1:]
    path, budget = Path(where), Budget(where, int(size))
    # Libraries print warnings.
    out, sys.stdout = sys.stdout.buffer, sys.stderr
    # The default ends the process at once, also within a library.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
        most = _BESIDE + _COPIES * budget.most
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    arrays: Sequence[np.ndarray] = ()
    try:
        reader: Reader = getattr(importlib.import_module(module), function)
        facts, arrays, notes = guarded(path, what, lambda: reader(path, budget))
        head = {
            "arrays": [(x.dtype.str, x.size) for x in arrays],
            "facts": facts,
            "notes": [(n.code, n.sentence, n.subjects, n.value) for n in notes],
        }
    except InputError as e:
        head = {"error": str(e)}
    out.write(json.dumps(head).encode() + b"\n")
    for x in arrays:
        out.write(np.ascontiguousarray(x).data)
    out.flush()
    # Skips the libraries' exit handlers, which may crash after a damaged file.
    os._exit(0)


if __name__ == "__main__":
    main()
