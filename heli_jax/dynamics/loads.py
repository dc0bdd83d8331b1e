r"""Loads of rotors and motor on the body: eqs 10, 14-17 and 19 with corrections.

The tail rotor (eqs 16, 17 and 20) has inflow, a side force and a power that it takes. The motor's
throttle is the stick's, or that of a governor that holds the rotor's speed:

$$x_g = K_P(\Omega_{ref} - \Omega) + i_g,\qquad
  \dot i_g = K_I\left[(\Omega_{ref} - \Omega) + (\mathrm{sat}\,x_g - x_g)/K_P\right]$$

with $x_g$ held within 0 and 1, and the integral led back while it is (Astrom and Hagglund, PID
Controllers, 1995: back-calculation). Its form and the X-Cell's gains are those of Gavrilets (MIT
thesis, 2003).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics import tip_path_plane
from heli_jax.dynamics.helicopter_equations import (
    Corrections,
    Moments,
    Motion,
    collective,
    cyclic,
    hub_speed,
    once,
)
from heli_jax.dynamics.tip_path_plane import Tilt
from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter


class TailRotor(NamedTuple):
    """Loads of the tail rotor."""

    T: Scalar
    """thrust, to the left: it turns the nose to the right [N]"""
    Q: Scalar
    """torque on its own shaft [N m]"""


class Drive(NamedTuple):
    """Motor, shaft and governor."""

    reaction: Scalar
    """torque of the motor and the tail's shaft on the fuselage, nose right [N m]"""
    dOmega: Scalar | None
    """acceleration of the rotor [rad/s^2]; None where its speed is measured"""
    dgovernor: Scalar | None = None
    """of the governor's integral part [1/s]"""


def motor_torque(corrections: Corrections, p: Helicopter, throttle: Scalar) -> Scalar:
    """T_m [N m], eq. 19, or as eq. 10 has the motor."""
    # Eq. 10 accelerates the rotor by K_throttle x_throttle, a torque Ir K_throttle on the fuselage.
    # K_Tm says the same thing once more: only where the two agree is the motor's torque one number.
    gain = p.Ir * p.K_throttle if corrections.tied_torque else p.K_Tm
    return gain * throttle


class Rotors(NamedTuple):
    """The forces of both rotors."""

    main: aero.RotorForce
    tail: TailRotor


def drive(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, air: aero.Flow, rotors: Rotors
) -> Drive:
    """Eqs 10 and 19, with the tail rotor's power and the governor where they are on."""
    Q = aero.torque(p, s.Omega, collective(p, u), air, rotors.main.inflow)
    # The tail's shaft is driven by the main one: K_Omega times its torque there, which the fuselage
    # feels on the way, so that of the motor's reaction what is left turns the main rotor.
    shaft = p.K_Omega * rotors.tail.Q if corrections.tail_power else 0.0 * Q
    if corrections.measured_speed:
        # What the motor gives is what the rotor takes: the record has no torque, but the speed.
        return Drive(Q, None)
    x_throttle, dgovernor = _throttle(corrections, p, s, u)
    # K_throttle x_throttle stands alone: its unit is rad/s^2 per unit of stick, not the one that
    # the paper's nomenclature says.
    dOmega = p.K_throttle * x_throttle - (1.0 / p.Ir) * (Q + shaft)
    return Drive(motor_torque(corrections, p, x_throttle) - shaft, dOmega, dgovernor)


def _throttle(
    corrections: Corrections, p: Helicopter, s: Record, u: Record
) -> tuple[Scalar, Scalar | None]:
    """The throttle and the derivative of the governor's integral part, where there is one."""
    if not corrections.governor:
        return u.x_throttle, None
    # Where the throttle stick is the collective one too it cannot ask for a speed.
    asked = set_point(p, u.x_throttle if corrections.collective else None)
    return throttle(p, asked, s.Omega, s.governor)


def moments(
    corrections: Corrections, p: Helicopter, hub: Moments, rotors: Rotors, shaft: Drive
) -> Moments:
    """The moments of eqs 5-7 and 14-17.

    Args:
        hub: those of the main rotor's hub about it, and of its in-plane forces.
    """
    # Trim needs M_psi = -T_m: x_yaw K_theta0T is negative in hover.
    yaw = hub.yaw + p.L_T * rotors.tail.T + shaft.reaction
    # The fuselage feels the motor's torque T_m alone. Eq. 7 has -Ir dOmega beside it, the motor a
    # second time: by eq. 10 that takes T_m off again and leaves the rotor's drag torque, which
    # follows a throttle step only as the rotor speeds up. Trim, where dOmega = 0, stays the same.
    if not corrections.reaction and shaft.dOmega is not None:
        yaw = yaw - p.Ir * shaft.dOmega
    # The tail rotor stands h_T above the centre of gravity and pulls to the left.
    roll = hub.roll - p.h_T * rotors.tail.T if corrections.tail_force else hub.roll
    # Eq. 6's -T lr: the rotor axis stands behind the centre of gravity, and lifts the tail.
    return once(Moments(roll, hub.pitch - rotors.main.T * p.lr, yaw))


