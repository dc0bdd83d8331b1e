"""The equations of the whole helicopter, one after another: eqs 2-9, 11 and 18 with corrections.

What the rotors and the motor do to the body is in `loads`, the induced velocity in `aerodynamics`,
flapping in `tip_path_plane`.

Frames: x forward, y right, z up; phi is positive right side down, theta nose up, psi nose right.
Body axes are forward, right and down. `helicopter` puts the equations together.
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


# Beyond the paper, which has one stick for throttle and collective: fields that a variant adds are
# kept apart, so that its records have those of its equations and no others.
COLLECTIVE = Annotated[Scalar, "1", "collective stick"]
"""an input of its own where collective and throttle are apart"""
ROTOR_SPEED = Annotated[Scalar, "rad/s", "rotor speed, measured"]
"""an input where the rotor's speed is measured and no motor is modelled"""
TILT = {
    "a1": Annotated[Scalar, "rad", "tip-path plane, back"],
    "b1": Annotated[Scalar, "rad", "tip-path plane, right"],
}
"""the states of flapping"""
GOVERNOR = Annotated[Scalar, "1", "governor: integral part of the throttle"]
"""the state of the governor"""
INFLOW = Annotated[Scalar, "m/s", "induced velocity of the main rotor"]
"""the state of dynamic inflow"""


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


# Switches and not subclasses: each departure from the paper can be tried by itself, and its effect
# told from that of the others. A NamedTuple of booleans is static to jit, so a switch that is off
# costs nothing.
class Corrections(NamedTuple):
    """Corrections of the paper's equations and additions to them, each independent of the
    others."""

    direction: bool = False
    """eqs 2-3: thrust along the mast at any heading (printed, they hold near psi = 0)"""
    rigid_body: bool = False
    """eqs 5-7: body rates, their kinematics and the inertia coupling"""
    reaction: bool = False
    """eq. 7: the motor's torque counts once (printed, T_m and -Ir dOmega both act)"""
    edgewise: bool = False
    """eq. 8: speed in the plane of the rotor as a norm, in the shaft's frame"""
    descent: bool = False
    """eq. 9: flow through the rotor by exact kinematics (printed, one sign is wrong)"""
    cyclic: bool = False
    """eqs 10, 13: the cyclic pitch of eq. 11 in place of (x_roll + x_pitch)/L1"""
    first_order_bar: bool = False
    """eq. 12: the flybar averaged over a turn; its state has no rate"""
    rotor_moment: bool = False
    """eqs 14-15: blade-element theory's 1/8, and damping by the body's rate"""
    tail: bool = False
    """eq. 16: inflow of the tail rotor, and with it yaw damping"""
    tied_torque: bool = False
    """eqs 18-19: K_Tm is Ir K_throttle, so that rotor and fuselage agree about the motor"""
    drag: bool = False
    """eqs 2-4: drag of the fuselage by its equivalent areas Sx, Sy, Sz"""
    dynamic_inflow: bool = False
    """momentum theory with the inertia of the air (Carpenter and Fridovich, 1953): a state vi"""
    flapping: bool = False
    """eqs 14-15: the rotor tilts first (states a1, b1); its stiffness and in-plane forces act; a
    seesaw, whose blades do not cone"""
    speed_stability: bool = False
    """the first harmonic of the lift in a speed: the rotor tilts back from where it flies to"""
    tip_loss: bool = False
    """eqs 14-15: the lift ends at B R, as in eqs 10 and 13"""
    tail_force: bool = False
    """eqs 2-3, 5: the tail rotor's thrust is a force at its place, not a moment alone"""
    tail_power: bool = False
    """eqs 7, 10: the tail rotor takes its power from the main rotor's shaft"""
    collective: bool = False
    """eqs 18-19: an input x_collective for the pitch; x_throttle is left with the motor"""
    governor: bool = False
    """eq. 10: the throttle is a governor's, which holds the speed that x_throttle asks for"""
    measured_speed: bool = False
    """in place of eq. 10: the rotor's speed is an input Omega, and no motor is modelled"""
    flybarless: bool = False
    """eqs 11-12: no flybar; all of the cyclic stick goes to the blades"""


class Attitude(NamedTuple):
    """Sines and cosines of the angles."""

    sphi: Scalar
    cphi: Scalar
    sth: Scalar
    cth: Scalar
    spsi: Scalar
    cpsi: Scalar


class Motion(NamedTuple):
    """Motion of the body and of the air past it; body axes are forward, right, down."""

    at: Attitude
    dx: Scalar
    """velocity relative to the air along x, y and z (up) [m/s]"""
    dy: Scalar
    dz: Scalar
    u: Scalar
    """the same in body axes [m/s]"""
    v: Scalar
    w: Scalar
    p: Scalar
    """rates of roll, pitch and yaw [rad/s]"""
    q: Scalar
    r: Scalar


class Moments(NamedTuple):
    """About the centre of gravity [N m]: roll right, nose up, nose right."""

    roll: Scalar
    pitch: Scalar
    yaw: Scalar


