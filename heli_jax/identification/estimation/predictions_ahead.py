"""Predictions some seconds ahead, from the state that a filter has estimated by then.

A simulation of an unstable machine leaves any record, and one step ahead everything is predicted
well. In between stands what such a model can be judged by.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.model import Model
from heli_jax.identification.estimation.filter_error import filter_arguments
from heli_jax.identification.estimation.filter_step import Estimate
from heli_jax.identification.estimation.kalman import (
    Innovations,
    begun,
    by_name,
    corrected,
    filter_of,
)
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, unpack
from heli_jax.simulation.options import SimulationOptions

SECONDS = 2.0
"""ahead of the filter at most; each window of so long begins with the filter's prediction"""


class Ahead(NamedTuple):
    """Predictions up to `SECONDS` ahead of one flight, by output; NaN where nothing is measured."""

    predicted: dict[str, Float[np.ndarray, " N"]]
    """SI"""
    variance: dict[str, Float[np.ndarray, " N"]]
    """of the error, as disturbance and noise make it"""


def predictions_ahead(at: Solution) -> tuple[Ahead, ...]:
    """By flight what is predicted in windows from the filter's state at the begin of each.

    Args:
        at: where a fit by filter error ended.
    """
    layout, data, noise, z = at
    # Outside of what is compiled: how many samples that are decides where windows begin.
    samples = tuple(max(1, round(SECONDS / float(flight.dt))) for flight in data.flights)
    errors = jax.device_get(_errors(layout, data, noise, z, samples))
    return tuple(
        Ahead(
            {n: np.asarray(f.outputs[n]) - e for n, e in innovations.error.items()},
            innovations.variance,
        )
        for f, innovations in zip(data.flights, errors, strict=True)
    )


@eqx.filter_jit
def _errors(
    layout: Layout, data: Data, noise: Noise, z: Array, samples: tuple[int, ...]
) -> tuple[Innovations, ...]:
    u = unpack(layout, data, z)
    return tuple(
        errors_ahead(*filter_arguments(layout, data, noise, u, i), every)
        for i, every in enumerate(samples)
    )


def errors_ahead(
    positional: tuple[Model, Any, Any, dict[str, Array], dict[str, Any]],
    options: SimulationOptions,
    every: int,
) -> Innovations:
    """Measured less predicted in windows of so many samples, and the variance of that.

    Args:
        positional: model, params, inputs, measured and sd, as of `kalman.innovations`.
        options: as there.
        every: samples of a window, each begun at what the filter predicts for its first.
    """
    drive, first, y, R = begun(*positional, options)
    filter_ = filter_of(drive)

    def step(carry: tuple[Estimate, Estimate], sample: Any) -> tuple[Any, Any]:
        filtered, ahead = carry
        y, begins, now = sample
        x, P = jax.tree.map(lambda f, a: jnp.where(begins, f, a), filtered, ahead)
        C, rest = filter_.measure(x, now)
        error = y - rest - jnp.sum(C * x[None, :], axis=1)
        variance = jnp.sum((C @ P) * C, axis=1) + R
        filtered, _ = corrected(filter_, filtered, R, y, now)
        moved = (_symmetric(filter_.move(*filtered, now)), _symmetric(filter_.move(x, P, now)))
        return moved, (error, jnp.where(jnp.isfinite(y), variance, jnp.nan))

    begins = jnp.arange(y.shape[0]) % every == 0
    _, (error, variance) = jax.lax.scan(step, (first, first), (y, begins, filter_.samples))
    return by_name(positional[3], error, variance)


def _symmetric(estimate: Estimate) -> Estimate:
    x, P = estimate
    return x, 0.5 * (P + P.T)
