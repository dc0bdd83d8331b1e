"""An output that is slower than the grid at its own samples, for what needs a row of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_REGULAR = 0.98
"""part of the steps between samples that are of one length, from which on they are a clock's"""
_MOST = 50
"""grid steps between two samples at most"""
_JITTERS = 5
"""grid steps between two samples from which on a clock falls on the grid one sooner or later"""


class OwnSamples(NamedTuple):
    """Where on the grid an output was sampled at even times."""

    rows: np.ndarray
    """(M,) their numbers"""
    every: int
    """grid steps from one to the next"""

    @property
    def holes(self) -> tuple[int, ...]:
        """Where in `rows` the sample before is missing: a slow residual jumps there, and so does an
        input, which is no answer of one to the other."""
        apart = np.diff(self.rows)
        return tuple((np.flatnonzero(apart > self.every + (self.every >= _JITTERS)) + 1).tolist())

    def of_input(self, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " M"]:
        """An input's mean from one sample to the next, so that nothing between them is lost; the
        first from where the flight begins.

        Args:
            u: the input (N,), any unit.
        """
        summed = np.concatenate([[0.0], np.cumsum(u)])
        # An input acts from its own sample on: that at the output's sample moves the next one.
        first = np.maximum(self.rows + 1 - self.every, 0)
        return (summed[self.rows + 1] - summed[first]) / (self.rows + 1 - first)


def own_samples(seen: Bool[np.ndarray, " N"]) -> OwnSamples | None:
    """Where an output was sampled; None where too much of its own samples is missing.

    Args:
        seen: whether there is one, on the grid.
    """
    rows = np.flatnonzero(seen)
    if rows.size == seen.size:
        return OwnSamples(rows, 1)
    if rows.size < 2:
        return None
    steps = np.diff(rows)
    usual = int(np.median(steps))
    # A clock that is no multiple of the grid's falls on its rows one sooner or later.
    near = np.abs(steps - usual) <= (0 if usual < _JITTERS else 1)
    if usual > _MOST or np.mean(near) < _REGULAR:
        return None
    return OwnSamples(rows, usual)
