"""Where the search for a trim begins: momentum theory in hover, and the size of each unknown."""

from typing import Any

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.model import Model

# The constants are a class of the user's, of numbers, arrays or tracers: `Any` below.


def first_guess(
    model: Model, p: Any, climb: Any, power_off: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Start and size of the unknowns: the rotor at its nominal speed, carrying the weight.

    Args:
        model: the full nonlinear model of a helicopter.
        climb: [m/s].
        power_off: whether the climb is found with the motor off.
    """
    # Momentum theory in hover, then blade-element theory solved for the collective pitch.
    area = jnp.pi * p.R**2
    vi = jnp.sqrt(p.m * p.g / (2.0 * p.rho * area))
    tip = p.R * p.Omega
    sigma = 2.0 * p.c / (jnp.pi * p.R)
    loading = 2.0 * p.m * p.g / (p.rho * area * tip**2 * p.a * sigma)
    # In autorotation hardly anything goes through the rotor.
    inflow = 0.0 * tip if power_off else (vi + climb) / tip
    theta0 = 3.0 / p.B**3 * (loading + 0.5 * p.B**2 * inflow)
    stick = theta0 / p.K_theta0
    guess = {
        "Omega": p.Omega, "vi": vi, "climb": -1.7 * vi,
        "x_collective": stick, "x_throttle": stick, "x_yaw": -0.5 * stick,
    }  # fmt: skip
    sizes = {
        "Omega": p.Omega, "vi": vi, "climb": vi, "governor": 0.5,
        "x_collective": stick, "x_throttle": stick, "x_yaw": stick,
        "x_roll": 0.1 * p.L1, "x_pitch": 0.1 * p.L1,
    }  # fmt: skip
    if "x_collective" in naming.names(model.Inputs):
        # The throttle that carries induced and half as much of other power; the governor's stick
        # asks for the whole speed.
        power = 1.5 * p.m * p.g * vi / (p.Ir * p.K_throttle * p.Omega)
        governed = "governor" in naming.names(model.State)
        guess |= {"x_throttle": 1.0 if governed else power, "governor": power}
        guess["governor"] = 0.0 if power_off else power
        sizes |= {"x_throttle": 0.5}
    return guess, sizes
