r"""A model's error at a record's own frequencies, whitened, without what the ends may add.

Complex numbers of a line stand as real ones, real parts first: their products are then products of
real matrices, for which libraries are fastest.

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Golub and Pereyra (1973) and Kaufman
(1975) for the projection.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.frequency_records import Record, records_of
from heli_jax.identification.estimation.linearised_flights import linear_drive
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns, unpack
from heli_jax.simulation.hold import linear_inputs
from heli_jax.simulation.stepping import held_columns

_TOGETHER = 4
"""flights of one machine side by side at most"""
_NO_END = 1e-10
"""part of the largest effect of an end's state below which a state has none"""
_SPARED = 0.1
"""part of a record's numbers that its ends may take, those of gusts among them"""


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


class Resolved(NamedTuple):
    """What a machine does at every line of a record, signals apart; without a derivative."""

    z: Complex[np.ndarray, " K"]
    T: Complex[Array, "n n"]
    """Ad = V T V^H, triangular"""
    V: Complex[Array, "n n"]
    W: Complex[Array, "K p p"]
    """the whitening"""
    H: Complex[Array, "K p n"]
    """W C (zI - Ad)^-1"""
    ends: Complex[np.ndarray, "K e"]
    """what drives a state that ends elsewhere than it began and, but in a very short record, what
    does where a slow gust that pushes it does"""
    Q: Float[Array, "s m"]
    """an orthonormal basis of what the ends may add to whitened rows; zero where a state leaves no
    trace"""
    solution: Float[Array, "m m"]
    """from the components along Q to the ends' states, and behind these to the gusts'"""


class Errors(NamedTuple):
    """Of one record, with what they came of."""

    rows: Float[Array, "K 2p"]
    """measured less simulated, whitened, the ends of the record taken off"""
    X: Complex[Array, "K n"]
    """the states"""
    signals: Signals
    """at the lines"""
    beyond: Complex[Array, "K p"]
    """measured less what the inputs add to the outputs past the states"""


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
    linear = linear_inputs(model, drive.inputs, layout.hold(i))
    Ad, B, U, acting = held_columns(model, drive.params, drive.inputs, drive.dt, u.shift, linear)
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


def resolved(m: Matrices, record: Record, whitening: Complex[Array, "K p p"]) -> Resolved:
    """A machine at the lines of a record.

    Args:
        m: its matrices.
        record: which samples it is.
        whitening: of the record's lines.
    """
    z = np.exp(2j * np.pi * np.arange(1, record.lines + 1) / record.samples)
    z = z.astype(np.result_type(m.Ad.dtype, np.complex64))
    T, V = _triangle(m.Ad)
    H = whitening @ (_solved(z, T, m.C.astype(z.dtype) @ V, left=False) @ jnp.conj(V.T))
    # A gust that ends elsewhere than it began has its leap at all lines: taken for noise of each
    # line by itself it moves slow modes by several standard deviations. Above its corner it is an
    # integrated push. Over the length, so that it is no larger than the states' own ends.
    ends = np.stack([z, z / (z - 1.0) / record.samples], axis=1)
    _, p, n = H.shape
    if 2 * n > _SPARED * 2 * p * record.lines:
        ends = ends[:, :1]
    # What the ends of the record explain is found by linear least squares.
    basis = jnp.concatenate([H * v[:, None, None] for v in jnp.asarray(ends).T], axis=2)
    Q, solution = _span(stacked(basis).reshape(-1, basis.shape[2]))
    return Resolved(z, T, V, whitening, H, ends, Q, solution)


def _triangle(Ad: Float[Array, "n n"]) -> tuple[Complex[Array, "n n"], Complex[Array, "n n"]]:
    """T and V with Ad = V T V^H, V unitary."""

    def triangle(Ad: Array) -> tuple[Array, Array]:
        T, V = jax.scipy.linalg.schur(Ad, output="complex")
        return T, V

    def whole(Ad: Array) -> tuple[Array, Array]:
        T = Ad.astype(np.result_type(Ad.dtype, np.complex64))
        return T, jnp.eye(Ad.shape[0], dtype=T.dtype)

    # Schur's triangle makes of an inverse for each line a substitution, and is as well-behaved. JAX
    # has it for the CPU alone: elsewhere `_solved` takes the matrix as it is.
    return jax.lax.platform_dependent(Ad, cpu=triangle, default=whole)


def _span(basis: Float[Array, "s m"]) -> tuple[Float[Array, "s m"], Float[Array, "m m"]]:
    Q, R = jnp.linalg.qr(basis)
    # A state that no output shows has a column of rounding, and QR makes some direction of it,
    # another at each step: what that takes off makes the sum of squares rough.
    U, sizes, Vt = jnp.linalg.svd(R)
    kept = sizes > _NO_END * sizes[0]
    over = jnp.where(kept, 1.0 / jnp.where(kept, sizes, 1.0), 0.0)
    return Q @ jnp.where(kept[None, :], U, 0.0), Vt.T * over[None, :]


def stacked(v: Array) -> Array:
    """Real parts and imaginary ones (K, 2, ...) of complex numbers (K, ...)."""
    return jnp.stack([jnp.real(v), jnp.imag(v)], axis=1)


def real(M: Complex[Array, "K a b"]) -> Float[Array, "K 2a 2b"]:
    """The real matrix that does to stacked vectors what M does to complex ones."""
    re, im = jnp.real(M), jnp.imag(M)
    return jnp.concatenate(
        [jnp.concatenate([re, -im], axis=2), jnp.concatenate([im, re], axis=2)], axis=1
    )


