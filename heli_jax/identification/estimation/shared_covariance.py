"""Flights of one linear model side by side: their Kalman filters differ in the states alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.kalman import Innovations, first_covariance
from heli_jax.identification.estimation.measured_signals import measurement_sd
from heli_jax.identification.estimation.simulated_flights import Drive, driven
from heli_jax.identification.estimation.steady_gain import Gaussian, Records, filtered_records
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns
from heli_jax.simulation.discretize import process_noise
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.stepping import held_columns


def innovations_together(
    layout: Layout, data: Data, noise: Noise, u: Unknowns, group: tuple[int, ...]
) -> list[Innovations]:
    """The innovations of flights that share their covariances, flight after flight.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements, by flight and output.
        u: the unknowns, in the units of the model.
        group: the numbers of the flights, one of `Layout.one_covariance`.
    """
    names = layout.outputs[group[0]]
    measured = [{n: data.flights[i].outputs[n] - u.biases[i][n] for n in names} for i in group]
    drives = [driven(layout, data, u, i) for i in group]
    system, U, acting = _system(layout, drives, noise, u, group)
    dtype = U.dtype
    y = jnp.stack([_columns([by_name[n] for by_name in measured]) for n in names], axis=2)
    x0 = jnp.stack([_first_state(layout, drive, dtype) for drive in drives])
    error, variance = filtered_records(system, Records(U, acting, y, x0))
    # Shorter records were filled up behind their end. A filter only looks back, so nothing of that
    # reaches the samples before it.
    lengths = [by_name[names[0]].shape[0] for by_name in measured]
    return [
        Innovations(
            {n: error[:N, j, k] for k, n in enumerate(names)},
            {n: variance[:N, k] for k, n in enumerate(names)},
        )
        for j, N in enumerate(lengths)
    ]


def _system(
    layout: Layout, drives: list[Drive], noise: Noise, u: Unknowns, group: tuple[int, ...]
) -> tuple[Gaussian, Array, Array]:
    """The model as the filter takes it, what B multiplies and the inputs that act, (N, m, .)."""
    # Parameters, sample time and holds are the same in all, or they were no group.
    model, params, dt = layout.model, drives[0].params, drives[0].dt
    names = layout.outputs[group[0]]
    inputs = jax.tree.map(lambda *v: _columns(v), *(drive.inputs for drive in drives))
    first, hold = drives[0].inputs, layout.hold(group[0])
    model = between_samples(layout.model, first, first, hold).model

    def held(inputs: Any) -> Any:
        _, inputs, linear = between_samples(layout.model, inputs, inputs, hold)
        return held_columns(model, params, inputs, dt, u.shift, linear)

    # The matrices come out once and not by record: they do not depend on the inputs, and that they
    # are the same in all flights is what makes these a group.
    Ad, B, U, acting = jax.vmap(held, -1, (None, None, 1, 1))(inputs)
    _, _, C, D = jacobians(model, params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in names])
    Q = process_noise(model, params, dt)
    # The scales are unknowns of the fit and common to all flights, so they may stand in R.
    R = jnp.square(_shared_sd(noise, u, names, group))
    P0 = first_covariance(model, params, Ad.dtype)
    return Gaussian(Ad, B, C[rows], D[rows], Q, R, P0), U, acting


def _shared_sd(
    noise: Noise, u: Unknowns, names: tuple[str, ...], group: tuple[int, ...]
) -> Float[Array, " p"]:
    """The sd of the measurement noise; NaN if it is not the same in all flights of the group."""
    by_flight = jnp.stack([jnp.stack([noise.sd[i][n] for n in names]) for i in group])
    # No number at all is better than one of another flight's noise.
    sd = jnp.where(jnp.all(by_flight == by_flight[:1]), by_flight[0], jnp.nan)
    return jnp.stack([measurement_sd(u, n, s) for n, s in zip(names, sd, strict=True)])


def _first_state(layout: Layout, drive: Drive, dtype: Any) -> Float[Array, " n"]:
    state = layout.model.initial_state(drive.params) if drive.state is None else drive.state
    return naming.ravel(state, dtype)


def _columns(records: Any) -> Float[Array, "N m"]:
    """Signals (N,) side by side, shorter ones filled up behind their end."""
    N = max(v.shape[0] for v in records)
    return jnp.stack([jnp.pad(v, (0, N - v.shape[0])) for v in records], axis=1)
