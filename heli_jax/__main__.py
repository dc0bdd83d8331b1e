"""Entry point of heli-jax, which handles Ctrl-C before anything else is imported."""

import atexit
import contextlib
import gc
import os
import signal
import sys
import threading

_ENDING = (signal.SIGINT, signal.SIGTERM)
_COLLECT_AFTER = 500_000
"""New objects between two garbage collections."""
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables for the number of threads in NumPy's linear algebra."""


def main() -> int:
    """Run one command as a program and return the exit code (`heli_jax.cli`)."""
    # An ignored signal, as behind nohup, stays ignored. Other systems report none through a pipe.
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler and os.name == "posix"
    if ours:
        _end_on_interrupts()
    # Imports and JAX's traces make millions of objects that stay. Python's default collections
    # would take a tenth of a command's time.
    gc.set_threshold(_COLLECT_AFTER)
    # Set before NumPy is imported. Our matrices are tall and narrow: more threads wait for each
    # other and double the time of a fit. XLA has its own threads.
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    try:
        from heli_jax import cli

        code = cli.main()
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
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


def _end_on_interrupts() -> None:
    """Let Ctrl-C and SIGTERM end the process from a thread.

    Python raises KeyboardInterrupt at an arbitrary place: in a library's callback or a finaliser it
    is lost, and compiled code raises none. Workers of dask and of studies end with this process.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    for number in _ENDING:
        # The main thread must not use files that are being removed.
        signal.signal(number, lambda *_: threading.Event().wait())
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reading,), daemon=True).start()


def _watch(pipe: int) -> None:
    while not (heard := [n for n in os.read(pipe, 64) if n in _ENDING]):
        pass
    # Without an import, which may be what was interrupted.
    files = sys.modules.get("heli_jax.run_directory")
    if files is not None and hasattr(files, "remove_unfinished"):
        files.remove_unfinished()
    # Bypass Python's buffers, whose locks the interrupted code may hold. Restore the cursor that a
    # progress line hides.
    restored = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""
    with contextlib.suppress(OSError):
        os.write(2, f"{restored}heli-jax: interrupted\n".encode())
    # Exit code that a shell reports for a program ended by a signal.
    os._exit(128 + heard[0])


if __name__ == "__main__":
    raise SystemExit(main())
