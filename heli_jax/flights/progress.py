"""How far the reading of a file is, for whoever wants to show it; nobody does unless asked to."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol


class Observer(Protocol):
    """Hears of files that are read."""

    def begin(self, path: str, size: int) -> None:
        """A file of `size` bytes is about to be read."""
        ...

    def advance(self, done: int) -> None:
        """Its first `done` bytes are read."""
        ...

    def end(self) -> None:
        """It is read, or cannot be."""
        ...


# One for the process: a reader is many calls deep, and a log is read by one thread.
_observer: Observer | None = None
STEP = 1 << 22
"""bytes between two calls of `advance`"""


@contextlib.contextmanager
def observed_by(observer: Observer) -> Iterator[None]:
    """Tell an observer of what is read meanwhile."""
    global _observer
    before, _observer = _observer, observer
    try:
        yield
    finally:
        _observer = before


@contextlib.contextmanager
def reading(path: str | Path, size: int) -> Iterator[None]:
    """A file is read meanwhile.

    Args:
        path: the file.
        size: of it [bytes].
    """
    observer = _observer
    if observer is None:
        yield
        return
    observer.begin(str(path), size)
    try:
        yield
    finally:
        observer.end()


def advance(done: int) -> None:
    """The first `done` bytes of the file that is read are read."""
    if _observer is not None:
        _observer.advance(done)
