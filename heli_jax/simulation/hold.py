"""Inputs between samples: constant (zero-order), on a straight line (linear), or mixed, which stays
until it jumps and follows straight lines elsewhere.

A stick that is commanded in steps stays; one that was sampled while it moved does not. To hold such
an input delays it by half a sample on average.

An input may be late, by one delay of all and one of its own. A delay is whole samples, by which an
array is read further back, and the rest of a sample, which divides every sample interval in two:
before and after the sample that falls into it.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.errors import nearest
from heli_jax.naming import Number, Record
from heli_jax.numerics.jumps import split


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
        """Return which inputs belong to a group."""
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


HOLDS = ("zero-order", "linear", "mixed")
"""The names of what an input may do between samples."""

# A Flight is a class of flights/, which this part does not import; Inputs are anyone's own.
FlightOrInputs = Any
"""a Flight, or a model's Inputs with arrays (N,)"""

type Hold = str | Mapping[str, str] | None
"""one name for all inputs, or names by input"""


class Between(NamedTuple):
    """A model and its inputs, each of which is held or linear in all sample intervals."""

    model: Model
    """takes the staircases of mixed inputs as inputs of their own"""
    inputs: Record
    """arrays (N,)"""
    linear: tuple[bool, ...]
    """of each input whether it is linear between samples; () where none is"""

    def merged(self, inputs: Record, model: Model) -> Record:
        """Return the Inputs of `model`, which this was made of, from those of `self.model`."""
        return inputs if self.model is model else _merged(model, inputs)


def between_samples(
    model: Model, flight: FlightOrInputs, inputs: Record, hold: Hold = None
) -> Between:
    """Return a model and inputs of which each has one hold throughout.

    A mixed input is the sum of a staircase of its jumps, which is held, and the rest, which is
    linear. What takes inputs of either hold takes a mixed one as two.

    Args:
        flight: a Flight, whose own `hold` counts for what `hold` does not name, or Inputs.

    Raises:
        ValueError: an unknown name of an input or of a hold.
    """
    names = naming.names(model.Inputs)
    # What is asked for goes before what the Flight says of its log; arrays alone are held.
    of_flight = getattr(flight, "hold", None)
    by_name = {}
    if isinstance(of_flight, dict):
        by_name = {n: of_flight.get(n, "zero-order") for n in names}
    if isinstance(hold, str):
        by_name = dict.fromkeys(names, hold)
    elif hold is not None:
        for name in hold:
            if name not in names:
                raise ValueError(f"hold: {model.name} has no input {name!r}{nearest(name, names)}")
        # Input by input: what is named goes before the Flight, the others stay as their log has
        # them.
        by_name |= hold
    for value in by_name.values():
        check_hold(value)
    moving = {n for n in names if by_name.get(n, "zero-order") != "zero-order"}
    mixed = tuple(n for n in names if by_name.get(n) == "mixed")
    if mixed:
        model, values = _with_stairs(model, mixed), naming.asdict(inputs)
        for n in mixed:
            values[_stairs(n)], values[n] = split(values[n], jnp)
        inputs = model.Inputs(**values)
    # The empty tuple where none moves: the simpler program, with one matrix less in its recurrence.
    linear = tuple(n in moving for n in naming.names(model.Inputs)) if moving else ()
    return Between(model, inputs, linear)


def _stairs(name: str) -> str:
    return f"stairs_of_{name}"


# Cached: a model is static to jit, and a second one of the same kind would be compiled again.
@functools.cache
def _with_stairs(model: Model, mixed: tuple[str, ...]) -> Model:
    """Return the model with the staircases of mixed inputs as inputs beside the rest of them."""
    annotations = naming.fields(model.Inputs)
    more = {_stairs(n): (annotations[n], None) for n in mixed}
    limits, late = model.limits, dict(model.delays)
    return dataclasses.replace(
        model,
        Inputs=naming.extended(model.Inputs, f"{model.Inputs.__name__}WithStairs", more),
        vector_field=lambda p, x, u: model.vector_field(p, x, _merged(model, u)),
        output=lambda p, x, u: model.output(p, x, _merged(model, u)),
        limits=None if limits is None else lambda p, x, u: limits(p, x, _merged(model, u)),
        delays=(*model.delays, *((_stairs(n), late[n]) for n in mixed if n in late)),
    )


def _merged(model: Model, inputs: Record) -> Record:
    """Return the model's Inputs from those with staircases."""
    of = naming.asdict(inputs)
    return model.Inputs(
        **{
            n: of[n] + of[_stairs(n)] if _stairs(n) in of else of[n]
            for n in naming.names(model.Inputs)
        }
    )


def check_hold(value: PyTree, where: str = "hold") -> None:
    """Refuse what is no hold.

    Raises:
        ValueError: naming the holds there are.
    """
    if value not in HOLDS:
        raise ValueError(f"{where}: expected one of {', '.join(HOLDS)}, got {value!r:.60}")


def at_end(inputs: Record, k: Int[Array, "..."] | int, linear: tuple[bool, ...]) -> Record:
    """The inputs at the end of the interval from sample k on, before any of them jumps."""
    held = at(inputs, k)
    return _chosen(linear, at(inputs, k + 1), held) if linear else held


