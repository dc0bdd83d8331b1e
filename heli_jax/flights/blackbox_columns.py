"""Numbers of a blackbox log in the fewest bits: decoded, most take a quarter of 32."""

from collections import deque

import numpy as np


def narrowed(column: np.ndarray) -> np.ndarray:
    """Whole numbers (N,) of 32 bits in the fewest bits that hold them.

    Args:
        column: int32 or uint32.
    """
    if not column.size:
        return column
    low, high = int(column.min()), int(column.max())
    kinds = (np.int8, np.int16) if column.dtype.kind == "i" else (np.uint8, np.uint16)
    for kind in kinds:
        if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
            return column.astype(kind)
    return column


def columns_of(values: np.ndarray, signed: tuple[bool, ...]) -> list[np.ndarray]:
    """Frames (N, F) int32 as columns (N,), each in the fewest bits.

    Args:
        values: modulo 2^32.
        signed: by field; one without a sign uses the top bit for its size.
    """
    columns = []
    for i, has_sign in enumerate(signed):
        column = np.ascontiguousarray(values[:, i])
        columns.append(narrowed(column if has_sign else column.view(np.uint32)))
    return columns


class Rows:
    """Numbers of frames as written, in the order of the file: packed until they are taken.

    Most are differences, of a byte each. As 32 bits the frames of a log are five times its size.
    """

    def __init__(self, width: int) -> None:
        self.width, self.size = width, 0
        self._pieces: deque[list[np.ndarray]] = deque()

    def append(self, values: np.ndarray) -> None:
        """Add frames (M, F) int32."""
        if len(values):
            self._pieces.append(columns_of(values, (True,) * self.width))
            self.size += len(values)

    def take(self, count: int) -> np.ndarray:
        """The next `count` frames (count, F) int32, which are given away."""
        taken, at = np.empty((count, self.width), np.int32), 0
        self.size -= count
        while at < count:
            piece = self._pieces[0]
            n = min(count - at, piece[0].size)
            for i, column in enumerate(piece):
                taken[at : at + n, i] = column[:n]
            if n == piece[0].size:
                self._pieces.popleft()
            else:
                self._pieces[0] = [column[n:] for column in piece]
            at += n
        return taken
