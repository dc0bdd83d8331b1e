"""The residual vector that fit, identifiability and uncertainty differentiate.

The rows of the measurements are the method's (`Objective.residuals`); those of the priors,
(value - mean) / sd, follow, then those of the weak priors.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.simulated_flights import Run, SimulatedOutputs, outputs_of
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, flight_places, unpack
from heli_jax.numerics.jitted import jitted


class Residuals(NamedTuple):
    """Rows of the measurements, and what was simulated or predicted for them."""

    rows: Float[Array, " n"]
    """whitened; zero where nothing is measured"""
    runs: tuple[Run, ...] | None
    """by flight; None where nothing was simulated"""
    innovations: tuple[Innovations, ...] = ()
    """by flight, of methods that predict one step ahead"""


# Derivatives of many windows at once. An initial state has an effect in its own window alone, an
# input's offset in its own flight. Unknowns that share no row are differentiated along one common
# direction ("colouring": Curtis, Powell and Reid, 1974), and their columns separated afterwards by
# the rows that each can reach.


class _Columns(NamedTuple):
    """Direction of each unknown, and where it has an effect (-1 everywhere)."""

    colour: np.ndarray
    window: np.ndarray
    bias: np.ndarray
    flight: np.ndarray
    """of an input's offset its flight, else -1"""


def seeded(layout: Layout) -> np.ndarray | None:
    """Return directions of differentiation (q, colours); None if each unknown has its own."""
    # One window has no neighbour to share directions with. All rows of a filter hang on every
    # unknown, through the scale that is concentrated out.
    if layout.noise_model != "white" or sum(count for count, _ in layout.windows) < 2:
        return None
    colour = _columns(layout).colour
    seeds = np.zeros((layout.size, int(colour.max()) + 1))
    seeds[np.arange(layout.size), colour] = 1.0
    return seeds


def _columns(layout: Layout) -> _Columns:
    states, shared = len(layout.states), layout.first_nuisance
    outputs = sorted({n for names in layout.outputs for n in names})
    # Parameters have an effect in every row: each has its own direction.
    colour = np.arange(layout.size)
    window, bias, flight = np.full((3, layout.size), -1)
    number, first_bias = 0, 0
    each = zip(flight_places(layout), layout.outputs, strict=True)
    for f, (places, names) in enumerate(each):
        k = np.arange(len(places.states))[:, None]
        # A defect hangs on the window before it and the one after: two sets of directions.
        side = k % 2 if layout.continuity is not None else 0
        colour[places.states] = shared + side * states + np.arange(states)
        window[places.states] = number + k
        # Windows and outputs of other flights share these directions: no row hangs on both.
        if layout.bias:
            colour[places.biases] = (
                shared + 2 * states + np.array([outputs.index(n) for n in names])
            )
            bias[places.biases] = first_bias + np.arange(len(names))
        colour[places.offsets] = shared + 2 * states + len(outputs) + np.arange(len(layout.offsets))
        flight[places.offsets] = f
        number, first_bias = number + len(k), first_bias + len(names)
    _, packed = np.unique(colour, return_inverse=True)
    return _Columns(packed, window, bias, flight)


class _Reach(NamedTuple):
    """Window, signal and flight of each row of the measurements (-2 for none)."""

    window: np.ndarray
    next_window: np.ndarray
    """the window after a defect, else -2"""
    signal: np.ndarray
    flight: np.ndarray


def _reach(layout: Layout, data: Data) -> _Reach:
    """Return them in the order of `OutputError.residuals`: signal after signal, then defects."""
    window, signals, flights = [], [], []
    first, signal = 0, 0
    each = zip(data.flights, layout.windows, layout.outputs, strict=True)
    for f, (flight, (count, m), names) in enumerate(each):
        for name in names:
            n = flight.outputs[name].shape[0]
            flights.append(np.full(n, f))
            window.append(first + np.arange(n) // m)
            signals.append(np.full(n, signal))
            signal += 1
        first += count
    following = [np.full(w.size, -2) for w in window]
    first = 0
    for f, (count, _) in enumerate(layout.windows):
        if layout.continuity is not None and count > 1:
            defects = np.repeat(first + np.arange(count - 1), len(layout.states))
            window.append(defects)
            following.append(defects + 1)
            # No bias has an effect on a defect of the states.
            signals.append(np.full(defects.size, -2))
            flights.append(np.full(defects.size, f))
        first += count
    return _Reach(*(np.concatenate(v) for v in (window, following, signals, flights)))


def spread_out(layout: Layout, data: Data, along: Float[Array, "n c"]) -> Float[Array, "n q"]:
    """Return the whole Jacobian from the derivatives along the colours."""
    # A derivative along a direction is the sum over its unknowns, of which each row hangs on one.
    columns, reach = _columns(layout), _reach(layout, data)
    shared = (columns.window < 0) & (columns.bias < 0) & (columns.flight < 0)
    # Numbers below zero never meet: rows have -2 where unknowns have -1.
    felt = (
        jnp.asarray(shared)[None, :]
        | (jnp.asarray(reach.window)[:, None] == jnp.asarray(columns.window)[None, :])
        | (jnp.asarray(reach.next_window)[:, None] == jnp.asarray(columns.window)[None, :])
        | (jnp.asarray(reach.signal)[:, None] == jnp.asarray(columns.bias)[None, :])
        | (jnp.asarray(reach.flight)[:, None] == jnp.asarray(columns.flight)[None, :])
    )
    # Priors are of the parameters; each weak prior is of its own unknown.
    nuisances = jnp.arange(layout.size - layout.first_nuisance)[:, None] + layout.first_nuisance
    of_itself = nuisances == jnp.arange(layout.size)[None, :]
    prior = jnp.broadcast_to(jnp.asarray(shared)[None, :], (len(layout.free), layout.size))
    kept = jnp.concatenate([felt, prior, of_itself])
    assert kept.shape[0] == along.shape[0], (kept.shape, along.shape)
    return jnp.where(kept, along[:, jnp.asarray(columns.colour)], 0.0)


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Return (value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    # Without a prior the sd is infinite: a row for every parameter keeps the shapes the same.
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
    """what output error simulates on its way; None where nothing is simulated"""


@jitted
def residual_and_jacobian(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> ResidualAndJacobian:
    """Residuals and their Jacobian in forward mode, in one pass."""
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
