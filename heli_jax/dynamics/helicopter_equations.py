"""Equations of the whole helicopter: eqs 2-9, 11 and 18 with corrections.

Loads of rotors and motor on the body are in `loads`, the induced velocity is in `aerodynamics`,
flapping in `tip_path_plane`.

Frames: x forward, y right, z up; positive phi is right side down, theta nose up, psi nose right.
Body axes are forward, right and down. `helicopter` combines the equations.
"""

import math
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics import flybar
from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter


class HelicopterState(NamedTuple):
    x: Annotated[Scalar, "m", "position forward of the origin"]
    y: Annotated[Scalar, "m", "position to the right"]
    z: Annotated[Scalar, "m", "height"]
    phi: Annotated[Scalar, "rad", "roll angle, right side down"]
    theta: Annotated[Scalar, "rad", "pitch angle, nose up"]
    psi: Annotated[Scalar, "rad", "yaw angle, nose right"]
    dx: Annotated[Scalar, "m/s", "velocity along x"]
    dy: Annotated[Scalar, "m/s", "velocity along y"]
    dz: Annotated[Scalar, "m/s", "velocity upwards"]
    dphi: Annotated[Scalar, "rad/s", "derivative of phi"]
    dtheta: Annotated[Scalar, "rad/s", "derivative of theta"]
    dpsi: Annotated[Scalar, "rad/s", "derivative of psi"]
    beta_roll: Annotated[Scalar, "rad", "flybar angle, roll"]
    dbeta_roll: Annotated[Scalar, "rad/s", "flybar rate, roll"]
    beta_pitch: Annotated[Scalar, "rad", "flybar angle, pitch"]
    dbeta_pitch: Annotated[Scalar, "rad/s", "flybar rate, pitch"]
    Omega: Annotated[Scalar, "rad/s", "rotor speed"]


class HelicopterInputs(NamedTuple):
    x_roll: Annotated[Scalar, "m", "cyclic input displacement, roll"]
    x_pitch: Annotated[Scalar, "m", "cyclic input displacement, pitch"]
    x_yaw: Annotated[Scalar, "1", "yaw stick"]
    x_throttle: Annotated[Scalar, "1", "throttle stick"]


# Extensions of the paper, which has one stick for throttle and collective. Fields of variants are
# separate, so that each variant's records have only the fields of its equations.
COLLECTIVE = Annotated[Scalar, "1", "collective stick"]
"""Input of variants with separate collective and throttle."""
ROTOR_SPEED = Annotated[Scalar, "rad/s", "rotor speed, measured"]
"""Input if the rotor speed is measured and no motor is modelled."""
TILT = {
    "a1": Annotated[Scalar, "rad", "tip-path plane, back"],
    "b1": Annotated[Scalar, "rad", "tip-path plane, right"],
}
"""States of flapping."""
GOVERNOR = Annotated[Scalar, "1", "governor: integral part of the throttle"]
"""State of the governor."""
INFLOW = Annotated[Scalar, "m/s", "induced velocity of the main rotor"]
"""State of dynamic inflow."""


class HelicopterOutputs(NamedTuple):
    roll: Annotated[Scalar, "rad", "roll angle"]
    pitch: Annotated[Scalar, "rad", "pitch angle"]
    yaw: Annotated[Scalar, "rad", "yaw angle"]
    roll_rate: Annotated[Scalar, "rad/s", "roll rate"]
    pitch_rate: Annotated[Scalar, "rad/s", "pitch rate"]
    yaw_rate: Annotated[Scalar, "rad/s", "yaw rate"]
    x: Annotated[Scalar, "m", "position forward of the origin"]
    y: Annotated[Scalar, "m", "position to the right"]
    z: Annotated[Scalar, "m", "height"]
    dx: Annotated[Scalar, "m/s", "velocity along x"]
    dy: Annotated[Scalar, "m/s", "velocity along y"]
    dz: Annotated[Scalar, "m/s", "velocity upwards"]
    rotor_speed: Annotated[Scalar, "rad/s", "rotor speed"]


