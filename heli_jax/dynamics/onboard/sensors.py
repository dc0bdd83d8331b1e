r"""Sensors between motion and log: accelerometers, low-passes, delays.

Motion sensors show specific force, angular acceleration and airspeed. At r from the centre of
gravity, $f = a - g + \dot\omega \times r + \omega \times (\omega \times r)$ and
$V = v - v_{wind} + \omega \times r$, along the body forward, right and down. Three kinds of models
know their velocities:

- linear models with body speeds u, v, w: about hover, $f_x = \dot u + g\theta$,
  $f_y = \dot v - g\phi$, $f_z = \dot w$ (the bias absorbs the steady -g of a level hover);
- other models with body speeds u, v, w and body rates p, q, r among their states;
- models with speeds dx, dy, dz over the ground (dz up) and angles phi, theta, psi, such as the
  whole helicopter. They also need either the derivatives dphi, dtheta, dpsi as states or the body
  rates as outputs.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model, axes_of, zeros
from heli_jax.dynamics.onboard.delays import ORDER, Late, with_delays
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, quotient, require
from heli_jax.naming import Record


def with_sensors(
    model: Model,
    lowpass: Sequence[str] = (),
    delay: Late = (),
    *,
    imu: bool = False,
    angular_acceleration: bool = False,
    airspeed: bool = False,
    order: int = ORDER,
) -> Model:
    r"""Return the model with motion sensors, then low-passes, then delays.

    An accelerometer adds the outputs `ax`, `ay`, `az` [m/s^2] along the body (forward, right,
    down). They are the specific force at (`x_imu`, `y_imu`, `z_imu`) [m] from the centre of
    gravity, which are new parameters. A low-pass is first order, `tau_lowpass_OUTPUT` [s] with the
    state `OUTPUT_lowpass`. Delays are those of `with_delays`.

    Args:
        lowpass: low-passed outputs, which may include `ax` and the like.
        delay: delayed outputs: names, or a mapping to delay parameters.
        angular_acceleration: True for outputs `pdot`, `qdot`, `rdot` [rad/s^2].
        airspeed: True for outputs `airspeed` and `u_air`, `v_air`, `w_air` [m/s], at (`x_air`,
            `y_air`, `z_air`) [m] from the centre of gravity.

    Raises:
        ValueError: no such output, velocities that the model does not know, or a name that is
            taken.
    """
    check_model(model)
    motion = {"imu": imu, "angular_acceleration": angular_acceleration, "airspeed": airspeed}
    if not (any(motion.values()) or lowpass or delay):
        raise ValueError(f"expected {', '.join(motion)}, lowpass or delay, got none")
    # The order is the signal's path to the log, so a low-pass can act on the IMU's outputs. A delay
    # line errs least for slow signals, so it follows the low-pass.
    model = with_motion_sensors(model, **motion) if any(motion.values()) else model
    model = _with_lowpass(model, tuple(lowpass)) if lowpass else model
    return with_delays(model, outputs=delay, order=order) if delay else model


@functools.cache
def _with_lowpass(model: Model, on: tuple[str, ...]) -> Model:
    require(on, model.Outputs, "output", model)
    return _LowPass(model, on).made("lowpass", lambda bare: _with_lowpass(bare, on))


class _LowPass(Device):
    """First-order lags on some outputs."""

    def __init__(self, model: Model, on: tuple[str, ...]) -> None:
        params = {
            f"tau_lowpass_{n}": Quantity(
                "s", f"time constant of the low-pass on {n}", math.nan, True
            )
            for n in on
        }
        states = {
            f"{n}_lowpass": Quantity(naming.unit(model.Outputs, n), f"{n}, low-passed") for n in on
        }
        super().__init__(model, Parts(params, states))
        self.on = on

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of the low-passed outputs."""
        y = self.measured(p, s, u)
        return {
            f"{n}_lowpass": (getattr(y, n) - getattr(s, f"{n}_lowpass"))
            / getattr(p, f"tau_lowpass_{n}")
            for n in self.on
        }

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """Return the outputs, with low-passed ones read from their states."""
        return naming.replace(y, **{n: getattr(s, f"{n}_lowpass") for n in self.on})

    def first(self, p: Record) -> dict[str, Any]:
        # The low-pass has settled at the first output.
        y = self.model.output(p, self.model.initial_state(p), zeros(self.model.Inputs))
        # Zero would add a start-up transient, which is over before a logger's record begins.
        return {f"{n}_lowpass": getattr(y, n) for n in self.on}


_AXES = {"x": "ahead of", "y": "to the right of", "z": "below"}
_ALONG = {"x": "forward", "y": "to the right", "z": "down"}


