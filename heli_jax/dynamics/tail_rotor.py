"""The tail rotor: eqs 16, 17 and 20, with inflow, the side force and the power that it takes."""

from typing import NamedTuple

import jax

from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics.helicopter_records import Corrections, Motion
from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter


class TailRotor(NamedTuple):
    """What the tail rotor does."""

    T: Scalar
    """thrust, to the left: it turns the nose to the right [N]"""
    Q: Scalar
    """torque on its own shaft [N m]"""


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
