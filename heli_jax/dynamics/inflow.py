"""The induced velocity of a rotor by momentum theory.

Everything here is divided by the air's mass flow scale, so that nothing is divided by the rotor's
speed: a rotor at rest is an ordinary point.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from heli_jax.naming import Scalar

_STEPS = 5
"""Newton steps; from the closed forms they start at, four to five reach the last digit."""
_REST = 1e-8
"""[m/s] of flow that is always there: the square root has a derivative even where nothing moves."""


def axial_velocity(c: Scalar, t: Scalar, b: Scalar) -> Scalar:
    r"""The root $v$ [m/s] of $2 v (c + v) = t - b v$, without airspeed in the plane of the rotor.

    Args:
        c: airspeed through the rotor, positive in climb [m/s].
        t: thrust without induced velocity over rho pi R^2, zero or more [m^2/s^2].
        b: what an induced velocity of 1 m/s takes off it, zero or more [m/s].
    """
    q = 2.0 * c + b
    root = jnp.sqrt(q * q + 8.0 * t) + _REST
    # Two forms of the same root: each subtracts nearly equal numbers where the other does not.
    return jnp.where(q > 0, 2.0 * t / (jnp.abs(q) + root), 0.25 * (root - q))


@jax.custom_jvp
def induced_velocity(V2: Scalar, W: Scalar, T0: Scalar, b: Scalar) -> Scalar:
    r"""The root $v_i$ [m/s] of $2 v_i \sqrt{V^2 + (W + v_i)^2} = T_0 - b v_i$.

    Momentum theory (Glauert) with the thrust of the blades, which falls with the inflow. The
    sign of the root is that of T0. Where a fast descent has three roots, this is the one that is
    connected with hover.

    Args:
        V2: square of the airspeed in the plane of the rotor [m^2/s^2].
        W: airspeed through the rotor against the thrust, positive in climb [m/s].
        T0: thrust without induced velocity over rho pi R^2 [m^2/s^2].
        b: what an induced velocity of 1 m/s takes off it, zero or more [m/s].

    The derivative, of any order and in both modes, is that of the implicit function.
    """
    # A negative thrust is a positive one seen from below: solved once, with the sign set back.
    sign = jnp.where(T0 < 0, -1.0, 1.0).astype(jnp.result_type(T0))
    c, t = sign * W, sign * T0
    # The root lies between 0 and that of V = 0, where the equation is quadratic, and below that of
    # W + v = 0, where it is linear.
    axial = axial_velocity(c, t, b)
    V2 = V2 + _REST**2
    x = jnp.minimum(axial, t / (2.0 * jnp.sqrt(V2) + b))
    # A fixed number of steps, not a loop until convergence: a batch of vehicles takes the same
    # path, and XLA fuses it with the rest.
    for _ in range(_STEPS):
        w = c + x
        s2 = V2 + w * w
        s = jnp.sqrt(s2)
        # The slope times s, so that a step is one division and not two.
        slope = 2.0 * (s2 + x * w) + b * s
        # In a fast descent the slope changes sign between the roots; without this a step would lead
        # away from the first of them.
        slope = jnp.where(slope > 0, slope, 2.0 * s2 + b * s)
        x = x - s * (2.0 * x * s + b * x - t) / slope
        # Not jnp.maximum: XLA's takes as long as half the step.
        x = jnp.where(x < 0, 0.0, x)
    return sign * x


@induced_velocity.defjvp
def _induced_velocity_jvp(
    primals: tuple[Scalar, ...], tangents: tuple[Scalar, ...]
) -> tuple[Scalar, Scalar]:
    # Of the implicit function: as exact as the root itself, at a fifth of what a gradient through
    # the steps costs. One Newton step with a stopped gradient would do for first derivatives, and
    # give a wrong Hessian.
    V2, W, _, b = primals
    dV2, dW, dT0, db = tangents
    v = induced_velocity(*primals)
    w = W + v
    s = jnp.sqrt(V2 + w * w + _REST**2)
    slope = 2.0 * (s + v * w / s) + b
    return v, (dT0 - v * db - (v / s) * dV2 - (2.0 * v * w / s) * dW) / slope


def mass_flow(v: Scalar, V2: Scalar, W: Scalar) -> Scalar:
    """The flow sqrt(V^2 + (W + v)^2) through the rotor [m/s].

    Args:
        v: induced velocity [m/s].
        V2: square of the airspeed in the plane of the rotor [m^2/s^2].
        W: airspeed through the rotor against the thrust [m/s].
    """
    return jnp.sqrt(V2 + (W + v) ** 2 + _REST**2)


def vortex_ring(V2: Scalar, W: Scalar, T0: Scalar, v: Scalar) -> Bool[Array, ""]:
    """Whether momentum theory has left its range: in a descent through the rotor's own wake.

    That is where the rotor sinks faster than half the induced velocity that the same thrust has
    in hover, with little flow in its plane (Johnson, Helicopter Theory, section 3-2). Only there
    can the equation have more than one root.

    Args:
        V2: square of the airspeed in the plane of the rotor [m^2/s^2].
        W: airspeed through the rotor against the thrust [m/s].
        T0: as in `induced_velocity`; its sign is that of the thrust.
        v: the induced velocity [m/s].
    """
    # By momentum theory v times the whole flow is T/(2 rho pi R^2), which is the square of the
    # induced velocity in hover.
    x = jnp.abs(v)
    sinking = jnp.where(T0 < 0, W, -W)
    hover2 = x * jnp.sqrt(V2 + (W + v) ** 2)
    return (sinking > 0) & (4.0 * sinking**2 > hover2) & (jnp.maximum(hover2, sinking**2 / 8) > V2)
