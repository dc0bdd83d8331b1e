"""What a linear model misses of flights in windows, of stable machines and of unstable ones.

Outputs that forget within a window are simulated; of the others the bounded solution goes through
the windows, and what the ends of the records add to it is projected out.

Sources: Golub and Pereyra (1973) and Kaufman (1975) for the projection.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.analysis.windowed import window_transforms
from heli_jax.identification.estimation.bounded_solution import (
    Resolved,
    bounded_outputs,
    driven_by,
    ends_outputs,
    output_slopes,
    resolved,
    span,
)
from heli_jax.identification.estimation.linear_machine import Machine
from heli_jax.identification.estimation.response_weights import ResponseWeights
from heli_jax.identification.estimation.shared_unknowns import (
    differentiated,
    shared_of,
    with_shared,
)
from heli_jax.identification.estimation.window_flights import (
    Flights,
    Group,
    flights_of,
    groups_of,
    machines_of,
    over_flights,
)
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns, unpack


def rows_of_responses(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns
) -> Float[Array, " r"]:
    """Whitened errors of all responses, without what the ends of the records may add.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the windows.
        u: the unknowns, in the units of the model.
    """
    rest, groups = jax.lax.stop_gradient(u), groups_of(layout, data, weights)

    def machines(v: Array) -> list[Machine]:
        return machines_of(layout, data, weights, with_shared(layout, rest, v), groups)

    @jax.custom_jvp
    def rows(v: Array) -> Array:
        return _rows(layout, data, weights, list(zip(groups, machines(v), strict=True))).rows

    # The derivatives share most of what they are made of, which forward differentiation of the
    # whole, an unknown at a time, does not know.
    @rows.defjvp
    def _(at: tuple[Array], along: tuple[Array]) -> tuple[Array, Array]:
        made, slopes = differentiated(machines, at[0])
        of_groups = list(zip(groups, made, strict=True))
        of = _rows(layout, data, weights, of_groups)
        J = _slopes(layout, data, weights, of_groups, slopes, of)
        return of.rows, jnp.zeros_like(of.rows) if J is None else J @ along[0]

    return rows(shared_of(layout, u))


class _Rows(NamedTuple):
    """Whitened errors, without what the ends of the records may add."""

    rows: Float[Array, " r"]
    Q: Float[Array, "r e"] | None
    """directions of what the ends add; None where all outputs forget"""
    ends: list[Float[Array, "f n"] | None]
    """by group those that suit the errors best"""


def _rows(
    layout: Layout, data: Data, weights: ResponseWeights, machines: list[tuple[Group, Machine]]
) -> _Rows:
    total, effects = [], []
    for group, machine in machines:

        def body(at: "_Ends | None", m: Machine, own: Flights, group: Group = group) -> Any:
            E = _windows(weights, group, own.y - _modelled(layout, weights, group, m, at))
            of_ends = None if at is None else _cross(own, at.effects)
            return _cross(own, E[:, None]), of_ends

        S, of_ends = over_flights(
            group,
            (machine,),
            functools.partial(_resolved, weights, group),
            body,
            flights_of(data, weights, group),
        )
        total.append(jnp.sum(S, axis=0))
        effects.append(of_ends)
    rows = _whitened(weights, sum(total[1:], total[0]))[:, 0]
    seen = [v for v in effects if v is not None]
    if not seen:
        return _Rows(rows, None, [None] * len(machines))
    # The states of each flight in turn, as columns.
    columns = [jnp.moveaxis(v, 0, 3).reshape(*v.shape[1:4], -1) for v in seen]
    Q, solution = span(_whitened(weights, jnp.concatenate(columns, axis=3)))
    along = Q.T @ rows
    first = np.cumsum([0, *(v.shape[3] for v in columns)])
    each = iter(jnp.split(solution @ along, first[1:-1]))
    ends = [None if v is None else next(each).reshape(v.shape[0], -1) for v in effects]
    return _Rows(rows - Q @ along, Q, ends)


def _slopes(
    layout: Layout,
    data: Data,
    weights: ResponseWeights,
    machines: list[tuple[Group, Machine]],
    slopes: list[Machine],
    of: _Rows,
) -> Float[Array, "r q"] | None:
    """The derivatives of the rows by the unknowns that all flights share; None where all are zero.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the windows.
        machines: of each group.
        slopes: derivatives of these.
        of: the rows there.
    """
    total = []
    for (group, machine), slope, ends in zip(machines, slopes, of.ends, strict=True):
        # Of outputs that do not forget the initial state is among the ends, which are held.
        felt = group.simulated or group.bounded
        moving = slope if group.simulated else slope._replace(x0=None)
        if not felt or all(d is None for d in moving):
            continue

        def body(
            at: Resolved | None, m: Machine, dm: Machine, of: Any, group: Group = group
        ) -> Array:
            own, ends = of
            y = _modelled_slopes(layout, weights, group, (m, dm), at, ends)
            return _cross(own, _windows(weights, group, y))

        S = over_flights(
            group,
            (machine, slope),
            lambda m, _, group=group: _bounded(group, m),
            body,
            (flights_of(data, weights, group), ends),
        )
        total.append(jnp.sum(S, axis=0))
    if not total:
        return None
    J = -_whitened(weights, sum(total[1:], total[0]))
    # Variable projection (Golub and Pereyra; Kaufman): about the ends that suit these unknowns
    # best, whose own effect moves with the unknowns.
    return J if of.Q is None else J - of.Q @ (of.Q.T @ J)


class _Ends(NamedTuple):
    """A machine whose outputs do not all forget."""

    at: Resolved
    """its lines, of the outputs that do not"""
    effects: Complex[Array, "p n W k"]
    """what the ends of a record add to the outputs in windows, for each state"""


def _bounded(group: Group, m: Machine) -> Resolved | None:
    if not group.bounded:
        return None
    return resolved(m.Ad, m.C[np.asarray(group.bounded)], group.samples)


def _resolved(weights: ResponseWeights, group: Group, m: Machine) -> _Ends | None:
    at = _bounded(group, m)
    if at is None:
        return None
    E = _windows(weights, group, ends_outputs(at, group.samples))
    return _Ends(at, _all_outputs(weights, group, None, E))


def _modelled(
    layout: Layout, weights: ResponseWeights, group: Group, m: Machine, ends: _Ends | None
) -> Float[Array, "p N"]:
    """The outputs in windows over a record, of those that do not forget without its ends."""
    simulated = bounded = None
    if not (group.simulated or group.bounded):
        return jnp.zeros((len(weights.windows.outputs), group.samples), m.C.dtype)
    if group.simulated:
        simulated = _of(m, group.simulated).simulated(layout.block)
    if ends is not None:
        of = _of(m, group.bounded)
        bounded = bounded_outputs(of, driven_by(of, ends.at, None))
    return _all_outputs(weights, group, simulated, bounded)


def _modelled_slopes(
    layout: Layout,
    weights: ResponseWeights,
    group: Group,
    machine: tuple[Machine, Machine],
    at: Resolved | None,
    ends: Float[Array, " n"] | None,
) -> Float[Array, "p q N"]:
    """Their derivatives, the ends held.

    Args:
        layout: what the unknowns are.
        weights: with the windows.
        group: of flights.
        machine: of one of them, and its derivatives.
        at: the machine at the record's lines; None where all outputs forget.
        ends: its ends.
    """
    simulated = bounded = None
    if group.simulated:
        m, dm = (_of(v, group.simulated) for v in machine)
        moving = {n: d for n, d in zip(m._fields, dm, strict=True) if d is not None}

        def run(parts: dict[str, Array]) -> Array:
            return m._replace(**parts).simulated(layout.block)

        here = {n: getattr(m, n) for n in moving}
        along = jax.vmap(lambda d: jax.jvp(run, (here,), (d,))[1], in_axes=-1, out_axes=1)
        simulated = along(moving)
    if at is not None:
        m, dm = (_of(v, group.bounded) for v in machine)
        bounded = output_slopes(m, dm, at, driven_by(m, at, ends))
    return _all_outputs(weights, group, simulated, bounded)


def _all_outputs(
    weights: ResponseWeights, group: Group, simulated: Array | None, bounded: Array | None
) -> Array:
    """(p, ...) of all outputs in windows, zero where one is not given."""
    given = [(k, v) for k, v in ((group.simulated, simulated), (group.bounded, bounded))]
    (like, *_) = (v for _, v in given if v is not None)
    y = jnp.zeros((len(weights.windows.outputs), *like.shape[1:]), like.dtype)
    for rows, v in given:
        y = y if v is None else y.at[np.asarray(rows)].set(v)
    return y


def _of(m: Machine, rows: tuple[int, ...]) -> Machine:
    """A machine, or its derivatives, with some of its outputs."""
    C, D = (None if v is None else v[np.asarray(rows)] for v in (m.C, m.D))
    return m._replace(C=C, D=D)


def _windows(
    weights: ResponseWeights, group: Group, y: Float[Array, "*c N"]
) -> Complex[Array, "*c W k"]:
    """Signals of a flight in its windows."""
    w = weights.windows
    E = window_transforms(y.reshape(-1, y.shape[-1]), group.starts, w.length, w.numbers, w.dt)
    return jnp.asarray(E).reshape(*y.shape[:-1], *E.shape[1:])


def _cross(own: Flights, E: Complex[Array, "p c W k"]) -> Complex[Array, "k p m c"]:
    """Products with the instruments in windows, summed over a flight."""
    E = E * own.seen.T[:, None, :, None].astype(E.dtype)
    return jnp.einsum("wkz,pcwk->kpzc", jnp.conj(own.Z), E)


def _whitened(weights: ResponseWeights, S: Complex[Array, "k p m c"]) -> Float[Array, "r c"]:
    """What such sums over all flights make of the responses, in rows of variance 1."""
    w, (k, c) = weights.windows, (S.shape[0], S.shape[3])
    S = S / jnp.sum(w.seen, axis=0).astype(S.dtype)[None, :, None, None]
    dH = jnp.einsum("pkmz,kpzc->kpmc", weights.averages.P, S)
    rows = weights.whitening @ dH.reshape(k, -1, c)
    # Of a complex normal error each part has half of the variance.
    return 2.0**0.5 * jnp.concatenate([jnp.real(rows), jnp.imag(rows)]).reshape(-1, c)


@eqx.filter_jit
def errors_in_windows(
    layout: Layout, data: Data, weights: ResponseWeights, z: Array
) -> Complex[Array, "W k p"]:
    """Transforms of measured less modelled outputs; zero where an output is not seen.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the windows.
        z: the unknowns.
    """
    u, by_flight = unpack(layout, data, z), dict[int, Array]()
    groups = groups_of(layout, data, weights)
    machines = machines_of(layout, data, weights, u, groups)
    # Of all that is seen in the windows, each output by its noise, and not of the responses alone.
    power = jnp.real(jnp.einsum("kii->ki", weights.density))
    for group, machine in zip(groups, machines, strict=True):

        def body(at: _Ends | None, m: Machine, own: Flights, group: Group = group) -> Array:
            E = _windows(weights, group, own.y - _modelled(layout, weights, group, m, at))
            seen = own.seen.T[:, :, None].astype(E.dtype)
            if at is None:
                return E * seen
            scale = seen / jnp.sqrt(power).T[:, None, :].astype(E.dtype)

            def rows(v: Array) -> Array:
                v = jnp.moveaxis(v * scale[:, None], 1, -1).reshape(-1, v.shape[1])
                return jnp.concatenate([jnp.real(v), jnp.imag(v)])

            Q, solution = span(rows(at.effects))
            ends = solution @ (Q.T @ rows(E[:, None])[:, 0])
            return (E - jnp.einsum("n,pnwk->pwk", ends.astype(E.dtype), at.effects)) * seen

        made = over_flights(
            group,
            (machine,),
            functools.partial(_resolved, weights, group),
            body,
            flights_of(data, weights, group),
        )
        by_flight |= {i: jnp.moveaxis(made[j], 0, -1) for j, i in enumerate(group.members)}
    return jnp.concatenate([by_flight[i] for i in sorted(by_flight)])
