r"""The whole helicopter: eqs 2-20 as printed, and with each correction that makes them physics.

Frames: x forward, y right, z up; phi is positive right side down, theta nose up, psi nose right:
the ordinary yaw-pitch-roll angles of a body with axes forward, right and down. The states dphi,
dtheta and dpsi are the angles' derivatives, in every variant. The rotor turns in -psi: counter-
clockwise seen from above.

`helicopter("paper")` is the paper to the letter; `helicopter("consistent")` has all corrections,
and `helicopter("paper", tail=True)` one of them. `Corrections` says what each is. Drag is a
disturbance in the paper, so the paper variant has none.
"""

import functools
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics import flybar
from heli_jax.dynamics.helicopter_records import (
    Attitude,
    Corrections,
    HelicopterInputs,
    HelicopterOutputs,
    HelicopterState,
    Motion,
)
from heli_jax.dynamics.inflow import vortex_ring
from heli_jax.dynamics.model import PITCH, ROLL, YAW, Axis, Model, SteadyFlight
from heli_jax.naming import Scalar
from heli_jax.numerics.sincos import sincos
from heli_jax.vehicle import Helicopter

_ALL = Corrections(*[True] * len(Corrections._fields))._replace(dynamic_inflow=False)
_VARIANTS = {"paper": Corrections(), "consistent": _ALL}


# Behind a barrier a number is computed once: without it XLA computes it again for each of the
# derivatives that need it, the inflow's iteration included.
_once = jax.lax.optimization_barrier


@functools.cache
def helicopter(
    variant: Literal["paper", "consistent"] = "consistent", *, wind: bool = False, **switches: bool
) -> Model:
    """The nonlinear helicopter with flybar, rotor speed and tail rotor, eqs 2-20.

    `switches` are those of `Corrections`. `wind` adds the inputs wind_x, wind_y, wind_z [m/s],
    the velocity of the air over the ground.

    Raises:
        ValueError: no such variant or switch.
    """
    if variant not in _VARIANTS:
        raise ValueError(f"variant: expected one of {', '.join(_VARIANTS)}, got {variant!r}")
    unknown = [n for n in switches if n not in Corrections._fields]
    if unknown:
        raise ValueError(
            f"corrections: expected some of {', '.join(Corrections._fields)}, got {unknown[0]!r}"
        )
    how = _VARIANTS[variant]._replace(**switches)
    State = _state_class(how)
    Inputs = HelicopterInputs
    if wind:
        air = {
            f"wind_{axis}": (Annotated[Scalar, "m/s", f"wind along {axis}"], None) for axis in "xyz"
        }
        Inputs = naming.extended(HelicopterInputs, "HelicopterWindInputs", air)
    changed = [
        f"{'+' if on else '-'}{n}"
        for n, on in how._asdict().items()
        if on != getattr(_VARIANTS[variant], n)
    ]
    return Model(
        f"helicopter-{variant}" + "".join(changed) + ("+wind" if wind else ""),
        functools.partial(_field, how, State),
        functools.partial(_output, how),
        Helicopter,
        State,
        Inputs,
        HelicopterOutputs,
        start=functools.partial(_start, State),
        limits=functools.partial(_limits, how),
        axes=_axes(how),
        steady_flight=_steady_flight(how),
    )


def _axes(how: Corrections) -> tuple[Axis, ...]:
    """A flybar averaged over a turn has no rate among the states."""
    if not how.first_order_bar:
        return (ROLL, PITCH, YAW)
    return (ROLL._replace(flybar=("beta_roll",)), PITCH._replace(flybar=("beta_pitch",)), YAW)


def _steady_flight(how: Corrections) -> SteadyFlight:
    """Attitude, rotor speed, inflow, flybar and sticks, of which none is chosen in a steady flight;
    position, heading and velocity are given, and the angles do not turn."""
    inflow = ("vi",) if how.dynamic_inflow else ()
    bar = ("beta_roll", "beta_pitch")
    turning = bar if how.first_order_bar else ("dbeta_roll", "dbeta_pitch")
    return SteadyFlight(
        ("phi", "theta", "Omega", *inflow, *bar, *HelicopterInputs._fields),
        ("dx", "dy", "dz", "dphi", "dtheta", "dpsi", *turning, "Omega", *inflow),
    )


def _state_class(how: Corrections) -> type:
    hints = naming.fields(HelicopterState)
    if how.first_order_bar:
        hints = {n: h for n, h in hints.items() if not n.startswith("dbeta")}
    if how.dynamic_inflow:
        hints["vi"] = Annotated[Scalar, "m/s", "induced velocity of the main rotor"]
    if tuple(hints) == HelicopterState._fields:
        return HelicopterState
    return NamedTuple("HelicopterState", list(hints.items()))  # type: ignore[misc]


