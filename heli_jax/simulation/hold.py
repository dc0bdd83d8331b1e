"""Inputs between samples: held (zero-order), linear, or mixed (held until a jump, else linear).

A stick that is commanded in steps is constant; one that was sampled while moving is not. Holding
the latter delays it by half a sample on average.

An input may have a common delay and one of its own. Whole samples of a delay shift the index into
the array. The remainder divides every sample interval in two, at the time when the delayed sample
acts.
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
    """Delays of the inputs in samples; inputs with equal delay share a group."""

    groups: tuple[int | None, ...] = eqx.field(static=True)
    """Group of each input, in the order of the fields; None for an input without delay."""
    whole: tuple[Array | int, ...]
    """Whole samples of each group, an integer."""
    rest: tuple[Array | float, ...]
    """Remaining fraction of a sample of each group, in [0, 1)."""

    def group(self, i: int) -> int | None:
        """Return the group of the i-th input; columns after the inputs (noise) have no delay."""
        return self.groups[i] if i < len(self.groups) else None

    def members(self, group: int | None) -> tuple[int, ...]:
        """Return the indices of the inputs in a group."""
        return tuple(i for i, g in enumerate(self.groups) if g == group)


def delays_of(
    model: Model, params: Record, common: "Number | Delays | None", dt: Number
) -> Delays | None:
    """Return the delays of a model's inputs; None if there are none.

    Args:
        model: model whose `delays` name the parameters that are delays of single inputs [s].
        common: None, or a delay of all inputs in addition to their own [s]. Delays are used
            unchanged, without the model's own.
        dt: sample time [s].
    """
    if isinstance(common, Delays):
        return common
    # None instead of zeros, so that the program has no second part in each interval.
    if common is None and not model.delays:
        return None
    own = dict(model.delays)
    # One group for each parameter: inputs that share it change together and need no further part.
    keys = [own.get(name) for name in naming.names(model.Inputs)]
    distinct = list(dict.fromkeys(k for k in keys if k is not None or common is not None))
    whole, rest = [], []
    for key in distinct:
        seconds = 0.0 if common is None else jnp.asarray(common)
        if key is not None:
            seconds = seconds + jnp.asarray(getattr(params, key))
        # The delays of an input are added before the division, since two fractions may make a whole
        # sample.
        samples = jnp.asarray(seconds) / dt
        # The whole part has no derivative; the remainder has that of the delay.
        floor = jnp.floor(jax.lax.stop_gradient(samples))
        whole.append(floor.astype(int))
        rest.append(samples - floor)
    # The set of delayed inputs is static; the delays are not, so a fit changes them without
    # compiling.
    groups = tuple(distinct.index(k) if k in distinct else None for k in keys)
    return Delays(groups, tuple(whole), tuple(rest))


def at(
    inputs: PyTree,
    k: Int[Array, "..."] | Int[np.ndarray, "..."] | int,
    delays: Delays | None = None,
) -> PyTree:
    """Return the inputs of sample k, clipped to the first and the last sample.

    Args:
        delays: if given, each input is read its whole number of samples before k.
    """

    def pick(u: Any, k: Any) -> Any:
        # Explicit clip: JAX would clip an index beyond the end, but wrap one below zero.
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
"""Names of the holds of an input between samples."""

# Flight is a class of flights/, which this module does not import; Inputs are the user's.
FlightOrInputs = Any
"""A Flight, or a model's Inputs with arrays (N,)."""

type Hold = str | Mapping[str, str] | None
"""One name for all inputs, or names by input."""


class Between(NamedTuple):
    """A model and its inputs, each with one hold (zero-order or linear) throughout."""

    model: Model
    """Model that takes the staircases of mixed inputs as separate inputs."""
    inputs: Record
    """Inputs with arrays (N,)."""
    linear: tuple[bool, ...]
    """True for each input that is linear between samples; () if none is."""

    def merged(self, inputs: Record, model: Model) -> Record:
        """Return the Inputs of `model`, the original, from those of `self.model`."""
        return inputs if self.model is model else _merged(model, inputs)


