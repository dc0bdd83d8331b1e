"""Free parameters as unbounded coordinates: log, linear where the sign is open, or logit between
bounds."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from heli_jax.identification.problem import Free

KINDS = ("log", "linear", "above", "below", "logit-log", "logit")
"""log: x = sign e^z. linear: x = scale z. above, below: a bound on one side. logit-log: between two
bounds of one sign, uniform in log x. logit: between any two bounds."""


def kind(free: Free) -> str:
    """The coordinate that a free parameter gets; without bounds it keeps the start's sign, unless
    that may be any."""
    if free.lower is None and free.upper is None:
        return "linear" if free.sign == "any" else "log"
    low, high = limits(free)
    if math.isinf(high):
        return "above"
    if math.isinf(low):
        return "below"
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
    low = free.lower if free.lower is not None else (0.0 if free.start > 0 else -math.inf)
    high = free.upper if free.upper is not None else (0.0 if free.start < 0 else math.inf)
    return low, high


def plain_kind(free: Free) -> str:
    """The coordinate without regard to bounds: log wherever zero is not inside them, linear where
    the sign may be any and there are not two of them.

    A least-squares valley that is straight in log coordinates stays straight; the bounds are
    looked at afterwards.
    """
    low, high = limits(free)
    if low >= 0 or high <= 0:
        return "log"
    return "linear" if changes_sign(free) else kind(free)


def changes_sign(free: Free) -> bool:
    """Whether a parameter is free to change its sign, rather than asked to stay between bounds."""
    low, high = limits(free)
    bounded = math.isfinite(low) and math.isfinite(high)
    return free.sign == "any" and low < 0 < high and not bounded


def scale(free: Free) -> float:
    """The size of a parameter that may have any sign: that of its start, else of its prior or
    bound, else one unit."""
    sizes = [abs(free.start)]
    if free.prior is not None:
        sizes += [abs(free.prior.mean), free.prior.sd]
    sizes += [abs(b) for b in (free.lower, free.upper) if b is not None]
    return next((s for s in sizes if s > 0), 1.0)


def sign_or_scale(free: Free) -> float:
    """What `to_value` and `to_coordinate` take as `sign`."""
    if changes_sign(free):
        return scale(free)
    return math.copysign(1.0, free.start) if free.start else 1.0


def inside(free: Free, value: float) -> bool:
    """Whether a value lies within the bounds."""
    low, high = limits(free)
    return bool(low <= value <= high)


def to_value(how: str, z: Any, sign: Any, low: Any, high: Any) -> Any:
    """The parameter's value for a coordinate z; `sign` is the scale where it is linear."""
    if how == "log":
        return sign * jnp.exp(z)
    if how == "linear":
        return sign * z
    if how == "above":
        return low + jnp.exp(z)
    if how == "below":
        return high - jnp.exp(z)
    if how == "logit":
        return low + (high - low) * jax.nn.sigmoid(z)
    a, b = jnp.log(jnp.abs(low)), jnp.log(jnp.abs(high))
    return sign * jnp.exp(a + (b - a) * jax.nn.sigmoid(z))


def to_coordinate(how: str, x: Any, sign: Any, low: Any, high: Any) -> Any:
    """The coordinate z of a value inside the bounds."""
    if how == "log":
        return jnp.log(sign * x)
    if how == "linear":
        return x / sign
    if how == "above":
        return jnp.log(x - low)
    if how == "below":
        return jnp.log(high - x)
    if how == "logit":
        share = (x - low) / (high - low)
    else:
        a, b = jnp.log(jnp.abs(low)), jnp.log(jnp.abs(high))
        share = (jnp.log(jnp.abs(x)) - a) / (b - a)
    return jnp.log(share) - jnp.log1p(-share)
