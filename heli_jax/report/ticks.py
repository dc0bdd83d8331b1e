"""Where an axis has its numbers, and how they are written."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from heli_jax.numbers import aligned

_ANGLES = (1.0, 2.0, 5.0, 15.0, 30.0, 45.0, 90.0, 180.0)
"""degrees: angles are read in parts of a right angle and in turns"""


def ticks(low: float, high: float, most: int, *, degrees: bool = False) -> list[float]:
    """Round numbers from low to high, 1, 2 or 5 times a power of ten apart; two at least.

    Args:
        low, high: ends of the axis, in either order.
        most: numbers at most, 3 at least.
        degrees: whether they are an angle's: then 15, 30, 45, 90 or 180 apart, or turns.
    """
    low, high = min(low, high), max(low, high)
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    before: list[float] = []
    for step in _steps((high - low) / most, degrees=degrees):
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        # Not by their number before it is known to be small.
        if last - first < most:
            found = [k * step for k in range(first, last + 1)]
            break
        before = [first * step, last * step]
    # One number tells no size. Those of the finer step that would be too many have their ends.
    return found if len(found) > 1 or not before else sorted({*found, *before})


def _steps(least: float, *, degrees: bool) -> Iterator[float]:
    """From one that is too fine on."""
    if degrees and least > 0.2:
        yield from _ANGLES
        yield from (360.0 * n for n in _steps(least / 360.0, degrees=False) if n >= 1.0)
        return
    power = 10.0 ** math.floor(math.log10(least))
    yield from (factor * power for factor in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0))


def decades(low: float, high: float, most: int) -> list[float]:
    """1, 2 and 5 times the powers of ten from low to high; the powers alone where that is too many.

    Args:
        low, high: ends of a logarithmic axis, both above zero.
        most: numbers at most, roughly.
    """
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1.0, 2.0, 5.0), (1.0,)):
        every = [m * 10.0**p for p in powers for m in digits]
        inside = [v for v in every if low * (1 - 1e-9) <= v <= high * (1 + 1e-9)]
        if len(inside) <= most + 2:
            break
    return inside


def tick_texts(values: Sequence[float]) -> list[str]:
    """The numbers of an axis: all with one power of ten, and as many places as tell them apart."""
    if not values:
        return []
    step = float(np.min(np.diff(values))) if len(values) > 1 else abs(values[0]) or 1.0
    return list(aligned(values, step))