def _start(State: type, p: Helicopter) -> Any:
    """At rest at the origin, the rotor at the speed of the vehicle file."""
    zero = 0.0 * p.Omega
    return State(**{**dict.fromkeys(naming.names(State), zero), "Omega": p.Omega})


def motion(how: Corrections, s: Any, u: Any) -> Motion:
    r"""Attitude, airspeed and rates of the body.

    The body's rates are $p = \dot\phi - \dot\psi s_\theta$,
    $q = \dot\theta c_\phi + \dot\psi c_\theta s_\phi$,
    $r = \dot\psi c_\theta c_\phi - \dot\theta s_\phi$; without `rigid_body` they are the
    angles' derivatives, as the paper has it.
    """
    at = _once(Attitude(*sincos(s.phi), *sincos(s.theta), *sincos(s.psi)))
    dx, dy, dz = s.dx, s.dy, s.dz
    if hasattr(u, "wind_x"):
        dx, dy, dz = dx - u.wind_x, dy - u.wind_y, dz - u.wind_z
    # Turned by psi, theta and phi, one after another.
    forward_speed, lateral_speed = dx * at.cpsi + dy * at.spsi, dy * at.cpsi - dx * at.spsi
    below = forward_speed * at.sth - dz * at.cth
    forward = forward_speed * at.cth + dz * at.sth
    right, down = (
        lateral_speed * at.cphi + below * at.sphi,
        below * at.cphi - lateral_speed * at.sphi,
    )
    p, q, r = s.dphi, s.dtheta, s.dpsi
    if how.rigid_body:
        p = s.dphi - s.dpsi * at.sth
        q = s.dtheta * at.cphi + s.dpsi * at.cth * at.sphi
        r = s.dpsi * at.cth * at.cphi - s.dtheta * at.sphi
    return _once(Motion(at, dx, dy, dz, forward, right, down, p, q, r))


def _to_earth(at: Attitude, forward: Scalar, right: Scalar, down: Scalar) -> tuple[Scalar, ...]:
    """A vector in body axes along x, y and z (up)."""
    lateral_speed, below = right * at.cphi - down * at.sphi, right * at.sphi + down * at.cphi
    forward_speed, up = forward * at.cth + below * at.sth, forward * at.sth - below * at.cth
    return (
        forward_speed * at.cpsi - lateral_speed * at.spsi,
        forward_speed * at.spsi + lateral_speed * at.cpsi,
        up,
    )


class Cyclic(NamedTuple):
    """Cyclic pitch of the blades, eq. 11 [rad]."""

    roll: Scalar
    pitch: Scalar


def cyclic(p: Helicopter, s: Any, u: Any) -> Cyclic:
    """Eq. 11 for both axes."""
    return Cyclic(
        flybar.cyclic_pitch(p, u.x_roll, s.beta_roll),
        flybar.cyclic_pitch(p, u.x_pitch, s.beta_pitch),
    )


def flow(how: Corrections, p: Helicopter, s: Any, u: Any, m: Motion) -> aero.Flow:
    r"""The air that the main rotor meets, eqs 8-9.

    $$\mu R\Omega = (\dot x - h_r\dot\theta)\cos\theta + (\dot y + h_r\dot\phi)\cos\phi
      + (\dot z - \ell_r\dot\theta)\sin\theta$$
    $$\nu R\Omega = (\dot x - h_r\dot\theta)\sin\theta + (\dot y - h_r\dot\phi)\sin\phi
      - (\dot z - \ell_r\dot\theta)\cos\theta$$

    With `edgewise` and `descent` both are those of the hub, which stands $h_r$ above and $\ell_r$
    behind the centre of gravity. The cyclic pitch then meets the air by direction: that of pitch
    has its largest blade angle on the right, where the blade advances in forward flight, that of
    roll at the nose, where it advances in flight to the left.
    """
    forward_speed, lateral_speed, up = (
        m.dx - p.hr * s.dtheta,
        m.dy + p.hr * s.dphi,
        m.dz - p.lr * s.dtheta,
    )
    if how.descent:
        W = -(m.w + p.lr * m.q)
    else:
        W = up * m.at.cth - forward_speed * m.at.sth - (m.dy - p.hr * s.dphi) * m.at.sphi
    tilt = Cyclic((1.0 / p.L1) * u.x_roll, (1.0 / p.L1) * u.x_pitch)
    if how.cyclic:
        tilt = cyclic(p, s, u)
    if how.edgewise:
        forward_speed, lateral_speed = m.u - p.hr * m.q, m.v + p.hr * m.p - p.lr * m.r
        return aero.Flow(
            forward_speed**2 + lateral_speed**2,
            W,
            forward_speed * tilt.pitch - lateral_speed * tilt.roll,
        )
    speed = forward_speed * m.at.cth + lateral_speed * m.at.cphi + up * m.at.sth
    return aero.Flow(speed**2, W, speed * (tilt.roll + tilt.pitch))


