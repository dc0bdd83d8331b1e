r"""The specific force that accelerometers show, from what a model knows of its velocities.

At r from the centre of gravity $f = a - g + \dot\omega \times r + \omega \times (\omega \times r)$,
along the body forward, right and down. Three kinds of models know it:

- linear ones with speeds u, v, w of the body: about hover, $f_x = \dot u + g\theta$,
  $f_y = \dot v - g\phi$, $f_z = \dot w$ (the steady -g of a level hover is left to the bias);
- others with speeds u, v, w and rates p, q, r of the body among their states;
- those with speeds dx, dy, dz over the ground (dz up) and the angles phi, theta, psi, whose body
  rates are outputs: the whole helicopter.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record

_G = 9.80665

type Vector = tuple[Any, Any, Any]


_BODY_RATES = (("p", "q", "r"), ("roll_rate", "pitch_rate", "yaw_rate"))
"""the names that outputs may have which are the rates of the body"""


class MotionKind(NamedTuple):
    """How a model knows its velocities."""

    kind: str
    """linear, body or ground"""
    outputs: tuple[str, ...]
    """those of ax, ay, az that it can show"""


def motion_of(model: Model) -> MotionKind:
    """How a model knows its velocities.

    Raises:
        ValueError: it knows none.
    """
    states = naming.names(model.State)
    if model.linear:
        seen = tuple(f"a{axis}" for axis, n in zip("xyz", "uvw", strict=True) if n in states)
        if seen:
            return MotionKind("linear", seen)
    elif {"u", "v", "w", "p", "q", "r", "phi", "theta"} <= set(states):
        return MotionKind("body", ("ax", "ay", "az"))
    elif {"dx", "dy", "dz", "phi", "theta", "psi"} <= set(states) and _body_rates(model):
        return MotionKind("ground", ("ax", "ay", "az"))
    raise ValueError(
        f"imu: model {model.name} does not know its velocities, expected states u, v, w (with p, "
        "q, r, phi, theta), or dx, dy, dz, phi, theta, psi with outputs p, q, r"
    )


def _body_rates(model: Model) -> tuple[str, ...]:
    """The outputs that are the rates of the body; () where there are none."""
    outputs = naming.names(model.Outputs)
    return next((names for names in _BODY_RATES if set(names) <= set(outputs)), ())


def specific_force(
    model: Model, motion: MotionKind, p: Record, s: Record, u: Record
) -> dict[str, Any]:
    """The specific force at the IMU [m/s^2], by output.

    Args:
        model: without its IMU.
        motion: of `motion_of`.
        p: the model's Params with x_imu, y_imu, z_imu.
        s: the model's State.
        u: the model's Inputs.
    """
    # From the model's own derivatives, so that thrust, drag and gusts are in it without being
    # named: an accelerometer shows all forces but weight.
    rates = model.vector_field(p, s, u)
    of_kind = {"linear": _linear, "body": _body, "ground": _ground}[motion.kind]
    force = of_kind(model, p, s, u, rates)
    return {n: force["xyz".index(n[1])] for n in motion.outputs}


def _g(p: Record) -> Any:
    # The model's own g where it has one: a fit in which weight and specific force had two values
    # would find the difference as a force.
    return getattr(p, "g", _G)


def _at(p: Record) -> Vector:
    return p.x_imu, p.y_imu, p.z_imu


def _linear(model: Model, p: Record, s: Record, u: Record, rates: Record) -> Vector:
    """About hover, of first order in all states; a state that the model has not is zero."""

    def of(record: Record, name: str) -> Any:
        return getattr(record, name, 0.0)

    # omega x v and omega x (omega x r) are products of two small numbers, of which a linear model
    # knows nothing: kept here, they would make the output nonlinear.
    turning = _cross((of(rates, "p"), of(rates, "q"), of(rates, "r")), _at(p))
    return (
        of(rates, "u") + _g(p) * of(s, "theta") + turning[0],
        of(rates, "v") - _g(p) * of(s, "phi") + turning[1],
        of(rates, "w") + turning[2],
    )


def _body(model: Model, p: Record, s: Record, u: Record, rates: Record) -> Vector:
    omega, velocity = (s.p, s.q, s.r), (s.u, s.v, s.w)
    # u, v and w are components along axes that turn: their derivatives lack omega x v, without
    # which a steady turn would show no acceleration.
    along = _sum((rates.u, rates.v, rates.w), _cross(omega, velocity))
    cos_theta = jnp.cos(s.theta)
    weight = (
        -_g(p) * jnp.sin(s.theta),
        _g(p) * cos_theta * jnp.sin(s.phi),
        _g(p) * cos_theta * jnp.cos(s.phi),
    )
    at_centre = tuple(a - g for a, g in zip(along, weight, strict=True))
    return _sum(at_centre, _lever(p, omega, (rates.p, rates.q, rates.r)))


def _ground(model: Model, p: Record, s: Record, u: Record, rates: Record) -> Vector:
    # Forward, right, down over the ground; the model's z is up. Then yaw, pitch, roll into the
    # body (Stevens and Lewis, 2003, eq. 1.3-20).
    # Acceleration less gravity while still along the ground, where gravity has one component.
    x, y, z = rates.dx, rates.dy, -rates.dz - _g(p)
    (cphi, sphi), (ctheta, stheta), (cpsi, spsi) = (
        (jnp.cos(angle), jnp.sin(angle)) for angle in (s.phi, s.theta, s.psi)
    )
    ahead, right = cpsi * x + spsi * y, cpsi * y - spsi * x
    force = (
        ctheta * ahead - stheta * z,
        sphi * (stheta * ahead + ctheta * z) + cphi * right,
        cphi * (stheta * ahead + ctheta * z) - sphi * right,
    )

    def body_rates(state: Record) -> Vector:
        outputs = model.output(p, state, u)
        roll, pitch, yaw = (getattr(outputs, n) for n in _body_rates(model))
        return roll, pitch, yaw

    # The rates are outputs here: their derivatives are those of the outputs along the motion.
    as_arrays = jax.tree.map(jnp.asarray, s)
    tangent = jax.tree.map(lambda v, like: jnp.asarray(v, like.dtype), _as(s, rates), as_arrays)
    omega, alpha = jax.jvp(body_rates, (as_arrays,), (tangent,))
    return _sum(force, _lever(p, omega, alpha))


def _as(state: Record, rates: Record) -> Record:
    """The rates in the state's class, which a device around the model may have extended."""
    return type(state)(**{n: getattr(rates, n) for n in naming.names(type(state))})


def _lever(p: Record, omega: Vector, alpha: Vector) -> Vector:
    """What the IMU feels beside the centre of gravity."""
    return _sum(_cross(alpha, _at(p)), _cross(omega, _cross(omega, _at(p))))


def _cross(a: Any, b: Any) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _sum(a: Any, b: Any) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
