"""Progress of reading a file, as a stage of the work."""

import contextlib
import functools
import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
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


# SHA-256 of a file, computed in parallel with other work.


class Digest:
    """SHA-256 of a file, from its bytes or its path, in a separate thread.

    For a large file it takes as long as reading it. It starts on request, because pyarrow reads
    with all cores.
    """

    def __init__(self, source: bytes | Path) -> None:
        self._source = source

    @functools.cached_property
    def _made(self) -> Future[str]:
        def made() -> str:
            if isinstance(self._source, bytes):
                return hashlib.sha256(self._source).hexdigest()
            with self._source.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()

        pool = ThreadPoolExecutor(1)
        try:
            return pool.submit(made)
        finally:
            pool.shutdown(wait=False)

    def begin(self) -> None:
        """Start, if not yet started."""
        _ = self._made

    def hex(self) -> str:
        """Wait for the hash and return it."""
        return self._made.result()