def main_rotor(p: Helicopter, s: Any, u: Any, air: aero.Flow) -> aero.RotorForce:
    """Thrust and inflow of the main rotor, eqs 13 and 18; with dynamic inflow vi is a state."""
    vi = getattr(s, "vi", None)
    return _once(aero.thrust(p, s.Omega, p.K_theta0 * u.x_throttle, air, vi))


def tail_rotor(p: Helicopter, s: Any, u: Any, m: Motion) -> aero.RotorForce:
    """Thrust and inflow of the tail rotor; a positive thrust turns the nose to the right."""
    V2 = m.u**2 + (m.w + p.L_T * m.q) ** 2
    W = p.L_T * m.r - m.v
    return _once(aero.tail_thrust(p, s.Omega, p.K_theta0T * u.x_yaw, V2, W))


def motor_torque(how: Corrections, p: Helicopter, u: Any) -> Scalar:
    """T_m [N m], eq. 19, or as eq. 10 has the motor."""
    gain = p.Ir * p.K_throttle if how.tied_torque else p.K_Tm
    return gain * u.x_throttle


def rotor_acceleration(
    p: Helicopter, s: Any, u: Any, air: aero.Flow, force: aero.RotorForce
) -> Scalar:
    """dOmega/dt [rad/s^2], eq. 10."""
    Q = aero.torque(p, s.Omega, p.K_theta0 * u.x_throttle, air, force.inflow)
    return p.K_throttle * u.x_throttle - (1.0 / p.Ir) * Q


class Moments(NamedTuple):
    """About the centre of gravity [N m]: roll right, nose up, nose right."""

    roll: Scalar
    pitch: Scalar
    yaw: Scalar


def moments(
    how: Corrections, p: Helicopter, s: Any, u: Any, m: Motion, T: Scalar, dOmega: Scalar
) -> Moments:
    """The moments of eqs 5-7 and 14-17."""
    tilt = cyclic(p, s, u)
    if how.rotor_moment:
        roll = aero.hub_moment(p, s.Omega, tilt.roll, m.p)
        pitch = aero.hub_moment(p, s.Omega, tilt.pitch, m.q)
    else:
        roll = aero.cyclic_moment(p, s.Omega, tilt.roll)
        pitch = aero.cyclic_moment(p, s.Omega, tilt.pitch)
    if how.tail:
        yaw = p.L_T * tail_rotor(p, s, u, m).T
    else:
        yaw = aero.tail_moment(p, s.Omega, p.K_theta0T * u.x_yaw)
    yaw = yaw + motor_torque(how, p, u)
    if not how.reaction:
        yaw = yaw - p.Ir * dOmega
    return _once(Moments(roll, pitch - T * p.lr, yaw))


def accelerations(
    how: Corrections, p: Helicopter, m: Motion, T: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    r"""Accelerations along x, y and z [m/s^2], eqs 2-4.

    $$\ddot x = -\tfrac1m\cos\psi\,T\sin\theta, \quad
      \ddot y = \tfrac1m\cos\psi\,T\sin\phi, \quad
      \ddot z = \tfrac1m\cos\phi\,T\cos\theta - g$$

    With `direction` $\ddot x = -\tfrac{T}{m}(c_\phi s_\theta c_\psi + s_\phi s_\psi)$ and
    $\ddot y = -\tfrac{T}{m}(c_\phi s_\theta s_\psi - s_\phi c_\psi)$. With `drag` less
    $\tfrac12\rho V (S_x u, S_y v, S_z w)/m$ in body axes.
    """
    at, pull = m.at, (1.0 / p.m) * T
    if how.direction:
        ddx = -pull * (at.cphi * at.sth * at.cpsi + at.sphi * at.spsi)
        ddy = -pull * (at.cphi * at.sth * at.spsi - at.sphi * at.cpsi)
    else:
        ddx, ddy = -pull * at.sth * at.cpsi, pull * at.sphi * at.cpsi
    ddz = pull * at.cphi * at.cth - p.g
    if not how.drag:
        return ddx, ddy, ddz
    square = m.u**2 + m.v**2 + m.w**2
    # The root of a speed of zero has no derivative; this one has, and gives zero drag there.
    speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0 * square)
    factor = _once((0.5 * p.rho / p.m) * speed)
    slowed = _to_earth(at, factor * p.Sx * m.u, factor * p.Sy * m.v, factor * p.Sz * m.w)
    return ddx - slowed[0], ddy - slowed[1], ddz - slowed[2]


