"""The Bell-Hiller flybar: mixing (eq. 11) and flapping (eq. 12), and the first-order bar.

Here and in the other equations, factors of parameters alone have their own brackets. They are
computed once, outside the loop over time, which then has no division. No equation divides by the
rotor speed, so a rotor at rest is not singular.
"""

import jax.numpy as jnp
import numpy as np

from heli_jax.naming import Scalar
from heli_jax.vehicle import Helicopter


def cyclic_pitch(p: Helicopter, x_cyc: Scalar, beta: Scalar) -> Scalar:
    r"""Return the cyclic pitch of the blades [rad], eq. 11.

    $$\theta_{cyc} L_1 = \frac{L_3}{L_2+L_3} x_{cyc} + \frac{L_2 L_4}{L_2+L_3} \beta$$

    Args:
        x_cyc: cyclic input displacement [m].
        beta: flapping angle of the flybar [rad].
    """
    # L3/(L2 + L3) is the Bell path, straight from the stick; L2 L4/(L2 + L3) is the Hiller path,
    # through the flybar. Only the ratio of L2 and L3 matters, so they are not identifiable
    # together.
    return (1.0 / (p.L1 * (p.L2 + p.L3))) * (p.L3 * x_cyc + (p.L2 * p.L4) * beta)


def flapping_rate_gain(p: Helicopter) -> Scalar:
    r"""Return $k_1 = \rho \Omega^2 a c (R_2^4 - R_1^4) / (8 I_f)$ [1/s^2]: eq. 12 divided by If.

    Here and below, a and c are the paddle's if given.
    """
    return _paddle(p) * p.Omega**2


def _paddle(p: Helicopter) -> Scalar:
    # R2 is the outer and R1 the inner end of the paddle. The paper's nomenclature exchanges them,
    # which would make the bracket, and the damping of eq. 12, negative. 1/8 is one paddle, so an If
    # estimated with eq. 12 is half the inertia of the whole flybar.
    return p.rho * paddle_lift_slope(p) * paddle_chord(p) * (p.R2**4 - p.R1**4) / (8.0 * p.If)


def paddle_lift_slope(p: Helicopter) -> Scalar:
    """Return the paddle's lift slope [1/rad]; default: the blade's `a`, as in eq. 12."""
    return _given_or(p.a_paddle, p.a)


def paddle_chord(p: Helicopter) -> Scalar:
    """Return the paddle's chord [m]; default: the blade's `c`, as in eq. 12."""
    return _given_or(p.c_paddle, p.c)


def _given_or(value: Scalar, default: Scalar) -> Scalar:
    """Return an optional constant, or its default if it is NaN."""
    # Evaluations outside jit use NumPy scalars, for which jnp would compile programs.
    if isinstance(value, np.floating):
        return default if np.isnan(value) else value
    return jnp.where(jnp.isnan(value), default, value)


def flapping_acceleration(
    p: Helicopter, Omega: Scalar, x_cyc: Scalar, beta: Scalar, dbeta: Scalar, omega: Scalar
) -> Scalar:
    r"""Return the flapping acceleration of the flybar [rad/s^2], eq. 12.

    $$I_f \ddot\beta + \Omega^2 I_f \beta = \tfrac18 \rho \Omega^2 a c
      \left(\frac{x_{cyc}}{L_5} - \frac{\dot\beta + \omega}{\Omega}\right)(R_2^4 - R_1^4)$$

    Args:
        Omega: rotor speed [rad/s].
        x_cyc: cyclic input displacement [m].
        beta: flapping angle [rad], and its derivative `dbeta` [rad/s].
        omega: body rate about the same axis [rad/s].
    """
    # The paper's text has beta + omega/Omega in the bracket (dots over symbols are lost there).
    # Only (dbeta + omega)/Omega has consistent units, and only it gives c1 = k1/Omega in eq. 23.
    pull = (Omega * (1.0 / p.L5)) * x_cyc - (dbeta + omega)
    return (_paddle(p) * Omega) * pull - (Omega**2) * beta


def flybar_time_constant(p: Helicopter, Omega: Scalar) -> Scalar:
    r"""Return $\tau = 2/(K\Omega)$, $K = \rho a c (R_2^4 - R_1^4)/(4 I_f)$ [s].

    It has two paddles and the inertia of the whole flybar, where eq. 12 has one paddle.
    """
    # The same factor as _paddle: two paddles, but 1/4 in K and 2 in tau give 1/8 again.
    return 1.0 / (_paddle(p) * Omega)


def flybar_rate(p: Helicopter, Omega: Scalar, x_cyc: Scalar, beta: Scalar, omega: Scalar) -> Scalar:
    r"""Return the tilt rate of the flybar's plane relative to the body [rad/s].

    $$\dot\beta = (x_{cyc}/L_5 - \beta)/\tau - \omega$$

    It replaces eq. 12, with the time constant of `flybar_time_constant`.

    Args:
        Omega: rotor speed [rad/s].
        x_cyc: cyclic input displacement [m].
        beta: tilt of the flybar's plane [rad].
        omega: body rate about the same axis [rad/s].
    """
    # Eq. 12 is in the rotating frame, but its inputs are in the fixed one. The flybar is in
    # resonance at Omega, while a constant stick is far below it. A simulation in the rotating frame
    # settles at x/L5. Eq. 12 settles at a twentieth of that, and its rate feedback is about 400
    # times too weak. Averaged over a turn, the flybar is of first order.
    return (_paddle(p) * Omega) * ((1.0 / p.L5) * x_cyc - beta) - omega
