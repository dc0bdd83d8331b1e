"""Numbers of a blackbox log in the fewest bits: decoded, most take a quarter of 32."""

from itertools import pairwise

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


class Rows:
    """Numbers of M frames as written, in the order of the file, by field: packed.

    Most are differences, of a byte each, and many are zero throughout. As 32 bits the frames of a
    log are five times its size.
    """

    def __init__(self, width: int) -> None:
        self.width, self.size = width, 0
        # By field its pieces, each the numbers or the one number that all of them are.
        self._pieces: list[list[np.ndarray]] = [[] for _ in range(width)]
        self._edges = [0]

    def append(self, values: np.ndarray) -> None:
        """Add frames (M, F) int32."""
        if not len(values):
            return
        for i, pieces in enumerate(self._pieces):
            packed = narrowed(np.ascontiguousarray(values[:, i]))
            pieces.append(packed[:1].copy() if np.all(packed == packed[0]) else packed)
        self.size += len(values)
        self._edges.append(self.size)

    def column(self, i: int) -> np.ndarray:
        """The numbers (M,) int32 of the i-th field."""
        numbers = np.empty(self.size, np.int32)
        for piece, (begin, end) in zip(self._pieces[i], pairwise(self._edges), strict=True):
            numbers[begin:end] = piece
        return numbers

    def frames(self) -> np.ndarray:
        """All frames (M, F) int32."""
        return np.stack([self.column(i) for i in range(self.width)], axis=1)
