"""The fingerprint of a file, computed beside other work."""

import hashlib
import threading
from collections.abc import Iterator
from pathlib import Path

_PIECE = 1 << 20
_AT_ONCE = 1 << 22
"""bytes: below, a thread costs more than it saves"""


class Digest:
    """SHA-256 of a file in a thread of its own: of a large one it takes as long as reading it.

    It begins when it is told to, or asked for: pyarrow reads with all cores there are.
    """

    def __init__(self, source: bytes | Path) -> None:
        """Note what to read.

        Args:
            source: all bytes of the file, or where it is.
        """
        self._hash = hashlib.sha256()
        self._thread: threading.Thread | None = None
        self._failure: OSError | None = None
        self._is_small = isinstance(source, bytes) and len(source) < _AT_ONCE
        self._pieces = _pieces_of(source) if isinstance(source, bytes) else _pieces_read(source)

    def begin(self) -> None:
        """Begin, if it has not, where that is worth a thread."""
        if self._thread is None and not self._is_small:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def hex(self) -> str:
        """The fingerprint, once it is there.

        Raises:
            OSError: the file could not be read to its end.
        """
        self.begin()
        if self._thread is None:
            self._run()
        else:
            self._thread.join()
        if self._failure is not None:
            raise self._failure
        return self._hash.hexdigest()

    def _run(self) -> None:
        try:
            for piece in self._pieces:
                self._hash.update(piece)
        except OSError as e:
            self._failure = e


def _pieces_of(data: bytes) -> Iterator[memoryview]:
    view = memoryview(data)
    for at in range(0, len(data), _PIECE):
        yield view[at : at + _PIECE]


def _pieces_read(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            yield piece
