"""Progress of reading a file, as a stage of the work."""

import contextlib
import functools
import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
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


# The fingerprint of a file, computed beside other work.


class Digest:
    """SHA-256 of a file, all bytes of it or where it is, in a thread of its own: of a large one it
    takes as long as reading it.

    It begins when it is told to, or asked for: pyarrow reads with all cores there are.
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
        """Begin, if it has not."""
        _ = self._made

    def hex(self) -> str:
        """The fingerprint, once it is there."""
        return self._made.result()
