"""Ctrl-C and SIGTERM: a command ends at once with one sentence.

Python raises KeyboardInterrupt at an arbitrary place. In a library's callback or a finaliser it is
lost and printed as a traceback; compiled code raises none. A program therefore raises nothing: it
removes unfinished files, prints a message and ends. A function, called by a test or a user's
program, must not end its caller. It raises KeyboardInterrupt as Python does.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from heli_jax import run_directory

INTERRUPTED = 130
"""Exit code that a shell reports for a program ended by SIGINT (128 + 2)."""
_ENDING = (signal.SIGINT, signal.SIGTERM)
_UNWINDING = 20.0
"""Longest time for a command to end its other processes [s]."""


class Interrupts:
    """Interrupts of one command, and its reaction."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        """Received signals, including those that a library turned into another error."""
        before = len(run_directory.written())
        self.words: Callable[[], str] = lambda: _words(run_directory.written()[before:])
        """Final message."""
        self.unwinds = False
        """True if a KeyboardInterrupt is raised as well, since a cluster must be closed."""
        self.over = threading.Event()
        """Set when the command ends by itself."""

    def heard(self, number: int, frame: FrameType | None) -> None:
        """Stop the main thread; `watch` ends the process.

        Raises:
            KeyboardInterrupt: the first time, if the command unwinds.
        """
        self.seen.append(number)
        if not self.unwinds:
            # The main thread must not use files that are being removed.
            threading.Event().wait()
        # A second interrupt would abort the clean-up of the first.
        if len(self.seen) == 1:
            raise KeyboardInterrupt

    def watch(self, pipe: int) -> None:
        """End the command from a thread, since compiled code blocks signals in the main thread."""
        while numbers := os.read(pipe, 64):
            if heard := [n for n in _ENDING if n in numbers]:
                if self.over.wait(_UNWINDING if self.unwinds else 0.0):
                    break
                self._end(heard[0])
        os.close(pipe)

    def _end(self, number: int) -> None:
        run_directory.remove_unfinished()
        # Bypass Python's buffers, whose locks the interrupted code may hold. Restore the cursor
        # that a progress bar hides.
        restored = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""
        with contextlib.suppress(OSError):
            os.write(2, f"{restored}heli-jax: {self.words()}\n".encode())
        # Exit code that a shell reports for a program ended by a signal.
        os._exit(128 + number)


@contextlib.contextmanager
def as_program() -> Iterator[Interrupts]:
    """End the process on an interrupt; ignore interrupts while Python shuts down."""
    # Other systems cannot report a signal through a pipe.
    if os.name != "posix":
        with as_function() as interrupts:
            yield interrupts
        return
    interrupts = Interrupts()
    if not _are_pythons_own():
        yield interrupts
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    for number in _ENDING:
        signal.signal(number, interrupts.heard)
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    hook = sys.unraisablehook
    sys.unraisablehook = lambda lost: None if _is_interrupt(lost) else hook(lost)
    # Python does not wait for a daemon thread at exit.
    threading.Thread(target=interrupts.watch, args=(reading,), daemon=True).start()
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        interrupts.over.set()
        signal.set_wakeup_fd(before)
        os.close(writing)


@contextlib.contextmanager
def as_function() -> Iterator[Interrupts]:
    """Count interrupts and raise KeyboardInterrupt."""
    interrupts = Interrupts()
    if not _are_pythons_own():
        yield interrupts
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.seen.append(number)
        signal.default_int_handler(number, frame)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def ending_block() -> Iterator[Callable[[], bool]]:
    """Let an interrupt end the block alone; yield a function that returns if there was one."""
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    # `watch` must not hear of it.
    pipe = signal.set_wakeup_fd(-1)
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, before)
        signal.set_wakeup_fd(pipe, warn_on_full_buffer=False)


def resumable(out: Path, finished: str) -> str:
    """Return the final message of work that --resume can continue."""
    if not out.exists():
        return "interrupted; nothing was written"
    if any(out.glob(finished)):
        return f"interrupted; finished parts are kept: --out {out} --resume continues"
    return f"interrupted; nothing was finished yet: --out {out} --resume begins with the first"


def _words(written: tuple[Path, ...]) -> str:
    # Results may exist already while a command prints its summary.
    names = ", ".join(map(str, written))
    return f"interrupted; wrote {names}" if names else "interrupted; nothing was written"


def _are_pythons_own() -> bool:
    """True if Python's own handler receives interrupts."""
    # Only the main thread can set handlers; elsewhere signal.signal raises.
    ours = threading.current_thread() is threading.main_thread()
    return ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler


# Any: the argument of `sys.unraisablehook` has no public class name.
def _is_interrupt(lost: Any) -> bool:
    return lost.exc_type is not None and issubclass(lost.exc_type, KeyboardInterrupt)
