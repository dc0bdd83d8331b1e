"""Several starts where a delay is free: a misfit has a valley for each period of the motion by
which a delay is wrong, and one start may end in the wrong one."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.problem import Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Layout

_STEPS = (-0.15, -0.05, 0.05, 0.15)
"""from the start value [s]: a delay that may change its sign"""
_FACTORS = (0.2, 0.5, 2.0, 4.0)
"""of the start value: one that is positive, or between bounds"""


def delay_starts(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], seed: int
) -> Float[Array, "s q"]:
    """Starts (s, q): z0 alone, or where delays are free z0 and four that differ in them alone.

    Args:
        layout: what the unknowns are.
        problem: with the free parameters and the model that says which are delays.
        z0: the first start.
        seed: of how the values of several delays are put together.
    """
    late = [n for n in problem.model.delay_parameters if n in problem.free]
    if not late:
        return z0[None, :]
    # Only delays differ between the starts: the other parameters have no valleys of this kind, and
    # what differs in the ends is then due to the delay alone.
    rng = np.random.default_rng(seed)
    rows = np.tile(np.asarray(z0, np.float64), (1 + len(_STEPS), 1))
    for name in late:
        i, free = layout.free.index(name), problem.free[name]
        low, high = transforms.limits(free)
        # A Latin square: each value of each delay once, whatever the others are.
        values = rng.permutation(_values(free))
        scale = transforms.sign_or_scale(free)
        rows[1:, i] = np.asarray(
            transforms.to_coordinate(layout.kinds[i], values, scale, low, high)
        )
    return jnp.asarray(rows, z0.dtype)


def _values(free: Free) -> np.ndarray:
    low, high = transforms.limits(free)
    if np.isfinite(low) and np.isfinite(high):
        # Off the bounds, at which a bounded coordinate is infinite.
        return low + (high - low) * np.array([0.1, 0.35, 0.65, 0.9])
    if transforms.changes_sign(free):
        return free.start + np.array(_STEPS)
    values = free.start * np.array(_FACTORS)
    # What a bound shuts out begins at the start value instead.
    return np.where([transforms.inside(free, float(v)) for v in values], values, free.start)
