"""What a linear model misses of flights in windows, of stable machines and of unstable ones.

Outputs that forget within a window are simulated; of the others the bounded solution goes through
the windows, and what the ends of the records add to it is projected out.

Sources: Golub and Pereyra (1973) and Kaufman (1975) for the projection.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.analysis.windowed import window_transforms
from heli_jax.identification.estimation.frequency_slopes import (
    differentiated,
    shared_of,
    with_shared,
)
from heli_jax.identification.estimation.response_weights import Machine, ResponseWeights, machine_of
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns, unpack

# What a linear machine does over a record, stable or not, but for what its ends add.
#
# With $z = e^{i \pi (2 k + 1) / N}$ the sums $X = (zI - A_d)^{-1} B U$ are those of the solution
# with $x_N = -x_0$. It is bounded where a simulation diverges, and what a machine does in the
# record is this and $n$ numbers times the effects of the ends: those of stable modes decay from the
# beginning on, those of unstable ones towards the end. Lines half a line away from those of Fourier
# have no pole of an integrator among them. With $H = C (zI - A_d)^{-1}$ the derivative of the
# outputs is $H (dA_d X + dB\,U) + dC X + dD\,U$.
#
# Sources: Pintelon and Schoukens (2012), chapters 6 and 9; Devasia, Chen and Paden (1996) for
# bounded solutions of unstable machines.


_NO_END = 1e-10
"""part of the largest effect of an end below which a state has none"""


class Resolved(NamedTuple):
    """A machine at K lines of a record of N samples."""

    R: Complex[Array, "K n n"]
    """(zI - Ad)^-1"""
    H: Complex[Array, "K p n"]
    """C (zI - Ad)^-1"""


class Driven(NamedTuple):
    """What a flight's inputs make of it."""

    U: Complex[Array, "K r"]
    X: Complex[Array, "K n"]
    """the states"""


def resolved(Ad: Float[Array, "n n"], C: Float[Array, "p n"], samples: int) -> Resolved:
    """A machine at the lines of a record.

    Args:
        Ad: from sample to sample.
        C: of the outputs.
        samples: of the record.
    """
    z, _ = _lines(samples)
    identity = jnp.eye(Ad.shape[0], dtype=z.dtype)
    R = jnp.linalg.inv(z[:, None, None] * identity[None] - Ad.astype(z.dtype)[None])
    return Resolved(R, C.astype(z.dtype)[None] @ R)


def driven_by(machine: Machine, at: Resolved, ends: Float[Array, " n"] | None) -> Driven:
    """The bounded solution.

    Args:
        machine: with the inputs of a flight.
        at: the machine at the record's lines.
        ends: of the states, those of `ends_outputs`; zero unless given.
    """
    z, turns = _lines(machine.U.shape[0])
    U = _at_lines(machine.U, turns)
    driving = U @ machine.B.T.astype(z.dtype)
    if ends is not None:
        driving = driving + z[:, None] * ends.astype(z.dtype)[None, :]
    return Driven(U, jnp.einsum("kij,kj->ki", at.R, driving))


def bounded_outputs(machine: Machine, driven: Driven) -> Float[Array, "p N"]:
    """The outputs over the record.

    Args:
        machine: with the inputs of a flight.
        driven: of these.
    """
    _, turns = _lines(machine.U.shape[0])
    outputs = machine.C.astype(driven.X.dtype) @ driven.X.T
    return _in_time(outputs, turns) + machine.D @ machine.acting.T


def ends_outputs(at: Resolved, samples: int) -> Float[Array, "p n N"]:
    """What the ends of the record add to the outputs, for each state.

    Args:
        at: the machine at the record's lines.
        samples: of the record.
    """
    z, turns = _lines(samples)
    return _in_time(jnp.moveaxis(at.H * z[:, None, None], 0, -1), turns)


