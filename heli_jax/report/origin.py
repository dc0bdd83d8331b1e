"""Origin of a page: command, date, configuration, and the files beside it."""

import contextlib
import shlex
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from datetime import datetime
from pathlib import Path
from typing import NamedTuple


class Origin(NamedTuple):
    """Origin of a page."""

    command: str
    date: str
    """Date with its offset from UTC."""
    config: str = ""
    """Full configuration as YAML."""
    files: tuple[str, ...] = ()
    """Files beside the page, as relative paths."""
    point: str = ""
    """Point of a study: its keys with their values."""


_asker: ContextVar[tuple[str, str] | None] = ContextVar("heli_jax_asker", default=None)
"""Command and study point, if this process works for another."""


@contextlib.contextmanager
def made_for(command: str, point: str) -> Iterator[None]:
    """Attribute results made in this context to another process's command."""
    token = _asker.set((command, point))
    try:
        yield
    finally:
        _asker.reset(token)


def command() -> str:
    """Return the command line of this process in shell syntax."""
    return _command(sys.argv)


def origin(config: str = "", files: tuple[str, ...] = ()) -> Origin:
    """Return the origin of a page made now by this process."""
    now = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    typed, point = _asker.get() or (command(), "")
    return Origin(typed, now, config, files, point)


def _command(words: list[str]) -> str:
    """Quote a command line in shell syntax."""
    # Only the program's name is shown, because its install path is private.
    program = Path(words[0] if words else "")
    if program.name.startswith(("ipykernel", "colab_kernel")):
        return "in a notebook"
    if program.name in ("", "-", "-c"):
        return "in a Python session"
    name = "heli-jax" if program.parts[-2:] == ("heli_jax", "__main__.py") else program.name
    return shlex.join([*(["python"] if name.endswith(".py") else []), name, *words[1:]])
