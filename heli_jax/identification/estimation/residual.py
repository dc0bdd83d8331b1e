"""The one residual: fit, identifiability and uncertainty all differentiate this function.

The rows of the measurements are the method's (`estimator`); those of the priors, (value - mean) /
sd, follow, then those of the weak priors.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.estimation.estimator import Residuals
from heli_jax.identification.estimation.jacobian_coloring import seeded, spread_out
from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.simulated_flights import SimulatedOutputs, shown_of
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """(value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Weak priors of initial states, biases, offsets: coordinates are in units of its sd."""
    return z[layout.first_nuisance :]


def _all_rows(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, Residuals]:
    """All rows: those of the measurements, then the priors'."""
    residuals = layout.estimator.residuals(layout, data, noise, unpack(layout, data, z))
    rows = [residuals.rows, prior_rows(layout, data, z), weak_rows(layout, z)]
    return jnp.concatenate(rows), residuals


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """The rows whose squares are summed, without their derivative."""
    return _all_rows(layout, data, noise, z)[0]


class ResidualAndJacobian(NamedTuple):
    """Residuals and their derivative at one point."""

    r: Any
    """(n,) whitened residuals with prior rows"""
    J: Any
    """(n, q) derivative of r by z"""
    innovations: tuple[Innovations, ...]
    """by flight; none with output error"""
    shown: SimulatedOutputs | None
    """what output error simulates on its way"""


@eqx.filter_jit
def differentiate(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> ResidualAndJacobian:
    """Residuals and their Jacobian in forward mode, in one pass."""

    def rows(z: Array) -> tuple[Array, Any]:
        r, residuals = _all_rows(layout, data, noise, z)
        return r, (r, residuals.runs, residuals.innovations)

    seeds = seeded(layout)
    if seeds is None:
        J, (r, runs, innovations) = jax.jacfwd(rows, has_aux=True)(z)
    else:

        def along(v: Array) -> Any:
            return jax.jvp(rows, (z,), (v,), has_aux=True)

        directions = jnp.asarray(seeds.T, z.dtype)
        r, J, (_, runs, innovations) = jax.vmap(along, out_axes=(None, -1, None))(directions)
        J = spread_out(layout, data, J)
    shown = None if runs is None else shown_of(unpack(layout, data, z), runs)
    return ResidualAndJacobian(r, J, innovations, shown)
