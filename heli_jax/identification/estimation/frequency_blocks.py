"""The lines of a record so many at a time, and how many of these blocks are gone through.

What is made for one block stays in the processor's caches. How many are gone through is a number
like any other and not part of the program: a search may begin with the lowest ones alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax.identification.estimation.frequency_records import Record

_NUMBERS = 20_000
"""outputs times states times lines in a block at most: 256 lines of a helicopter, and the whole
record of a small machine, whose blocks would take longer to begin than to go through"""


class Blocks(NamedTuple):
    """Those of a record; the last one is filled up."""

    lines: int
    """of the record"""
    count: int
    size: int
    last: Array
    """lines that are used, from the lowest frequency"""

    def cut(self, v: Array, axis: int = 0) -> Array:
        """An array with an axis of lines, the blocks as its first axis; zeros beyond the last line.

        Args:
            v: at all lines.
            axis: of the lines.
        """
        widths = [(0, 0)] * v.ndim
        widths[axis] = (0, self.count * self.size - self.lines)
        v = jnp.pad(v, widths)
        v = v.reshape(*v.shape[:axis], self.count, self.size, *v.shape[axis + 1 :])
        return jnp.moveaxis(v, axis, 0)

    def joined(self, v: Array, axis: int = 0) -> Array:
        """The inverse of `cut`.

        Args:
            v: with the blocks as its first axis.
            axis: of the lines in the result.
        """
        v = jnp.moveaxis(v, 0, axis)
        v = v.reshape(*v.shape[:axis], self.count * self.size, *v.shape[axis + 2 :])
        return jax.lax.slice_in_dim(v, 0, self.lines, axis=axis)

    def within(self, b: Array | int) -> Array:
        """(size,) whether a line of a block is used.

        Args:
            b: number of the block.
        """
        return b * self.size + jnp.arange(self.size) < self.last

    def over(self, step: Callable[[Any, Any], Any], first: Any) -> Any:
        """`step(b, so far)` for the blocks that are used, one after another.

        Args:
            step: returns what the next one is given.
            first: what the first one is given.
        """
        if self.count == 1:
            return step(0, first)
        used = -(-self.last // self.size)
        return jax.lax.fori_loop(0, used, step, first)


def blocks_of(record: Record, part: Array, numbers: int) -> Blocks:
    """Those of a record.

    Args:
        record: which samples it is.
        part: of its lines that are used.
        numbers: outputs times states.
    """
    K = record.lines
    count = -(-K * numbers // _NUMBERS)
    # So that a half and a quarter of the lines are whole blocks.
    count = count if count == 1 else 4 * -(-count // 4)
    return Blocks(K, count, -(-K // count), jnp.floor(part * K).astype(int))