# Behind a barrier a number is computed once: without it XLA computes it again for each of the
# derivatives that need it, the inflow's iteration included.
once = jax.lax.optimization_barrier


def motion(corrections: Corrections, s: Record, u: Record) -> Motion:
    r"""Attitude, airspeed and rates of the body.

    The body's rates are $p = \dot\phi - \dot\psi s_\theta$,
    $q = \dot\theta c_\phi + \dot\psi c_\theta s_\phi$,
    $r = \dot\psi c_\theta c_\phi - \dot\theta s_\phi$; without `rigid_body` they are the
    angles' derivatives, as the paper has it.

    Args:
        u: inputs; wind_x, wind_y and wind_z [m/s] where there is wind.
    """
    at = once(Attitude(*sincos(s.phi), *sincos(s.theta), *sincos(s.psi)))
    dx, dy, dz = s.dx, s.dy, s.dz
    # All aerodynamics sees the motion through the air; only the position is over the ground.
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
    # Eqs 5-7 integrate M/I straight into the angles, so the paper's rates are the angles'
    # derivatives. That is right in level flight alone: a body that turns steadily with dpsi at a
    # bank phi has a pitch rate.
    p, q, r = _turned(s, at) if corrections.rigid_body else (s.dphi, s.dtheta, s.dpsi)
    return once(Motion(at, dx, dy, dz, forward, right, down, p, q, r))


def body_rates(s: Record) -> dict[str, Scalar]:
    """p, q and r [rad/s] by name, as gyros on the body measure them."""
    at = Attitude(*sincos(s.phi), *sincos(s.theta), *sincos(s.psi))
    return dict(zip("pqr", _turned(s, at), strict=True))


def _turned(s: Record, at: Attitude) -> tuple[Scalar, ...]:
    """p, q and r [rad/s] of the Euler angles' derivatives."""
    p = s.dphi - s.dpsi * at.sth
    q = s.dtheta * at.cphi + s.dpsi * at.cth * at.sphi
    r = s.dpsi * at.cth * at.cphi - s.dtheta * at.sphi
    return p, q, r


def _to_earth(at: Attitude, forward: Scalar, right: Scalar, down: Scalar) -> tuple[Scalar, ...]:
    """A vector in body axes along x, y and z (up)."""
    # The turns of `motion` in the opposite order and direction.
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
    """Eq. 11 for both axes."""
    if not hasattr(s, "beta_roll"):
        # Without a bar all of the stick is Bell's path: eq. 11 with L2 = 0.
        return Cyclic((1.0 / p.L1) * u.x_roll, (1.0 / p.L1) * u.x_pitch)
    return Cyclic(
        flybar.cyclic_pitch(p, u.x_roll, s.beta_roll),
        flybar.cyclic_pitch(p, u.x_pitch, s.beta_pitch),
    )


def collective(p: Helicopter, u: Record) -> Scalar:
    """theta0 [rad], eq. 18: of the collective stick where there is one, else of the throttle."""
    return p.K_theta0 * (u.x_collective if hasattr(u, "x_collective") else u.x_throttle)


def hub_speed(p: Helicopter, m: Motion) -> tuple[Scalar, Scalar]:
    """The hub's speed through the air, forward and to the right [m/s]."""
    # omega x r at r = (-lr, 0, -hr), of which forward and right count here.
    return m.u - p.hr * m.q, m.v + p.hr * m.p - p.lr * m.r


def flow(corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion) -> aero.Flow:
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
    # The hub is h_r above the centre of gravity: a nose that rises carries it backwards, a right
    # side that sinks carries it to the right.
    forward_speed, lateral_speed, up = (
        m.dx - p.hr * s.dtheta,
        m.dy + p.hr * s.dphi,
        m.dz - p.lr * s.dtheta,
    )
    if corrections.descent:
        # v + omega x r at r = (-lr, 0, -hr), along the mast. With dpsi = 0 this is eq. 9 with
        # -(dy + hr dphi) sin phi: as printed the sign of hr dphi disagrees with eq. 3, an rms error
        # of 0.19 m/s against exact kinematics where the other sign leaves 0.04.
        W = -(m.w + p.lr * m.q)
    else:
        W = up * m.at.cth - forward_speed * m.at.sth - (m.dy - p.hr * s.dphi) * m.at.sphi
    # Eqs 10 and 13 print (x_roll + x_pitch)/L1: sticks straight to the blades, without the ratio
    # L3/(L2 + L3) and the flybar that eq. 11 puts between the two.
    tilt = Cyclic((1.0 / p.L1) * u.x_roll, (1.0 / p.L1) * u.x_pitch)
    if corrections.cyclic:
        tilt = cyclic(p, s, u)
    if corrections.edgewise:
        forward_speed, lateral_speed = hub_speed(p, m)
        if corrections.flapping:
            # Seen from the tilted plane: less air comes through it, and the blades' pitch to it is
            # less by the same angle, so that thrust stays and power is that of the tilted thrust.
            W = W - forward_speed * s.a1 + lateral_speed * s.b1
            tilt = Cyclic(tilt.roll - s.b1, tilt.pitch - s.a1)
        return aero.Flow(
            forward_speed**2 + lateral_speed**2,
            W,
            forward_speed * tilt.pitch - lateral_speed * tilt.roll,
        )
    # Eq. 8 adds the speeds along x and y as if they had one direction: flight ahead and to the left
    # at the same speed gives mu = 0. It is not turned by psi either, so it holds near psi = 0.
    speed = forward_speed * m.at.cth + lateral_speed * m.at.cphi + up * m.at.sth
    return aero.Flow(speed**2, W, speed * (tilt.roll + tilt.pitch))