# Switches instead of subclasses make each correction testable alone. A NamedTuple of booleans is
# static to jit, so a switch that is off costs nothing.
class Corrections(NamedTuple):
    """Independent corrections of the paper's equations, and extensions."""

    direction: bool = False
    """Eqs 2-3: thrust along the mast at any heading (as printed, valid only near psi = 0)."""
    rigid_body: bool = False
    """Eqs 5-7: body rates, their kinematics and inertial coupling."""
    reaction: bool = False
    """Eq. 7: the motor's torque counts once (as printed, both T_m and -Ir dOmega act)."""
    edgewise: bool = False
    """Eq. 8: speed in the rotor plane as a norm, in the shaft's frame."""
    descent: bool = False
    """Eq. 9: flow through the rotor by exact kinematics (as printed, one sign is wrong)."""
    cyclic: bool = False
    """Eqs 10, 13: cyclic pitch of eq. 11 instead of (x_roll + x_pitch)/L1."""
    first_order_bar: bool = False
    """Eq. 12: the flybar averaged over a turn; its state has no rate."""
    rotor_moment: bool = False
    """Eqs 14-15: factor 1/8 of blade-element theory, and damping by the body's rate."""
    tail: bool = False
    """Eq. 16: inflow of the tail rotor, which adds yaw damping."""
    tied_torque: bool = False
    """Eqs 18-19: K_Tm is Ir K_throttle, so that rotor and fuselage use the same motor torque."""
    drag: bool = False
    """Eqs 2-4: fuselage drag with the equivalent areas Sx, Sy, Sz."""
    dynamic_inflow: bool = False
    """Momentum theory with the inertia of the air (Carpenter and Fridovich, 1953): a state vi."""
    flapping: bool = False
    """Eqs 14-15: the rotor tilts first (states a1, b1), and its stiffness and in-plane forces act
    on the body. The rotor is a seesaw without coning.
    """
    speed_stability: bool = False
    """First harmonic of the lift at speed: the rotor tilts back against the motion."""
    tip_loss: bool = False
    """Eqs 14-15: the lift ends at B R, as in eqs 10 and 13."""
    tail_force: bool = False
    """Eqs 2-3, 5: the tail rotor's thrust is a force at its position, not only a moment."""
    tail_power: bool = False
    """Eqs 7, 10: the tail rotor takes its power from the main rotor's shaft."""
    collective: bool = False
    """Eqs 18-19: x_collective sets the pitch, and x_throttle only the motor."""
    governor: bool = False
    """Eq. 10: a governor sets the throttle to hold the speed commanded by x_throttle."""
    measured_speed: bool = False
    """Instead of eq. 10: the rotor speed is an input Omega, and no motor is modelled."""
    flybarless: bool = False
    """Eqs 11-12: no flybar; the blades take the whole cyclic stick."""


class Attitude(NamedTuple):
    """Sines and cosines of the angles."""

    sphi: Scalar
    cphi: Scalar
    sth: Scalar
    cth: Scalar
    spsi: Scalar
    cpsi: Scalar


class Motion(NamedTuple):
    """Motion of the body and relative airspeed; body axes are forward, right, down."""

    at: Attitude
    dx: Scalar
    """Velocity relative to the air along x, y and z (up) [m/s]."""
    dy: Scalar
    dz: Scalar
    u: Scalar
    """The same velocity in body axes [m/s]."""
    v: Scalar
    w: Scalar
    p: Scalar
    """Roll, pitch and yaw rate [rad/s]."""
    q: Scalar
    r: Scalar


class Moments(NamedTuple):
    """Moments about the centre of gravity [N m]: roll right, nose up, nose right."""

    roll: Scalar
    pitch: Scalar
    yaw: Scalar


# The barrier makes XLA compute a value once. Otherwise it computes it again for each derivative
# that needs it, including the inflow iteration.
once = jax.lax.optimization_barrier


def motion(corrections: Corrections, s: Record, u: Record) -> Motion:
    r"""Return attitude, airspeed and body rates.

    The body rates are $p = \dot\phi - \dot\psi s_\theta$, $q = \dot\theta c_\phi + \dot\psi
    c_\theta s_\phi$, $r = \dot\psi c_\theta c_\phi - \dot\theta s_\phi$; without `rigid_body` they
    are the angles' derivatives, as in the paper.

    Args:
        u: inputs, with wind_x, wind_y and wind_z [m/s] if there is wind.
    """
    at = once(Attitude(*sincos(s.phi), *sincos(s.theta), *sincos(s.psi)))
    dx, dy, dz = s.dx, s.dy, s.dz
    # Aerodynamics depends on the motion through the air; only the position is relative to the
    # ground.
    if hasattr(u, "wind_x"):
        dx, dy, dz = dx - u.wind_x, dy - u.wind_y, dz - u.wind_z
    # Rotations by psi, theta and phi, in this order.
    forward_speed, lateral_speed = dx * at.cpsi + dy * at.spsi, dy * at.cpsi - dx * at.spsi
    below = forward_speed * at.sth - dz * at.cth
    forward = forward_speed * at.cth + dz * at.sth
    right, down = (
        lateral_speed * at.cphi + below * at.sphi,
        below * at.cphi - lateral_speed * at.sphi,
    )
    # Eqs 5-7 integrate M/I into the angles, so the paper's rates are the angles' derivatives. This
    # holds only in level flight: in a steady turn with dpsi at bank phi, the body has a pitch rate.
    p, q, r = _turned(s, at) if corrections.rigid_body else (s.dphi, s.dtheta, s.dpsi)
    return once(Motion(at, dx, dy, dz, forward, right, down, p, q, r))


