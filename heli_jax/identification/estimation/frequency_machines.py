"""Machines that take signals to outputs, sample by sample, and the flights that share one.

Source: Pintelon and Schoukens (2012), chapter 6.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.frequency_records import Record, records_of
from heli_jax.identification.estimation.linearised_flights import linear_drive
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.stepping import held_columns

_TOGETHER = 4
"""flights of one machine side by side at most"""


class Matrices(NamedTuple):
    """x[k+1] = Ad x[k] + B U[k], y[k] = C x[k] + D acting[k]; n states, p measured outputs."""

    Ad: Float[Array, "... n n"]
    B: Float[Array, "... n r"]
    C: Float[Array, "... p n"]
    D: Float[Array, "... p m"]


class Machine(NamedTuple):
    """What turns gusts into outputs."""

    Ad: Float[Array, "n n"]
    C: Float[Array, "p n"]


class Signals(NamedTuple):
    """What drives a machine, in time or at the lines."""

    U: Array
    """what B multiplies, (N, r)"""
    acting: Array
    """the inputs that act at the samples, (N, m)"""


class Machines(NamedTuple):
    """Flights that are alike, side by side."""

    matrices: Matrices
    """of all of them, or with a leading axis where parameters are known of each flight"""
    signals: Signals
    """with a leading axis"""
    by: Signals | None
    """likewise with the inputs by instrument; None without"""


def alike(layout: Layout, data: Data) -> list[list[int]]:
    """The flights in groups that differ in numbers alone.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
    """
    groups: dict[Any, list[int]] = {}
    for i, flight in enumerate(data.flights):
        n = next(iter(flight.outputs.values())).shape[0]
        key = (n, layout.outputs[i], layout.holds[i], layout.of_flights[i], tuple(flight.known))
        # An offset of its own moves the point about which a flight is linearised.
        key = key if layout.model.linear else (i, *key)
        groups.setdefault(key, []).append(i)
    return list(groups.values())


def machines_of(layout: Layout, data: Data, u: Unknowns, members: list[int]) -> Machines:
    """Those of one group.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        u: the unknowns, in the units of the model.
        members: the flights' numbers.
    """
    first = members[0]
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *(data.flights[i] for i in members))

    def of_one(flight: Any) -> Machines:
        # With one sample time all that does not hang on the signals is computed once.
        flight = flight._replace(dt=data.flights[first].dt)
        matrices, signals = _machine(layout, data, u, (first, flight))
        if flight.by_instrument is None:
            return Machines(matrices, signals, None)
        # A point to linearise about knows means alone, which inputs by instrument have as well.
        by = flight._replace(inputs=flight.by_instrument)
        return Machines(matrices, signals, _machine(layout, data, u, (first, by))[1])

    axes = Machines(None if _one_machine(data, members) else 0, 0, 0)  # pyright: ignore
    return jax.vmap(of_one, out_axes=axes)(stacked)


def _one_machine(data: Data, members: list[int]) -> bool:
    return len(members) > 1 and not data.flights[members[0]].known


def _machine(
    layout: Layout, data: Data, u: Unknowns, of: tuple[int, Any]
) -> tuple[Matrices, Signals]:
    i, flight = of
    data = data._replace(flights=(*data.flights[:i], flight, *data.flights[i + 1 :]))
    condition = layout.of_flights[i].condition
    model, drive, _ = linear_drive(layout, driven(layout, data, u, i), condition)
    model, inputs, linear = between_samples(model, drive.inputs, drive.inputs, layout.hold(i))
    Ad, B, U, acting = held_columns(model, drive.params, inputs, drive.dt, u.shift, linear)
    _, _, C, D = jacobians(model, drive.params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in layout.outputs[i]])
    return Matrices(Ad, B, C[rows], D[rows]), Signals(U, acting)


def by_flight(
    data: Data,
    members: list[int],
    prepared: Callable[[Any], Any],
    body: Callable[[Any, Any], Any],
    common: Any,
    each: Any,
) -> Any:
    """`body(prepared(common), some of each)` over the flights of a group, with a leading axis.

    Args:
        data: the numbers of the problem.
        members: the flights' numbers.
        prepared: what of it is the same for flights that have one machine.
        body: of a few flights, which have a leading axis in what it is given and what it returns.
        common: of the machine; with a leading axis where each flight has its own.
        each: of the flights, with a leading axis.
    """
    count = len(members)
    one_machine = _one_machine(data, members)
    # A few at a time: what is read for every line of a machine is then read once for all of them,
    # and what is on the way to a few sums of a flight still fits into memory.
    size = max(n for n in range(1, _TOGETHER + 1) if count % n == 0) if one_machine else 1
    some = jax.tree.map(lambda v: v.reshape(count // size, size, *v.shape[1:]), each)
    if one_machine:
        ready = prepared(common)
        made = jax.lax.map(lambda of: body(ready, of), some)
    else:
        made = jax.lax.map(lambda of: body(prepared(of[0]), of[1]), (common, some))
    return jax.tree.map(lambda v: v.reshape(count, *v.shape[2:]), made)


def first_machine(m: Matrices) -> Machine:
    """That of the first flight of a group: records of one length share a spectrum.

    Args:
        m: of all of them, or with a leading axis.
    """
    Ad, C = (v[0] if v.ndim == 3 else v for v in (m.Ad, m.C))
    return Machine(Ad, C)


def parts_of_group(layout: Layout, noise: Noise, members: list[int]) -> list[tuple[Record, Array]]:
    """The records of each flight of a group, with their whitening.

    Args:
        layout: what the unknowns are.
        noise: with the whitening of each record.
        members: the flights' numbers.
    """
    # Records of one length have one spectrum (`smoothed`): that of the first flight's serve all.
    pairs = zip(records_of(layout), noise.whitening, strict=True)
    return [(record, W) for record, W in pairs if record.flight == members[0]]


def measured(layout: Layout, data: Data, members: list[int]) -> Float[Array, "f N p"]:
    """What the flights of a group measured.

    Args:
        layout: says in what order.
        data: the numbers of the problem.
        members: the flights' numbers.
    """
    names = layout.outputs[members[0]]
    columns = [[data.flights[i].outputs[n] for n in names] for i in members]
    return jnp.stack([jnp.stack([jnp.asarray(v) for v in of], axis=1) for of in columns])
