"""The unknowns that a method in frequency does not see, from the simulation in time."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.numerics.jitted import jitted

_STEPS = 20
"""at most, for models that are not linear"""
_DAMPED = (0.0, 0.01, 1.0, 100.0)
"""damping (Marquardt's) of the steps that are tried beside one another"""
_ENOUGH = 1e-4
"""part of the cost that a step has to gain for another one to be made"""


def in_time(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Float[Array, " q"]:
    """z with the biases, offsets and initial states by which the simulation is nearest in time."""
    if layout.first_nuisance == z.shape[0]:
        return z
    # Of a linear model one step is enough.
    for _ in range(1 if layout.model.linear else _STEPS):
        z, gained = _step(layout, data, noise, z)
        if not float(gained) > _ENOUGH:
            break
    return z


@jitted
def _step(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, Array]:
    """The best of a few damped steps of Gauss and Newton, and the part of the cost it gains."""
    first = layout.first_nuisance

    def rows(part: Array) -> Array:
        u = unpack(layout, data, z.at[first:].set(part))
        return jnp.concatenate([OUTPUT_ERROR.residuals(layout, data, noise, u).rows, part])

    part = z[first:]
    r, J = rows(part), jax.jacfwd(rows)(part)
    sizes = jnp.diag(jnp.linalg.norm(J, axis=0))
    below = jnp.zeros_like(part)

    def tried(damping: Array) -> tuple[Array, Array]:
        stacked = jnp.concatenate([J, jnp.sqrt(damping) * sizes])
        step = jnp.linalg.lstsq(stacked, -jnp.concatenate([r, below]))[0]
        cost = jnp.sum(rows(part + step) ** 2)
        # The simulation of an unstable machine over a whole record may be no number.
        return step, jnp.where(jnp.isfinite(cost), cost, jnp.inf)

    dampings = _DAMPED[:1] if layout.model.linear else _DAMPED
    steps, costs = jax.lax.map(tried, jnp.asarray(dampings, z.dtype))
    best, before = jnp.argmin(costs), jnp.sum(r**2)
    better = costs[best] < before
    gained = jnp.where(better, 1.0 - costs[best] / before, 0.0)
    return z.at[first:].add(jnp.where(better, steps[best], 0.0)), gained