def output_slopes(
    machine: Machine, slopes: Machine, at: Resolved, driven: Driven
) -> Float[Array, "p q N"]:
    """The derivatives of the outputs by the unknowns, the ends of the record held.

    Args:
        machine: with the inputs of a flight.
        slopes: its derivatives by q unknowns, a last axis; None in place of those that are zero.
            Where that is all of them, q is 1.
        at: the machine at the record's lines.
        driven: what the inputs make of it.
    """
    N, (U, X) = machine.U.shape[0], driven
    _, turns = _lines(N)
    lines = []
    if slopes.U is not None:
        moved = jnp.einsum("nr,krq->knq", machine.B.astype(X.dtype), _at_lines(slopes.U, turns))
        lines.append(at.H @ moved)
    if (moved := _moved([(X, slopes.Ad), (U, slopes.B)])) is not None:
        lines.append(at.H @ moved)
    if (moved := _moved([(X, slopes.C)])) is not None:
        lines.append(moved)
    time = [_in_time(jnp.moveaxis(sum(lines[1:], lines[0]), 0, -1), turns)] if lines else []
    if slopes.acting is not None:
        time.append(jnp.einsum("pm,tmq->pqt", machine.D, slopes.acting))
    if slopes.D is not None:
        time.append(jnp.einsum("pmq,tm->pqt", slopes.D, machine.acting))
    return sum(time[1:], time[0]) if time else jnp.zeros((len(machine.C), 1, N), machine.C.dtype)


def _moved(pairs: Sequence[tuple[Array, Array | None]]) -> Complex[Array, "K a q"] | None:
    """The sum of dF (a, n, q) x over pairs of signals x (K, n) and dF; None where none moves."""
    moving = [(x, d) for x, d in pairs if d is not None]
    if not moving:
        return None
    # One product of large real matrices: real and imaginary parts are rows of the first.
    x = jnp.concatenate([x for x, _ in moving], axis=1)
    d = jnp.concatenate([d for _, d in moving], axis=1)
    a, n, q = d.shape
    flat = jnp.swapaxes(d, 0, 1).reshape(n, a * q)
    both = jnp.concatenate([jnp.real(x), jnp.imag(x)]) @ flat
    re, im = both.reshape(2, -1, a, q)
    return jax.lax.complex(re, im)


def span(basis: Float[Array, "s n"]) -> tuple[Float[Array, "s n"], Float[Array, "n n"]]:
    """Orthonormal directions of a space, zero where a column is none of its own, and what makes the
    columns' factors of components along them.

    Args:
        basis: what spans it.
    """
    sizes = jnp.linalg.norm(basis, axis=0)
    # A state that no output shows has a column of rounding, which would take some direction off.
    seen = sizes > max(_NO_END, 10.0 * float(jnp.finfo(basis.dtype).eps)) * jnp.max(sizes)
    over = jnp.where(seen, 1.0 / jnp.where(seen, sizes, 1.0), 0.0)
    Q, R = jnp.linalg.qr(basis * over[None, :])
    U, values, Vt = jnp.linalg.svd(R)
    kept = values > _NO_END * values[0]
    root = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)

    return jnp.where(kept[None, :], Q @ U, 0.0), over[:, None] * (Vt.T * root[None, :])


def _lines(N: int) -> tuple[np.ndarray, np.ndarray]:
    """Of half of the lines z (K,), the others being conjugate, and exp(i pi t / N) (N,)."""
    # The odd record's line at Nyquist's frequency is its own conjugate.
    k = np.arange((N + 1) // 2)
    return np.exp(1j * np.pi * (2 * k + 1) / N), np.exp(1j * np.pi * np.arange(N) / N)


def _at_lines(v: Float[Array, "N *c"], turns: Complex[np.ndarray, " N"]) -> Complex[Array, "K *c"]:
    back = np.conj(turns).reshape(-1, *(1 for _ in v.shape[1:]))
    return jnp.fft.fft(v.astype(turns.dtype) * back, axis=0)[: (turns.size + 1) // 2]


def _in_time(
    lines: Complex[Array, "*c K"], turns: Complex[np.ndarray, " N"]
) -> Float[Array, "*c N"]:
    N, K = turns.size, lines.shape[-1]
    weights = np.full(K, 2.0, turns.dtype)
    if N % 2:
        weights[-1] = 1.0
    of_lines, in_time = (v.reshape(*(1 for _ in lines.shape[1:]), -1) for v in (weights, turns))
    return jnp.real(jnp.fft.ifft(lines * of_lines, N, axis=-1) * in_time)


# Flights in windows and their machines, those together that differ in numbers alone.
#
# What is done for one flight of a group is one program for all of them, and what hangs on the
# machine alone is done once where they have the same.


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
