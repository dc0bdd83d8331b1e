r"""The induced velocity of a rotor in any axial flow: climb, hover, vortex ring, windmill.

Momentum theory gives $2 v_i s = T/(\rho\pi R^2)$ with the flow $s = \sqrt{V^2 + (W + v_i)^2}$
through the rotor. Between a descent at half and at twice the induced velocity it has three roots or
the wrong one: the wake is a ring or turbulent, and measured rotors have more flow through them.
Here that flow is a term of its own,

$$s^2 = V^2 + (W + v_i)^2 + k\,\frac{q^2}{v_i^2 + k_V V^2},\qquad
  q = \max\left(0, (-W - \tfrac12 v_i)(\tfrac{11}{5} v_i + W)\right),$$

zero outside the range and with a continuous first derivative at its ends, so that hover and the
windmill brake are joined by one curve with one root. k = 0.37 and k_V = 5.8 are fitted to the
measured curve as W. Johnson gives it (NASA TP-2005-213477, and the theory of NDARC, NASA
TP-2009-215402): in units of the induced velocity of hover,
$W + v_i = W(0.373 W^2 + 0.598 V^2 - 0.991)$ where $1.5 V^2 + (2W + 3)^2 < 1$. It is met within 8 %,
and where nothing goes through the rotor (W = -1.63, autorotation) within 4 %.
"""

import jax
import jax.numpy as jnp

from heli_jax.naming import Scalar

_STEPS = 7
"""Newton steps; over the whole range six reach 1e-7 and seven the last digit."""
_REST = 1e-8
"""[m/s] of flow that is always there: the square root has a derivative even where nothing moves."""
_BEGINS, _ENDS = 0.5, 2.2
"""descents over the induced velocity between which the wake is no stream tube"""
# Fitted with the two ends above in place: another end changes the shape of q, and both numbers have
# to be fitted to the measured curve again.
_K, _K_V = 0.37, 5.8


def _flow2(v: Scalar, V2: Scalar, W: Scalar) -> tuple[Scalar, Scalar]:
    """The square of the flow through the rotor [m^2/s^2] and its derivative by v [m/s]."""
    below, above = -W - _BEGINS * v, _ENDS * v + W
    # The term enters by its square, so cutting q to zero outside the range leaves the flow with a
    # continuous first derivative. Newton's steps and the gradients of a fit need that.
    product = below * above
    inside = product > 0
    q = jnp.where(inside, product, 0.0)
    dq = jnp.where(inside, _ENDS * below - _BEGINS * above, 0.0)
    ratio = q / (v * v + _K_V * V2 + _REST**2)
    w = W + v
    slope = 2.0 * w + 2.0 * _K * ratio * (dq - v * ratio)
    return V2 + w * w + _K * ratio * q + _REST**2, slope


def mass_flow(v: Scalar, V2: Scalar, W: Scalar) -> Scalar:
    """The flow s through the rotor [m/s] of the module's text.

    Args:
        v: induced velocity, of the sign of the thrust [m/s].
        V2: square of the airspeed in the plane of the rotor [m^2/s^2].
        W: airspeed through the rotor against the thrust, positive in climb [m/s].
    """
    # The sign of v and not that of a thrust: with dynamic inflow v is a state, and no thrust is at
    # hand here.
    sign = jnp.where(v < 0, -1.0, 1.0).astype(jnp.result_type(v))
    return jnp.sqrt(_flow2(sign * v, V2, sign * W)[0])


