"""What an input did between the samples of a log: what the record itself shows of it.

An input that stays for several samples and jumps was commanded in steps, and each sample holds
until the next. One that moves at nearly every sample was sampled on its way: a straight line from
sample to sample is nearer to it.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


class Decision(NamedTuple):
    """A hold and, in words, what speaks for it."""

    hold: str
    reason: str


_LOW_PASSED = "was low-passed as"
_QUIET = 0.25 + 1e-6
"""of a jump: a neighbour smaller than that is none"""
_FEW = 10
"""quanta in the whole range, below which the resolution of the log hides how an input moves"""
_ROUNDING = 1e-9
"""of the range: smaller moves are rounding"""
_POWER = 1.5
"""Moves count by their size to this power: between their sum, which much small noise dominates, and
their energy, which a single glitch does."""


def decide(values: np.ndarray) -> Decision:
    """The hold of an input (N,), in any unit, by how it moves from sample to sample.

    A jump is a move between two quiet samples: both neighbouring moves are below a quarter of it.
    Where jumps make up most of the motion the input was commanded in steps, whether it stays for
    two samples (a stick logged faster than it was sampled) or two hundred, and whatever noise of a
    few counts lies on the steps. A smooth motion has hardly any, with or without pauses, and nor
    has a step that takes several samples. Moves by one count of the log say nothing by themselves:
    they are the resolution's, of a slow motion or of noise.
    """
    largest = float(np.abs(values).max())
    if largest > 0:
        values = values / largest  # what is left neither overflows nor vanishes
    moves = np.diff(values)
    span = float(np.ptp(values))
    size = np.where(np.abs(moves) > _ROUNDING * span, np.abs(moves), 0.0)
    moved = size > 0
    if not moved.any():
        return Decision("zero-order", "never moves")
    quantum = float(size[moved].min())
    share = float(moved.mean())
    if span <= (_FEW + 0.5) * quantum:
        return _of_few_values(moves, moved, span, quantum, share)
    # 1.5: one count against two, whatever the rounding of either.
    evident = np.where(size > 1.5 * quantum, size, 0.0)
    if not evident.any():
        return Decision("linear", f"moves by one count of the log at a time, {_percent(share)}")
    # The larger of a move's two neighbours; before the first and after the last there is none.
    beside = np.maximum(np.r_[0.0, size[:-1]], np.r_[size[1:], 0.0])
    jumps = (evident > 0) & (beside <= _QUIET * evident)
    # No move counts for more than the range of nearly all samples: a single absurd number goes
    # farther than all steps together.
    low, high = np.quantile(values, [0.01, 0.99])
    weight = np.minimum(evident, (high - low) or span) ** _POWER
    if weight[jumps].sum() >= 0.5 * weight.sum():
        return Decision("zero-order", _steps(jumps))
    return Decision("linear", f"moves at {_percent(share)}")


def low_passed(outputs: Iterable[str]) -> Decision:
    """Of an input that was commanded in steps and went through the filter of these outputs."""
    return Decision("linear", f"{_LOW_PASSED} {', '.join(outputs)}")


def is_low_passed(reason: str) -> bool:
    """Whether the reason of a hold is that of `low_passed`: no other hold is right then."""
    return reason.startswith(_LOW_PASSED)


def _of_few_values(
    moves: np.ndarray, moved: np.ndarray, span: float, quantum: float, share: float
) -> Decision:
    """Of an input with a handful of values, such as -1, 0 and 1, or noise of a few counts: steps,
    unless it passes through the values between on its way."""
    at = np.flatnonzero(moved)
    # Two moves of the same sign at neighbouring samples are one motion, seen on its way.
    # Of white noise of a few counts less than a third of neighbouring moves agree in sign, since a
    # value above the mean tends to come back: hence 0.4.
    onward = (np.diff(at) == 1) & (np.sign(moves[at[1:]]) == np.sign(moves[at[:-1]]))
    if at.size > 1 and onward.mean() > 0.4:
        return Decision("linear", f"passes through the values between, moves at {_percent(share)}")
    return Decision("zero-order", _steps(moved))


def _steps(jumps: np.ndarray) -> str:
    at = np.flatnonzero(jumps)
    if at.size < 2:
        return "jumps once and stays"
    stay = round(float(np.median(np.diff(at))))
    if stay < 2:  # a random binary signal at the log's own rate
        return "jumps from sample to sample among few values"
    return f"stays for {stay} samples at a time and jumps"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} % of the samples"
