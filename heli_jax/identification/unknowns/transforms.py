"""Coordinates of free parameters: logarithmic, linear for any sign, or logit between bounds of
different sign."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax.identification.problem import Free

type Real = Array | np.ndarray | np.floating | float
"""Real numbers of any shape, traced or not."""

KINDS = ("log", "linear", "logit")
"""log: x = sign e^z. linear: x = scale z. logit: between two bounds of different sign."""


def kind(free: Free) -> str:
    """Return the coordinate of a free parameter: a logarithm unless zero is inside its bounds.

    Other bounds limit the optimiser without bending the coordinate. A product of powers that the
    data determine, such as a/Ixx, is then a straight valley in logarithms.
    """
    low, high = limits(free)
    if low >= 0 or high <= 0:
        return "log"
    if math.isfinite(low) and math.isfinite(high):
        return "logit"
    return "linear" if free.sign == "any" else "log"


def limits(free: Free) -> tuple[float, float]:
    """Return lower and upper bound; the start's sign sets a missing one to zero or infinity.

    A positive mass with upper bound 2 kg lies between 0 and 2. If any sign is allowed, missing
    bounds are infinite.
    """
    if free.sign == "any":
        return (
            -math.inf if free.lower is None else free.lower,
            math.inf if free.upper is None else free.upper,
        )
    # A logarithm cannot cross zero.
    low = free.lower if free.lower is not None else (0.0 if free.start > 0 else -math.inf)
    high = free.upper if free.upper is not None else (0.0 if free.start < 0 else math.inf)
    return low, high


def changes_sign(free: Free) -> bool:
    """True if a parameter may change its sign, and need not stay between bounds."""
    return kind(free) == "linear"


def scale(free: Free) -> float:
    """Return the size of a parameter of any sign: that of its start, else of its prior or bound,
    else one unit."""
    sizes = [abs(free.start)]
    if free.prior is not None:
        sizes += [abs(free.prior.mean), free.prior.sd]
    sizes += [abs(b) for b in (free.lower, free.upper) if b is not None]
    return next((s for s in sizes if s > 0), 1.0)


def sign_or_scale(free: Free) -> float:
    """Return the `sign` argument of `to_value` and `to_coordinate`."""
    if changes_sign(free):
        return scale(free)
    return math.copysign(1.0, free.start) if free.start else 1.0


def inside(free: Free, value: float) -> bool:
    """True if a value lies within the bounds."""
    low, high = limits(free)
    return bool(low <= value <= high)


def coordinates(free: Free, kind: str, values: Real) -> np.ndarray:
    """Return the coordinates of values; NaN for values without one."""
    return np.asarray(to_coordinate(kind, values, sign_or_scale(free), *limits(free)))


def coordinate(free: Free, kind: str, value: float) -> float | None:
    """Return the coordinate of a value; None outside the bounds, or without a coordinate."""
    z = float(coordinates(free, kind, value))
    return z if inside(free, value) and math.isfinite(z) else None


def at_bound(free: Free, value: float) -> bool:
    """True if an estimate is at a stated bound."""
    low, high = free.lower, free.upper
    width = high - low if low is not None and high is not None else abs(value)
    near = 1e-3 * width
    # For a small lower bound of a wide range the tolerance is relative to the bound, because
    # coordinates are logarithms.
    by_low = low is not None and value - low < min(near, 1e-3 * abs(low) if low else near)
    by_high = high is not None and high - value < near
    return bool(by_low or by_high)


def to_value(transform: str, z: Real, sign: Real, low: Real, high: Real) -> Real:
    """Return the value of a coordinate of one of `KINDS`.

    Args:
        sign: sign, or scale of a linear coordinate (`sign_or_scale`).
    """
    # The branch is static, so the compiled program contains one expression.
    if transform == "log":
        return sign * jnp.exp(z)
    if transform == "linear":
        return sign * z
    return low + (high - low) * jax.nn.sigmoid(z)


def to_coordinate(transform: str, x: Real, sign: Real, low: Real, high: Real) -> Real:
    """Return the coordinate of a value inside the bounds: the inverse of `to_value`, not traced."""
    # JAX would load a separate program for each operation, so NumPy is used.
    x, sign, low, high = (np.asarray(v) for v in (x, sign, low, high))
    # A value on a bound of a logit has an infinite coordinate.
    with np.errstate(all="ignore"):
        if transform == "log":
            return np.log(sign * x)
        if transform == "linear":
            return x / sign
        share = (x - low) / (high - low)
        # log1p keeps the digits of a share near zero, where 1 - share rounds to 1.
        return np.log(share) - np.log1p(-share)


def coordinate_limits(kind: str, sign: Real, low: Real, high: Real) -> np.ndarray:
    """Return the lowest and the highest coordinate within the bounds (2,)."""
    ends = np.array([to_coordinate(kind, bound, sign, low, high) for bound in (low, high)])
    # Zero does not bound a logarithm from the other side.
    ends = np.where(np.isnan(ends), -np.inf, ends)
    return np.sort(ends)
