"""The one residual: fit, identifiability and uncertainty all differentiate this function.

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
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.numerics.jitted import jitted

# Derivatives of many windows at once: an initial state is felt by its own window alone, an input's
# offset by its own flight.
#
# Unknowns that no row shares get one direction of differentiation together ("colouring": Curtis,
# Powell and Reid, 1974); the columns are told apart afterwards by the rows that they can reach.


class Residuals(NamedTuple):
    """What a method makes small."""

    rows: Float[Array, " n"]
    """whitened; zero where nothing is measured. Those of the priors are added to them"""
    runs: tuple[Run, ...] | None
    """by flight the simulated `Run`s on whose way the rows came; None where none was simulated"""
    innovations: tuple[Innovations, ...] = ()
    """by flight, where predictions one step ahead are what is compared"""


class _Columns(NamedTuple):
    """Of each unknown: its direction, and where it is felt (-1 where everywhere)."""

    colour: np.ndarray
    window: np.ndarray
    bias: np.ndarray
    flight: np.ndarray
    """of an input's offset its flight, else -1"""


def seeded(layout: Layout) -> np.ndarray | None:
    """The directions (q, colours) in which to differentiate; None where each is one unknown's."""
    # One window has no neighbour to share directions with. A filter's rows, through the scale that
    # is concentrated out, feel every unknown.
    if layout.noise_model != "white" or sum(count for count, _ in layout.windows) < 2:
        return None
    colour = _columns(layout).colour
    seeds = np.zeros((layout.size, int(colour.max()) + 1))
    seeds[np.arange(layout.size), colour] = 1.0
    return seeds


def _columns(layout: Layout) -> _Columns:
    states, shared = len(layout.states), layout.first_nuisance
    outputs = sorted({n for names in layout.outputs for n in names})
    # What all flights share is felt by every row: each has a direction to itself.
    colour = list(range(shared))
    window, bias, flight = [-1] * shared, [-1] * shared, [-1] * shared
    number, first_bias = 0, 0
    for f, ((count, _), names) in enumerate(zip(layout.windows, layout.outputs, strict=True)):
        for k in range(count):
            # A defect feels the window before it and the one after: two sets of directions.
            side = k % 2 if layout.continuity is not None else 0
            colour += [shared + side * states + i for i in range(states)]
            window += [number] * states
            bias += [-1] * states
            flight += [-1] * states
            number += 1
        # Another flight's windows and outputs use the same directions again: no row feels both.
        if layout.bias:
            colour += [shared + 2 * states + outputs.index(n) for n in names]
            window += [-1] * len(names)
            bias += [first_bias + j for j in range(len(names))]
            flight += [-1] * len(names)
        first_bias += len(names)
        offsets = len(layout.offsets)
        colour += [shared + 2 * states + len(outputs) + j for j in range(offsets)]
        window += [-1] * offsets
        bias += [-1] * offsets
        flight += [f] * offsets
    # Directions that nobody uses are left out.
    _, packed = np.unique(colour, return_inverse=True)
    return _Columns(packed, np.array(window), np.array(bias), np.array(flight))


class _Reach(NamedTuple):
    """Of each row of the measurements what it belongs to (-2 for a defect where it is none's)."""

    window: np.ndarray
    next_window: np.ndarray
    """of a defect the window after it, else -2"""
    signal: np.ndarray
    flight: np.ndarray


def _reach(layout: Layout, data: Data) -> _Reach:
    """In the order of `OutputError.residuals`: signal after signal, then the defects."""
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
            # Biases are of outputs: no defect of the states feels them.
            signals.append(np.full(defects.size, -2))
            flights.append(np.full(defects.size, f))
        first += count
    return _Reach(*(np.concatenate(v) for v in (window, following, signals, flights)))


def spread_out(layout: Layout, data: Data, along: Float[Array, "n c"]) -> Float[Array, "n q"]:
    """The whole Jacobian from the derivatives along the colours."""
    # A derivative along a direction is the sum over its unknowns. Since no row feels two of them,
    # each row's sum is the derivative by the one that it does feel.
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
    """(value - mean) / sd of the parameters' priors; zero where there is none."""
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
    residuals = layout.objective.residuals(layout, data, noise, unpack(layout, data, z))
    rows = [residuals.rows, prior_rows(layout, data, z), weak_rows(layout, z)]
    return jnp.concatenate(rows), residuals


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """The rows whose squares are summed, without their derivative."""
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
