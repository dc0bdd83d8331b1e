"""The fingerprint of a file, computed beside other work."""

import functools
import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path


class Digest:
    """SHA-256 of a file, all bytes of it or where it is, in a thread of its own: of a large one it
    takes as long as reading it.

    It begins when it is told to, or asked for: pyarrow reads with all cores there are.
    """

    def __init__(self, source: bytes | Path) -> None:
        self._source = source

    @functools.cached_property
    def _made(self) -> Future[str]:
        pool = ThreadPoolExecutor(1)
        try:
            return pool.submit(_sha256, self._source)
        finally:
            pool.shutdown(wait=False)

    def begin(self) -> None:
        """Begin, if it has not."""
        _ = self._made

    def hex(self) -> str:
        """The fingerprint, once it is there.

        Raises:
            OSError: the file could not be read to its end.
        """
        return self._made.result()


def _sha256(source: bytes | Path) -> str:
    if isinstance(source, bytes):
        return hashlib.sha256(source).hexdigest()
    with source.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
