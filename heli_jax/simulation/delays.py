"""How late each input acts: one delay for all, and one of its own where the model gives it one.

A delay is whole samples, by which an array is read further back, and the rest of a sample, which
divides every sample interval in two: before and after the sample that falls into it.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.naming import Number, Record


class Delays(eqx.Module):
    """Delays of the inputs in samples; inputs that are equally late share a group."""

    groups: tuple[int | None, ...] = eqx.field(static=True)
    """by input, in the order of its fields; None where an input acts at once"""
    whole: tuple[Array | int, ...]
    """by group, an integer"""
    rest: tuple[Array | float, ...]
    """by group, the fraction of a sample in [0, 1) beside it"""

    def group(self, i: int) -> int | None:
        """The group of the i-th input; what comes behind the inputs (noise) is never late."""
        return self.groups[i] if i < len(self.groups) else None

    def members(self, group: int | None) -> tuple[int, ...]:
        """Which inputs belong to a group."""
        return tuple(i for i, g in enumerate(self.groups) if g == group)


def delays_of(
    model: Model, params: Record, common: "Number | Delays | None", dt: Number
) -> Delays | None:
    """The delays of a model's inputs; None where none is late.

    Args:
        model: whose `delays` name the parameters that are delays of single inputs [s].
        common: None, or the delay of all inputs beside their own [s]; Delays are taken as they
            are, and a model's own are no longer added.
        dt: sample time [s].
    """
    if isinstance(common, Delays):
        return common
    # None and not zeros: without a delay the program has no second part in each interval.
    if common is None and not model.delays:
        return None
    own = dict(model.delays)
    # One group a parameter: inputs that share it are late together, and cost no part more.
    keys = [own.get(name) for name in naming.names(model.Inputs)]
    distinct = list(dict.fromkeys(k for k in keys if k is not None or common is not None))
    whole, rest = [], []
    for key in distinct:
        seconds = 0.0 if common is None else jnp.asarray(common)
        if key is not None:
            seconds = seconds + jnp.asarray(getattr(params, key))
        # Both delays of an input add before they are divided: two fractions of a sample may make a
        # whole one.
        samples = jnp.asarray(seconds) / dt
        # The whole part has no derivative; the rest has that of the delay.
        floor = jnp.floor(jax.lax.stop_gradient(samples))
        whole.append(floor.astype(int))
        rest.append(samples - floor)
    # Which inputs are late is known when the program is made, by how much is not: a fit moves
    # delays without compiling anew.
    groups = tuple(distinct.index(k) if k in distinct else None for k in keys)
    return Delays(groups, tuple(whole), tuple(rest))


def at(
    inputs: PyTree,
    k: Int[Array, "..."] | Int[np.ndarray, "..."] | int,
    delays: Delays | None = None,
) -> PyTree:
    """The inputs of sample k; before the first the first, after the last the last.

    Args:
        inputs: a pytree of arrays (N,).
        delays: where given, each input is read its whole samples before k.
    """

    def pick(u: Any, k: Any) -> Any:
        # Clipped on purpose and in sight: JAX would clip an index past the end, and wrap one below
        # zero.
        return u[jnp.clip(k, 0, u.shape[0] - 1)]

    if delays is None:
        return jax.tree.map(lambda u: pick(u, k), inputs)
    leaves, structure = jax.tree.flatten(inputs)
    picked = []
    for i, u in enumerate(leaves):
        group = delays.group(i)
        picked.append(pick(u, k if group is None else k - delays.whole[group]))
    return jax.tree.unflatten(structure, picked)