def with_motion_sensors(
    model: Model, *, imu: bool = False, angular_acceleration: bool = False, airspeed: bool = False
) -> Model:
    """Return the model with outputs of its motion sensors.

    Args:
        imu: True for an accelerometer: outputs ax, ay, az [m/s^2], the specific force at the new
            parameters x_imu, y_imu, z_imu [m].
        angular_acceleration: True for pdot, qdot, rdot [rad/s^2], the derivatives of those body
            rates that the model has.
        airspeed: True for the speed through the air at the new parameters x_air, y_air, z_air [m]:
            u_air, v_air, w_air along the body and their norm airspeed [m/s].

    Raises:
        ValueError: the model does not know a requested quantity, or has the name already.
    """
    requested = {"imu": imu, "angular_acceleration": angular_acceleration, "airspeed": airspeed}
    return _with_sensors(model, tuple(name for name, on in requested.items() if on))


# Cached because a model is static to jit: an equal second model would be compiled again.
@functools.cache
def _with_sensors(model: Model, shown: tuple[str, ...]) -> Model:
    def again(other: Model) -> Model:
        return _with_sensors(other, shown)

    # Sensors use derivatives, so a disturbance must act before them. `with_disturbance` therefore
    # adds it to the inner model.
    return _MotionSensors(model, shown).made("+".join(shown), again, within=(model, again))


class _MotionSensors(Device):
    """Sensors at given positions in the body, without dynamics."""

    def __init__(self, model: Model, shown: tuple[str, ...]) -> None:
        self.requested = shown
        self.motion = motion_of(model) if {"imu", "airspeed"} & set(shown) else None
        rates = {letter: rate_of(model, letter) for letter in "pqr"}
        self.body_rates = {letter: rate for letter, rate in rates.items() if rate is not None}
        params: dict[str, Quantity] = {}
        outputs: dict[str, Quantity] = {}
        if "imu" in shown:
            params |= _place("imu", "IMU")
            outputs |= self._forces()
        if "angular_acceleration" in shown:
            outputs |= self._accelerations(model)
        if "airspeed" in shown:
            params |= _place("air", "airspeed probe")
            outputs |= self._speeds(model)
        super().__init__(model, Parts(params, {}, outputs))

    def _forces(self) -> dict[str, Quantity]:
        assert self.motion is not None
        return {
            n: Quantity("m/s^2", f"specific force {_ALONG[n[1]]} at the IMU")
            for n in self.motion.outputs
        }

    def _accelerations(self, model: Model) -> dict[str, Quantity]:
        if not self.body_rates:
            raise ValueError(
                f"model {model.name} has no body rates, expected states or outputs p, q, r or "
                "axes named roll, pitch, yaw"
            )
        words = {"p": "roll", "q": "pitch", "r": "yaw"}
        quantities = {}
        for letter, (kind, name) in self.body_rates.items():
            record = model.State if kind == "state" else model.Outputs
            unit = quotient(naming.unit(record, name), "s")
            meaning = f"angular acceleration of {words[letter]}"
            quantities[f"{letter}dot"] = Quantity(unit, meaning)
        return quantities

    def _speeds(self, model: Model) -> dict[str, Quantity]:
        assert self.motion is not None
        windy = "wind_x" in naming.names(model.Inputs)
        if self.motion.kind != "ground" and windy and "psi" not in naming.names(model.State):
            raise ValueError(
                f"model {model.name} has wind over the ground and speeds along its body, expected "
                "a state psi for its heading"
            )
        speeds = {
            f"{'uvw'['xyz'.index(axis)]}_air": Quantity("m/s", f"airspeed {_ALONG[axis]}")
            for axis in self.motion.along
        }
        if self.motion.kind == "linear":
            return speeds
        return {"airspeed": Quantity("m/s", "airspeed at the probe"), **speeds}

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return no derivatives, since these sensors have no states."""
        return {}

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """Return the outputs of the model and of its sensors."""
        model, motion = self.model, self.motion
        s = self.inner(s)
        # Evaluate the vector field once for all sensors, since it is the expensive part.
        rates = model.vector_field(p, s, u)
        y = naming.asdict(model.output(p, s, u))
        if "imu" in self.requested and motion is not None:
            y |= specific_force(model, motion, p, s, u, rates)
        if "angular_acceleration" in self.requested:
            y |= {
                f"{letter}dot": angular_acceleration(model, rate, p, s, u, rates)
                for letter, rate in self.body_rates.items()
            }
        if "airspeed" in self.requested and motion is not None:
            y |= airspeed(model, motion, p, s, u, rates)
        return self.Outputs(**y)


def _place(suffix: str, what: str) -> dict[str, Quantity]:
    # The default is the centre of gravity, the one position that needs no measurement.
    return {
        f"{axis}_{suffix}": Quantity("m", f"{what} {where} the centre of gravity", 0.0)
        for axis, where in _AXES.items()
    }


_G = 9.80665

type Vector = tuple[Any, Any, Any]

_ANGLE_RATES = ("dphi", "dtheta", "dpsi")
_BODY_RATES = (("p", "q", "r"), ("roll_rate", "pitch_rate", "yaw_rate"))
"""Names of outputs that are body rates."""


class MotionKind(NamedTuple):
    """Form of a model's velocities."""

    kind: str
    """One of linear, body and ground."""
    outputs: tuple[str, ...]
    """Accelerations among ax, ay, az that the model can show."""

    @property
    def along(self) -> str:
        """Letters of the axes along which the model knows its velocity."""
        return "".join(name[1] for name in self.outputs)


