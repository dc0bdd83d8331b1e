"""Entry point of heli-jax, which handles Ctrl-C before anything else is imported."""

import atexit
import gc
import os
import signal
import sys
import threading
from types import FrameType

_COLLECT_AFTER = 500_000
"""New objects between two garbage collections."""
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables for the number of threads in NumPy's linear algebra."""


def main() -> int:
    """Run one command as a program and return the exit code (`heli_jax.cli`)."""
    before = signal.getsignal(signal.SIGINT)
    ours = before is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, _end)
    # Imports and JAX's traces make millions of objects that stay. Python's default collections
    # would take a tenth of a command's time.
    gc.set_threshold(_COLLECT_AFTER)
    # Set before NumPy is imported. Our matrices are tall and narrow: more threads wait for each
    # other and double the time of a fit. XLA has its own threads.
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    from heli_jax import cli

    # The command line now installs its own handlers.
    if ours:
        signal.signal(signal.SIGINT, before)
    code = cli.main()
    _leave(code)
    return code


def _leave(code: int) -> None:
    """End the process at once if no work is left.

    Freeing all traces and programs of JAX one by one takes a tenth of a command's time.
    """
    # Python would wait for this thread, which is still working.
    if any(not t.daemon for t in threading.enumerate() if t is not threading.main_thread()):
        return
    # Libraries clean up here: temporary files, processes of a cluster.
    atexit._run_exitfuncs()
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except BrokenPipeError:
        pass  # a closed pipe is no failure
    except (OSError, ValueError):
        return  # a full disk, which Python reports at exit
    os._exit(code)


def _end(number: int, frame: FrameType | None) -> None:
    # `heli_jax.cli.interrupts` would have to be imported first.
    os.write(2, b"heli-jax: interrupted; nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    raise SystemExit(main())
