"""Flights in windows and their machines, those together that differ in numbers alone.

What is done for one flight of a group is one program for all of them, and what hangs on the machine
alone is done once where they have the same.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.linear_machine import Machine, machine_of
from heli_jax.identification.estimation.response_weights import ResponseWeights
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns

_SIGNALS = ("U", "acting", "x0")
"""what of a machine each flight has of its own"""


class Group(NamedTuple):
    """Flights of one length with the same outputs, f of them."""

    members: tuple[int, ...]
    """the flights' numbers"""
    kind: tuple[int, ...]
    """those of all flights, of any length, whose machines are made by one program"""
    samples: int
    starts: tuple[int, ...]
    """first samples of the windows"""
    simulated: tuple[int, ...]
    """which of the outputs in windows are simulated"""
    bounded: tuple[int, ...]
    """which do not forget; the flights do not have the others"""
    one_machine: bool
    """whether all of the kind have the same matrices; else these have a leading axis too"""


def groups_of(layout: Layout, data: Data, weights: ResponseWeights) -> list[Group]:
    """Those that have windows.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the windows.
    """
    # Any: what a program is made for.
    kinds: dict[Any, dict[Any, list[int]]] = {}
    for i, (flight, starts) in enumerate(zip(data.flights, weights.windows.starts, strict=True)):
        if starts:
            groups = kinds.setdefault((layout.holds[i], tuple(flight.known)), {})
            key = (_samples(data, i), starts, layout.outputs[i])
            groups.setdefault(key, []).append(i)
    each, made = list(zip(weights.windows.outputs, weights.simulated, strict=True)), []
    for (_, known), groups in kinds.items():
        kind = tuple(sorted(i for members in groups.values() for i in members))
        for (n, starts, names), members in groups.items():
            through, rest = (
                tuple(k for k, (o, sent) in enumerate(each) if o in names and sent == of)
                for of in (True, False)
            )
            made.append(Group(tuple(members), kind, n, starts, through, rest, not known))
    return made


def _samples(data: Data, i: int) -> int:
    return next(iter(data.flights[i].outputs.values())).shape[0]


def machines_of(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns, groups: list[Group]
) -> list[Machine]:
    """Those of each group, the flights as a leading axis of what they have of their own. The
    outputs are those in windows.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the initial states and offsets.
        u: the unknowns.
        groups: all of them.
    """
    # One of each kind for all its flights: to trace a model and its matrices takes longest.
    made = {g.kind: _of_kind(layout, data, weights, u, g) for g in groups}

    def of_group(g: Group) -> Machine:
        at = np.searchsorted(g.kind, g.members)
        of_kind = made[g.kind]
        own = {n: getattr(of_kind, n)[at] for n in _SIGNALS}
        own |= {n: own[n][:, : g.samples] for n in ("U", "acting")}
        if not g.one_machine:
            own |= {n: v[at] for n, v in of_kind._asdict().items() if n not in _SIGNALS}
        return of_kind._replace(**own)

    return [of_group(g) for g in groups]


def _of_kind(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns, group: Group
) -> Machine:
    (first, *_), (states, offsets) = group.kind, weights.begun
    longest = max(_samples(data, i) for i in group.kind)
    layout = dataclasses.replace(layout, outputs=(weights.windows.outputs,) * len(data.flights))

    # Any: the model's own records.
    def own(i: int) -> Any:
        flight, more = data.flights[i], longest - _samples(data, i)
        # Held beyond its end: what acts at a sample goes by the samples up to the next one.
        inputs = jax.tree.map(lambda v: jnp.pad(v, (0, more), mode="edge"), flight.inputs)
        return inputs, flight.known, states[i], offsets[i]

    def of_one(inputs: Any, known: Any, state: Any, offset: Any) -> Machine:
        # With one sample time all that does not hang on the signals is computed once.
        flight = data.flights[first]._replace(inputs=inputs, known=known)
        numbers = data._replace(flights=_with(data.flights, first, flight))
        # Numbers, not unknowns: they are found in time, since responses hardly tell them.
        begun = u._replace(
            states=_with(u.states, first, state), offsets=_with(u.offsets, first, offset)
        )
        return machine_of(layout, numbers, begun, first)

    each = jax.tree.map(lambda *v: jnp.stack(v), *(own(i) for i in group.kind))
    axes = (0 if n in _SIGNALS or not group.one_machine else None for n in Machine._fields)
    return jax.vmap(of_one, out_axes=Machine(*axes))(*each)  # pyright: ignore


def _with(values: tuple[Any, ...], i: int, value: Any) -> tuple[Any, ...]:
    return (*values[:i], value, *values[i + 1 :])


class Flights(NamedTuple):
    """What was measured in each flight of a group, with a leading axis."""

    y: Float[Array, "f p N"]
    """the outputs in windows; zero where nothing is measured"""
    Z: Array
    """(f, W, k, m), see `Windowed`"""
    seen: Array
    """(f, W, p)"""


def flights_of(data: Data, weights: ResponseWeights, group: Group) -> Flights:
    """Signals and windows of a group.

    Args:
        data: the numbers of the problem.
        weights: with the windows.
        group: of flights.
    """
    w = weights.windows
    first = np.cumsum([0, *(len(s) for s in w.starts)])
    own = [slice(first[i], first[i + 1]) for i in group.members]

    def measured(i: int) -> Array:
        outputs = data.flights[i].outputs
        absent = jnp.zeros_like(next(iter(outputs.values())))
        return jnp.stack([jnp.nan_to_num(outputs.get(n, absent)) for n in w.outputs])

    return Flights(
        jnp.stack([measured(i) for i in group.members]),
        jnp.stack([w.Z[at] for at in own]),
        jnp.stack([w.seen[at] for at in own]),
    )


def over_flights(
    group: Group,
    machines: tuple[Machine, ...],
    prepared: Callable[..., Any],
    body: Callable[..., Any],
    each: Any,
) -> Any:
    """`body(prepared(*machines), *machines, each)` of one flight after another, with a leading
    axis.

    Args:
        group: of flights.
        machines: of `machines_of`, maybe with their derivatives.
        prepared: what hangs on matrices alone.
        body: of one flight.
        each: arrays of the flights, with a leading axis.
    """
    own = [{n: v for n, v in m._asdict().items() if n in _SIGNALS} for m in machines]
    common = [m._replace(**dict.fromkeys(_SIGNALS)) for m in machines]

    def of_one(ready: Any, common: Any, of: Any) -> Any:
        own, each = of
        return body(ready, *(m._replace(**v) for m, v in zip(common, own, strict=True)), each)

    if group.one_machine:
        ready = prepared(*common)
        return jax.lax.map(lambda of: of_one(ready, common, of), (own, each))
    return jax.lax.map(lambda of: of_one(prepared(*of[0]), *of), (common, (own, each)))
