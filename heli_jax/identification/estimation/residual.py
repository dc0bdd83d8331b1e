"""The one residual: fit, identifiability and uncertainty all differentiate this function.

The rows of the measurements are the method's (`estimator`); those of the priors, (value - mean) /
sd, follow, then those of the weak priors.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.estimation.estimator import Residuals
from heli_jax.identification.estimation.jacobian_coloring import seeded, spread_out
from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.simulated_flights import SimulatedOutputs, outputs_of
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.numerics.jitted import jitted


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """(value - mean) / sd of the parameters' priors; zero where there is none.

    Args:
        layout: what the unknowns are.
        data: with means and sds by parameter, in its unit.
        z: the unknowns.
    """
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    # Without a prior the sd is infinite: a row for every parameter keeps the shapes the same.
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Weak priors of initial states, biases, offsets: coordinates are in units of its sd."""
    return z[layout.first_nuisance :]


def _all_rows(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, Residuals]:
    """All rows: those of the measurements, then the priors'."""
    # The measurements' rows first: what asks for them alone need not know how many priors follow.
    residuals = layout.estimator.residuals(layout, data, noise, unpack(layout, data, z))
    rows = [residuals.rows, prior_rows(layout, data, z), weak_rows(layout, z)]
    return jnp.concatenate(rows), residuals


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """The rows whose squares are summed, without their derivative.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements, by which the rows are divided.
        z: the unknowns.
    """
    return _all_rows(layout, data, noise, z)[0]


class ResidualAndJacobian(NamedTuple):
    """Residuals and their derivative at one point."""

    r: Float[Array, " n"]
    """whitened residuals with prior rows"""
    J: Float[Array, "n q"]
    """derivative of r by z"""
    innovations: tuple[Innovations, ...]
    """by flight; none with output error"""
    simulated: SimulatedOutputs | None
    """what output error simulates on its way; None where nothing is simulated"""


@jitted
def differentiate(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> ResidualAndJacobian:
    """Residuals and their Jacobian in forward mode, in one pass.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements, by which the rows are divided.
        z: the unknowns.
    """
    # Forwards: there are far more rows than unknowns, and nothing of the simulation is stored.

    def rows(z: Array) -> tuple[Array, Any]:
        # The residuals come along as auxiliary values: a pass of their own would simulate again.
        r, residuals = _all_rows(layout, data, noise, z)
        return r, (r, residuals.runs, residuals.innovations)

    seeds = seeded(layout)
    if seeds is None:
        J, (r, runs, innovations) = jax.jacfwd(rows, has_aux=True)(z)
    else:

        def along(v: Array) -> Any:
            return jax.jvp(rows, (z,), (v,), has_aux=True)

        # Several unknowns a direction, each felt by rows of its own: see jacobian_coloring.
        directions = jnp.asarray(seeds.T, z.dtype)
        # The residuals are the same for all directions: with None vmap computes them once.
        r, J, (_, runs, innovations) = jax.vmap(along, out_axes=(None, -1, None))(directions)
        J = spread_out(layout, data, J)
    simulated = None if runs is None else outputs_of(unpack(layout, data, z), runs)
    return ResidualAndJacobian(r, J, innovations, simulated)
