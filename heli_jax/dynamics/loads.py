r"""Loads of rotors and motor on the body: eqs 10, 14-17 and 19 with corrections.

The tail rotor (eqs 16, 17 and 20) has inflow, a side force and a power demand. The motor's
throttle comes from the stick, or from a governor that holds the rotor speed:

$$x_g = K_P(\Omega_{ref} - \Omega) + i_g,\qquad
  \dot i_g = K_I\left[(\Omega_{ref} - \Omega) + (\mathrm{sat}\,x_g - x_g)/K_P\right]$$

with $x_g$ limited to 0 and 1, and back-calculation of the integral (Astrom and Hagglund, PID
Controllers, 1995). Its form and the X-Cell's gains are those of Gavrilets (MIT thesis, 2003).
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
    """Thrust to the left, which turns the nose to the right [N]."""
    Q: Scalar
    """Torque on its own shaft [N m]."""


class Drive(NamedTuple):
    """Motor, shaft and governor."""

    reaction: Scalar
    """Torque of motor and tail shaft on the fuselage, nose right [N m]."""
    dOmega: Scalar | None
    """Acceleration of the rotor [rad/s^2]; None if its speed is measured."""
    dgovernor: Scalar | None = None
    """Derivative of the governor's integral part [1/s]."""


def motor_torque(corrections: Corrections, p: Helicopter, throttle: Scalar) -> Scalar:
    """Return T_m [N m], eq. 19, or the motor torque of eq. 10."""
    # Eq. 10 accelerates the rotor by K_throttle x_throttle, a torque Ir K_throttle on the fuselage.
    # K_Tm is a second value for the same torque, and may contradict it.
    gain = p.Ir * p.K_throttle if corrections.tied_torque else p.K_Tm
    return gain * throttle


class Rotors(NamedTuple):
    """Forces of both rotors."""

    main: aero.RotorForce
    tail: TailRotor


def drive(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, air: aero.Flow, rotors: Rotors
) -> Drive:
    """Return the drive of eqs 10 and 19, optionally with the tail rotor's power and
    the governor.
    """
    Q = aero.torque(p, s.Omega, collective(p, u), air, rotors.main.inflow)
    # The main shaft drives the tail shaft with K_Omega times the tail torque, which reacts on the
    # fuselage. The remaining motor torque turns the main rotor.
    shaft = p.K_Omega * rotors.tail.Q if corrections.tail_power else 0.0 * Q
    if corrections.measured_speed:
        # The motor gives the torque that the rotor takes, since the record has the speed but no
        # torque.
        return Drive(Q, None)
    x_throttle, dgovernor = _throttle(corrections, p, s, u)
    # K_throttle x_throttle has no factor: its unit is rad/s^2 per unit of stick, not that in the
    # paper's nomenclature.
    dOmega = p.K_throttle * x_throttle - (1.0 / p.Ir) * (Q + shaft)
    return Drive(motor_torque(corrections, p, x_throttle) - shaft, dOmega, dgovernor)


def _throttle(
    corrections: Corrections, p: Helicopter, s: Record, u: Record
) -> tuple[Scalar, Scalar | None]:
    """Return the throttle, and the derivative of the governor's integral part if there is one."""
    if not corrections.governor:
        return u.x_throttle, None
    # A throttle stick that is also the collective cannot command a speed.
    commanded = set_point(p, u.x_throttle if corrections.collective else None)
    return throttle(p, commanded, s.Omega, s.governor)


def moments(
    corrections: Corrections, p: Helicopter, hub: Moments, rotors: Rotors, shaft: Drive
) -> Moments:
    """Return the moments of eqs 5-7 and 14-17.

    Args:
        hub: moments of the main rotor's hub and of its in-plane forces.
    """
    # Trim needs M_psi = -T_m, so x_yaw K_theta0T is negative in hover.
    yaw = hub.yaw + p.L_T * rotors.tail.T + shaft.reaction
    # Only the motor's torque T_m acts on the fuselage. Eq. 7 also has -Ir dOmega, so the motor acts
    # twice. By eq. 10 that cancels T_m and leaves the rotor's drag torque, which follows a throttle
    # step only as the rotor speeds up. Trim, with dOmega = 0, is unaffected.
    if not corrections.reaction and shaft.dOmega is not None:
        yaw = yaw - p.Ir * shaft.dOmega
    # The tail rotor is h_T above the centre of gravity and pulls to the left.
    roll = hub.roll - p.h_T * rotors.tail.T if corrections.tail_force else hub.roll
    # -T lr of eq. 6: the rotor axis is behind the centre of gravity and lifts the tail.
    return once(Moments(roll, hub.pitch - rotors.main.T * p.lr, yaw))


