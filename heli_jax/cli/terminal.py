"""Terminal output: sentences and tables, and the progress of long work on standard error.

Numbers are never cut. Names from logs, files and configurations cannot send control sequences.
"""

import contextlib
import io
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, TextIO

from heli_jax import stages
from heli_jax.errors import shortened
from heli_jax.numbers import plain_cell, terminal_sentence
from heli_jax.schema_keys import Key
from heli_jax.stages import Note, Stage

type _Row = tuple[str, ...]
_BETWEEN = 3
"""Space between two columns of a table [characters]."""
_AFTER = 2.0
"""Shortest stage that shows progress [s]."""
_EVERY = 30.0
"""Time between two progress lines if standard error is no terminal [s]."""
_COUNTED = 100_000
"""Number of steps above which a percentage is shown (bytes of a file)."""


def plain_text(text: str) -> str:
    """Return text without escape sequences, direction marks and lone surrogates."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else " " if c.isspace() else "?" for c in text)


def print_text(text: str, file: TextIO | None = None) -> None:
    """Print sentences on `file` (default: standard output), wrapped on a terminal."""
    text = plain_text(terminal_sentence(text))
    stream = sys.stdout if file is None else file
    if stream.isatty():
        width = shutil.get_terminal_size().columns
        text = "\n".join(_folded(line, width) for line in text.split("\n"))
    print(text, file=stream, flush=stream is sys.stderr)


def _folded(line: str, width: int) -> str:
    # A terminal would break a line within a number. A single long word, such as a path, may break.
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.fill(
        line,
        max(width, 20),
        subsequent_indent=indent,
        replace_whitespace=False,
        break_long_words=False,
        break_on_hyphens=False,
    )


def print_table(head: _Row, rows: Sequence[_Row], *, keys: int = 1) -> None:
    """Print a table on standard output; print a list if it is wider than the terminal."""
    # rich takes a tenth of a second to import, too long for `heli-jax --help`.
    from rich.box import SIMPLE_HEAD
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table

    head, rows = tuple(map(plain_text, head)), [tuple(map(plain_text, row)) for row in rows]
    width = sum(max(map(cell_len, column)) + _BETWEEN for column in zip(head, *rows, strict=True))
    if sys.stdout.isatty() and width > shutil.get_terminal_size().columns:
        for row in rows:
            print(f"\n{', '.join(row[:keys])}")
            for name, cell in zip(head[keys:], row[keys:], strict=True):
                if cell:
                    print(f"  {name}: {cell}" if name else f"  {cell}")
        print()
        return
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, name in enumerate(head):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    # rich would treat '[deg]' as markup and ':m:' as an emoji. Print here, since rich ends the
    # program on a closed pipe.
    text = io.StringIO()
    console = Console(
        file=text,
        force_terminal=sys.stdout.isatty(),
        width=width + _BETWEEN,
        highlight=False,
        markup=False,
        emoji=False,
    )
    console.print(table)
    print("\n".join(line.rstrip() for line in text.getvalue().splitlines()))


# Any: a page's table, a NamedTuple of head and rows.
def print_page_table(table: Any, keys: int = 1) -> None:
    """Print a page's table with numbers and units in ASCII; `keys` as for `print_table`."""
    print_table(table.head, [tuple(map(plain_cell, row)) for row in table.rows], keys=keys)


def say(text: str) -> None:
    """Print a line on standard error. Standard output is for results, which may be piped."""
    print_text(f"heli-jax: {shortened(text)}", sys.stderr)


def say_notes(text: str) -> None:
    """Print a line only if it is a note, since --quiet hides progress but no doubts."""
    if isinstance(text, Note):
        say(text)


@contextlib.contextmanager
def progress_shown(quiet: bool) -> Iterator[None]:
    """Show the stages of long work, unless `quiet`."""
    if quiet:
        yield
        return
    display = _Display()
    try:
        with stages.observed_by(display):
            yield
    finally:
        display.hide()


class _Display:
    """Observer that shows one changing line on a terminal, else a line at intervals."""

    def __init__(self) -> None:
        self.stack: list[Stage] = []
        self.over = threading.Event()
        self.lock = threading.Lock()
        # Any: rich is imported only when there is something to show.
        self.live: Any = None

    def begin(self, stage: Stage) -> None:
        self.stack.append(stage)
        if len(self.stack) == 1:
            self.over = threading.Event()
            threading.Thread(target=self._watch, args=(self.over,), daemon=True).start()

    def end(self, stage: Stage) -> None:
        self.stack.remove(stage)
        # Hide the line after the last stage, since the next output may be a result.
        if not self.stack:
            self.hide()

    def hide(self) -> None:
        """Hide the display."""
        self.over.set()
        with self.lock:
            if self.live is not None:
                self.live.stop()
            self.live = None

    def _watch(self, over: threading.Event) -> None:
        if over.wait(_AFTER):
            return
        if sys.stderr.isatty():
            self._show(over)
            return
        while not over.wait(_EVERY):
            say(self._text())

    def _show(self, over: threading.Event) -> None:
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        def line() -> Text:
            return Text(self._text(), no_wrap=True, overflow="ellipsis")

        with self.lock:
            if not over.is_set():
                # Other output appears above the line.
                console = Console(stderr=True)
                live = Live(console=console, get_renderable=line, transient=True)
                live.start()
                self.live = live

    def _text(self) -> str:
        stack = self.stack[-1:]  # another thread may remove the last stage now
        return (
            plain_text(terminal_sentence(in_words(stack[0], time.perf_counter()))) if stack else ""
        )


def in_words(stage: Stage, now: float) -> str:
    """Return the state of a stage: `fitting Ixx: step 12, cost 1.2e+03, 14 s`.

    `now` is a time of `time.perf_counter` [s].
    """
    done, total, spent = stage.done, stage.total, now - stage.began
    parts = []
    if stage.first is not None:
        share = total is not None and total > _COUNTED
        of = f"{done} of {total}" if total else f"step {done}"
        parts = [f"{100 * done / total:.0f} %" if total and share else of]
    parts += [*([stage.detail] if stage.detail else []), _time(spent)]
    # The first step includes compilation, which would make the estimated time far too long.
    if stage.first is not None and total and stage.first[0] < done < total:
        rate = (done - stage.first[0]) / (now - stage.first[1])
        parts.append(f"{_time((total - done) / rate)} left")
    return f"{stage.words}: {', '.join(parts)}"


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds // 3600:.0f}:{seconds // 60 % 60:02.0f}:{seconds % 60:02.0f}"


def print_keys(found: Sequence[Key]) -> None:
    """Print keys of a file with their meaning."""
    # Longer lines are hard to read.
    width, indent = min(shutil.get_terminal_size().columns, 100), "    "
    for key in found:
        default = key.default and f"default {key.default}"
        default = "has to be there" if default is None else default
        # A default of null means only that the key may be left out.
        default = "optional" if default == "default null" else default
        head = "; ".join(filter(None, (f"{key.path}: {key.kind}", default)))
        for text, first in ((head, ""), (key.meaning, indent)):
            lines = textwrap.wrap(
                text, width, initial_indent=first, subsequent_indent=indent, break_on_hyphens=False
            )
            print(*lines, sep="\n", end="\n" if lines else "")
