"""Biases and initial states for a simulation in time of what was fitted otherwise."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax.identification.estimation.output_error import ESTIMATOR as OUTPUT_ERROR
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack


@eqx.filter_jit
def in_time(layout: Layout, data: Data, noise: Noise, z: Array) -> Array:
    """z with the biases, offsets and initial states by which the simulation is nearest in time: for
    methods in whose rows they are not.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: with standard deviations by flight and output.
        z: the unknowns.
    """
    first = layout.first_nuisance
    if first == z.shape[0]:
        return z

    def rows(part: Array) -> Array:
        u = unpack(layout, data, z.at[first:].set(part))
        return jnp.concatenate([OUTPUT_ERROR.residuals(layout, data, noise, u).rows, part])

    # Linear in them: one step is enough.
    r, J = rows(z[first:]), jax.jacfwd(rows)(z[first:])
    step = jnp.linalg.lstsq(J, -r)[0]
    # The simulation of an unstable machine over a whole record is no number: left as it is.
    return z.at[first:].add(jnp.where(jnp.all(jnp.isfinite(step)), step, 0.0))