def angular_accelerations(
    how: Corrections, p: Helicopter, s: Any, m: Motion, M: Moments
) -> tuple[Scalar, Scalar, Scalar]:
    r"""Second derivatives of phi, theta and psi [rad/s^2].

    Eqs 5-7, $\ddot\phi = M_\phi/I_{xx}$ and so on, or with `rigid_body` Euler's equations for
    the body rates, $I\dot\omega = M - \omega\times I\omega$, and the derivative of
    $\dot\phi = p + \dot\psi s_\theta$, $\dot\theta = q c_\phi - r s_\phi$,
    $\dot\psi = (q s_\phi + r c_\phi)/c_\theta$.
    """
    Ixx, Iyy, Izz = p.Ixx + p.Ixx_added, p.Iyy + p.Iyy_added, p.Izz
    if not how.rigid_body:
        return (1.0 / Ixx) * M.roll, (1.0 / Iyy) * M.pitch, (1.0 / Izz) * M.yaw
    at = m.at
    dp = (1.0 / Ixx) * (M.roll - (Izz - Iyy) * m.q * m.r)
    dq = (1.0 / Iyy) * (M.pitch - (Ixx - Izz) * m.r * m.p)
    dr = (1.0 / Izz) * (M.yaw - (Iyy - Ixx) * m.p * m.q)
    ddtheta = dq * at.cphi - dr * at.sphi - s.dphi * s.dpsi * at.cth
    turn = dq * at.sphi + dr * at.cphi + s.dphi * s.dtheta + s.dpsi * s.dtheta * at.sth
    ddpsi = _once(turn / at.cth)
    ddphi = dp + ddpsi * at.sth + s.dpsi * s.dtheta * at.cth
    return ddphi, ddtheta, ddpsi


# A solver asks for the rates some twenty times: under jit they are traced once.
@functools.partial(jax.jit, static_argnums=(0, 1))
def _field(how: Corrections, State: type, p: Helicopter, s: Any, u: Any) -> Any:
    m = motion(how, s, u)
    air = _once(flow(how, p, s, u, m))
    force = main_rotor(p, s, u, air)
    dOmega = rotor_acceleration(p, s, u, air, force)
    ddx, ddy, ddz = accelerations(how, p, m, force.T)
    M = moments(how, p, s, u, m, force.T, dOmega)
    ddphi, ddtheta, ddpsi = angular_accelerations(how, p, s, m, M)
    found = {
        "x": s.dx, "y": s.dy, "z": s.dz,
        "phi": s.dphi, "theta": s.dtheta, "psi": s.dpsi,
        "dx": ddx, "dy": ddy, "dz": ddz,
        "dphi": ddphi, "dtheta": ddtheta, "dpsi": ddpsi,
        "Omega": dOmega,
        **_bar(how, p, s, u, m),
    }  # fmt: skip
    if how.dynamic_inflow:
        found["vi"] = aero.inflow_rate(p, force, air.V2)
    return State(**found)


def _bar(how: Corrections, p: Helicopter, s: Any, u: Any, m: Motion) -> dict[str, Scalar]:
    if how.first_order_bar:
        return {
            "beta_roll": flybar.flybar_rate(p, s.Omega, u.x_roll, s.beta_roll, m.p),
            "beta_pitch": flybar.flybar_rate(p, s.Omega, u.x_pitch, s.beta_pitch, m.q),
        }
    roll = (u.x_roll, s.beta_roll, s.dbeta_roll, m.p)
    pitch = (u.x_pitch, s.beta_pitch, s.dbeta_pitch, m.q)
    return {
        "beta_roll": s.dbeta_roll,
        "dbeta_roll": flybar.flapping_acceleration(p, s.Omega, *roll),
        "beta_pitch": s.dbeta_pitch,
        "dbeta_pitch": flybar.flapping_acceleration(p, s.Omega, *pitch),
    }


def _output(how: Corrections, p: Helicopter, s: Any, u: Any) -> HelicopterOutputs:
    """Angles, body rates (as gyros measure them), position and velocity, rotor speed."""
    m = motion(how, s, u)
    rates, place = (m.p, m.q, m.r), (s.x, s.y, s.z, s.dx, s.dy, s.dz)
    return HelicopterOutputs(s.phi, s.theta, s.psi, *rates, *place, s.Omega)


_SLOWEST = 0.2
_FASTEST = 0.5
_UPRIGHT = 0.1


def _limits(how: Corrections, p: Helicopter, s: Any, u: Any) -> dict[str, Any]:
    """Where the model's range ends, by name; True where it has been left."""
    air = flow(how, p, s, u, motion(how, s, u))
    force = main_rotor(p, s, u, air)
    found = {
        "vortex ring": vortex_ring(air.V2, air.W, force.T0, force.vi),
        "slow rotor": s.Omega < _SLOWEST * p.Omega,
        "fast flight": (_FASTEST * p.R * s.Omega) ** 2 < air.V2,
    }
    if how.rigid_body:
        found["nose up or down"] = jnp.abs(jnp.cos(s.theta)) < _UPRIGHT
    return found
