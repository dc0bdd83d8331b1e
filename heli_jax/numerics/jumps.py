"""Jumps of a sampled signal: intervals in which it was held and then stepped."""

from typing import Any

import numpy as np

_ROUNDING = 1e-9
"""Largest move that counts as rounding [fraction of the range]."""
_COUNT = 1.5
"""Largest move that counts as one count of the log, after rounding [quanta]."""
FEW = 10.5
"""Range up to which one count is more than the resolution [quanta]."""
_QUIET = 0.25 + 1e-6
"""Largest neighbouring move that counts as none [fraction of the jump]."""
_BESIDE = 8
"""Number of intervals on either side in which jumps must make up most of the motion."""
POWER = 1.5
"""Exponent of the moves' weights, between 1, where small noise dominates, and 2, where one glitch
does.
"""


def smallest_move(u: np.ndarray) -> float:
    """Return the smallest move of a signal (N,), in its unit; inf where it never moves."""
    return float(_sizes(u, np)[1])


def weights(u: Any, xp: Any = np) -> Any:
    """Return the weights (N-1,) of moves between samples; zero for rounding and single counts.

    Args:
        u: samples (N,), finite, in any unit.
        xp: numpy, or jax.numpy for traced samples.
    """
    size, smallest, span = _sizes(u, xp)
    # In a fine log, one count is resolution, slow motion or noise.
    evident = (size > _COUNT * smallest) | (span <= FEW * smallest)
    return xp.where(evident, size / xp.where(span > 0, span, 1.0), 0.0) ** POWER


def jumps(u: Any, xp: Any = np) -> Any:
    """Return a mask of intervals (N-1,) in which a signal was held until it jumped.

    A jump is a move at least four times its two neighbours. Noise has such moves by chance, so
    jumps must also make up most of the motion within eight samples on either side.

    Args:
        u: samples (N,), finite, in any unit.
        xp: numpy, or jax.numpy for traced samples.
    """
    size, weight = _sizes(u, xp)[0], weights(u, xp)
    none = xp.zeros(1, size.dtype)
    neighbours = xp.maximum(xp.concatenate([none, size[:-1]]), xp.concatenate([size[1:], none]))
    alone = (weight > 0) & (neighbours <= _QUIET * size)
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
    """Return the sizes of the moves (N-1,), the smallest of them, and the range."""
    size, span = xp.abs(xp.diff(u)), xp.max(u) - xp.min(u)
    size = xp.where(size > _ROUNDING * span, size, 0.0)
    return size, xp.min(xp.where(size > 0, size, xp.inf)), span
