"""Levenberg-Marquardt from many starts near an optimum, or on many records, side by side."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from heli_jax import stages
from heli_jax.fused.code import UnsupportedError
from heli_jax.identification.estimation.fused_runs import FusedRuns, Own
from heli_jax.identification.estimation.levenberg_marquardt import (
    Optimum,
    descend,
    residual_and_jacobian,
)
from heli_jax.identification.estimation.measured_signals import measured_counts
from heli_jax.identification.estimation.optimiser_step import BATCHED, constants_of
from heli_jax.identification.estimation.residual import differentiate
from heli_jax.identification.estimation.scaling import Scaling, scaling, trusted_columns
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution

_MANY = 24
"""runs from which on a program of machine code is worth its compilation"""
_SIDE_BY_SIDE = 256
"""runs that such a program computes together: between them somebody may interrupt"""
_MANY_STEPS = 60
"""steps after which a run among many, which began near its optimum, is given up"""


@eqx.filter_jit
def _batch(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, "b q"]
) -> tuple[Float[Array, "b n"], Float[Array, "b n q"]]:
    """Residuals and Jacobians of a batch; all of `data` has a leading axis too."""

    def single(data: Data, z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    return jax.vmap(single)(data, z)


def optimise_many(
    reached: Solution,
    data: Callable[[Any], Data],
    starts: Float[Array, "k q"],
    each: Any,
    *,
    hold: int | None = None,
    batch: int = 8,
    say: Callable[[str], None] = lambda _: None,
) -> Optimum:
    """Optima (k, ...) for many starts or records near an optimum.

    Args:
        reached: that optimum; its Jacobian gives the units of all runs.
        data: makes the numbers of one run out of its slice of `each`.
        starts: where each run begins.
        each: what differs between the runs, a pytree of arrays (k, ...).
        hold: the unknown that stays at its start, by its number.
        batch: runs side by side, by vmap.
        say: called with a sentence where many runs are no programs of machine code.
    """
    layout, noise = reached.layout, reached.noise
    units = _units_at(reached)
    fused = _fused(reached, data, each, say) if starts.shape[0] >= _MANY else None
    if fused is not None:
        batch = _SIDE_BY_SIDE
    if hold is not None:
        # What has no unit stays, see `scaling`.
        units = units._replace(unit=units.unit.at[hold].set(0.0))
    k, batch = starts.shape[0], min(batch, starts.shape[0])
    optima = []
    for i in range(0, k, batch):
        # The last ones again where the batch is not full: another shape would compile anew.
        chosen = np.minimum(np.arange(i, i + batch), k - 1)
        z0 = starts[chosen]
        numbers = jax.vmap(data)(jax.tree.map(lambda v, chosen=chosen: v[chosen], each))
        constants = jax.vmap(lambda z: constants_of(layout, z, units))(z0)

        def evaluate(z: Array, numbers: Data = numbers) -> tuple[Array, Array]:
            return _batch(layout, numbers, noise, z) if fused is None else fused(numbers, z)

        # Each record's own: of one another may lack most samples.
        count = measured_counts(numbers)
        ends = descend(evaluate, constants, evaluate(z0), count, _MANY_STEPS, BATCHED).optimum
        optima.append(jax.tree.map(lambda v, n=min(batch, k - i): np.asarray(v)[:n], ends))
        stages.advance(min(batch, k - i))
    return jax.tree.map(lambda *v: np.concatenate(v), *optima)


def _fused(
    reached: Solution,
    data: Callable[[Any], Data],
    each: Any,
    say: Callable[[str], None],
) -> FusedRuns | None:
    """The runs as programs of machine code; None where they cannot be."""
    layout, numbers, noise, _ = reached
    one = jax.tree.map(lambda v: v[0], each)
    flights = list(zip(data(one).flights, numbers.flights, strict=True))
    # Beside the means of priors.
    own = Own(
        any(made.inputs is not given.inputs for made, given in flights),
        any(made.outputs is not given.outputs for made, given in flights),
    )
    try:
        return FusedRuns(layout, numbers, noise, own)
    except UnsupportedError as e:
        say(
            "each record is fitted by XLA step by step, not by one program of machine code: "
            f"there is no translation of {e}"
        )
        return None


def _units_at(reached: Solution) -> Scaling:
    """The units of runs that begin near an optimum."""
    layout, data, noise, z = reached

    def evaluate(z: Array) -> tuple[Array, Array]:
        e = residual_and_jacobian(layout, data, noise, z)
        return e.r, e.J

    r, J = evaluate(z)
    return scaling(r, J, trusted_columns(layout, evaluate, z, r, J))
