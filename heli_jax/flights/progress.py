"""How far the reading of a file is, as a stage of the work."""

import contextlib
from pathlib import Path

from heli_jax import stages
from heli_jax.regular_file import size_words

STEP = 1 << 22
"""bytes between two calls of `advance`"""


def reading(path: str | Path, size: int) -> contextlib.AbstractContextManager[None]:
    """A file is read meanwhile."""
    # Names may hold anything; a terminal obeys escape sequences.
    name = "".join(c if c.isprintable() else "?" for c in Path(path).name)[:40]
    return stages.stage(f"reading {name} ({size_words(size)})", total=size)


def advance(done: int) -> None:
    """The first `done` bytes of the file that is read are read."""
    stages.reach(done)
