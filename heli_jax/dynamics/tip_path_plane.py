r"""The main rotor as a tip-path plane that tilts back by a1 and to the right by b1.

$$\tau_f\dot a_1 = -a_1 - \tau_f q + \theta_{pitch} + \frac{\partial a_1}{\partial\mu}\mu_x
    + \tau_f\omega_k b_1, \qquad
  \tau_f\dot b_1 = -b_1 - \tau_f p + \theta_{roll} - \frac{\partial a_1}{\partial\mu}\mu_y
    - \tau_f\omega_k a_1$$

with the cyclic pitch of eq. 11, $\tau_f = 16/(\gamma\Omega)$ and the Lock number
$\gamma = \rho a c R^4/I_\beta$ (Mettler, Tischler and Kanade, CMU-RI-TR-00-03, 2000; Gavrilets,
MIT thesis, 2003; Padfield, Helicopter Flight Dynamics). $\omega_k = k_\beta/(2 I_\beta\Omega)$ is
what a stiff hub turns: it raises the blade's frequency above $\Omega$, and a free tilt then moves
around against the rotor's sense.

Left out are the blade's own second derivative, which is $\gamma/16$ of what is kept or less, and
coning. The rotor is a seesaw, whose blades do not cone. One whose blades flap freely by the angle
$a_0$ tilts further by $-\tfrac43\frac{v}{R\Omega}a_0$ in a1, with v the speed to the right, and by
$-\tfrac43\frac{u}{R\Omega}a_0$ in b1, with u that forward. For the X-Cell 60, whose thrust would
cone free blades by 1.3 degrees, that is -0.17 degrees of b1 at 10 m/s, beside the -0.15 that it has
here; in a trim the lateral stick takes it up.
"""

from typing import NamedTuple

from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter

_STOPPED = 1e-8
"""[rad^2/s^2] beside Omega^2: a rotor at rest has no flapping, but is an ordinary point"""


class Tilt(NamedTuple):
    """Angles of the tip-path plane to the hub [rad]."""

    a1: Scalar
    """back"""
    b1: Scalar
    """right"""


def lock_number(p: Helicopter) -> Scalar:
    r"""$\gamma = \rho a c R^4/I_\beta$ [1]: the air's forces over the blade's inertia."""
    return p.rho * p.a * p.c * p.R**4 / p.I_beta


def flapping_rate_constant(p: Helicopter, Omega: Scalar, B: Scalar) -> Scalar:
    r"""$1/\tau_f = \gamma B^4\Omega/16$ [1/s].

    Args:
        Omega: main rotor speed [rad/s].
        B: tip loss factor, 1 for lift up to the tip.
    """
    # The lift against a flapping rate is that of Omega r times the blade's own speed, which grows
    # with r as well; times the arm r its integral up to B R goes with B^4.
    return (lock_number(p) / 16.0 * B**4) * Omega


def speed_lift(p: Helicopter, Omega: Scalar, theta0: Scalar, inflow: Scalar, B: Scalar) -> Scalar:
    r"""$\tfrac23 B^3\theta_0\Omega R - \tfrac12 B^2\lambda\Omega R$ [m/s].

    The lift that the advancing blade has more of in a speed V, integrated along the blade, is
    $\tfrac12\rho a c R^2 V$ times this.

    Args:
        Omega: main rotor speed [rad/s].
        theta0: collective pitch [rad].
        inflow: lambda R Omega [m/s].
        B: tip loss factor, 1 for lift up to the tip.
    """
    # An advancing blade sees Omega r + V. To first order in V the pitch gives 2 Omega r V and the
    # inflow V, each times the arm r: integrated up to B R these are the 2/3 and the 1/2.
    return (2.0 / 3.0 * B**3 * p.R) * Omega * theta0 - (0.5 * B**2) * inflow


def flap_back(p: Helicopter, Omega: Scalar, lift: Scalar, B: Scalar) -> Scalar:
    r"""Return the tilt of the plane away from a speed of 1 m/s [rad s/m].

    $$\frac{1}{R\Omega}\frac{\partial a_1}{\partial\mu}
      = \frac{2 K_\mu}{R\Omega}\,\frac{1}{B^4}
      \left(\tfrac43 B^3\theta_0 - B^2\lambda\right)$$

    Args:
        p: vehicle, SI; K_mu is 1 in blade-element theory.
        Omega: main rotor speed [rad/s].
        B: tip loss factor, 1 for lift up to the tip.
    """
    # The plane tilts until the lift that its flapping takes off is the lift that the speed adds.
    # Both are moments of the same air on the same blade: density, chord and lift slope cancel.
    return (4.0 * p.K_mu / (p.R**2 * B**4)) * lift / (Omega * Omega + _STOPPED)


def first_harmonic_moment(p: Helicopter, lift: Scalar) -> Scalar:
    r"""Moment on a hub without hinges in a speed of 1 m/s [N s].

    $\tfrac12\rho a c V\Omega R^3(\tfrac23\theta_0 - \tfrac12\lambda)$, which eqs 14-15 leave out;
    like the cyclic pitch it acts with the lag of a quarter of a turn.
    """
    return (0.5 * p.K_mu * p.rho * p.a * p.c * p.R**2) * lift


def flapping_rates(
    p: Helicopter, Omega: Scalar, tilt: Tilt, driven: Tilt, m: Record, B: Scalar
) -> Tilt:
    """da1/dt and db1/dt [rad/s], the equations of the module's text.

    Args:
        Omega: main rotor speed [rad/s].
        m: the `Motion` of the body, of which p and q [rad/s] count.
        B: tip loss factor, 1 for lift up to the tip.
    """
    # The body's rates come in as they are, not by way of k: like a gyroscope the plane keeps its
    # place in space while the hub turns under it, and the air then leads it after the hub.
    k = flapping_rate_constant(p, Omega, B)
    # Omega over Omega^2 and not one over Omega: at rest there is then no precession instead of an
    # infinite one.
    turn = (0.5 * p.k_beta / p.I_beta) * Omega / (Omega * Omega + _STOPPED)
    return Tilt(
        k * (driven.a1 - tilt.a1) + turn * tilt.b1 - m.q,
        k * (driven.b1 - tilt.b1) - turn * tilt.a1 - m.p,
    )


class HubLoads(NamedTuple):
    """Loads of a tilted rotor on the body, beside its thrust along the mast."""

    forward: Scalar
    """force [N]"""
    right: Scalar
    roll: Scalar
    """moment about the centre of gravity [N m]"""
    pitch: Scalar
    yaw: Scalar


def hub_loads(p: Helicopter, T: Scalar, tilt: Tilt) -> HubLoads:
    r"""Return the in-plane forces $-T a_1$ and $T b_1$ at the hub, and $(k_\beta + T h_r)$ times
    the tilt.

    Args:
        p: vehicle, SI; k_beta is the stiffness of the whole hub.
        T: thrust of the main rotor [N].
    """
    # The hub's spring and the thrust's arm turn the body by the same tilt: the moments of one
    # flight state show their sum. k_beta by itself takes a known hr or several thrusts.
    stiffness = p.k_beta + T * p.hr
    right = T * tilt.b1
    # The mast stands lr behind the centre of gravity: a force to the right there turns the nose
    # left.
    return HubLoads(-T * tilt.a1, right, stiffness * tilt.b1, stiffness * tilt.a1, -p.lr * right)
