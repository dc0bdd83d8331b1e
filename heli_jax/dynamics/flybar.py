"""The Bell-Hiller flybar: mixing (eq. 11) and flapping (eq. 12), and the first-order bar.

Factors of parameters alone stand in brackets of their own here and in the other equations: they
are then computed once, outside the loop over time, and no division is left in it. Nothing is
divided by the rotor's speed, so that a rotor at rest is an ordinary point.
"""

import jax.numpy as jnp
import numpy as np

from heli_jax.naming import Scalar
from heli_jax.vehicle import Helicopter


def cyclic_pitch(p: Helicopter, x_cyc: Scalar, beta: Scalar) -> Scalar:
    r"""Cyclic pitch of the blades [rad], eq. 11.

    $$\theta_{cyc} L_1 = \frac{L_3}{L_2+L_3} x_{cyc} + \frac{L_2 L_4}{L_2+L_3} \beta$$

    Args:
        x_cyc: cyclic input displacement [m].
        beta: flapping angle of the flybar [rad].
    """
    # L3/(L2 + L3) is the Bell path, straight from the stick; L2 L4/(L2 + L3) the Hiller path by way
    # of the bar. L2 and L3 enter by their ratio alone: freed together they are not identifiable.
    return (1.0 / (p.L1 * (p.L2 + p.L3))) * (p.L3 * x_cyc + (p.L2 * p.L4) * beta)


def flapping_rate_gain(p: Helicopter) -> Scalar:
    r"""$k_1 = \rho \Omega^2 a c (R_2^4 - R_1^4) / (8 I_f)$ [1/s^2]: eq. 12 divided by If.

    Here and in what follows a and c are the paddle's where they are given.
    """
    return _paddle(p) * p.Omega**2


def _paddle(p: Helicopter) -> Scalar:
    # R2 is the outer and R1 the inner end of the paddle. The paper's nomenclature names them the
    # other way round, which would make the bracket, and the damping of eq. 12, negative.
    # 1/8 is one paddle: an If that is identified with eq. 12 is half the inertia of the whole bar.
    return p.rho * paddle_lift_slope(p) * paddle_chord(p) * (p.R2**4 - p.R1**4) / (8.0 * p.If)


def paddle_lift_slope(p: Helicopter) -> Scalar:
    """Lift slope of the flybar's paddle [1/rad]: the blade's `a`, as in eq. 12, unless given."""
    return _given_or(p.a_paddle, p.a)


def paddle_chord(p: Helicopter) -> Scalar:
    """Chord of the flybar's paddle [m]: the blade's `c`, as in eq. 12, unless given."""
    return _given_or(p.c_paddle, p.c)


def _given_or(value: Scalar, default: Scalar) -> Scalar:
    """A constant that may be left out (NaN), or what stands in its place then."""
    # A quick look at the equations has NumPy's scalars, which jnp would compile programs for.
    if isinstance(value, np.floating):
        return default if np.isnan(value) else value
    return jnp.where(jnp.isnan(value), default, value)


def flapping_acceleration(
    p: Helicopter, Omega: Scalar, x_cyc: Scalar, beta: Scalar, dbeta: Scalar, omega: Scalar
) -> Scalar:
    r"""Flapping acceleration of the flybar [rad/s^2], eq. 12.

    $$I_f \ddot\beta + \Omega^2 I_f \beta = \tfrac18 \rho \Omega^2 a c
      \left(\frac{x_{cyc}}{L_5} - \frac{\dot\beta + \omega}{\Omega}\right)(R_2^4 - R_1^4)$$

    Args:
        Omega: rotor speed [rad/s].
        x_cyc: cyclic input displacement [m].
        beta: flapping angle [rad], and its derivative `dbeta` [rad/s].
        omega: rate of the body about the same axis [rad/s].
    """
    # The text of the paper reads beta + omega/Omega in the bracket (dots over symbols get lost in
    # it). Only (dbeta + omega)/Omega has one unit, and only it gives c1 = k1/Omega in eq. 23.
    pull = (Omega * (1.0 / p.L5)) * x_cyc - (dbeta + omega)
    return (_paddle(p) * Omega) * pull - (Omega**2) * beta


def flybar_time_constant(p: Helicopter, Omega: Scalar) -> Scalar:
    r"""$\tau = 2/(K\Omega)$, $K = \rho a c (R_2^4 - R_1^4)/(4 I_f)$ [s].

    Two paddles and the inertia of the whole bar, where eq. 12 has one paddle.
    """
    # The same number as _paddle: two paddles, but 1/4 with K and the 2 of tau make 1/8 again.
    return 1.0 / (_paddle(p) * Omega)


def flybar_rate(p: Helicopter, Omega: Scalar, x_cyc: Scalar, beta: Scalar, omega: Scalar) -> Scalar:
    r"""Tilt rate of the flybar's plane seen from the body [rad/s]: the bar as it moves.

    $$\dot\beta = (x_{cyc}/L_5 - \beta)/\tau - \omega$$

    In place of eq. 12, with the time constant of `flybar_time_constant`.

    Args:
        Omega: rotor speed [rad/s].
        x_cyc: cyclic input displacement [m].
        beta: tilt of the bar's plane [rad].
        omega: rate of the body about the same axis [rad/s].
    """
    # Eq. 12 is an equation of the rotating frame, driven by inputs of the fixed one: at its own
    # frequency Omega the bar is in resonance, and a constant stick is far below it. Simulated in
    # the rotating frame the bar settles at x/L5; eq. 12 settles at a twentieth of that, and its
    # rate feedback is some 400 times too weak. Averaged over a turn the bar is of first order.
    return (_paddle(p) * Omega) * ((1.0 / p.L5) * x_cyc - beta) - omega