class Segment(NamedTuple):
    """A part of a sample interval in which every input stays or follows one straight line."""

    length: Array
    """[s]"""
    inputs: Record
    """at its begin"""
    slope: Record
    """of the inputs, per second; zero where they stay"""


def segments(
    inputs: Record,
    dt: Number,
    delays: Delays | None,
    k: Int[Array, "..."] | int,
    linear: tuple[bool, ...],
) -> list[Segment]:
    """The parts of the interval from sample k (an integer or a whole array of them) to the next.

    Args:
        dt: [s].
        delays: None, or how late the inputs are: the interval then has a part more for each group
            of them, divided where its sample falls into it.
    """
    linear = linear or (False,) * len(jax.tree.leaves(inputs))
    if delays is None:
        now = at(inputs, k)
        return [Segment(jnp.asarray(dt), now, _slope(linear, now, at(inputs, k + 1), dt))]
    # Three samples: the one that is late by a fraction arrives within the interval, before it the
    # one before still acts, and a line leads on to the next.
    before, now, after = (at(inputs, k + i, delays) for i in (-1, 0, 1))
    ends, ranks = _divided(delays)
    parts = []
    for j, (begin, end) in enumerate(itertools.pairwise(ends)):
        values, slopes = [], []
        for i, u in enumerate(
            zip(*(jax.tree.leaves(v) for v in (before, now, after)), strict=True)
        ):
            corner, following, since = _line(delays, i, u, ranks, j)
            rise = following - corner
            moves = linear[i]
            values.append(corner + rise * (begin - since) if moves else corner)
            slopes.append(rise / dt if moves else jnp.zeros_like(corner))
        structure = jax.tree.structure(inputs)
        parts.append(
            Segment(
                (end - begin) * dt,
                jax.tree.unflatten(structure, values),
                jax.tree.unflatten(structure, slopes),
            )
        )
    return parts


def _divided(delays: Delays) -> tuple[list[Any], list[Any]]:
    """Return the division points of an interval [samples] with its two ends, and the place of each
    group among them."""
    if len(delays.rest) == 1:  # nothing to sort, and nothing that depends on a value
        return [0.0, delays.rest[0], 1.0], [0]
    rest = jnp.stack(delays.rest)
    # Which delay is the shorter is no smooth question; the times between which the parts lie keep
    # their derivatives.
    order = jnp.argsort(jax.lax.stop_gradient(rest))
    inner = rest[order]
    ranks = jnp.argsort(order)
    ends = [0.0, *(inner[i] for i in range(len(delays.rest))), 1.0]
    return ends, [ranks[g] for g in range(len(delays.rest))]


def _line(delays: Delays, i: int, u: Any, ranks: list[Any], j: int) -> tuple[Any, Any, Any]:
    """The two corners of the line that the i-th input follows in the j-th part, and when the first
    of them was reached [samples, from the begin of the interval].

    By the rank and not by the time: two delays may be the same number.
    """
    before, now, after = u
    group = delays.group(i)
    if group is None:
        return now, after, 0.0
    rest, rank = delays.rest[group], ranks[group]
    if isinstance(rank, int):
        return (now, after, rest) if rank < j else (before, now, rest - 1.0)
    reached = rank < j
    return (
        jnp.where(reached, now, before),
        jnp.where(reached, after, now),
        jnp.where(reached, rest, rest - 1.0),
    )


def _slope(linear: tuple[bool, ...], first: Record, second: Record, dt: Number) -> Record:
    # Over the whole sample time also where a part is shorter: the line is that between two samples.
    slopes = jax.tree.map(lambda a, b: (b - a) / dt, first, second)
    return _chosen(linear, slopes, jax.tree.map(jnp.zeros_like, first))


def delayed(
    inputs: Record, delays: Delays, k: Int[Array, "..."] | int, linear: tuple[bool, ...]
) -> Record:
    """The inputs that act at sample k (an integer or an array of them) when they are late."""
    before, now = at(inputs, k - 1, delays), at(inputs, k, delays)
    acting = []
    leaves = zip(jax.tree.leaves(before), jax.tree.leaves(now), strict=True)
    for i, (earlier, current) in enumerate(leaves):
        group = delays.group(i)
        if group is None:
            acting.append(current)
            continue
        rest = delays.rest[group]
        if linear and linear[i]:
            # On the line between the two samples, `rest` short of the second.
            acting.append(rest * earlier + (1.0 - rest) * current)
        else:
            # One that is late by a part of a sample has not arrived at the sample itself.
            acting.append(jnp.where(rest > 0, earlier, current))
    return jax.tree.unflatten(jax.tree.structure(inputs), acting)


def _chosen(linear: tuple[bool, ...], moving: Record, held: Record) -> Record:
    """The moving ones of the inputs that are linear, the held ones of the others."""
    leaves = zip(linear, jax.tree.leaves(moving), jax.tree.leaves(held), strict=True)
    return jax.tree.unflatten(jax.tree.structure(held), [a if is_ else b for is_, a, b in leaves])