def at_lines(record: Record, v: Float[Array, "N c"]) -> Complex[Array, "K c"]:
    """The Fourier transform of a record's part of signals, over the root of its length.

    Args:
        record: which samples it is.
        v: over the whole flight; columns behind delays, so that what acted in a part was logged
            before it.
    """
    # Without a mean: the zero line is not used, and rounding would carry it to the others.
    part = v[record.first : record.last]
    part = part - jnp.mean(part, axis=0, keepdims=True)
    return jnp.fft.rfft(part, axis=0)[1 : 1 + record.lines] * float(record.samples) ** -0.5


def errors_of_some(
    at: Resolved,
    m: Matrices,
    record: Record,
    signals: Signals,
    y: Float[Array, "f N p"],
    by: Signals | None = None,
) -> tuple[Errors, Complex[Array, "f K n"] | None]:
    """Of one record of each of a few flights of one machine, with a leading axis; and the states
    that inputs by instrument make, None without any.

    Args:
        at: the machine at the record's lines.
        m: the machine.
        record: which samples it is.
        signals: over the whole flights.
        y: what was measured.
        by: the inputs by instrument.
    """
    B, D = (M.T.astype(at.z.dtype) for M in (m.B, m.D))

    def of_one(signals: Signals, y: Float[Array, "N p"]) -> tuple[Array, Array, Signals, Array]:
        lines = Signals(*(at_lines(record, v) for v in signals))
        beyond = at_lines(record, y) - lines.acting @ D
        driving = lines.U @ B
        white = stacked(_times(at.W, beyond) - _times(at.H, driving)).reshape(record.lines, -1)
        # The ends of the record: what they add lies along Q.
        along = at.Q.T @ white.reshape(-1)
        d = (at.solution @ along).reshape(at.ends.shape[1], -1).astype(at.z.dtype)
        rows = white - (at.Q @ along).reshape(white.shape)
        return rows, driving + at.ends @ d, lines, beyond

    # Under vmap flights are columns of the same products and substitutions.
    rows, driving, lines, beyond = jax.vmap(of_one)(signals, y)
    if by is not None:
        others = jax.vmap(lambda U: at_lines(record, U) @ B)(by.U)
        driving = jnp.concatenate([driving, others])
    X = jax.vmap(lambda driving: states(at, driving))(driving)
    count = rows.shape[0]
    return Errors(rows, X[:count], lines, beyond), None if by is None else X[count:]


def states(at: Resolved, driving: Complex[Array, "K n"]) -> Complex[Array, "K n"]:
    """(zI - Ad)^-1 of what drives them.

    Args:
        at: the machine at the lines.
        driving: B U, and the ends.
    """
    seen = (driving @ jnp.conj(at.V))[:, :, None]
    return _solved(at.z, at.T, seen, left=True)[:, :, 0] @ at.V.T


def _solved(z: Complex[np.ndarray, " K"], T: Array, b: Array, *, left: bool) -> Array:
    """(zI - T)^-1 b at each line (K, ...), or b (zI - T)^-1, with T of `_triangle`."""
    M = z[:, None, None] * jnp.eye(T.shape[0], dtype=z.dtype)[None] - T[None]
    b = jnp.broadcast_to(b, (len(z), *b.shape[-2:]))

    def whole(M: Array, b: Array) -> Array:
        if left:
            return jnp.linalg.solve(M, b)
        turned = jnp.linalg.solve(jnp.swapaxes(M, 1, 2), jnp.swapaxes(b, 1, 2))
        return jnp.swapaxes(turned, 1, 2)

    def triangle(M: Array, b: Array) -> Array:
        return jax.lax.linalg.triangular_solve(M, b, left_side=left, lower=False)

    return jax.lax.platform_dependent(M, b, cpu=triangle, default=whole)


def _times(M: Complex[Array, "K a b"], v: Complex[Array, "K b"]) -> Complex[Array, "K a"]:
    # A sum: products of a small matrix and a vector each would call a routine for every line.
    return jnp.sum(M * v[:, None, :], axis=2)


@eqx.filter_jit
def errors_of_lines(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> tuple[list[Complex[Array, "K p"]], Machine]:
    """By record the errors, its ends taken off, not whitened; and the machine of the first flight.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: with the whitening of each record.
        z: the unknowns.
    """
    u, errors, first = unpack(layout, data, z), {}, None
    for members in alike(layout, data):
        parts = parts_of_group(layout, noise, members)
        machines, y = machines_of(layout, data, u, members), measured(layout, data, members)

        def ready(m: Matrices, parts: Any = parts) -> Any:
            return m, [resolved(m, record, W) for record, W in parts]

        def of_some(common: Any, some: Any, parts: Any = parts) -> list[Array]:
            m, ats = common
            made = []
            for at, (record, _) in zip(ats, parts, strict=True):
                e, _ = errors_of_some(at, m, record, *some)
                made.append(e.beyond - e.X @ m.C.T.astype(at.z.dtype))
            return made

        first = first_machine(machines.matrices) if first is None else first
        each = (machines.signals, y)
        made = by_flight(data, members, ready, of_some, machines.matrices, each)
        for k, i in enumerate(members):
            errors[i] = [v[k] for v in made]
    assert first is not None
    return [one for i in range(len(data.flights)) for one in errors[i]], first


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
