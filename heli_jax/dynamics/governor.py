r"""The motor's throttle: the stick's, or that of a governor that holds the rotor's speed.

$$x_g = K_P(\Omega_{ref} - \Omega) + i_g,\qquad
  \dot i_g = K_I\left[(\Omega_{ref} - \Omega) + (\mathrm{sat}\,x_g - x_g)/K_P\right]$$

with $x_g$ held within 0 and 1, and the integral led back while it is (Astrom and Hagglund, PID
Controllers, 1995: back-calculation). Its form and the X-Cell's gains are those of Gavrilets (MIT
thesis, 2003).
"""

import jax.numpy as jnp

from heli_jax.naming import Scalar
from heli_jax.vehicle import Helicopter


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
