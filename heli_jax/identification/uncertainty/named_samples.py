"""Samples of all unknowns by the names that a fit gives them."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.result import Fit
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns, unpack


class NamedSamples(NamedTuple):
    """Samples of the unknowns, SI, each of the shape of all."""

    parameters: dict[str, np.ndarray]
    """the free ones"""
    nuisance: dict[str, np.ndarray]
    """what was estimated beside them, by the names of `Fit.nuisance`; the noise's factors as
    'noise factor OUTPUT'"""


def named_samples(fit: Fit, z: Float[Array, "... q"]) -> NamedSamples:
    """Names and SI for samples of the vector of unknowns.

    Args:
        fit: whose unknowns they are.
        z: the samples (..., q), in the optimiser's coordinates.
    """
    layout, data = fit.reached.layout, fit.reached.data
    shape = z.shape[:-1]
    one_by_one = _unpacked(layout, data, z.reshape(-1, z.shape[-1]))
    u: Unknowns = jax.tree.map(np.asarray, one_by_one)
    parameters = {name: u.params[name] for name in layout.free}
    nuisance = {f"gain {name}": v for name, v in u.gains.items()}
    if layout.shift:
        nuisance["time_shift"] = u.shift
    nuisance |= {name: u.noise[name] for name in layout.noises}
    nuisance |= {f"noise factor {name}": u.scales[name] for name in layout.scaled}
    fitted = [s.flight for s in fit.signals if not s.hold_out]
    for i, label in enumerate(fitted):
        # Only what is among the unknowns: a model's own initial state and a bias of zero are not.
        nuisance |= _initial_states(layout, i, label, u.states[i])
        biases = u.biases[i] if layout.bias else {}
        nuisance |= {f"{label}/bias {n}": v for n, v in biases.items()}
        nuisance |= {f"{label}/offset {n}": v for n, v in u.offsets[i].items()}

    def shaped(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: np.asarray(v).reshape(shape) for name, v in samples.items()}

    return NamedSamples(shaped(parameters), shaped(nuisance))


@functools.partial(jax.jit, static_argnums=0)
def _unpacked(layout: Layout, data: Data, z: Float[Array, "n q"]) -> Unknowns:
    return jax.vmap(lambda z: unpack(layout, data, z))(z)


# Any: a State, which is a class of the user's.
def _initial_states(layout: Layout, i: int, label: str, state: Any) -> dict[str, np.ndarray]:
    """Of the i-th flight, each (samples,)."""
    if state is None:
        return {}
    count, values = layout.windows[i][0], naming.asdict(state)
    if count == 1:
        return {f"{label}/initial {n}": values[n] for n in layout.states}
    return {
        f"{label}/initial {n} of window {w + 1}": values[n][:, w]
        for w in range(count)
        for n in layout.states
    }
