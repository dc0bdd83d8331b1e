"""Minimum of a function within limits, by an augmented Lagrangian and L-BFGS-B."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_ROUNDS, _TOLERANCE = 12, 1e-3
"""Rounds of multipliers, and change of the function and excess of a limit at which they end."""


class Minimum(NamedTuple):
    """Result of a search."""

    x: np.ndarray
    converged: bool
    steps: int


def lagrangian(
    value: Float[Array, ""], excess: Float[Array, " m"], multipliers: Array, penalty: Array
) -> Float[Array, ""]:
    """Return the augmented Lagrangian of a value and the excess over m limits."""
    active = jnp.maximum(multipliers + penalty * excess, 0.0)
    return value + jnp.sum(jnp.square(active) - jnp.square(multipliers)) / (2.0 * penalty)


def minimise(
    augmented: Callable[[Any, Any, Any], Any],
    x: np.ndarray,
    limits: int,
    bounds: Sequence[tuple[float, float]],
    max_steps: int,
    tolerance: float = 1e-7,
) -> Minimum:
    """Return the minimum with no excess.

    Args:
        augmented: function of x, multipliers and penalty; returns ((`lagrangian`, excess), slope).
        x: start (n,).
        limits: number of limits.
        bounds: lowest and highest value of each x.
        max_steps: most steps of all rounds.
        tolerance: relative change of the function in a step at which a round ends.
    """
    from scipy.optimize import minimize  # commands that do not search need not wait for it

    multipliers, penalty, steps, before = np.zeros(limits), 10.0, 0, np.inf

    def cost(x: np.ndarray, *of_round: Any) -> tuple[float, np.ndarray]:
        (value, _), slope = augmented(x, *of_round)
        return float(value), np.asarray(slope, float)

    for _ in range(_ROUNDS):
        found = minimize(
            cost,
            x,
            args=(multipliers, penalty),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": max_steps - steps, "ftol": tolerance, "gtol": 10.0 * tolerance},
        )
        x, steps = found.x, steps + int(found.nit)
        if not limits:
            break
        excess = np.asarray(augmented(x, multipliers, penalty)[0][1])
        value = float(found.fun)
        if steps >= max_steps or (np.all(excess < _TOLERANCE) and abs(before - value) < _TOLERANCE):
            break
        multipliers = np.maximum(multipliers + penalty * excess, 0.0)
        penalty, before = 2.0 * penalty, value
    return Minimum(np.clip(x, *np.array(bounds).T), steps < max_steps, steps)
