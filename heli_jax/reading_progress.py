"""A bar on the terminal while a large log is read."""

import contextlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from heli_jax.flights import progress
from heli_jax.regular_file import size_words
from heli_jax.terminal_table import plain_text

_AFTER = 2.0
"""s: what is read sooner shows nothing"""


@contextlib.contextmanager
def on_terminal() -> Iterator[None]:
    """Show on standard error how far a log is read, where that takes longer than two seconds."""
    # A bar in a log file is a line of carriage returns.
    if not sys.stderr.isatty():
        yield
        return
    with progress.observed_by(_Bar()):
        yield


class _Bar:
    """An `Observer` with a bar of rich, made by a timer: most files are read before it ends."""

    def __init__(self) -> None:
        self.words, self.size, self.done = "", 0, 0
        # Any: of rich, which is imported only when there is something to show.
        self.bar: Any = None
        self.lock = threading.Lock()
        self.timer: threading.Timer | None = None

    def begin(self, path: str, size: int) -> None:
        """Wait for what is worth showing.

        Args:
            path: of the file.
            size: of it [bytes].
        """
        name = plain_text(Path(path).name)[:40]
        self.words, self.size, self.done = f"reading {name} ({size_words(size)})", size, 0
        self.timer = threading.Timer(_AFTER, self._show)
        self.timer.daemon = True
        self.timer.start()

    def advance(self, done: int) -> None:
        self.done = done
        with self.lock:
            if self.bar is not None:
                self.bar.update(self.bar.task_ids[0], total=self.size, completed=done)

    def end(self) -> None:
        if self.timer is not None:
            self.timer.cancel()
        with self.lock:
            self.timer = None
            if self.bar is not None:
                self.bar.stop()
            self.bar = None

    def _show(self) -> None:
        from rich.console import Console
        from rich.errors import LiveError
        from rich.markup import escape
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        bar = Progress(*columns, console=Console(stderr=True), transient=True)
        # Without a total it moves to and fro: pyarrow does not say how far it is.
        total = self.size if self.done else None
        bar.add_task(escape(self.words), total=total, completed=self.done)
        with self.lock:
            # The file may have come to its end meanwhile, or a bar of a sweep may be shown.
            if self.timer is None:
                return
            with contextlib.suppress(LiveError):
                bar.start()
                self.bar = bar
