r"""Forces and moments of the rotors: eqs 10 and 13 to 20.

Airspeeds are in m/s instead of the paper's ratios to R Omega ($\mu$, $\nu$, $\lambda$). No equation
divides by the rotor speed, so a rotor at rest is not singular.

The induced velocity covers all axial flow: climb, hover, vortex ring, windmill. Momentum theory
gives $2 v_i s = T/(\rho\pi R^2)$ with the flow $s = \sqrt{V^2 + (W + v_i)^2}$ through the rotor. In
a descent between half and twice the induced velocity it has three roots or the wrong one. The wake
is then a ring or turbulent, and measured rotors have more flow. Here a separate term adds that
flow,

$$s^2 = V^2 + (W + v_i)^2 + k\,\frac{q^2}{v_i^2 + k_V V^2},\qquad
  q = \max\left(0, (-W - \tfrac12 v_i)(\tfrac{11}{5} v_i + W)\right),$$

It is zero outside the range and has a continuous first derivative at its ends. One curve with one
root therefore joins hover and the windmill brake. k = 0.37 and k_V = 5.8 are fitted to the measured
curve of W. Johnson (NASA TP-2005-213477, and the theory of NDARC, NASA TP-2009-215402): in units of
the induced velocity of hover, $W + v_i = W(0.373 W^2 + 0.598 V^2 - 0.991)$ where
$1.5 V^2 + (2W + 3)^2 < 1$. The fit is within 8 %, and within 4 % where no air flows through the
rotor (W = -1.63, autorotation).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from heli_jax.naming import Scalar
from heli_jax.vehicle import Helicopter


class Flow(NamedTuple):
    """Air flow at a rotor."""

    V2: Scalar
    """Squared speed in the rotor plane, (mu R Omega)^2 [m^2/s^2]."""
    W: Scalar
    """Speed through the rotor against its thrust, -nu R Omega [m/s]."""
    edgewise: Scalar
    """mu R Omega times the effective cyclic pitch [rad m/s]; see `thrust`."""


class RotorForce(NamedTuple):
    """Thrust of a rotor and the corresponding flow."""

    T: Scalar
    """Thrust [N]."""
    inflow: Scalar
    """lambda R Omega, the total flow through the rotor [m/s]."""
    vi: Scalar
    """Induced velocity [m/s]."""
    T0: Scalar
    """Thrust without induced velocity over rho pi R^2 [m^2/s^2]."""


def solidity(R: Scalar, c: Scalar) -> Scalar:
    r"""Return the solidity $\sigma = 2c/(\pi R)$ [1]."""
    # N c R over the area pi R^2 with two blades, as for both rotors of the paper. Another number of
    # blades needs an equivalent chord.
    return (2.0 / math.pi) * c / R


def cyclic_moment(p: Helicopter, Omega: Scalar, theta_cyc: Scalar) -> Scalar:
    r"""Return the rotor's roll or pitch moment for a cyclic blade angle, eqs 14-15 [N m].

    $$M = \tfrac12 \rho \Omega^2 a c R^4 \theta_{cyc}$$

    The factor 1/2 is the parameter `cyclic_moment`. Blade-element theory averaged over a turn
    gives 1/8 for two blades, so an inertia estimated with 1/2 is valid only in this model.

    Args:
        Omega: main rotor speed [rad/s].
        theta_cyc: cyclic pitch of the blades [rad], eq. 11.
    """
    # The default is the paper's 1/2, not 1/8: only with it are its Ixx and a comparable. Rates do
    # not enter here, although a rotor damps the body by -omega/Omega: see `hub_moment`.
    return (p.cyclic_moment * p.rho * p.a * p.c * p.R**4) * Omega**2 * theta_cyc


def hub_moment(p: Helicopter, Omega: Scalar, theta_cyc: Scalar, omega: Scalar) -> Scalar:
    r"""Return the roll or pitch moment of a hingeless two-bladed rotor, averaged over a turn [N m].

    $$M = \tfrac18 \rho \Omega^2 a c R^4 (\theta_{cyc} - \omega/\Omega)$$

    It replaces eqs 14-15, with the factor of blade-element theory and the rotor's damping.

    Args:
        Omega: main rotor speed [rad/s].
        theta_cyc: cyclic pitch of the blades [rad], eq. 11.
        omega: body rate about the same axis [rad/s].
    """
    # Omega^2 (theta - omega/Omega) without division is finite and smooth for a rotor at rest.
    return (0.125 * p.rho * p.a * p.c * p.R**4) * Omega * (Omega * theta_cyc - omega)


def thrust(
    p: Helicopter,
    Omega: Scalar,
    theta0: Scalar,
    flow: Flow,
    vi: Scalar | None = None,
) -> RotorForce:
    r"""Return the main rotor's thrust, eq. 13, with the inflow of momentum theory.

    $$T = \tfrac12\rho\pi R^4\Omega^2 a\sigma
      \left[\tfrac{B^3}{3}\theta_0 - \tfrac{B^2}{2}\lambda +
      \tfrac{B^2}{2}\mu\,\theta_{edge}\right], \qquad \lambda = -\nu + \frac{v_i}{R\Omega}$$

    `flow.edgewise` is $\mu R\Omega\,\theta_{edge}$; in the paper $\theta_{edge} = (x_{roll} +
    x_{pitch})/L_1$.

    Args:
        Omega: main rotor speed [rad/s].
        theta0: collective pitch [rad], eq. 18.
        vi: induced velocity [m/s], given for dynamic inflow; default: computed.
    """
    # Blade-element theory has another term B/2 mu^2 theta0 in the bracket, which the paper drops.
    # The tests' quadrature agrees with eq. 13 except for that term.
    half = 0.5 * p.a * solidity(p.R, p.c)
    b = (half * 0.5 * p.B**2 * p.R) * Omega
    # T over rho pi R^2 is linear in vi: T0 - b vi. Momentum theory, which the paper omits,
    # therefore couples thrust and inflow in one scalar equation.
    lifting = (half * p.B**3 / 3.0 * p.R**2) * Omega**2 * theta0 + b * flow.edgewise
    T0 = lifting - b * flow.W
    if vi is None:
        vi = induced_velocity(flow.V2, flow.W, T0, b)
    return RotorForce((p.rho * math.pi * p.R**2) * (T0 - b * vi), flow.W + vi, vi, T0)


def torque(p: Helicopter, Omega: Scalar, theta0: Scalar, flow: Flow, inflow: Scalar) -> Scalar:
    r"""Return the main rotor's torque [N m], the bracket of eq. 10.

    $$Q = \rho\pi R^5\Omega^2\left[\tfrac18\sigma C_{d0} + \tfrac12 a\sigma\lambda
      \left(\tfrac{B^3}{3}\theta_0 - \tfrac{B^2}{2}\lambda +
      \tfrac{B^2}{4}\mu\,\theta_{edge}\right)\right]$$

    Args:
        Omega: main rotor speed [rad/s].
        theta0: collective pitch [rad], eq. 18.
        inflow: lambda R Omega [m/s], from `thrust` for the same flow.
    """
    # B^2/4 before mu here and B^2/2 in eq. 13 are both right; the quadrature confirms it.
    sigma = solidity(p.R, p.c)
    scale = p.rho * math.pi * p.R**3
    lifting = (p.B**3 / 3.0 * p.R) * Omega * theta0 - (0.5 * p.B**2) * inflow
    induced = inflow * (lifting + (0.25 * p.B**2) * flow.edgewise)
    # The second part changes sign if air comes from below. It then drives the rotor, as in
    # autorotation. The first part, profile drag, always brakes.
    return (scale * sigma * p.Cd0 / 8.0 * p.R**2) * Omega**2 + (scale * 0.5 * p.a * sigma) * induced


def tail_moment(p: Helicopter, Omega: Scalar, theta0T: Scalar) -> Scalar:
    r"""Return the tail rotor's yaw moment [N m], eqs 16 and 20; `Omega` is the main rotor's speed.

    $$M_\psi = \tfrac12\rho\pi R_T^4\Omega_T^2 a_T\sigma_T\tfrac{B^3}{3}\theta_{0T}L_T,
      \qquad \Omega_T = K_\Omega\Omega$$

    Args:
        Omega: main rotor speed [rad/s].
        theta0T: blade pitch of the tail rotor [rad], eq. 17.
    """
    # Without inflow a yaw rate has no effect, so the heading is undamped. See `tail_thrust`.
    scale = 0.5 * p.rho * math.pi * p.R_T**4 * p.a_T * solidity(p.R_T, p.c_T) * p.B**3 / 3.0
    return (scale * p.L_T * p.K_Omega**2) * Omega**2 * theta0T


def tail_thrust(
    p: Helicopter,
    Omega: Scalar,
    theta0T: Scalar,
    V2: Scalar,
    W: Scalar,
) -> RotorForce:
    r"""Return the tail rotor's thrust with inflow, which replaces eq. 16's.

    $$T_T = \tfrac12\rho\pi R_T^4\Omega_T^2 a_T\sigma_T
      \left[\tfrac{B^3}{3}\theta_{0T} - \tfrac{B^2}{2}\lambda_T\right]$$

    Args:
        Omega: main rotor speed [rad/s].
        theta0T: blade pitch of the tail rotor [rad], eq. 17.
        V2: squared speed in the tail rotor's plane [m^2/s^2].
        W: speed against its thrust [m/s].
    """
    # Two terms instead of three, since there is no cyclic pitch to act with the edgewise flow. The
    # speed V2 acts only through the induced velocity.
    half = 0.5 * p.a_T * solidity(p.R_T, p.c_T)
    b = (half * 0.5 * p.B**2 * p.R_T * p.K_Omega) * Omega
    T0 = (half * p.B**3 / 3.0 * (p.R_T * p.K_Omega) ** 2) * Omega**2 * theta0T - b * W
    vi = induced_velocity(V2, W, T0, b)
    return RotorForce((p.rho * math.pi * p.R_T**2) * (T0 - b * vi), W + vi, vi, T0)


def tail_torque(p: Helicopter, Omega: Scalar, theta0T: Scalar, inflow: Scalar) -> Scalar:
    r"""Return the tail rotor's torque on its own shaft [N m]: eq. 10's bracket without edgewise
    flow.

    $$Q_T = \rho\pi R_T^5\Omega_T^2\left[\tfrac18\sigma_T C_{d0} + \tfrac12 a_T\sigma_T\lambda_T
      \left(\tfrac{B^3}{3}\theta_{0T} - \tfrac{B^2}{2}\lambda_T\right)\right]$$

    Its blades have the drag coefficient of the main rotor.

    Args:
        Omega: main rotor speed [rad/s].
        theta0T: blade pitch of the tail rotor [rad].
        inflow: lambda_T R_T Omega_T [m/s].
    """
    sigma = solidity(p.R_T, p.c_T)
    scale = p.rho * math.pi * p.R_T**3 * sigma
    lifting = (p.B**3 / 3.0 * p.R_T * p.K_Omega) * Omega * theta0T - (0.5 * p.B**2) * inflow
    # The same two parts as in `torque`: profile drag grows with the squared rotor speed, and the
    # rest is power given to the air.
    drag = (scale * p.Cd0 / 8.0 * (p.R_T * p.K_Omega) ** 2) * Omega**2
    return drag + (scale * 0.5 * p.a_T) * inflow * lifting


def inflow_rate(p: Helicopter, force: RotorForce, through: Scalar) -> Scalar:
    r"""Return the acceleration of the induced velocity [m/s^2] with the inertia of the air.

    $$0.637\cdot\tfrac43\rho\pi R^3\,\dot v_i
      = T - 2\rho\pi R^2 v_i\sqrt{V^2 + (W + v_i)^2}$$

    Source: Carpenter and Fridovich, NACA TN 3044 (1953).

    Args:
        through: the flow sqrt(V^2 + (W + v_i)^2) through the rotor [m/s].
    """
    # 0.637 is from the source: the effective part of a sphere of air with the rotor's radius.
    area = math.pi * p.R**2
    # Dividing by rho pi R^2 leaves a length instead of the air's mass, so the inflow's time
    # constant does not depend on density. The equilibrium is the equation of `induced_velocity`.
    excess = (1.0 / (p.rho * area)) * force.T - 2.0 * force.vi * through
    return (1.0 / (0.637 * 4.0 / 3.0 * p.R)) * excess


_STEPS = 7
"""Newton steps; over the whole range six reach 1e-7 and seven the last digit."""
_REST = 1e-8
"""Smallest flow [m/s], which gives the square root a derivative at rest."""
_BEGINS, _ENDS = 0.5, 2.2
"""Range of descent speed over induced velocity in which the wake is no stream tube."""
# Fitted with the two ends above, which set the shape of q. New ends need a new fit of both numbers.
_K, _K_V = 0.37, 5.8


def _flow2(v: Scalar, V2: Scalar, W: Scalar) -> tuple[Scalar, Scalar]:
    """Return the squared flow through the rotor [m^2/s^2] and its derivative by v [m/s]."""
    below, above = -W - _BEGINS * v, _ENDS * v + W
    # The term is squared, so setting q to zero outside the range keeps the first derivative
    # continuous. Newton's steps and a fit's gradients need that.
    product = below * above
    inside = product > 0
    q = jnp.where(inside, product, 0.0)
    dq = jnp.where(inside, _ENDS * below - _BEGINS * above, 0.0)
    ratio = q / (v * v + _K_V * V2 + _REST**2)
    w = W + v
    slope = 2.0 * w + 2.0 * _K * ratio * (dq - v * ratio)
    return V2 + w * w + _K * ratio * q + _REST**2, slope


def mass_flow(v: Scalar, V2: Scalar, W: Scalar) -> Scalar:
    """Return the flow s through the rotor [m/s], as defined in the module's docstring.

    Args:
        v: induced velocity, with the sign of the thrust [m/s].
        V2: squared airspeed in the rotor plane [m^2/s^2].
        W: airspeed through the rotor against the thrust, positive in climb [m/s].
    """
    # The sign is that of v, since with dynamic inflow v is a state and no thrust is known here.
    sign = jnp.where(v < 0, -1.0, 1.0).astype(jnp.result_type(v))
    return jnp.sqrt(_flow2(sign * v, V2, sign * W)[0])


@jax.custom_jvp
def induced_velocity(V2: Scalar, W: Scalar, T0: Scalar, b: Scalar) -> Scalar:
    r"""Return the single root $v_i$ [m/s] of $2 v_i s = T_0 - b v_i$; it has T0's sign.

    Args:
        V2: squared airspeed in the rotor plane [m^2/s^2].
        W: airspeed through the rotor against the thrust, positive in climb [m/s].
        T0: thrust without induced velocity over rho pi R^2 [m^2/s^2].
        b: reduction of T0 by an induced velocity of 1 m/s, zero or more [m/s].

    The derivative, of any order and in both modes, is that of the implicit function.
    """
    # A negative thrust is a positive one, mirrored.
    sign = jnp.where(T0 < 0, -1.0, 1.0).astype(jnp.result_type(T0))
    c, t = sign * W, sign * T0
    # Start slightly above the root, from three closed forms: edgewise flow, climb and hover, and
    # the windmill state beyond the wake's range. Plain Newton steps converge from there. A bracket
    # would undo the last step through rounding.
    along = t / (2.0 * jnp.sqrt(V2 + _REST**2) + b + _REST)
    x = jnp.minimum(_climbing(c, t, b), along)
    windmill = _windmill(c, t, b)
    x = jnp.where(_ENDS * windmill < -c, jnp.minimum(windmill, x), x)
    # A fixed number of steps gives all vehicles of a batch the same path, which XLA fuses with the
    # rest.
    for _ in range(_STEPS):
        s2, ds2 = _flow2(x, V2, c)
        s = jnp.sqrt(s2)
        # Numerator and denominator times s, so that a step has one division instead of two.
        x = x - s * (2.0 * x * s + b * x - t) / (2.0 * s2 + x * ds2 + b * s)
    return sign * x


def _climbing(c: Scalar, t: Scalar, b: Scalar) -> Scalar:
    """Return the root v [m/s] of 2 v (c + v) = t - b v: vertical climb and hover."""
    q = 2.0 * c + b
    root = jnp.sqrt(q * q + 8.0 * t) + _REST
    # Two forms of the same root; each avoids the other's cancellation.
    return jnp.where(q > 0, 2.0 * t / (jnp.abs(q) + root), 0.25 * (root - q))


def _windmill(c: Scalar, t: Scalar, b: Scalar) -> Scalar:
    """Return the smaller root v [m/s] of 2 v (-c - v) = t - b v (fast descent), or infinity."""
    q = b - 2.0 * c
    inside = q * q - 8.0 * t
    there = (q > 0) & (inside > 0)
    root = jnp.sqrt(jnp.where(there, inside, 0.0))
    return jnp.where(there, 2.0 * t / (jnp.abs(q) + root + _REST), jnp.inf)


@induced_velocity.defjvp
def _induced_velocity_jvp(
    primals: tuple[Scalar, ...], tangents: tuple[Scalar, ...]
) -> tuple[Scalar, Scalar]:
    V2, W, T0, b = primals
    dV2, dW, dT0, db = tangents
    v = induced_velocity(*primals)
    # The sign of T0, while `mass_flow` uses that of v: they agree, and both vanish at zero.
    sign = jnp.where(T0 < 0, -1.0, 1.0).astype(jnp.result_type(T0))
    x, c = sign * v, sign * W
    s2, ds2 = _flow2(x, V2, c)
    s = jnp.sqrt(s2)
    below, above = -c - _BEGINS * x, _ENDS * x + c
    q = jnp.where(below * above > 0, below * above, 0.0)
    ratio = q / (x * x + _K_V * V2 + _REST**2)
    # Derivatives of s^2 by V2 and by c. In F = 2 x s + b x - t they appear with 2 ds = d(s^2)/s,
    # hence x/s below. `slope` is the derivative of F by x.
    by_V2 = 1.0 - _K * _K_V * ratio * ratio
    by_c = 2.0 * (c + x) + 2.0 * _K * ratio * jnp.where(q > 0, below - above, 0.0)
    slope = 2.0 * s + x * ds2 / s + b
    moved = sign * dT0 - x * db - (x / s) * (by_V2 * dV2 + by_c * sign * dW)
    return v, sign * moved / slope