def rigid_hub_moments(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion, force: aero.RotorForce
) -> Moments:
    """Return the moments of hingeless blades, which follow the cyclic pitch at once, eqs 14-15."""
    tilt = cyclic(p, s, u)
    if corrections.rotor_moment:
        roll = aero.hub_moment(p, s.Omega, tilt.roll, m.p)
        pitch = aero.hub_moment(p, s.Omega, tilt.pitch, m.q)
    else:
        roll = aero.cyclic_moment(p, s.Omega, tilt.roll)
        pitch = aero.cyclic_moment(p, s.Omega, tilt.pitch)
    if corrections.tip_loss:
        # The moment of a cyclic pitch is the integral of r^2 theta times the arm r, up to B R.
        roll, pitch = p.B**4 * roll, p.B**4 * pitch
    if corrections.speed_stability:
        lift = tip_path_plane.speed_lift(
            p, s.Omega, collective(p, u), force.inflow, _tip(corrections, p)
        )
        per_speed = tip_path_plane.first_harmonic_moment(p, lift)
        forward, right = hub_speed(p, m)
        # The advancing side lifts more, and a quarter turn later the rotor tilts against the
        # motion: nose up in forward flight, left in a slip to the right. This speed stability
        # causes the slow oscillation in hover.
        roll, pitch = roll - per_speed * right, pitch + per_speed * forward
    return Moments(roll, pitch, 0.0 * roll)


def _tip(corrections: Corrections, p: Helicopter) -> Scalar:
    """Return the tip loss factor for flapping and hub moment; thrust and torque always use B."""
    return p.B if corrections.tip_loss else 1.0


def flapping(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion, force: aero.RotorForce
) -> Tilt:
    """Return da1/dt and db1/dt [rad/s] of the tip-path plane."""
    B, pitch = _tip(corrections, p), cyclic(p, s, u)
    # Only the plane's equilibrium; body rates and hub stiffness are added in `flapping_rates`.
    driven = Tilt(pitch.pitch, pitch.roll)
    if corrections.speed_stability:
        lift = tip_path_plane.speed_lift(p, s.Omega, collective(p, u), force.inflow, B)
        per_speed = tip_path_plane.flap_back(p, s.Omega, lift, B)
        forward, right = hub_speed(p, m)
        driven = Tilt(driven.a1 + per_speed * forward, driven.b1 - per_speed * right)
    return tip_path_plane.flapping_rates(p, s.Omega, Tilt(s.a1, s.b1), driven, m, B)


def set_point(p: Helicopter, x_throttle: Scalar | None) -> Scalar:
    """Return the commanded rotor speed [rad/s]: the throttle stick's fraction of the nominal speed.

    Args:
        x_throttle: the stick [1]; None if it moves the collective pitch, and the speed is nominal.
    """
    return p.Omega if x_throttle is None else p.Omega * x_throttle


def throttle(
    p: Helicopter, commanded: Scalar, Omega: Scalar, integral: Scalar
) -> tuple[Scalar, Scalar]:
    """Return the throttle, 0 to 1, and the derivative of the integral part [1/s].

    Args:
        commanded: commanded rotor speed [rad/s].
        Omega: main rotor speed [rad/s].
        integral: the state i_g [1].
    """
    error = commanded - Omega
    free = p.K_P * error + integral
    # A motor cannot brake the rotor or exceed full power. At a limit the throttle does not depend
    # on the gains, so such parts of a record have no information on K_P.
    held = jnp.clip(free, 0.0, 1.0)
    # Without the last term the integral would grow while full throttle is not enough, and the rotor
    # would then overspeed. K_P must not be zero, since it divides here.
    return held, p.K_I * (error + (1.0 / p.K_P) * (held - free))


def tail_rotor(
    corrections: Corrections, p: Helicopter, u: Record, m: Motion, Omega: Scalar
) -> TailRotor:
    """Return thrust and torque of the tail rotor.

    Args:
        Omega: main rotor speed [rad/s].
    """
    theta0T = p.K_theta0T * u.x_yaw
    if corrections.tail:
        force = tail_force(corrections, p, m, Omega, theta0T)
        T, inflow = force.T, force.inflow
    else:
        # Eq. 16 gives only a moment. Divided by its arm it is the force, so that all variants share
        # the way from tail thrust to moments and forces in `loads`.
        T = (1.0 / p.L_T) * aero.tail_moment(p, Omega, theta0T)
        inflow = 0.0 * T
    # It is computed only if used, since a vehicle of the paper may lack its constants.
    Q = aero.tail_torque(p, Omega, theta0T, inflow) if corrections.tail_power else 0.0 * T
    # Yaw, roll, side force and shaft power all use these two. With the barrier, the inflow
    # iteration runs only once.
    return jax.lax.optimization_barrier(TailRotor(T, Q))


def tail_force(
    corrections: Corrections,
    p: Helicopter,
    m: Motion,
    Omega: Scalar,
    theta0T: Scalar,
) -> aero.RotorForce:
    """Return thrust and inflow of the tail rotor; a positive thrust turns the nose to the right.

    Args:
        Omega: main rotor speed [rad/s].
        theta0T: blade pitch [rad].
    """
    # The position is (-L_T, 0, -h_T) and the thrust points left, so V2 is forward and down. W grows
    # with the yaw rate caused by the thrust, which gives the yaw damping that eq. 16 lacks.
    forward, W = m.u, p.L_T * m.r - m.v
    if corrections.tail_force:
        # omega x r at that position. The flow at height h_T counts only if the force acts there
        # too. Both together damp the roll rate; one alone would be a one-way coupling.
        forward, W = forward - p.h_T * m.q, W - p.h_T * m.p
    V2 = forward**2 + (m.w + p.L_T * m.q) ** 2
    return aero.tail_thrust(p, Omega, theta0T, V2, W)
