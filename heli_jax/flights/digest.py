"""The fingerprint of a file, computed while the file is read."""

import hashlib
import os
import threading
from collections.abc import Iterator
from typing import BinaryIO

_PIECE = 1 << 20
_AT_ONCE = 1 << 22
"""bytes: below, a thread costs more than it saves"""


class Digest:
    """SHA-256 of a file in a thread of its own: of a large one it takes as long as reading it."""

    def __init__(self, source: bytes | BinaryIO) -> None:
        """Begin.

        Args:
            source: all bytes of the file, or the open file, of which the position stays.
        """
        self._hash = hashlib.sha256()
        self._thread: threading.Thread | None = None
        self._failure: OSError | None = None
        if isinstance(source, bytes):
            size, pieces = len(source), _pieces_of(source)
        else:
            # A descriptor of its own: the caller closes the file before this has come to its end.
            descriptor = os.dup(source.fileno())
            size, pieces = os.fstat(descriptor).st_size, _pieces_read(descriptor)
        if size < _AT_ONCE:
            self._run(pieces)
            return
        self._thread = threading.Thread(target=self._run, args=(pieces,), daemon=True)
        self._thread.start()

    def hex(self) -> str:
        """The fingerprint, once it is there.

        Raises:
            OSError: the file could not be read to its end.
        """
        if self._thread is not None:
            self._thread.join()
        if self._failure is not None:
            raise self._failure
        return self._hash.hexdigest()

    def _run(self, pieces: Iterator[bytes | memoryview]) -> None:
        try:
            for piece in pieces:
                self._hash.update(piece)
        except OSError as e:
            self._failure = e


def _pieces_of(data: bytes) -> Iterator[memoryview]:
    view = memoryview(data)
    for at in range(0, len(data), _PIECE):
        yield view[at : at + _PIECE]


def _pieces_read(descriptor: int) -> Iterator[bytes]:
    at = 0
    try:
        # At places of its own: the position is shared with the descriptor it was made of.
        while piece := os.pread(descriptor, _PIECE, at):
            yield piece
            at += len(piece)
    finally:
        os.close(descriptor)