def main_rotor(p: Helicopter, s: Record, u: Record, air: aero.Flow) -> aero.RotorForce:
    """Thrust and inflow of the main rotor, eqs 13 and 18; with dynamic inflow vi is a state."""
    return once(aero.thrust(p, s.Omega, collective(p, u), air, getattr(s, "vi", None)))


def accelerations(
    corrections: Corrections,
    p: Helicopter,
    m: Motion,
    T: Scalar,
    aside: tuple[Scalar, Scalar] | None = None,
) -> tuple[Scalar, Scalar, Scalar]:
    r"""Accelerations along x, y and z [m/s^2], eqs 2-4.

    $$\ddot x = -\tfrac1m\cos\psi\,T\sin\theta, \quad
      \ddot y = \tfrac1m\cos\psi\,T\sin\phi, \quad
      \ddot z = \tfrac1m\cos\phi\,T\cos\theta - g$$

    With `direction` $\ddot x = -\tfrac{T}{m}(c_\phi s_\theta c_\psi + s_\phi s_\psi)$ and
    $\ddot y = -\tfrac{T}{m}(c_\phi s_\theta s_\psi - s_\phi c_\psi)$. With `drag` less
    $\tfrac12\rho V (S_x u, S_y v, S_z w)/m$ in body axes.

    Args:
        T: thrust of the main rotor [N].
        aside: forces of the rotors forward and to the right, beside T [N].
    """
    at, pull = m.at, (1.0 / p.m) * T
    if corrections.direction:
        ddx = -pull * (at.cphi * at.sth * at.cpsi + at.sphi * at.spsi)
        ddy = -pull * (at.cphi * at.sth * at.spsi - at.sphi * at.cpsi)
    else:
        # cos(psi) in both: at psi = 90 degrees nothing accelerates horizontally. As printed.
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
    # The root of a speed of zero has no derivative; this one has, and gives zero drag there.
    speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0 * square)
    # Each axis has its area times the whole speed, not the square of its own component: with equal
    # areas the drag then points against the motion, whatever its direction in the body.
    factor = once((0.5 * p.rho / p.m) * speed)
    return factor * p.Sx * m.u, factor * p.Sy * m.v, factor * p.Sz * m.w


def angular_accelerations(
    corrections: Corrections, p: Helicopter, s: Record, m: Motion, M: Moments
) -> tuple[Scalar, Scalar, Scalar]:
    r"""Second derivatives of phi, theta and psi [rad/s^2].

    Eqs 5-7, $\ddot\phi = M_\phi/I_{xx}$ and so on, or with `rigid_body` Euler's equations for
    the body rates, $I\dot\omega = M - \omega\times I\omega$, and the derivative of
    $\dot\phi = p + \dot\psi s_\theta$, $\dot\theta = q c_\phi - r s_\phi$,
    $\dot\psi = (q s_\phi + r c_\phi)/c_\theta$.
    """
    # The body's axes are taken for principal ones: neither the paper nor a vehicle has Ixz. What is
    # bolted on is rigid with the body, so it adds to the inertias and nowhere else.
    Ixx, Iyy, Izz = p.Ixx + p.Ixx_added, p.Iyy + p.Iyy_added, p.Izz
    if not corrections.rigid_body:
        return (1.0 / Ixx) * M.roll, (1.0 / Iyy) * M.pitch, (1.0 / Izz) * M.yaw
    at = m.at
    dp = (1.0 / Ixx) * (M.roll - (Izz - Iyy) * m.q * m.r)
    dq = (1.0 / Iyy) * (M.pitch - (Ixx - Izz) * m.r * m.p)
    dr = (1.0 / Izz) * (M.yaw - (Iyy - Ixx) * m.p * m.q)
    # The states are derivatives of the angles in every variant, so the body's accelerations are
    # turned into second derivatives. q sin phi + r cos phi is dpsi cos theta, and so on: products
    # of the angles' derivatives stand for those with the body's rates.
    ddtheta = dq * at.cphi - dr * at.sphi - s.dphi * s.dpsi * at.cth
    turn = dq * at.sphi + dr * at.cphi + s.dphi * s.dtheta + s.dpsi * s.dtheta * at.sth
    # The angles' own singularity, nose straight up: `_limits` says before it is reached.
    ddpsi = once(turn / at.cth)
    ddphi = dp + ddpsi * at.sth + s.dpsi * s.dtheta * at.cth
    return ddphi, ddtheta, ddpsi


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
