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
    if not layout.estimator.rows_are_samples or sum(count for count, _ in layout.windows) < 2:
        return None
    colour = _columns(layout).colour
    seeds = np.zeros((layout.size, int(colour.max()) + 1))
    seeds[np.arange(layout.size), colour] = 1.0
    return seeds


def _columns(layout: Layout) -> _Columns:
    states, shared = len(layout.states), layout.first_nuisance
    outputs = sorted({n for names in layout.outputs for n in names})
    colour = list(range(shared))
    window, bias, flight = [-1] * shared, [-1] * shared, [-1] * shared
    number, first_bias = 0, 0
    for f, ((count, _), names) in enumerate(zip(layout.windows, layout.outputs, strict=True)):
        for k in range(count):
            # A jump is felt by the window before and the one after: two sets of directions.
            side = k % 2 if layout.continuity is not None else 0
            colour += [shared + side * states + i for i in range(states)]
            window += [number] * states
            bias += [-1] * states
            flight += [-1] * states
            number += 1
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


def spread_out(layout: Layout, data: Data, along: Float[Array, "n c"]) -> Float[Array, "n q"]:
    """The whole Jacobian from the derivatives along the colours."""
    columns = _columns(layout)
    window, after, bias, by_flight = [], [], [], []
    first, signal = 0, 0
    for f, (flight, (count, m), names) in enumerate(
        zip(data.flights, layout.windows, layout.outputs, strict=True)
    ):
        for name in names:
            n = flight.outputs[name].shape[0]
            by_flight.append(np.full(n, f))
            window.append(first + np.arange(n) // m)
            bias.append(np.full(n, signal))
            signal += 1
        first += count
    after = [np.full(w.size, -2) for w in window]
    first = 0
    for f, (count, _) in enumerate(layout.windows):
        if layout.continuity is not None and count > 1:
            jumps = np.repeat(first + np.arange(count - 1), len(layout.states))
            window.append(jumps)
            after.append(jumps + 1)
            bias.append(np.full(jumps.size, -2))
            by_flight.append(np.full(jumps.size, f))
        first += count
    rows, follows, signals, flights = (np.concatenate(v) for v in (window, after, bias, by_flight))
    k, p = rows.size, len(layout.free)
    shared = (columns.window < 0) & (columns.bias < 0) & (columns.flight < 0)
    felt = (
        jnp.asarray(shared)[None, :]
        | (jnp.asarray(rows)[:, None] == jnp.asarray(columns.window)[None, :])
        | (jnp.asarray(follows)[:, None] == jnp.asarray(columns.window)[None, :])
        | (jnp.asarray(signals)[:, None] == jnp.asarray(columns.bias)[None, :])
        | (jnp.asarray(flights)[:, None] == jnp.asarray(columns.flight)[None, :])
    )
    # Priors are of the parameters; each weak prior is of its own unknown.
    weak = jnp.arange(layout.size - layout.first_nuisance)[:, None] + layout.first_nuisance
    own = weak == jnp.arange(layout.size)[None, :]
    prior = jnp.broadcast_to(jnp.asarray(shared)[None, :], (p, layout.size))
    kept = jnp.concatenate([felt, prior, own])
    assert kept.shape[0] == along.shape[0], (k, along.shape)
    return jnp.where(kept, along[:, jnp.asarray(columns.colour)], 0.0)
