"""The fingerprint of a file, computed beside other work."""

import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path


class Digest:
    """SHA-256 of a file in a thread of its own: of a large one it takes as long as reading it.

    It begins when it is told to, or asked for: pyarrow reads with all cores there are.
    """

    def __init__(self, source: bytes | Path) -> None:
        """Note what to read: all bytes of the file, or where it is."""
        self._source = source
        self._made: Future[str] | None = None

    def begin(self) -> None:
        """Begin, if it has not."""
        self._begun()

    def hex(self) -> str:
        """The fingerprint, once it is there.

        Raises:
            OSError: the file could not be read to its end.
        """
        return self._begun().result()

    def _begun(self) -> Future[str]:
        if self._made is None:
            pool = ThreadPoolExecutor(1)
            self._made = pool.submit(_sha256, self._source)
            pool.shutdown(wait=False)
        return self._made


def _sha256(source: bytes | Path) -> str:
    if isinstance(source, bytes):
        return hashlib.sha256(source).hexdigest()
    with source.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
