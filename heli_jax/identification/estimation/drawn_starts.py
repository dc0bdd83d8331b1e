"""Starts about the given one, drawn within the bounds."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.problem import Free, Problem
from heli_jax.identification.unknowns import transforms as coordinates
from heli_jax.identification.unknowns.layout import Layout


def draw(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], starts: int, seed: int
) -> Float[Array, "s q"]:
    """Starts (s, q): the first is z0, the others differ in the free parameters.

    Between two bounds of one sign the draw is uniform in log, between two of different sign
    uniform; elsewhere log-normal about the start, a factor of three wide or as wide as the prior,
    and of either sign where that may be any.

    Args:
        layout: what the unknowns are.
        problem: with the free parameters' bounds and priors.
        z0: the first start.
        starts: how many, the first included.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    rows = np.tile(np.asarray(z0, dtype=np.float64), (max(starts, 1), 1))
    dtype = z0.dtype
    for i, (free, kind) in enumerate(zip(problem.free.values(), layout.kinds, strict=True)):
        values = jnp.asarray(_draw_values(free, rows.shape[0] - 1, rng), dtype)
        sign = jnp.asarray(coordinates.sign_or_scale(free), dtype)
        low, high = (jnp.asarray(b, dtype) for b in coordinates.limits(free))
        rows[1:, i] = np.asarray(coordinates.to_coordinate(kind, values, sign, low, high))
    return jnp.asarray(rows, dtype)


def _draw_values(free: Free, size: int, rng: np.random.Generator) -> np.ndarray:
    # Off the bounds, where a bounded coordinate has no slope left.
    share = rng.uniform(0.02, 0.98, size)
    low, high = free.lower, free.upper
    if low is not None and high is not None:
        if low * high > 0:
            return low * (high / low) ** share
        return low + (high - low) * share
    width = 1.1  # e^1.1 is a factor of three
    if free.prior is not None and free.prior.mean:
        # Twice the prior: a start beyond would only be pulled back.
        width = min(width, 2.0 * free.prior.sd / abs(free.prior.mean))
    # Log-normal: a parameter of physics is more likely wrong by a factor than by an amount, and
    # keeps its sign.
    values = free.start * np.exp(width * rng.standard_normal(size))
    if coordinates.changes_sign(free):
        values = _either_sign(free, width, rng.standard_normal((2, size)))
    # A single bound does not shape the draw: what lies beyond it begins at the start value instead.
    return np.where([coordinates.inside(free, float(v)) for v in values], values, free.start)


def _either_sign(free: Free, width: float, drawn: np.ndarray) -> np.ndarray:
    """Values of the start's size; about the prior's mean where there is one, which knows more."""
    if free.prior is not None:
        return free.prior.mean + 2.0 * free.prior.sd * drawn[0]
    return coordinates.scale(free) * np.exp(width * drawn[0]) * np.sign(drawn[1])
