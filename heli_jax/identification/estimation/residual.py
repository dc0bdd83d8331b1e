"""The residual vector, and its Jacobian.

The rows of the measurements belong to the method (`Objective.residuals`). The rows of the priors,
(value - mean) / sd, follow, then those of the weak priors.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.simulated_flights import Run, with_bias
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, flight_places, unpack
from heli_jax.numerics.jitted import jitted


class Residuals(NamedTuple):
    """Rows of the measurements, and the simulation or prediction they come from."""

    rows: Float[Array, " n"]
    """Whitened rows; zero without measurement."""
    runs: tuple[Run, ...] | None
    """Simulations by flight; None without simulation."""
    innovations: tuple[Innovations, ...] = ()
    """Innovations by flight, for methods that predict one step ahead."""
    added: Array | float = 0.0
    """Added to the sum of squares it gives minus twice the log-likelihood. It has no derivative of
    its own: the rows contain that."""


# Derivatives of many windows at once. An initial state affects only its window, an input's offset
# only its flight. Unknowns without a common row share one direction of differentiation (colouring:
# Curtis, Powell and Reid, 1974), and their rows separate their columns.


_NONE = -2
"""No group of unknowns; other numbers are windows, signals or flights."""


def _colours(layout: Layout) -> tuple[Int[np.ndarray, " q"], Int[np.ndarray, " q"]] | None:
    """Return the direction of each unknown, and the group of rows that it affects (-1: all rows).

    Groups are the windows, then the signals, then the flights. The result is None if each unknown
    has its own direction.
    """
    # All rows of a filter depend on every unknown, through the row of the variances.
    windows = sum(count for count, _ in layout.windows)
    if layout.noise_model != "white" or windows < 2:
        return None
    states, shared = len(layout.states), layout.first_nuisance
    outputs = sorted({n for names in layout.outputs for n in names})
    # Parameters affect every row.
    colour, group = np.arange(layout.size), np.full(layout.size, -1)
    window, signal = 0, windows
    each = zip(flight_places(layout), layout.outputs, strict=True)
    for f, (places, names) in enumerate(each, windows + sum(map(len, layout.outputs))):
        k = np.arange(len(places.states))[:, None]
        # A defect depends on the windows before and after it, so there are two sets of directions.
        side = k % 2 if layout.continuity is not None else 0
        colour[places.states] = shared + side * states + np.arange(states)
        group[places.states] = window + k
        # Windows and outputs of other flights share these directions, because no row depends on
        # both.
        if layout.bias:
            at = np.array([outputs.index(n) for n in names])
            colour[places.biases] = shared + 2 * states + at
            group[places.biases] = signal + np.arange(len(names))
        colour[places.offsets] = shared + 2 * states + len(outputs) + np.arange(len(layout.offsets))
        group[places.offsets] = f
        window, signal = window + len(k), signal + len(names)
    return np.unique(colour, return_inverse=True)[1], group


def _groups_of_rows(layout: Layout, data: Data) -> Int[np.ndarray, "4 n"]:
    """Return the groups of each row of the measurements, in the order of `OutputError.residuals`.

    They are its window, for a defect the window after it, its signal and its flight.
    """
    rows, defects = [], []
    window, signal = 0, sum(count for count, _ in layout.windows)
    each = zip(data.flights, layout.windows, layout.outputs, strict=True)
    for f, (flight, (count, m), names) in enumerate(each, signal + sum(map(len, layout.outputs))):
        for name in names:
            own = window + np.arange(flight.outputs[name].shape[0]) // m
            rows.append(np.stack(np.broadcast_arrays(own, _NONE, signal, f)))
            signal += 1
        if layout.continuity is not None:
            # A bias does not affect a defect of the states.
            own = np.repeat(window + np.arange(count - 1), len(layout.states))
            defects.append(np.stack(np.broadcast_arrays(own, own + 1, _NONE, f)))
        window += count
    return np.concatenate([*rows, *defects], axis=1)


def _spread_out(
    layout: Layout, data: Data, along: Float[Array, "n c"], colour: np.ndarray, group: np.ndarray
) -> Float[Array, "n q"]:
    """Return the whole Jacobian from the derivatives along the colours."""
    # A derivative along a direction sums over its unknowns, of which each row depends on one.
    shared = jnp.asarray(group < 0)
    felt = shared[None, :]
    for own in _groups_of_rows(layout, data):
        felt = felt | (jnp.asarray(own)[:, None] == jnp.asarray(group)[None, :])
    # Priors depend on the parameters; each weak prior depends on its own unknown.
    prior = jnp.broadcast_to(shared[None, :], (len(layout.free), layout.size))
    kept = jnp.concatenate([felt, prior, jnp.eye(layout.size, dtype=bool)[layout.first_nuisance :]])
    assert kept.shape[0] == along.shape[0], (kept.shape, along.shape)
    return jnp.where(kept, along[:, jnp.asarray(colour)], 0.0)


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Return (value - mean) / sd of the parameters' priors; zero without a prior."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    # Without a prior the sd is infinite, so that shapes do not depend on priors.
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Return the weak priors of initial states, biases and offsets: coordinates over their sd."""
    return z[layout.first_nuisance :]


def _all_rows(
    layout: Layout, data: Data, noise: Noise, z: Array
) -> tuple[Array, Float[Array, ""], Residuals]:
    """Return the rows of the measurements, then the priors', and what the optimiser minimises."""
    residuals = layout.objective.residuals(layout, data, noise, unpack(layout, data, z))
    rows = [residuals.rows, prior_rows(layout, data, z), weak_rows(layout, z)]
    r = jnp.concatenate(rows)
    return r, jnp.sum(r**2) + residuals.added, residuals


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """Return the rows whose squares the optimiser sums."""
    return _all_rows(layout, data, noise, z)[0]


def cost_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Float[Array, ""]:
    """Return what the optimiser minimises."""
    return _all_rows(layout, data, noise, z)[1]


class ResidualAndJacobian(NamedTuple):
    """Residuals and their derivative at one point."""

    r: Float[Array, " n"]
    """Whitened residuals with prior rows."""
    J: Float[Array, "n q"]
    """Derivative of r by z."""
    innovations: tuple[Innovations, ...]
    """Innovations by flight; empty with output error."""
    simulated: tuple[Run, ...] | None
    """Simulated flights with bias; None without simulation."""
    cost: Float[Array, ""]
    """What the optimiser minimises: the sum of squares of r, and what the method adds to it."""


@jitted
def residual_and_jacobian(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> ResidualAndJacobian:
    """Return residuals and their Jacobian in forward mode, in one pass."""
    # Forward mode is faster, because there are far more rows than unknowns.

    def rows(z: Array) -> tuple[Array, Any]:
        # Auxiliary values avoid a second simulation.
        r, cost, residuals = _all_rows(layout, data, noise, z)
        return r, (r, residuals.runs, residuals.innovations, cost)

    def along(v: Array) -> Any:
        return jax.jvp(rows, (z,), (v,), has_aux=True)

    directions, colours = jnp.eye(layout.size, dtype=z.dtype), _colours(layout)
    if colours is not None:
        directions = jnp.zeros_like(directions).at[colours[0], np.arange(layout.size)].set(1.0)
        directions = directions[: colours[0].max() + 1]
    # The None axis makes vmap compute once what all directions share.
    r, J, (_, runs, innovations, cost) = jax.vmap(along, out_axes=(None, -1, None))(directions)
    if colours is not None:
        J = _spread_out(layout, data, J, *colours)
    simulated = None if runs is None else with_bias(unpack(layout, data, z), runs)
    return ResidualAndJacobian(r, J, innovations, simulated, cost)