def body_rates(s: Record) -> dict[str, Scalar]:
    """Return p, q and r [rad/s] by name, as gyros on the body measure them."""
    at = Attitude(*sincos(s.phi), *sincos(s.theta), *sincos(s.psi))
    return dict(zip("pqr", _turned(s, at), strict=True))


def _turned(s: Record, at: Attitude) -> tuple[Scalar, ...]:
    """Return p, q and r [rad/s] from the derivatives of the Euler angles."""
    p = s.dphi - s.dpsi * at.sth
    q = s.dtheta * at.cphi + s.dpsi * at.cth * at.sphi
    r = s.dpsi * at.cth * at.cphi - s.dtheta * at.sphi
    return p, q, r


def _to_earth(at: Attitude, forward: Scalar, right: Scalar, down: Scalar) -> tuple[Scalar, ...]:
    """Return a vector in body axes along x, y and z (up)."""
    # The rotations of `motion`, reversed.
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


def cyclic(p: Helicopter, s: Record, u: Record) -> Cyclic:
    """Return the cyclic pitch of eq. 11 for both axes."""
    if not hasattr(s, "beta_roll"):
        # Without a flybar only Bell's path remains: eq. 11 with L2 = 0.
        return Cyclic((1.0 / p.L1) * u.x_roll, (1.0 / p.L1) * u.x_pitch)
    return Cyclic(
        flybar.cyclic_pitch(p, u.x_roll, s.beta_roll),
        flybar.cyclic_pitch(p, u.x_pitch, s.beta_pitch),
    )


def collective(p: Helicopter, u: Record) -> Scalar:
    """Return theta0 [rad], eq. 18, from the collective stick if there is one, else from the
    throttle.
    """
    return p.K_theta0 * (u.x_collective if hasattr(u, "x_collective") else u.x_throttle)


def hub_speed(p: Helicopter, m: Motion) -> tuple[Scalar, Scalar]:
    """Return the hub's speed through the air, forward and to the right [m/s]."""
    # Forward and right components of omega x r at r = (-lr, 0, -hr).
    return m.u - p.hr * m.q, m.v + p.hr * m.p - p.lr * m.r