def between_samples(
    model: Model, flight: FlightOrInputs, inputs: Record, hold: Hold = None
) -> Between:
    """Return a model and inputs that each have one hold throughout.

    A mixed input becomes two: a staircase of its jumps, which is held, and the rest, which is
    linear.

    Args:
        flight: a Flight, whose own `hold` applies to inputs not in `hold`, or Inputs.

    Raises:
        ValueError: an unknown input or hold.
    """
    names = naming.names(model.Inputs)
    # `hold` takes precedence over the Flight; plain arrays are held.
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
        # Input by input: `hold` takes precedence over the Flight.
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
    # An empty tuple gives the simpler program, with one matrix less in its recurrence.
    linear = tuple(n in moving for n in naming.names(model.Inputs)) if moving else ()
    return Between(model, inputs, linear)


def _stairs(name: str) -> str:
    return f"stairs_of_{name}"


# Cached, since a model is static to jit and a second equal one would be compiled again.
@functools.cache
def _with_stairs(model: Model, mixed: tuple[str, ...]) -> Model:
    """Return the model with staircases of mixed inputs as additional inputs."""
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
    """Refuse an unknown hold.

    Raises:
        ValueError: the value is no hold; the message lists them.
    """
    if value not in HOLDS:
        raise ValueError(f"{where}: expected one of {', '.join(HOLDS)}, got {value!r:.60}")


def at_end(inputs: Record, k: Int[Array, "..."] | int, linear: tuple[bool, ...]) -> Record:
    """Return the inputs at the end of the interval after sample k, before any jump."""
    held = at(inputs, k)
    return _chosen(linear, at(inputs, k + 1), held) if linear else held


class Segment(NamedTuple):
    """A part of a sample interval in which every input is constant or follows one straight line."""

    length: Array
    """Length [s]."""
    inputs: Record
    """Inputs at its start."""
    slope: Record
    """Slope of the inputs per second; zero if held."""


def segments(
    inputs: Record,
    dt: Number,
    delays: Delays | None,
    k: Int[Array, "..."] | int,
    linear: tuple[bool, ...],
) -> list[Segment]:
    """Return the parts of the interval from sample k (an integer or an array) to the next.

    Args:
        dt: sample time [s].
        delays: None, or the delays of the inputs. Each group adds a part, divided where its sample
            acts.
    """
    linear = linear or (False,) * len(jax.tree.leaves(inputs))
    if delays is None:
        now = at(inputs, k)
        return [Segment(jnp.asarray(dt), now, _slope(linear, now, at(inputs, k + 1), dt))]
    # A sample with a fractional delay acts within the interval. Before it the previous sample acts,
    # and after it a line leads to the next, so three samples are needed.
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
    """Return the division points of an interval [samples] with its ends, and each group's index
    among them.
    """
    if len(delays.rest) == 1:  # nothing to sort, and nothing depends on a value
        return [0.0, delays.rest[0], 1.0], [0]
    rest = jnp.stack(delays.rest)
    # The order of delays is not smooth; the times between the parts keep their derivatives.
    order = jnp.argsort(jax.lax.stop_gradient(rest))
    inner = rest[order]
    ranks = jnp.argsort(order)
    ends = [0.0, *(inner[i] for i in range(len(delays.rest))), 1.0]
    return ends, [ranks[g] for g in range(len(delays.rest))]


def _line(delays: Delays, i: int, u: Any, ranks: list[Any], j: int) -> tuple[Any, Any, Any]:
    """Return both corners of the i-th input's line in the j-th part, and the time of the first
    corner.

    The time is in samples from the start of the interval. Parts are found by rank, since two delays
    may be equal.
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
    # Divide by the whole sample time even for a shorter part, since the line is between two
    # samples.
    slopes = jax.tree.map(lambda a, b: (b - a) / dt, first, second)
    return _chosen(linear, slopes, jax.tree.map(jnp.zeros_like, first))


def delayed(
    inputs: Record, delays: Delays, k: Int[Array, "..."] | int, linear: tuple[bool, ...]
) -> Record:
    """Return the acting inputs at sample k (an integer or an array) with delays."""
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
            # Point on the line between the two samples, `rest` before the second.
            acting.append(rest * earlier + (1.0 - rest) * current)
        else:
            # A sample with a fractional delay does not act yet at the sample itself.
            acting.append(jnp.where(rest > 0, earlier, current))
    return jax.tree.unflatten(jax.tree.structure(inputs), acting)


def _chosen(linear: tuple[bool, ...], moving: Record, held: Record) -> Record:
    """Return the `moving` values of linear inputs, and the `held` values of the others."""
    leaves = zip(linear, jax.tree.leaves(moving), jax.tree.leaves(held), strict=True)
    return jax.tree.unflatten(jax.tree.structure(held), [a if is_ else b for is_, a, b in leaves])
