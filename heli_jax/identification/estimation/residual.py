"""The residual vector, and its Jacobian.

The rows of the measurements are the method's (`Objective.residuals`); those of the priors,
(value - mean) / sd, follow, then those of the weak priors.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.simulated_flights import Run, SimulatedOutputs, outputs_of
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, flight_places, unpack
from heli_jax.numerics.jitted import jitted


class Residuals(NamedTuple):
    """Rows of the measurements, and the simulation or prediction behind them."""

    rows: Float[Array, " n"]
    """whitened; zero where nothing is measured"""
    runs: tuple[Run, ...] | None
    """by flight; None where nothing was simulated"""
    innovations: tuple[Innovations, ...] = ()
    """by flight, of methods that predict one step ahead"""


# Derivatives of many windows at once. An initial state has an effect in its own window alone, an
# input's offset in its own flight. Unknowns without a common row are differentiated along one
# direction (colouring: Curtis, Powell and Reid, 1974), and their columns separated by their rows.


_NONE = -2
"""no group of unknowns, beside the number of a window, a signal or a flight"""


def _colours(layout: Layout) -> tuple[Int[np.ndarray, " q"], Int[np.ndarray, " q"]] | None:
    """Return the direction of each unknown, and the group of rows in which it has an effect (-1 for
    all rows); None if each unknown has its own direction.

    Groups are the windows, then the signals, then the flights.
    """
    # All rows of a filter depend on every unknown, through the scale that is concentrated out.
    windows = sum(count for count, _ in layout.windows)
    if layout.noise_model != "white" or windows < 2:
        return None
    states, shared = len(layout.states), layout.first_nuisance
    outputs = sorted({n for names in layout.outputs for n in names})
    # Parameters have an effect in every row.
    colour, group = np.arange(layout.size), np.full(layout.size, -1)
    window, signal = 0, windows
    each = zip(flight_places(layout), layout.outputs, strict=True)
    for f, (places, names) in enumerate(each, windows + sum(map(len, layout.outputs))):
        k = np.arange(len(places.states))[:, None]
        # A defect depends on the windows before and after it: two sets of directions.
        side = k % 2 if layout.continuity is not None else 0
        colour[places.states] = shared + side * states + np.arange(states)
        group[places.states] = window + k
        # Windows and outputs of other flights share these directions: no row depends on both.
        if layout.bias:
            at = np.array([outputs.index(n) for n in names])
            colour[places.biases] = shared + 2 * states + at
            group[places.biases] = signal + np.arange(len(names))
        colour[places.offsets] = shared + 2 * states + len(outputs) + np.arange(len(layout.offsets))
        group[places.offsets] = f
        window, signal = window + len(k), signal + len(names)
    return np.unique(colour, return_inverse=True)[1], group


def _groups_of_rows(layout: Layout, data: Data) -> Int[np.ndarray, "4 n"]:
    """Return the groups that each row of the measurements belongs to: its window, for a defect the
    window after it, its signal and its flight; in the order of `OutputError.residuals`."""
    rows, defects = [], []
    window, signal = 0, sum(count for count, _ in layout.windows)
    each = zip(data.flights, layout.windows, layout.outputs, strict=True)
    for f, (flight, (count, m), names) in enumerate(each, signal + sum(map(len, layout.outputs))):
        for name in names:
            own = window + np.arange(flight.outputs[name].shape[0]) // m
            rows.append(np.stack(np.broadcast_arrays(own, _NONE, signal, f)))
            signal += 1
        if layout.continuity is not None:
            # No bias has an effect on a defect of the states.
            own = np.repeat(window + np.arange(count - 1), len(layout.states))
            defects.append(np.stack(np.broadcast_arrays(own, own + 1, _NONE, f)))
        window += count
    return np.concatenate([*rows, *defects], axis=1)


def _spread_out(
    layout: Layout, data: Data, along: Float[Array, "n c"], colour: np.ndarray, group: np.ndarray
) -> Float[Array, "n q"]:
    """Return the whole Jacobian from the derivatives along the colours."""
    # A derivative along a direction is the sum over its unknowns, and each row depends on one.
    shared = jnp.asarray(group < 0)
    felt = shared[None, :]
    for own in _groups_of_rows(layout, data):
        felt = felt | (jnp.asarray(own)[:, None] == jnp.asarray(group)[None, :])
    # Priors are of the parameters; each weak prior is of its own unknown.
    prior = jnp.broadcast_to(shared[None, :], (len(layout.free), layout.size))
    kept = jnp.concatenate([felt, prior, jnp.eye(layout.size, dtype=bool)[layout.first_nuisance :]])
    assert kept.shape[0] == along.shape[0], (kept.shape, along.shape)
    return jnp.where(kept, along[:, jnp.asarray(colour)], 0.0)


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Return (value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    # Without a prior the sd is infinite: the shapes do not depend on priors.
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Return the weak priors of initial states, biases and offsets: coordinates over their sd."""
    return z[layout.first_nuisance :]


def _all_rows(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, Residuals]:
    """Return the rows of the measurements, then the priors'."""
    residuals = layout.objective.residuals(layout, data, noise, unpack(layout, data, z))
    rows = [residuals.rows, prior_rows(layout, data, z), weak_rows(layout, z)]
    return jnp.concatenate(rows), residuals


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """Return the rows whose squares the optimiser sums."""
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
    """None where nothing is simulated"""


@jitted
def residual_and_jacobian(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> ResidualAndJacobian:
    """Return residuals and their Jacobian in forward mode, in one pass."""
    # Forwards: there are far more rows than unknowns.

    def rows(z: Array) -> tuple[Array, Any]:
        # The residuals are auxiliary values, without a second simulation.
        r, residuals = _all_rows(layout, data, noise, z)
        return r, (r, residuals.runs, residuals.innovations)

    def along(v: Array) -> Any:
        return jax.jvp(rows, (z,), (v,), has_aux=True)

    directions, colours = jnp.eye(layout.size, dtype=z.dtype), _colours(layout)
    if colours is not None:
        directions = jnp.zeros_like(directions).at[colours[0], np.arange(layout.size)].set(1.0)
        directions = directions[: colours[0].max() + 1]
    # With None vmap computes once what is the same for all directions.
    r, J, (_, runs, innovations) = jax.vmap(along, out_axes=(None, -1, None))(directions)
    if colours is not None:
        J = _spread_out(layout, data, J, *colours)
    simulated = None if runs is None else outputs_of(unpack(layout, data, z), runs)
    return ResidualAndJacobian(r, J, innovations, simulated)
