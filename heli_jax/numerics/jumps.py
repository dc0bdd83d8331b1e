"""Jumps of a sampled signal: sample intervals in which it was held and then stepped."""

from typing import Any

import numpy as np

_ROUNDING = 1e-9
"""of the range: smaller moves are rounding"""
_COUNT = 1.5
"""quanta up to which a move is one count of the log, whatever the rounding of either"""
FEW = 10.5
"""quanta in the whole range, up to which one count is no longer the resolution's"""
_QUIET = 0.25 + 1e-6
"""of a jump: a neighbouring move up to that is none"""
_BESIDE = 8
"""sample intervals on either side in which jumps have to make up most of the motion"""
POWER = 1.5
"""Moves count by their size to this power: between their sum, which much small noise dominates, and
their energy, which a single glitch does."""


def smallest_move(u: np.ndarray) -> float:
    """Return the smallest move of a signal (N,), in its unit; inf where it never moves."""
    return float(_sizes(u, np)[1])


def weights(u: Any, xp: Any = np) -> Any:
    """Weights (N-1,) of the moves from sample to sample; zero for rounding and single counts.

    Args:
        u: samples (N,), finite, in any unit.
        xp: numpy, or jax.numpy for traced samples.
    """
    size, smallest, span = _sizes(u, xp)
    # One count of a fine log is the resolution's, of a slow motion or of noise.
    evident = (size > _COUNT * smallest) | (span <= FEW * smallest)
    return xp.where(evident, size / xp.where(span > 0, span, 1.0), 0.0) ** POWER


def jumps(u: Any, xp: Any = np) -> Any:
    """Return the sample intervals (N-1,) that a signal was held in until it jumped.

    A jump is a move between two quiet ones: both neighbours are below a quarter of it. Chance makes
    such moves of noise too, so jumps must also make up most of the motion within eight samples on
    either side.

    Args:
        u: samples (N,), finite, in any unit.
        xp: numpy, or jax.numpy for traced samples.
    """
    size, weight = _sizes(u, xp)[0], weights(u, xp)
    none = xp.zeros(1, size.dtype)
    beside = xp.maximum(xp.concatenate([none, size[:-1]]), xp.concatenate([size[1:], none]))
    alone = (weight > 0) & (beside <= _QUIET * size)
    nearby = xp.ones(2 * _BESIDE + 1, weight.dtype)

    def around(w: Any) -> Any:
        return xp.convolve(w, nearby)[_BESIDE:-_BESIDE]

    return alone & (around(xp.where(alone, weight, 0.0)) >= 0.5 * around(weight))


def split(u: Any, xp: Any = np) -> tuple[Any, Any]:
    """Split a signal (N,) into a staircase of its jumps and the rest, which sum to it.

    Args:
        u: samples (N,), finite, in any unit.
        xp: numpy, or jax.numpy for traced samples.

    Returns:
        The staircase, held between samples, and the rest, which follows straight lines.
    """
    stairs = xp.concatenate(
        [xp.zeros(1, u.dtype), xp.cumsum(xp.where(jumps(u, xp), xp.diff(u), 0.0))]
    )
    return stairs, u - stairs


def _sizes(u: Any, xp: Any) -> tuple[Any, Any, Any]:
    """Sizes of the moves (N-1,), the smallest of them, and the range."""
    size, span = xp.abs(xp.diff(u)), xp.max(u) - xp.min(u)
    size = xp.where(size > _ROUNDING * span, size, 0.0)
    return size, xp.min(xp.where(size > 0, size, xp.inf)), span
