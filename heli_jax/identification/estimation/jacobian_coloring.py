"""Derivatives of many windows at once: an initial state is felt by its own window alone, an input's
offset by its own flight.

Unknowns that no row shares get one direction of differentiation together ("colouring": Curtis,
Powell and Reid, 1974); the columns are told apart afterwards by the rows that they can reach.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.unknowns.layout import Data, Layout


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
    if not layout.estimator.rows_are_samples or sum(count for count, _ in layout.windows) < 2:
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
    """The whole Jacobian from the derivatives along the colours.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        along: the derivatives of all rows, a column a colour.
    """
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
