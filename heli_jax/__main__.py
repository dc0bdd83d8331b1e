"""The command heli-jax from its first moment, in which Ctrl-C finds nothing imported yet."""

import atexit
import gc
import os
import signal
import sys
import threading
from types import FrameType

_COLLECT_AFTER = 500_000
"""new objects between two searches for garbage"""
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""what says how many threads NumPy's linear algebra has"""


def main() -> int:
    """Run one command as a program; returns the exit code (`heli_jax.cli`)."""
    before = signal.getsignal(signal.SIGINT)
    ours = before is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, _end)
    # Imports and what JAX traces make millions of objects that stay: to look through them for
    # garbage as often as Python does by itself takes a tenth of a command.
    gc.set_threshold(_COLLECT_AFTER)
    # Before NumPy is imported. Its matrices here are tall and a few columns wide: further threads
    # wait for each other at full speed, and double what a fit takes. XLA has threads of its own.
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    from heli_jax import cli

    # From here on the command line listens itself.
    if ours:
        signal.signal(signal.SIGINT, before)
    code = cli.main()
    _leave(code)
    return code


def _leave(code: int) -> None:
    """End the process at once, where nothing is left to be done.

    To free all that JAX has traced and compiled one by one takes a tenth of a command.
    """
    # A thread that Python would wait for still works at something.
    if any(not t.daemon for t in threading.enumerate() if t is not threading.main_thread()):
        return
    # Temporary files, processes of a cluster: what libraries tidy up at the end of Python.
    atexit._run_exitfuncs()
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except BrokenPipeError:
        pass  # who reads has enough, which is no failure
    except (OSError, ValueError):
        return  # a disk that is full, which Python says as it ends
    os._exit(code)


def _end(number: int, frame: FrameType | None) -> None:
    # Not `heli_jax.interrupts`, which would have to be imported first.
    os.write(2, b"heli-jax: interrupted; nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    raise SystemExit(main())
