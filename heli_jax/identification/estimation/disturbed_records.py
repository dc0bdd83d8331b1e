"""Records of a fitted model with the disturbance drawn anew."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.model import correlation_of, initial_sd_of
from heli_jax.identification.estimation.simulated_flights import Drive, driven
from heli_jax.identification.unknowns.layout import Layout, Solution, Unknowns
from heli_jax.simulation.simulate import simulate

_BATCH = 8
"""records that are drawn side by side"""


def disturbed_records(reached: Solution, u: Unknowns, i: int, keys: Array) -> dict[str, Array]:
    """By name the outputs (runs, N) with a disturbance drawn for each key.

    Args:
        reached: where the fit ended.
        u: the unknowns there.
        i: number of the flight.
        keys: of the draws.
    """
    layout, drive = reached.layout, driven(reached.layout, reached.data, u, i)
    drawn_state = _random_first_state(layout, drive, reached.z.dtype)

    @jax.jit
    def run(key: Array) -> Any:
        of_first, of_noise = jax.random.split(key)
        return simulate(
            layout.model,
            drive.params,
            drive.inputs,
            dt=drive.dt,
            initial_state=drawn_state(of_first),
            solver=layout.solver,
            substeps=layout.substeps,
            key=of_noise,
            hold=layout.hold(i),
        ).outputs

    return naming.asdict(jax.lax.map(run, keys, batch_size=_BATCH))


def _random_first_state(layout: Layout, drive: Drive, dtype: np.dtype) -> Callable[[Array], Any]:
    """Of a key the State at the first sample, with what is random there drawn."""
    model, params = layout.model, drive.params
    first = drive.state if drive.state is not None else model.initial_state(params)
    names = naming.names(model.State)
    sds = initial_sd_of(model, params, dtype)
    # Factored without the sds, which may be zero.
    factor = sds[:, None] * jnp.linalg.cholesky(correlation_of(model, params, dtype))

    def draw(key: Array) -> Any:
        drawn = jnp.sum(factor * jax.random.normal(key, (1, len(names)), dtype), axis=1)
        values = {n: getattr(first, n) + drawn[names.index(n)] for n in model.random_states}
        return naming.replace(first, **values)

    return draw
