"""Progress of reading a file, as a stage of the work."""

import contextlib
from pathlib import Path

from heli_jax import stages
from heli_jax.regular_file import size_words

STEP = 1 << 22
"""Bytes between two calls of `advance`."""


def reading(path: str | Path, size: int) -> contextlib.AbstractContextManager[None]:
    """Report that a file is read meanwhile."""
    # Names may hold anything, and a terminal obeys escape sequences.
    name = "".join(c if c.isprintable() else "?" for c in Path(path).name)[:40]
    return stages.stage(f"reading {name} ({size_words(size)})", total=size)


def advance(done: int) -> None:
    """Report that the first `done` bytes of the file were read."""
    stages.reach(done)