@jax.custom_jvp
def induced_velocity(V2: Scalar, W: Scalar, T0: Scalar, b: Scalar) -> Scalar:
    r"""The root $v_i$ [m/s] of $2 v_i s = T_0 - b v_i$, which there is once; it has T0's sign.

    Args:
        V2: square of the airspeed in the plane of the rotor [m^2/s^2].
        W: airspeed through the rotor against the thrust, positive in climb [m/s].
        T0: thrust without induced velocity over rho pi R^2 [m^2/s^2].
        b: what an induced velocity of 1 m/s takes off it, zero or more [m/s].

    The derivative, of any order and in both modes, is that of the implicit function.
    """
    # A negative thrust is a positive one seen from below.
    sign = jnp.where(T0 < 0, -1.0, 1.0).astype(jnp.result_type(T0))
    c, t = sign * W, sign * T0
    # A start close above the root, by the three closed forms: flow along the rotor, climb and
    # hover, and the windmill's where its root lies beyond the wake. From there plain Newton steps
    # converge. No bracket guards them: comparisons that rounding decides would undo the last step.
    along = t / (2.0 * jnp.sqrt(V2 + _REST**2) + b + _REST)
    x = jnp.minimum(_climbing(c, t, b), along)
    windmill = _windmill(c, t, b)
    x = jnp.where(_ENDS * windmill < -c, jnp.minimum(windmill, x), x)
    # A fixed number of steps, not a loop until convergence: a batch of vehicles takes the same
    # path, and XLA fuses it with the rest.
    for _ in range(_STEPS):
        s2, ds2 = _flow2(x, V2, c)
        s = jnp.sqrt(s2)
        # Numerator and denominator times s, so that a step is one division and not two.
        x = x - s * (2.0 * x * s + b * x - t) / (2.0 * s2 + x * ds2 + b * s)
    return sign * x


def _climbing(c: Scalar, t: Scalar, b: Scalar) -> Scalar:
    """The root v [m/s] of 2 v (c + v) = t - b v: climb and hover straight up."""
    q = 2.0 * c + b
    root = jnp.sqrt(q * q + 8.0 * t) + _REST
    # Two forms of the same root: each subtracts nearly equal numbers where the other does not.
    return jnp.where(q > 0, 2.0 * t / (jnp.abs(q) + root), 0.25 * (root - q))


def _windmill(c: Scalar, t: Scalar, b: Scalar) -> Scalar:
    """The lesser root v [m/s] of 2 v (-c - v) = t - b v: a fast descent straight down; infinite
    where there is none."""
    q = b - 2.0 * c
    inside = q * q - 8.0 * t
    there = (q > 0) & (inside > 0)
    root = jnp.sqrt(jnp.where(there, inside, 0.0))
    return jnp.where(there, 2.0 * t / (jnp.abs(q) + root + _REST), jnp.inf)


@induced_velocity.defjvp
def _induced_velocity_jvp(
    primals: tuple[Scalar, ...], tangents: tuple[Scalar, ...]
) -> tuple[Scalar, Scalar]:
    V2, W, T0, b = primals
    dV2, dW, dT0, db = tangents
    v = induced_velocity(*primals)
    # By the sign of T0, where `mass_flow` has that of v: they agree, and at zero both vanish.
    sign = jnp.where(T0 < 0, -1.0, 1.0).astype(jnp.result_type(T0))
    x, c = sign * v, sign * W
    s2, ds2 = _flow2(x, V2, c)
    s = jnp.sqrt(s2)
    below, above = -c - _BEGINS * x, _ENDS * x + c
    q = jnp.where(below * above > 0, below * above, 0.0)
    ratio = q / (x * x + _K_V * V2 + _REST**2)
    # Derivatives of s^2 by V2 and by c. In F = 2 x s + b x - t they come with 2 ds = d(s^2)/s,
    # which is the x/s below; `slope` is the derivative of F by x.
    by_V2 = 1.0 - _K * _K_V * ratio * ratio
    by_c = 2.0 * (c + x) + 2.0 * _K * ratio * jnp.where(q > 0, below - above, 0.0)
    slope = 2.0 * s + x * ds2 / s + b
    moved = sign * dT0 - x * db - (x / s) * (by_V2 * dV2 + by_c * sign * dW)
    return v, sign * moved / slope
