"""What the rotors and the motor do to the body: eqs 10, 14-17 and 19 with corrections."""

from typing import NamedTuple

from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics import governor, tip_path_plane
from heli_jax.dynamics.helicopter_equations import collective, cyclic, hub_speed, once
from heli_jax.dynamics.helicopter_records import Corrections, Moments, Motion
from heli_jax.dynamics.tail_rotor import TailRotor
from heli_jax.dynamics.tip_path_plane import Tilt
from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter


class Drive(NamedTuple):
    """Motor, shaft and governor."""

    reaction: Scalar
    """torque of the motor and the tail's shaft on the fuselage, nose right [N m]"""
    dOmega: Scalar | None
    """acceleration of the rotor [rad/s^2]; None where its speed is measured"""
    dgovernor: Scalar | None = None
    """of the governor's integral part [1/s]"""


def motor_torque(corrections: Corrections, p: Helicopter, throttle: Scalar) -> Scalar:
    """T_m [N m], eq. 19, or as eq. 10 has the motor.

    Args:
        throttle: 0 to 1.
    """
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
    asked = governor.set_point(p, u.x_throttle if corrections.collective else None)
    return governor.throttle(p, asked, s.Omega, s.governor)


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
    """Where the lift of flapping and hub moment ends; thrust and torque have B in any variant."""
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
