"""Where the windows of a record begin, so that none says more than the record it is cut from.

A window has an initial state, biases and offsets of its own. With states and offsets that fit its
samples best it would move more than the record does at the start values, and with weak priors of
its own it would know more: both would let a part say more than the whole. So a window begins where
the record's own simulation is at that instant, and its share of what the weak priors say is its
share of the samples.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.simulated_flights import predict
from heli_jax.identification.unknowns.layout import Data, Layout, Solution, unpack

_DIVERGED = 10.0
"""times the measured range, beyond which the simulation of the whole record says nothing of where a
window begins"""
_FREE = 1e-3
"""weight of the weak prior of a state that the whole record has none for: next to nothing, and no
direction without any information, which would be rounding"""


def states_of_record(at: Solution, e: Evaluation) -> tuple[np.ndarray, ...] | None:
    """By flight the simulated states (s, N); None where the simulation diverges.

    Args:
        at: layout, data and unknowns of the whole record.
        e: the evaluation there.
    """
    for run, flight in zip(e.simulated, at.data.flights, strict=True):
        for name, y in run.items():
            size = float(np.nanmax(np.abs(np.asarray(flight.outputs[name]))))
            if not np.isfinite(y).all() or np.max(np.abs(y)) > _DIVERGED * max(size, 1e-300):
                return None
    states = tuple(np.asarray(x) for x in jax.device_get(_states(at.layout, at.data, at.z)))
    return states if all(np.isfinite(x).all() for x in states) else None


@eqx.filter_jit
def _states(layout: Layout, data: Data, z: Float[Array, " q"]) -> tuple[Array, ...]:
    return tuple(run.states for run in predict(layout, data, unpack(layout, data, z)))


def begins_on_record(
    layout: Layout,
    data: Data,
    cuts: Sequence[tuple[int, int, int]],
    at: Solution,
    states: tuple[np.ndarray, ...],
) -> Float[Array, " k"]:
    """The nuisances of all windows: states from the whole record's simulation, biases and offsets
    those of the record.

    Args:
        layout: of the windows.
        data: of the windows.
        cuts: (flight, first, last) of each of the layout's flights.
        at: the whole record.
        states: of `states_of_record`.
    """
    every = naming.names(layout.model.State)
    values: list[float] = []
    for c, (i, first, _) in enumerate(cuts):
        count, m = layout.windows[c]
        scale = data.flights[c].state_scale
        for k in range(count):
            x = states[i][:, first + k * m]
            values += [float(x[every.index(n)]) / float(scale[n]) for n in layout.states]
        values += [float(v) for v in _constants(at, i)]
    return jnp.asarray(values, at.z.dtype)


def _constants(at: Solution, i: int) -> np.ndarray:
    """Biases and offsets of the i-th flight of the whole record."""
    position = at.layout.first_nuisance
    for j in range(i + 1):
        position += at.layout.windows[j][0] * len(at.layout.states)
        position += at.layout.constants(at.layout.outputs[j])
    return np.asarray(at.z)[position - at.layout.constants(at.layout.outputs[i]) : position]


def prior_weights(
    layout: Layout,
    cuts: Sequence[tuple[int, int, int]],
    sizes: Sequence[int],
    samples: int,
    *,
    shooting: bool,
) -> Float[np.ndarray, " k"]:
    """By nuisance of all windows, the part of its weak prior (as 1 / sd) that a window has.

    Args:
        layout: of the windows.
        cuts: (flight, first, last) of each of the layout's flights.
        sizes: samples of each whole flight.
        samples: of a window.
        shooting: whether the whole record has initial states at every window too.
    """
    weights: list[float] = []
    for c, (i, first, _) in enumerate(cuts):
        count, _ = layout.windows[c]
        for k in range(count):
            # In the whole record the state has a prior at its beginning alone.
            stated = first == 0 and (k == 0 or shooting)
            weights += [1.0 if stated else _FREE] * len(layout.states)
        # All windows together have one prior of a bias, as the whole record has.
        share = min(samples / sizes[i], 1.0) ** 0.5
        weights += [share] * layout.constants(layout.outputs[c])
    return np.array(weights)