def motion_of(model: Model) -> MotionKind:
    """Return the form of a model's velocities.

    Raises:
        ValueError: the model has no velocities.
    """
    states = naming.names(model.State)
    if model.linear:
        seen = tuple(f"a{axis}" for axis, n in zip("xyz", "uvw", strict=True) if n in states)
        if seen:
            return MotionKind("linear", seen)
    elif {"u", "v", "w", "p", "q", "r", "phi", "theta"} <= set(states):
        return MotionKind("body", ("ax", "ay", "az"))
    elif {"dx", "dy", "dz", "phi", "theta", "psi"} <= set(states) and (
        set(_ANGLE_RATES) <= set(states) or _body_rates(model)
    ):
        return MotionKind("ground", ("ax", "ay", "az"))
    raise ValueError(
        f"model {model.name} has no velocities, expected states u, v, w (with p, q, r, phi, "
        "theta), or dx, dy, dz, phi, theta, psi with states dphi, dtheta, dpsi or outputs p, q, "
        "r"
    )


def _body_rates(model: Model) -> tuple[str, ...]:
    """Return the outputs that are body rates; () if there are none."""
    outputs = naming.names(model.Outputs)
    return next((names for names in _BODY_RATES if set(names) <= set(outputs)), ())


def specific_force(
    model: Model, motion: MotionKind, p: Record, s: Record, u: Record, rates: Record
) -> dict[str, Any]:
    """Return the specific force at the IMU [m/s^2], by output."""
    # An accelerometer shows all forces except weight. The model's derivatives include thrust, drag
    # and gusts without naming them.
    of_kind = {"linear": _linear, "body": _body, "ground": _ground}[motion.kind]
    force = of_kind(model, p, s, u, rates)
    return {n: force["xyz".index(n[1])] for n in motion.outputs}


def airspeed(
    model: Model, motion: MotionKind, p: Record, s: Record, u: Record, rates: Record
) -> dict[str, Any]:
    """Return the speed through the air at the probe [m/s], by output.

    The outputs are u_air, v_air, w_air along the body (forward, right, down), and airspeed, their
    norm.

    Args:
        u: the model's Inputs; the wind is wind_x, wind_y, wind_z if they are among them.
    """
    at = (p.x_air, p.y_air, p.z_air)
    if motion.kind == "linear":
        omega = tuple(getattr(s, n, 0.0) for n in "pqr")
        velocity = tuple(getattr(s, n, 0.0) for n in "uvw")
    elif motion.kind == "body":
        omega, velocity = (s.p, s.q, s.r), (s.u, s.v, s.w)
        wind = _wind(u)
        if wind is not None:
            velocity = _less(velocity, _into_body(s, wind))
    else:
        omega, _ = _turning(model, p, s, u, rates)
        wind = _wind(u)
        over_ground = (s.dx, s.dy, -s.dz)
        velocity = _into_body(s, over_ground if wind is None else _less(over_ground, wind))
    velocity = _sum(velocity, _cross(omega, at))
    shown = {f"{'uvw'['xyz'.index(n)]}_air": velocity["xyz".index(n)] for n in motion.along}
    # About hover the norm has no linear part, so a linear model only shows components.
    return shown if motion.kind == "linear" else {"airspeed": _norm(velocity), **shown}


def rate_of(model: Model, letter: str) -> tuple[str, str] | None:
    """Return ('state', name) or ('output', name) for the body rate p, q or r; None without one."""
    states, outputs = naming.names(model.State), naming.names(model.Outputs)
    if letter in states:
        return "state", letter
    i = "pqr".index(letter)
    for names in _BODY_RATES:
        if names[i] in outputs:
            return "output", names[i]
    rates = {axis.name: axis.rate for axis in axes_of(model)}
    rate = rates.get(("roll", "pitch", "yaw")[i])
    return None if rate is None else ("state", rate)


def angular_acceleration(
    model: Model, rate: tuple[str, str], p: Record, s: Record, u: Record, rates: Record
) -> Any:
    """Return the derivative of a body rate [rad/s^2]."""
    kind, name = rate
    if kind == "state":
        return getattr(rates, name)
    return _along_motion(lambda state: getattr(model.output(p, state, u), name), s, rates)[1]


