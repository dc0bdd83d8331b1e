"""Free parameters as unbounded coordinates: log, linear where the sign is open, or logit between
bounds."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax.identification.problem import Free

type Real = Array | np.ndarray | np.floating | float
"""real numbers of any shape, traced or not"""

KINDS = ("log", "linear", "above", "below", "logit-log", "logit")
"""log: x = sign e^z. linear: x = scale z. above, below: a bound on one side. logit-log: between two
bounds of one sign, uniform in log x. logit: between any two bounds."""


def kind(free: Free) -> str:
    """The coordinate that a free parameter gets; without bounds it keeps the start's sign, unless
    that may be any."""
    if free.lower is None and free.upper is None:
        return "linear" if free.sign == "any" else "log"
    # By `limits`, not by what is stated: one bound on a parameter of one sign makes two with zero.
    low, high = limits(free)
    if math.isinf(high):
        return "above"
    if math.isinf(low):
        return "below"
    # A logarithm needs both bounds on one side of zero, and none at zero.
    return "logit-log" if low * high > 0 else "logit"


def limits(free: Free) -> tuple[float, float]:
    """Lower and upper as numbers: where one is missing, zero or infinity by the start's sign.

    One bound on a parameter of one sign leaves zero as the other: a positive mass below 2 kg lies
    between 0 and 2. Not so where its sign may be any.
    """
    if free.sign == "any":
        return (
            -math.inf if free.lower is None else free.lower,
            math.inf if free.upper is None else free.upper,
        )
    # Zero cannot be crossed in log coordinates, so it bounds the side on which the start lies.
    low = free.lower if free.lower is not None else (0.0 if free.start > 0 else -math.inf)
    high = free.upper if free.upper is not None else (0.0 if free.start < 0 else math.inf)
    return low, high


def plain_kind(free: Free) -> str:
    """The coordinate without regard to bounds: log wherever zero is not inside them, linear where
    the sign may be any and there are not two of them."""
    # A product of powers that the data determine, such as a/Ixx, is a straight valley in log
    # coordinates. A logit bends it, and Levenberg-Marquardt then creeps along the bend; so bounds
    # are looked at only after this search has left them.
    low, high = limits(free)
    if low >= 0 or high <= 0:
        return "log"
    return "linear" if changes_sign(free) else kind(free)


def changes_sign(free: Free) -> bool:
    """True if a parameter may change its sign, and need not stay between bounds."""
    low, high = limits(free)
    bounded = math.isfinite(low) and math.isfinite(high)
    return bool(free.sign == "any" and low < 0 < high and not bounded)


def scale(free: Free) -> float:
    """The size of a parameter that may have any sign: that of its start, else of its prior or
    bound, else one unit."""
    # Of these the first that is not zero: a start of zero says nothing of the parameter's size.
    sizes = [abs(free.start)]
    if free.prior is not None:
        sizes += [abs(free.prior.mean), free.prior.sd]
    sizes += [abs(b) for b in (free.lower, free.upper) if b is not None]
    return next((s for s in sizes if s > 0), 1.0)


def sign_or_scale(free: Free) -> float:
    """Return the `sign` that `to_value` and `to_coordinate` take."""
    # Whichever of the two it is, to_value multiplies by it: one array of numbers serves both.
    if changes_sign(free):
        return scale(free)
    return math.copysign(1.0, free.start) if free.start else 1.0


def inside(free: Free, value: float) -> bool:
    """True if a value lies within the bounds."""
    low, high = limits(free)
    return bool(low <= value <= high)


def coordinates(free: Free, kind: str, values: Real) -> np.ndarray:
    """The coordinates of values; infinite or NaN of those on the bounds or outside."""
    return np.asarray(to_coordinate(kind, values, sign_or_scale(free), *limits(free)))


def coordinate(free: Free, kind: str, value: float) -> float | None:
    """The coordinate of a value; None where it lies outside the bounds, or has none."""
    z = float(coordinates(free, kind, value))
    return z if inside(free, value) and math.isfinite(z) else None


def at_bound(free: Free, value: float) -> bool:
    """True if an estimate ended at a bound that was stated."""
    low, high = free.lower, free.upper
    width = high - low if low is not None and high is not None else abs(value)
    near = 1e-3 * width
    # Of a small lower bound beside a wide range: near in proportion to the bound itself, since the
    # search is in logarithms there.
    by_low = low is not None and value - low < min(near, 1e-3 * abs(low) if low else near)
    by_high = high is not None and high - value < near
    return bool(by_low or by_high)


def to_value(transform: str, z: Real, sign: Real, low: Real, high: Real) -> Real:
    """The parameter's value for a coordinate of one of `KINDS`; its sign is its scale where that is
    linear (`sign_or_scale`), and a bound that is missing is infinite."""
    # Which branch is taken is known before tracing: the compiled program holds one expression.
    if transform == "log":
        return sign * jnp.exp(z)
    if transform == "linear":
        return sign * z
    if transform == "above":
        return low + jnp.exp(z)
    if transform == "below":
        # e^z is the distance to the bound, so the value falls as z rises.
        return high - jnp.exp(z)
    if transform == "logit":
        return low + (high - low) * jax.nn.sigmoid(z)
    # logit-log: a is the logarithm of the lower bound's size, so for two negative bounds a > b and
    # the value still rises with z.
    a, b = jnp.log(jnp.abs(low)), jnp.log(jnp.abs(high))
    return sign * jnp.exp(a + (b - a) * jax.nn.sigmoid(z))


def to_coordinate(transform: str, x: Real, sign: Real, low: Real, high: Real) -> Real:
    """The coordinate of a value inside the bounds: the inverse of `to_value`, of numbers alone."""
    # By NumPy: each step by itself would be a program of JAX's to load.
    x, sign, low, high = (np.asarray(v) for v in (x, sign, low, high))
    # A value on a bound has an infinite coordinate: callers move it inside first.
    with np.errstate(all="ignore"):
        if transform == "log":
            return np.log(sign * x)
        if transform == "linear":
            return x / sign
        if transform == "above":
            return np.log(x - low)
        if transform == "below":
            return np.log(high - x)
        if transform == "logit":
            share = (x - low) / (high - low)
        else:
            a, b = np.log(np.abs(low)), np.log(np.abs(high))
            share = (np.log(np.abs(x)) - a) / (b - a)
        # log1p keeps the digits of a share near zero, where 1 - share rounds to 1.
        return np.log(share) - np.log1p(-share)