def flow(corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion) -> aero.Flow:
    r"""Return the air flow at the main rotor, eqs 8-9.

    $$\mu R\Omega = (\dot x - h_r\dot\theta)\cos\theta + (\dot y + h_r\dot\phi)\cos\phi
      + (\dot z - \ell_r\dot\theta)\sin\theta$$
    $$\nu R\Omega = (\dot x - h_r\dot\theta)\sin\theta + (\dot y - h_r\dot\phi)\sin\phi
      - (\dot z - \ell_r\dot\theta)\cos\theta$$

    With `edgewise` and `descent` both are those of the hub, $h_r$ above and $\ell_r$ behind the
    centre of gravity. The effect of cyclic pitch then depends on the flight direction. Pitch cyclic
    has its largest blade angle on the right, where the blade advances in forward flight. Roll
    cyclic has its largest blade angle at the nose, where the blade advances in flight to the left.
    """
    # The hub is h_r above the centre of gravity. A rising nose moves it backwards, and a sinking
    # right side moves it to the right.
    forward_speed, lateral_speed, up = (
        m.dx - p.hr * s.dtheta,
        m.dy + p.hr * s.dphi,
        m.dz - p.lr * s.dtheta,
    )
    if corrections.descent:
        # v + omega x r at r = (-lr, 0, -hr), along the mast. With dpsi = 0 this is eq. 9 with -(dy
        # + hr dphi) sin phi. The printed sign of hr dphi contradicts eq. 3: its rms error against
        # exact kinematics is 0.19 m/s, compared with 0.04 for the other sign.
        W = -(m.w + p.lr * m.q)
    else:
        W = up * m.at.cth - forward_speed * m.at.sth - (m.dy - p.hr * s.dphi) * m.at.sphi
    # Eqs 10 and 13 print (x_roll + x_pitch)/L1, without the ratio L3/(L2 + L3) and the flybar of
    # eq. 11.
    tilt = Cyclic((1.0 / p.L1) * u.x_roll, (1.0 / p.L1) * u.x_pitch)
    if corrections.cyclic:
        tilt = cyclic(p, s, u)
    if corrections.edgewise:
        forward_speed, lateral_speed = hub_speed(p, m)
        if corrections.flapping:
            # Relative to the tilted plane, less air flows through it and the blade pitch is smaller
            # by the same angle. The thrust is therefore unchanged, and the power is that of the
            # tilted thrust.
            W = W - forward_speed * s.a1 + lateral_speed * s.b1
            tilt = Cyclic(tilt.roll - s.b1, tilt.pitch - s.a1)
        return aero.Flow(
            forward_speed**2 + lateral_speed**2,
            W,
            forward_speed * tilt.pitch - lateral_speed * tilt.roll,
        )
    # Eq. 8 adds speeds along x and y as if they had one direction: equal speeds forward and to the
    # left give mu = 0. It is not rotated by psi, so it holds only near psi = 0.
    speed = forward_speed * m.at.cth + lateral_speed * m.at.cphi + up * m.at.sth
    return aero.Flow(speed**2, W, speed * (tilt.roll + tilt.pitch))


def main_rotor(p: Helicopter, s: Record, u: Record, air: aero.Flow) -> aero.RotorForce:
    """Return thrust and inflow of the main rotor, eqs 13 and 18; with dynamic inflow
    vi is a state.
    """
    return once(aero.thrust(p, s.Omega, collective(p, u), air, getattr(s, "vi", None)))


def accelerations(
    corrections: Corrections,
    p: Helicopter,
    m: Motion,
    T: Scalar,
    aside: tuple[Scalar, Scalar] | None = None,
) -> tuple[Scalar, Scalar, Scalar]:
    r"""Return the accelerations along x, y and z [m/s^2], eqs 2-4.

    $$\ddot x = -\tfrac1m\cos\psi\,T\sin\theta, \quad
      \ddot y = \tfrac1m\cos\psi\,T\sin\phi, \quad \ddot z = \tfrac1m\cos\phi\,T\cos\theta - g$$

    With `direction` $\ddot x = -\tfrac{T}{m}(c_\phi s_\theta c_\psi + s_\phi s_\psi)$ and $\ddot y
    = -\tfrac{T}{m}(c_\phi s_\theta s_\psi - s_\phi c_\psi)$. `drag` subtracts $\tfrac12\rho V (S_x
    u, S_y v, S_z w)/m$ in body axes.

    Args:
        T: thrust of the main rotor [N].
        aside: forces of the rotors forward and to the right, in addition to T [N].
    """
    at, pull = m.at, (1.0 / p.m) * T
    if corrections.direction:
        ddx = -pull * (at.cphi * at.sth * at.cpsi + at.sphi * at.spsi)
        ddy = -pull * (at.cphi * at.sth * at.spsi - at.sphi * at.cpsi)
    else:
        # As printed, with cos(psi) in both: at psi = 90 degrees there is no horizontal
        # acceleration.
        ddx, ddy = -pull * at.sth * at.cpsi, pull * at.sphi * at.cpsi
    ddz = pull * at.cphi * at.cth - p.g
    if not corrections.drag and aside is None:
        return ddx, ddy, ddz
    slowed = _drag(p, m) if corrections.drag else (0.0 * pull, 0.0 * pull, 0.0 * pull)
    if aside is not None:
        slowed = (slowed[0] - (1.0 / p.m) * aside[0], slowed[1] - (1.0 / p.m) * aside[1], slowed[2])
    slowed = _to_earth(at, *slowed)
    return ddx - slowed[0], ddy - slowed[1], ddz - slowed[2]


