"""Sine and cosine of an angle, faster than XLA's where a loop over time asks for many."""

# Why not jnp.sin and jnp.cos: in double precision XLA calls scalar code of the C library for each
# angle of each stage, which is most of the whole helicopter's step in
# `experiments/benchmarks/helicopter.py`; this polynomial is vectorised with the rest.

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax.naming import Scalar

_RIGHT_ANGLE = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624871116645580e-21)
"""pi/2 in three parts; the first two have so few digits that their multiples are exact (fdlibm)."""
_TERMS = 10
"""of Taylor's series of the sine beyond x: the last digit up to a right angle"""


@jax.custom_jvp
def sincos(x: Scalar) -> tuple[Scalar, Scalar]:
    """Sine and cosine of x [rad], to the last digit up to 1e6 rad.

    Each is the sine of what is left of x after the nearest half turn, or for the cosine the
    nearest half turn and right angle, with its sign. In double precision this takes a fraction of
    the time of jnp.sin and jnp.cos; in any other it is them.
    """
    x = jnp.asarray(x)
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    # Only sines are summed: the cosine is a sine a right angle away, with the same series, and both
    # are evaluated where |r| <= pi/2. Half turns k and m + 1/2 are the nearest ones.
    k = jnp.round(x * (1.0 / math.pi))
    m = jnp.round(x * (1.0 / math.pi) - 0.5)
    return _sign(k) * _sine_past(x, 2.0 * k), -_sign(m) * _sine_past(x, 2.0 * m + 1.0)


def _sign(k: Scalar) -> Scalar:
    """1 for even k and -1 for odd."""
    # Without integers: a conversion is slow, and k may be past what an int32 holds.
    half = 0.5 * k
    return 1.0 - 4.0 * (half - jnp.floor(half))


def _sine_past(x: Scalar, right_angles: Scalar) -> Scalar:
    """The sine of x less so many right angles, which is a right angle or less."""
    # Part by part (Cody and Waite): one product with pi/2 would lose what x and it have in common.
    r = x
    for part in _RIGHT_ANGLE:
        r = r - right_angles * part
    r2, total = r * r, 0.0
    for n in range(_TERMS, 0, -1):
        total = total * r2 + (-1.0) ** n / math.factorial(2 * n + 1)
    return r + (r * r2) * total


@sincos.defjvp
def _sincos_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
    # The derivative is there already; that of the rounding would be zero almost everywhere.
    s, c = sincos(*primals)
    return (s, c), (c * tangents[0], -s * tangents[0])
