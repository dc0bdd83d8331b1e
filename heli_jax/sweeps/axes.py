"""The axes of a design: from where to where, or values; checked, and as numbers.

Values are in SI; a configuration's units are converted before.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

Columns = dict[str, np.ndarray]


class Range(NamedTuple):
    """An axis from `lower` to `upper`, in SI, evenly in the value or in its logarithm."""

    lower: float
    upper: float
    scale: Literal["linear", "log"] = "linear"
    n: int | None = None
    """points, for a grid"""

    def at(self, fraction: np.ndarray) -> np.ndarray:
        """The value at fractions (k,) of the way, 0 to 1; the ends are exact."""
        # A weighted mean and no difference: that of two huge ends would overflow.
        low, high = float(self.lower), float(self.upper)
        if self.scale == "log":
            # Both ends are negative or both positive, which was checked; the logarithm is of their
            # size.
            sign = math.copysign(1.0, low)
            values = sign * np.exp(
                (1.0 - fraction) * math.log(abs(low)) + fraction * math.log(abs(high))
            )
        else:
            values = (1.0 - fraction) * low + fraction * high
        # exp(log(0.1)) is not 0.1: who asks for an end gets it to the last bit.
        return np.where(fraction == 0.0, low, np.where(fraction == 1.0, high, values))


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of named arrays, whatever their order."""
    sha = hashlib.sha256()
    # In order of the names, since two dictionaries with the same arrays may have been filled in
    # another order.
    for name in sorted(arrays):
        v = np.ascontiguousarray(arrays[name])
        # Type and shape too: the bytes of two arrays may be equal where their numbers are not.
        sha.update(f"{name}:{v.dtype.str}:{v.shape}:".encode())
        sha.update(v.tobytes())
    return sha.hexdigest()


def check_range(name: str, axis: Range) -> None:
    """Refuse an axis without a beginning below its end.

    Raises:
        ValueError: naming the axis.
    """
    low, high = axis.lower, axis.upper
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"axes.{name}: expected finite lower < upper, got {low:g} and {high:g}")
    if axis.scale not in ("linear", "log"):
        raise ValueError(f"axes.{name}.scale: expected linear or log, got {axis.scale!r}")
    if axis.scale == "log" and low * high <= 0:
        raise ValueError(
            f"axes.{name}: expected lower and upper of one sign on a log scale, got {low:g} and "
            f"{high:g}"
        )


def check_axes(axes: Mapping[str, object]) -> None:
    """Refuse a design without axes.

    Raises:
        ValueError: there is none.
    """
    if not axes:
        raise ValueError("axes: none given, expected at least one")


def axis_values(name: str, axis: Range | Sequence[float] | np.ndarray) -> np.ndarray:
    """The values (k,) of one axis of a grid or a list.

    Raises:
        ValueError: there is none, or they are no numbers.
    """
    if isinstance(axis, Range):
        check_range(name, axis)
        if axis.n is None or axis.n < 2:
            got = "none" if axis.n is None else axis.n
            raise ValueError(f"axes.{name}.n: expected at least 2 points, got {got}")
        values = axis.at(np.linspace(0.0, 1.0, axis.n))
        even = axis.scale == "linear" and (axis.upper - axis.lower) % (axis.n - 1) == 0.0
        # From 0 to 9 in ten points: 7 and not 6.999999999999999, which as a seed would be 6.
        return np.round(values) if even and axis.lower == round(axis.lower) else values
    values = np.asarray(axis)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"axes.{name}: no values, expected at least one")
    if values.dtype.kind not in "iuf":
        raise ValueError(f"axes.{name}: expected numbers, got {values[0]!r:.40}")
    # Whole numbers stay whole, so that seeds stand as integers in the store.
    return values if values.dtype.kind in "iu" else values.astype(np.float64)


def whole_seeds(values: np.ndarray) -> np.ndarray:
    """Seeds (k,) as whole numbers.

    Raises:
        ValueError: one is none.
    """
    # Refused and not rounded: 6.999, from a range that was not meant for seeds, would be seed 6.
    # They reach JAX as uint32, so larger ones would draw what smaller ones do.
    whole = np.isfinite(values) & (values == np.round(values)) & (values >= 0)
    wrong = values[~(whole & (values < 2**32))]
    if wrong.size:
        raise ValueError(
            f"axes.seed: expected whole numbers from 0 to 2^32 - 1, got {wrong[0]:.10g}"
        )
    return values.astype(np.int64)
