"""Everything that one point tells, for what is not compiled."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.kalman import Innovations
from heli_jax.identification.layout import Data, Layout, Noise, unpack
from heli_jax.identification.optimise import slopes
from heli_jax.identification.residual import Shown, predict, shown_of


class Evaluation(NamedTuple):
    """Everything that one point tells, as NumPy arrays."""

    simulated: tuple[dict[str, Any], ...]
    """with the bias, SI, by flight and output"""
    raw: tuple[dict[str, Any], ...]
    """measured - simulated, SI, by flight and output; NaN where nothing is measured"""
    state_rms: Any
    """(flights, states) root mean square of each simulated state"""
    innovations: tuple[Innovations, ...]
    r: Any
    J: Any
    named: Any
    """values of the named unknowns"""
    slopes: Any
    """their derivatives by their own coordinates"""


def evaluate(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Evaluation:
    """The slopes, the simulation, and the named unknowns."""
    at = slopes(layout, data, noise, z)
    shown = _shown(layout, data, z) if at.shown is None else at.shown
    found = jax.device_get((shown, at.innovations, at.r, at.J, *_named(layout, data, z)))
    (outputs, biases, rms), *rest = found
    bias = iter(biases)
    simulated = tuple(
        {n: y + next(bias) for n, y in zip(names, run, strict=True)}
        for run, names in zip(outputs, layout.outputs, strict=True)
    )
    raw = tuple(
        {n: np.asarray(flight.outputs[n]) - v for n, v in run.items()}
        for flight, run in zip(data.flights, simulated, strict=True)
    )
    return Evaluation(simulated, raw, rms, *rest)


def simulated_outputs(
    layout: Layout, data: Data, z: Float[Array, " q"]
) -> tuple[dict[str, np.ndarray], ...]:
    """By flight and output the simulation (N,) with the bias, SI."""
    outputs, biases, _ = jax.device_get(_shown(layout, data, z))
    bias = iter(biases)
    return tuple(
        {n: np.asarray(y + next(bias)) for n, y in zip(names, run, strict=True)}
        for run, names in zip(outputs, layout.outputs, strict=True)
    )


@eqx.filter_jit
def _shown(layout: Layout, data: Data, z: Array) -> Shown:
    u = unpack(layout, data, z)
    return shown_of(u, predict(layout, data, u))


@eqx.filter_jit
def _named(layout: Layout, data: Data, z: Array) -> tuple[Array, Array]:
    def named(z: Array) -> Array:
        u = unpack(layout, data, z)
        shift = () if u.shift is None else (u.shift,)
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    return named(z), jnp.diagonal(jax.jacfwd(named)(z))