def _drag(p: Helicopter, m: Motion) -> tuple[Scalar, ...]:
    """Return the deceleration by drag forward, right and down [m/s^2]."""
    square = m.u**2 + m.v**2 + m.w**2
    # The square root has no derivative at zero speed; this form has one, and gives zero drag there.
    speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0 * square)
    # Each axis uses its area times the total speed, not its own squared component. With equal areas
    # the drag then opposes the motion in any direction.
    factor = once((0.5 * p.rho / p.m) * speed)
    return factor * p.Sx * m.u, factor * p.Sy * m.v, factor * p.Sz * m.w


def angular_accelerations(
    corrections: Corrections, p: Helicopter, s: Record, m: Motion, M: Moments
) -> tuple[Scalar, Scalar, Scalar]:
    r"""Return the second derivatives of phi, theta and psi [rad/s^2].

    Eqs 5-7, $\ddot\phi = M_\phi/I_{xx}$ and so on, or with `rigid_body` Euler's equations for the
    body rates, $I\dot\omega = M - \omega\times I\omega$, and the derivative of $\dot\phi = p +
    \dot\psi s_\theta$, $\dot\theta = q c_\phi - r s_\phi$, $\dot\psi = (q s_\phi + r
    c_\phi)/c_\theta$.
    """
    # Body axes are assumed to be principal axes: neither the paper nor vehicle files have Ixz.
    # Added masses are fixed to the body and add only to the inertias.
    Ixx, Iyy, Izz = p.Ixx + p.Ixx_added, p.Iyy + p.Iyy_added, p.Izz
    if not corrections.rigid_body:
        return (1.0 / Ixx) * M.roll, (1.0 / Iyy) * M.pitch, (1.0 / Izz) * M.yaw
    at = m.at
    dp = (1.0 / Ixx) * (M.roll - (Izz - Iyy) * m.q * m.r)
    dq = (1.0 / Iyy) * (M.pitch - (Ixx - Izz) * m.r * m.p)
    dr = (1.0 / Izz) * (M.yaw - (Iyy - Ixx) * m.p * m.q)
    # The states are the angles' derivatives in every variant, so body accelerations are converted
    # to second derivatives. Body rates are replaced by products of the angles' derivatives, since q
    # sin phi + r cos phi is dpsi cos theta, and so on.
    ddtheta = dq * at.cphi - dr * at.sphi - s.dphi * s.dpsi * at.cth
    turn = dq * at.sphi + dr * at.cphi + s.dphi * s.dtheta + s.dpsi * s.dtheta * at.sth
    # Euler angles are singular for a vertical nose, which `_limits` reports beforehand.
    ddpsi = once(turn / at.cth)
    ddphi = dp + ddpsi * at.sth + s.dpsi * s.dtheta * at.cth
    return ddphi, ddtheta, ddpsi


_RIGHT_ANGLE = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624871116645580e-21)
"""pi/2 in three parts; the first two have few enough digits for exact multiples (fdlibm)."""
_TERMS = 10
"""Terms of Taylor's series of the sine after x, exact to the last digit up to a right angle."""


@jax.custom_jvp
def sincos(x: Scalar) -> tuple[Scalar, Scalar]:
    """Return sine and cosine of x [rad], to the last digit up to 1e6 rad.

    Each is the signed sine of the remainder of x after the nearest half turn; for the cosine,
    shifted by a right angle. In double precision this is much faster than jnp.sin and jnp.cos;
    other precisions use those.
    """
    x = jnp.asarray(x)
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    # The cosine is a sine shifted by a right angle, so one series serves both, for |r| <= pi/2. k
    # and m + 1/2 are the nearest numbers of half turns.
    k = jnp.round(x * (1.0 / math.pi))
    m = jnp.round(x * (1.0 / math.pi) - 0.5)
    return _sign(k) * _sine_past(x, 2.0 * k), -_sign(m) * _sine_past(x, 2.0 * m + 1.0)


def _sign(k: Scalar) -> Scalar:
    """Return 1 for even k and -1 for odd."""
    # Floating point, since conversion is slow and k may exceed an int32.
    half = 0.5 * k
    return 1.0 - 4.0 * (half - jnp.floor(half))


def _sine_past(x: Scalar, right_angles: Scalar) -> Scalar:
    """Return the sine of x minus a number of right angles; the difference is at most one right
    angle.
    """
    # Subtract in parts (Cody and Waite). One product with pi/2 would cancel digits.
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
    # The derivative is known; that of the rounding would be zero almost everywhere.
    s, c = sincos(*primals)
    return (s, c), (c * tangents[0], -s * tangents[0])
