"""Ctrl-C and SIGTERM end a command at once, with one sentence, whatever it is doing.

Python raises KeyboardInterrupt wherever it happens to be. In a callback of a library or in a
finaliser that is lost, and printed as a traceback; and while compiled code runs none is raised at
all. A command that runs as a program therefore raises nothing: it removes what is half-written,
says so and ends. What is called as a function (by a test, by a program of somebody's own) must not
end its caller, and raises KeyboardInterrupt as Python does.
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
"""what a shell reports of a program ended by SIGINT (128 + 2)"""
_ENDING = (signal.SIGINT, signal.SIGTERM)
_UNWINDING = 20.0
"""s for a command that has other processes to end"""


class Interrupts:
    """The interrupts of one command, and how it ends by them."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        """the signals that came, also those of which a library has made another error"""
        before = len(run_directory.written())
        self.words: Callable[[], str] = lambda: _words(run_directory.written()[before:])
        """the sentence of the end"""
        self.unwinds = False
        """whether a KeyboardInterrupt is raised all the same: a cluster has to be taken down"""
        self.over = threading.Event()
        """set where the command has come to its own end"""

    def heard(self, number: int, frame: FrameType | None) -> None:
        """Stop what the main thread does; `watch` ends the process.

        Raises:
            KeyboardInterrupt: the first time, where the command unwinds.
        """
        self.seen.append(number)
        if not self.unwinds:
            # It must not meet what is being removed.
            threading.Event().wait()
        # Pressed again, it would break off the cleaning up of the first time.
        if len(self.seen) == 1:
            raise KeyboardInterrupt

    def watch(self, pipe: int) -> None:
        """End the command: a thread, since the main one hears of no signal within compiled code."""
        while numbers := os.read(pipe, 64):
            if heard := [n for n in _ENDING if n in numbers]:
                if self.over.wait(_UNWINDING if self.unwinds else 0.0):
                    break
                self._end(heard[0])
        os.close(pipe)

    def _end(self, number: int) -> None:
        run_directory.remove_unfinished()
        # Past Python's own buffers, whose locks the interrupted code may hold. A progress bar hides
        # the cursor of a terminal.
        restored = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""
        with contextlib.suppress(OSError):
            os.write(2, f"{restored}heli-jax: {self.words()}\n".encode())
        # As a shell reports of a program that was ended by a signal.
        os._exit(128 + number)


@contextlib.contextmanager
def as_program() -> Iterator[Interrupts]:
    """Interrupts end the process, as long as the command runs; afterwards, while Python takes
    itself down, they are ignored."""
    # Elsewhere a signal cannot be heard through a pipe.
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
    # A daemon: Python does not wait for it at the end.
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
    """Interrupts are counted and raise KeyboardInterrupt."""
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


def resumable(out: Path, finished: str) -> str:
    """The sentence of the end of work that --resume goes on with."""
    if not out.exists():
        return "interrupted; nothing was written"
    if any(out.glob(finished)):
        return f"interrupted; what is finished is kept: --out {out} --resume goes on"
    return f"interrupted; nothing was finished yet: --out {out} --resume begins with the first"


def _words(written: tuple[Path, ...]) -> str:
    # The last moments of a command, when its results are there and it prints a summary.
    names = ", ".join(map(str, written))
    return f"interrupted; wrote {names}" if names else "interrupted; nothing was written"


def _are_pythons_own() -> bool:
    """True if Python's own handler receives interrupts."""
    # Python sets handlers in its main thread alone; elsewhere signal.signal raises.
    ours = threading.current_thread() is threading.main_thread()
    return ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler


# Any: the class of what is given to `sys.unraisablehook` has no public name.
def _is_interrupt(lost: Any) -> bool:
    return lost.exc_type is not None and issubclass(lost.exc_type, KeyboardInterrupt)
