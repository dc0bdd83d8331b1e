"""What a command says on standard error while it works."""

import contextlib
import sys
from collections.abc import Iterator

from heli_jax import stage_display
from heli_jax.errors import shortened
from heli_jax.stages import Note
from heli_jax.terminal_table import tell


def say(text: str) -> None:
    """Print a line."""
    # On standard error: standard output is for results, which may be piped on.
    tell(f"heli-jax: {shortened(text)}", sys.stderr)


def say_notes(text: str) -> None:
    """Print a line where it is a note: a doubt is no progress that may be hidden."""
    if isinstance(text, Note):
        say(text)


@contextlib.contextmanager
def progress_shown(quiet: bool) -> Iterator[None]:
    """Show how far long work is, such as the reading of a log.

    Args:
        quiet: show nothing.
    """
    if quiet:
        yield
        return
    with stage_display.on_terminal(say):
        yield