def _g(p: Record) -> Any:
    # Use the model's own g: with two values a fit would see their difference as a force.
    return getattr(p, "g", _G)


def _at(p: Record) -> Vector:
    return p.x_imu, p.y_imu, p.z_imu


def _linear(model: Model, p: Record, s: Record, u: Record, rates: Record) -> Vector:
    """Return the specific force about hover, to first order; states the model lacks are zero."""

    def of(record: Record, name: str) -> Any:
        return getattr(record, name, 0.0)

    # omega x v and omega x (omega x r) are of second order, and would make the output nonlinear.
    turning = _cross((of(rates, "p"), of(rates, "q"), of(rates, "r")), _at(p))
    return (
        of(rates, "u") + _g(p) * of(s, "theta") + turning[0],
        of(rates, "v") - _g(p) * of(s, "phi") + turning[1],
        of(rates, "w") + turning[2],
    )


def _body(model: Model, p: Record, s: Record, u: Record, rates: Record) -> Vector:
    omega, velocity = (s.p, s.q, s.r), (s.u, s.v, s.w)
    # u, v and w are along rotating axes, so their derivatives lack omega x v. Without it a steady
    # turn would show no acceleration.
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
    # Subtract gravity in ground axes, where it has one component.
    force = _into_body(s, (rates.dx, rates.dy, -rates.dz - _g(p)))
    return _sum(force, _lever(p, *_turning(model, p, s, u, rates)))


def _into_body(s: Record, vector: Vector) -> Vector:
    """Return a vector in body axes, given it forward, right, down over the ground.

    The order is yaw, pitch, roll (Stevens and Lewis, 2003, eq. 1.3-20).
    """
    x, y, z = vector
    (cphi, sphi), (ctheta, stheta), (cpsi, spsi) = (
        (jnp.cos(angle), jnp.sin(angle)) for angle in (s.phi, s.theta, s.psi)
    )
    ahead, right = cpsi * x + spsi * y, cpsi * y - spsi * x
    return (
        ctheta * ahead - stheta * z,
        sphi * (stheta * ahead + ctheta * z) + cphi * right,
        cphi * (stheta * ahead + ctheta * z) - sphi * right,
    )


def _turning(model: Model, p: Record, s: Record, u: Record, rates: Record) -> tuple[Vector, Vector]:
    """Return the body rates and their derivatives, for velocities over the ground."""
    # Derivatives of the angles take precedence if they are states. The paper's helicopter takes
    # them for body rates, which holds only in level flight.
    if set(_ANGLE_RATES) <= set(naming.names(model.State)):
        return _along_motion(_from_angles, s, rates)

    def shown(state: Record) -> Vector:
        outputs = model.output(p, state, u)
        roll, pitch, yaw = (getattr(outputs, n) for n in _body_rates(model))
        return roll, pitch, yaw

    return _along_motion(shown, s, rates)


def _from_angles(s: Record) -> Vector:
    cphi, sphi = jnp.cos(s.phi), jnp.sin(s.phi)
    ctheta, stheta = jnp.cos(s.theta), jnp.sin(s.theta)
    return (
        s.dphi - s.dpsi * stheta,
        s.dtheta * cphi + s.dpsi * ctheta * sphi,
        s.dpsi * ctheta * cphi - s.dtheta * sphi,
    )


def _along_motion(function: Callable[[Record], Any], s: Record, rates: Record) -> tuple[Any, Any]:
    """Return a function of the state and its time derivative."""
    as_arrays = jax.tree.map(jnp.asarray, s)
    tangent = jax.tree.map(lambda v, like: jnp.asarray(v, like.dtype), _as(s, rates), as_arrays)
    return jax.jvp(function, (as_arrays,), (tangent,))


def _as(state: Record, rates: Record) -> Record:
    """Return the rates in the state's class, which a device around the model may have extended."""
    return type(state)(**{n: getattr(rates, n) for n in naming.names(type(state))})


def _wind(u: Record) -> Vector | None:
    """Return the wind velocity forward, right, down over the ground; None in still air."""
    names = naming.names(type(u))
    if not {"wind_x", "wind_y", "wind_z"} <= set(names):
        return None
    # The model's z is up.
    return u.wind_x, u.wind_y, -u.wind_z


def _norm(v: Vector) -> Any:
    # The square root has no derivative at zero; use zero there.
    square = v[0] ** 2 + v[1] ** 2 + v[2] ** 2
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0 * square)


def _lever(p: Record, omega: Vector, alpha: Vector) -> Vector:
    """Return the acceleration at the IMU relative to the centre of gravity."""
    return _sum(_cross(alpha, _at(p)), _cross(omega, _cross(omega, _at(p))))


def _cross(a: Any, b: Any) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _sum(a: Any, b: Any) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _less(a: Any, b: Any) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]
