r"""The main rotor as a tip-path plane that tilts back by a1 and to the right by b1.

$$\tau_f\dot a_1 = -a_1 - \tau_f q + \theta_{pitch} + \frac{\partial a_1}{\partial\mu}\mu_x
    + \tau_f\omega_k b_1, \qquad
  \tau_f\dot b_1 = -b_1 - \tau_f p + \theta_{roll} - \frac{\partial a_1}{\partial\mu}\mu_y
    - \tau_f\omega_k a_1$$

with the cyclic pitch of eq. 11, $\tau_f = 16/(\gamma\Omega)$ and the Lock number
$\gamma = \rho a c R^4/I_\beta$ (Mettler, Tischler and Kanade, CMU-RI-TR-00-03, 2000; Gavrilets, MIT
thesis, 2003; Padfield, Helicopter Flight Dynamics). $\omega_k = k_\beta/(2 I_\beta\Omega)$ is the
effect of a stiff hub. It raises the blade's frequency above $\Omega$, and a free tilt then rotates
against the rotor's sense.

Two effects are neglected: the blade's second derivative, at most $\gamma/16$ of the other terms,
and coning, which a seesaw rotor does not have. With a coning angle $a_0$, speed v to the right and
u forward, a rotor tilts further by $-\tfrac43\frac{v}{R\Omega}a_0$ in a1 and
$-\tfrac43\frac{u}{R\Omega}a_0$ in b1. The X-Cell 60's thrust would cone free blades by 1.3 degrees.
At 10 m/s this adds -0.17 degrees of b1 to the modelled -0.15. In trim the lateral stick compensates
it.
"""

from typing import NamedTuple

from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter

_STOPPED = 1e-8
"""Term added to Omega^2, so that a rotor at rest is no singular point [rad^2/s^2]."""


class Tilt(NamedTuple):
    """Angles of the tip-path plane relative to the hub [rad]."""

    a1: Scalar
    """Backward tilt."""
    b1: Scalar
    """Tilt to the right."""


def lock_number(p: Helicopter) -> Scalar:
    r"""Return the Lock number $\gamma = \rho a c R^4/I_\beta$ [1], aerodynamic over inertial
    forces.
    """
    return p.rho * p.a * p.c * p.R**4 / p.I_beta


def flapping_rate_constant(p: Helicopter, Omega: Scalar, B: Scalar) -> Scalar:
    r"""Return $1/\tau_f = \gamma B^4\Omega/16$ [1/s].

    Args:
        Omega: main rotor speed [rad/s].
        B: tip loss factor, 1 for lift up to the tip.
    """
    # Lift against a flapping rate is proportional to Omega r times the blade's own speed, which
    # also grows with r. Times the arm r, its integral up to B R is proportional to B^4.
    return (lock_number(p) / 16.0 * B**4) * Omega


def speed_lift(p: Helicopter, Omega: Scalar, theta0: Scalar, inflow: Scalar, B: Scalar) -> Scalar:
    r"""Return $\tfrac23 B^3\theta_0\Omega R - \tfrac12 B^2\lambda\Omega R$ [m/s].

    The additional moment of the advancing blade's lift at speed V, integrated along the blade, is
    $\tfrac12\rho a c R^2 V$ times this.

    Args:
        Omega: main rotor speed [rad/s].
        theta0: collective pitch [rad].
        inflow: lambda R Omega [m/s].
        B: tip loss factor, 1 for lift up to the tip.
    """
    # An advancing blade meets Omega r + V. To first order in V, pitch gives 2 Omega r V and inflow
    # V, each times the arm r. Integrated up to B R, these give 2/3 and 1/2.
    return (2.0 / 3.0 * B**3 * p.R) * Omega * theta0 - (0.5 * B**2) * inflow


def flap_back(p: Helicopter, Omega: Scalar, lift: Scalar, B: Scalar) -> Scalar:
    r"""Return the tilt of the plane against a speed of 1 m/s [rad s/m].

    $$\frac{1}{R\Omega}\frac{\partial a_1}{\partial\mu}
      = \frac{2 K_\mu}{R\Omega}\,\frac{1}{B^4} \left(\tfrac43 B^3\theta_0 - B^2\lambda\right)$$

    Args:
        p: vehicle, SI; K_mu is 1 in blade-element theory.
        Omega: main rotor speed [rad/s].
        B: tip loss factor, 1 for lift up to the tip.
    """
    # The plane tilts until flapping removes the lift that the speed adds. Both are moments of the
    # same air on the same blade, so density, chord and lift slope cancel.
    return (4.0 * p.K_mu / (p.R**2 * B**4)) * lift / (Omega * Omega + _STOPPED)


def first_harmonic_moment(p: Helicopter, lift: Scalar) -> Scalar:
    r"""Return the moment on a hingeless hub at a speed of 1 m/s [N s].

    $\tfrac12\rho a c V\Omega R^3(\tfrac23\theta_0 - \tfrac12\lambda)$, which eqs 14-15 omit. Like
    cyclic pitch it acts a quarter turn later.
    """
    return (0.5 * p.K_mu * p.rho * p.a * p.c * p.R**2) * lift


def flapping_rates(
    p: Helicopter, Omega: Scalar, tilt: Tilt, driven: Tilt, m: Record, B: Scalar
) -> Tilt:
    """Return da1/dt and db1/dt [rad/s], the equations of the module's docstring.

    Args:
        Omega: main rotor speed [rad/s].
        m: the `Motion` of the body; p and q [rad/s] are used.
        B: tip loss factor, 1 for lift up to the tip.
    """
    # Body rates enter directly, without k: the plane keeps its direction in space like a gyroscope
    # while the hub turns, and the air then aligns it with the hub.
    k = flapping_rate_constant(p, Omega, B)
    # Omega over Omega^2 instead of 1 over Omega, so that a rotor at rest has no precession instead
    # of an infinite one.
    turn = (0.5 * p.k_beta / p.I_beta) * Omega / (Omega * Omega + _STOPPED)
    return Tilt(
        k * (driven.a1 - tilt.a1) + turn * tilt.b1 - m.q,
        k * (driven.b1 - tilt.b1) - turn * tilt.a1 - m.p,
    )


class HubLoads(NamedTuple):
    """Loads of a tilted rotor on the body, in addition to the thrust along the mast."""

    forward: Scalar
    """Force [N]."""
    right: Scalar
    roll: Scalar
    """Moment about the centre of gravity [N m]."""
    pitch: Scalar
    yaw: Scalar


def hub_loads(p: Helicopter, T: Scalar, tilt: Tilt) -> HubLoads:
    r"""Return the hub forces $-T a_1$ and $T b_1$, and the moments $(k_\beta + T h_r)$ times tilt.

    Args:
        p: vehicle, SI; k_beta is the stiffness of the whole hub.
        T: thrust of the main rotor [N].
    """
    # Hub stiffness and thrust arm act through the same tilt, so one flight state shows only their
    # sum. To separate k_beta, hr must be known or the thrust must vary.
    stiffness = p.k_beta + T * p.hr
    right = T * tilt.b1
    # The mast is lr behind the centre of gravity, so a force to the right there turns the nose
    # left.
    return HubLoads(-T * tilt.a1, right, stiffness * tilt.b1, stiffness * tilt.a1, -p.lr * right)