def rigid_hub_moments(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion, force: aero.RotorForce
) -> Moments:
    """Eqs 14-15: the moments of blades without hinges, which follow the cyclic pitch at once."""
    tilt = cyclic(p, s, u)
    if corrections.rotor_moment:
        roll = aero.hub_moment(p, s.Omega, tilt.roll, m.p)
        pitch = aero.hub_moment(p, s.Omega, tilt.pitch, m.q)
    else:
        roll = aero.cyclic_moment(p, s.Omega, tilt.roll)
        pitch = aero.cyclic_moment(p, s.Omega, tilt.pitch)
    if corrections.tip_loss:
        # The moment of a cyclic pitch is the integral of r^2 theta times the arm r up to B R.
        roll, pitch = p.B**4 * roll, p.B**4 * pitch
    if corrections.speed_stability:
        lift = tip_path_plane.speed_lift(
            p, s.Omega, collective(p, u), force.inflow, _tip(corrections, p)
        )
        per_speed = tip_path_plane.first_harmonic_moment(p, lift)
        forward, right = hub_speed(p, m)
        # The advancing side lifts more, and a quarter of a turn later the rotor leans away from
        # where it flies to: nose up ahead, to the left in a slip to the right. This speed
        # stability is what hover's slow oscillation comes from.
        roll, pitch = roll - per_speed * right, pitch + per_speed * forward
    return Moments(roll, pitch, 0.0 * roll)


def _tip(corrections: Corrections, p: Helicopter) -> Scalar:
    """Return the radius at which lift ends for flapping and hub moment; thrust and torque use B in
    any variant."""
    return p.B if corrections.tip_loss else 1.0


def flapping(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion, force: aero.RotorForce
) -> Tilt:
    """da1/dt and db1/dt [rad/s] of the tip-path plane."""
    B, pitch = _tip(corrections, p), cyclic(p, s, u)
    # Only where the plane would settle: the body's rates and the hub's stiffness act on the way
    # there, in `flapping_rates`.
    driven = Tilt(pitch.pitch, pitch.roll)
    if corrections.speed_stability:
        lift = tip_path_plane.speed_lift(p, s.Omega, collective(p, u), force.inflow, B)
        per_speed = tip_path_plane.flap_back(p, s.Omega, lift, B)
        forward, right = hub_speed(p, m)
        driven = Tilt(driven.a1 + per_speed * forward, driven.b1 - per_speed * right)
    return tip_path_plane.flapping_rates(p, s.Omega, Tilt(s.a1, s.b1), driven, m, B)


def set_point(p: Helicopter, x_throttle: Scalar | None) -> Scalar:
    """The rotor speed to be held [rad/s]: on a transmitter the throttle stick asks for a share of
    the nominal speed, and at zero for none.

    Args:
        x_throttle: the stick [1]; None where it moves the collective pitch.
    """
    return p.Omega if x_throttle is None else p.Omega * x_throttle


def throttle(
    p: Helicopter, asked: Scalar, Omega: Scalar, integral: Scalar
) -> tuple[Scalar, Scalar]:
    """The throttle, 0 to 1, and the derivative of the integral part [1/s].

    Args:
        asked: the rotor speed to be held [rad/s].
        Omega: main rotor speed [rad/s].
        integral: the state i_g [1].
    """
    error = asked - Omega
    free = p.K_P * error + integral
    # A motor cannot brake the rotor, nor give more than all it has. While it is at an end the
    # throttle does not depend on the gains: such stretches of a record say nothing of K_P.
    held = jnp.clip(free, 0.0, 1.0)
    # Without the last term the integral would grow for as long as full throttle is not enough, and
    # the rotor would then overspeed until it had run down again. The division by K_P is why that
    # gain, unlike K_I, may not be zero.
    return held, p.K_I * (error + (1.0 / p.K_P) * (held - free))


def tail_rotor(
    corrections: Corrections, p: Helicopter, u: Record, m: Motion, Omega: Scalar
) -> TailRotor:
    """Thrust and torque of the tail rotor.

    Args:
        Omega: main rotor speed [rad/s].
    """
    theta0T = p.K_theta0T * u.x_yaw
    if corrections.tail:
        force = tail_force(corrections, p, m, Omega, theta0T)
        T, inflow = force.T, force.inflow
    else:
        # Eq. 16 gives a moment alone. Divided by its arm it is the force that makes it, so that in
        # every variant there is one way from a tail thrust to the moments and forces in `loads`.
        T = (1.0 / p.L_T) * aero.tail_moment(p, Omega, theta0T)
        inflow = 0.0 * T
    # Not computed where nothing reads it: a vehicle of the paper's may lack what it needs.
    Q = aero.tail_torque(p, Omega, theta0T, inflow) if corrections.tail_power else 0.0 * T
    # Yaw, roll, the side force and the shaft's power all read these two: behind the barrier the
    # iteration for the inflow runs once, and not once for each of them.
    return jax.lax.optimization_barrier(TailRotor(T, Q))


def tail_force(
    corrections: Corrections,
    p: Helicopter,
    m: Motion,
    Omega: Scalar,
    theta0T: Scalar,
) -> aero.RotorForce:
    """Thrust and inflow of the tail rotor; a positive thrust turns the nose to the right.

    Args:
        Omega: main rotor speed [rad/s].
        theta0T: pitch of its blades [rad].
    """
    # Its place is (-L_T, 0, -h_T) and its thrust points to the left: V2 is in its plane, forward
    # and down. W grows with the yaw rate that the thrust makes, which is where yaw damping comes
    # from; eq. 16, without inflow, has none.
    forward, W = m.u, p.L_T * m.r - m.v
    if corrections.tail_force:
        # omega x r at that place. The flow at the height h_T counts only where the force acts there
        # as well: the tail damps the roll rate through both together, and one without the other
        # would be a coupling in one direction.
        forward, W = forward - p.h_T * m.q, W - p.h_T * m.p
    V2 = forward**2 + (m.w + p.L_T * m.q) ** 2
    return aero.tail_thrust(p, Omega, theta0T, V2, W)
