"""A model's error at a record's own frequencies, whitened, without what the ends may add.

Complex numbers of a line stand as real ones, real parts first: their products are then products of
real matrices, for which libraries are fastest.

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Golub and Pereyra (1973) and Kaufman
(1975) for the projection.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.trim import Condition
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import FEWEST, SHORTEST, spans
from heli_jax.identification.estimation.linearised_flights import linear_drive
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns, unpack
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.stepping import held_columns

# The records that frequency error transforms: flights, cut where an output has a missing sample.
#
# A Fourier transform has no place for a missing sample. Since the ends of a record are projected
# out, a part costs no more than the few numbers of its own ends, and nothing has to be filled in.


class FlightFacts(NamedTuple):
    """Facts of a flight that are fixed before anything is traced."""

    parts: tuple[tuple[int, int], ...]
    """first sample, and that behind the last, of each part that is a record of its own"""
    dt: float
    """[s]: flights of one sample time share much of their program"""
    condition: Condition | None = None
    """the steady flight about which a whole helicopter is linearised"""


class Record(NamedTuple):
    """Samples in a row of one flight."""

    flight: int
    """its number"""
    first: int
    last: int
    """the sample behind its last one"""

    @property
    def samples(self) -> int:
        """N."""
        return self.last - self.first

    @property
    def lines(self) -> int:
        """Frequencies of the record's own, without zero and the Nyquist frequency."""
        return (self.samples - 1) // 2


def lines_of(v: Float[np.ndarray, "N c"]) -> Complex[np.ndarray, "K c"]:
    """Fourier transform of signals at a record's own frequencies, over the root of its length."""
    N = len(v)
    return np.fft.rfft(v - v.mean(axis=0), axis=0)[1 : 1 + (N - 1) // 2] / np.sqrt(N)


def in_time_of(lines: Complex[np.ndarray, "K c"], samples: int) -> Float[np.ndarray, "N c"]:
    """The inverse of `lines_of`: signals without a mean."""
    whole = np.zeros((samples // 2 + 1, lines.shape[1]), complex)
    whole[1 : 1 + len(lines)] = lines * np.sqrt(samples)
    return np.fft.irfft(whole, samples, axis=0)


def parts_of(flight: Flight) -> tuple[tuple[int, int], ...]:
    """First sample, and that behind the last, of each part in which all outputs are there; without
    those that are too short to be records. A flight without a missing sample is one part.

    Args:
        flight: with at least one output.
    """
    seen = spans(flight.outputs.values())
    if seen == [(0, flight.n_samples)]:
        return tuple(seen)
    # As with the parts of `gaps: split`: each has ends of its own, which short ones hardly tell.
    least = max(FEWEST, int(np.ceil(SHORTEST / flight.dt)))
    return tuple((a, b) for a, b in seen if b - a >= least)


def records_of(layout: Layout) -> list[Record]:
    """All records, flight after flight."""
    return [Record(i, a, b) for i, facts in enumerate(layout.flight_facts) for a, b in facts.parts]


def without_parts(flights: Sequence[Flight]) -> str | None:
    """The reason why a flight leaves no record, and what to do; None where each leaves one."""
    for flight in flights:
        if parts_of(flight):
            continue
        missing = {n: float(np.mean(~np.isfinite(y))) for n, y in flight.outputs.items()}
        worst = max(missing, key=lambda n: missing[n])
        return (
            f"{flight.name or 'a flight'}: output {worst} lacks {100 * missing[worst]:.2g} % of "
            f"its samples, and no part of at least {SHORTEST:g} s and {FEWEST} samples has all "
            "outputs without a missing one, which a Fourier transform needs; leave that output "
            "out, lower flights[].rate to its own rate, or use output-error or filter-error"
        )
    return None


def other_outputs(flights: Sequence[Flight]) -> str | None:
    """The flights without the outputs of the others, and what to do; None where all have them."""
    # The noise's spectrum is one matrix over the outputs.
    common = set.intersection(*(set(f.outputs) for f in flights))
    for flight in flights:
        more = sorted(set(flight.outputs) - common)
        if more:
            return (
                f"{flight.name or 'a flight'}: output {', '.join(more)} is not in every flight, "
                "and frequency-error has one spectrum of noise for all; leave it out "
                "(signals.outputs), or use frequency-response, output-error or filter-error"
            )
    return None


def cut_notes(layout: Layout, data: Data, names: Sequence[str]) -> list[Finding]:
    """By flight that was cut, how much of it is used."""
    notes = []
    for i, (flight, facts) in enumerate(zip(data.flights, layout.flight_facts, strict=True)):
        parts = facts.parts
        n = next(iter(flight.outputs.values())).shape[0]
        used = sum(b - a for a, b in parts)
        if used == n:
            continue
        dt = float(flight.dt)
        lacking = [name for name, y in flight.outputs.items() if not np.isfinite(y).all()]
        several = len(data.flights) > 1
        words = (
            f"{names[i] if several else 'The flight'} was cut where samples of "
            f"{', '.join(lacking)} are missing: {used * dt:.4g} of {n * dt:.4g} s are used, in "
            f"{len(parts)} {'parts' if len(parts) > 1 else 'part'} with ends of their own."
        )
        notes.append(note("frequency.flight-cut", words, *lacking))
    return notes


# Machines that take signals to outputs, sample by sample, and the flights that share one.
#
# Source: Pintelon and Schoukens (2012), chapter 6.


class Matrices(NamedTuple):
    """x[k+1] = Ad x[k] + B U[k], y[k] = C x[k] + D held[k]; n states, p measured outputs."""

    Ad: Float[Array, "... n n"]
    B: Float[Array, "... n r"]
    C: Float[Array, "... p n"]
    D: Float[Array, "... p m"]


class Driving(NamedTuple):
    """Inputs of a vehicle, in time or at the lines."""

    U: Array
    """what B multiplies, (N, r)"""
    held: Array
    """the inputs that act at the samples, (N, m): what D multiplies"""


class Machines(NamedTuple):
    """Flights that are alike, side by side."""

    matrices: Matrices
    """of all of them, or with a leading axis where parameters are known of each flight"""
    driving: Driving
    """with a leading axis"""
    by: Driving | None
    """likewise with the inputs by instrument; None without"""


def alike(layout: Layout, data: Data) -> list[list[int]]:
    """The flights in groups that differ in numbers alone."""
    groups: dict[Any, list[int]] = {}
    for i, flight in enumerate(data.flights):
        n = next(iter(flight.outputs.values())).shape[0]
        facts = layout.flight_facts[i : i + 1]
        key = (n, layout.outputs[i], layout.holds[i], facts, tuple(flight.known))
        # An offset of its own moves the point about which a flight is linearised.
        key = key if layout.model.linear else (i, *key)
        groups.setdefault(key, []).append(i)
    return list(groups.values())


def machines_of(layout: Layout, data: Data, u: Unknowns, members: list[int]) -> Machines:
    """The matrices of one group."""
    first = members[0]
    own = [(data.flights[i], u.states[i], u.offsets[i]) for i in members]

    def of_one(flight: Any, state: Any, offset: Any) -> Machines:
        # With one sample time all that does not hang on the signals is computed once.
        flight = flight._replace(dt=data.flights[first].dt)
        here = u._replace(
            states=_with(u.states, first, state), offsets=_with(u.offsets, first, offset)
        )
        matrices, driving = _machine(layout, data, here, (first, flight))
        if flight.by_instrument is None:
            return Machines(matrices, driving, None)
        # A point to linearise about knows means alone, which inputs by instrument have as well.
        by = flight._replace(inputs=flight.by_instrument)
        return Machines(matrices, driving, _machine(layout, data, here, (first, by))[1])

    axes = Machines(None if _one_machine(data, members) else 0, 0, 0)  # pyright: ignore
    return jax.vmap(of_one, out_axes=axes)(*jax.tree.map(lambda *v: jnp.stack(v), *own))


def _with(values: tuple[Any, ...], i: int, value: Any) -> tuple[Any, ...]:
    return (*values[:i], value, *values[i + 1 :])


def _one_machine(data: Data, members: list[int]) -> bool:
    return len(members) > 1 and not data.flights[members[0]].known


def _machine(
    layout: Layout, data: Data, u: Unknowns, of: tuple[int, Any]
) -> tuple[Matrices, Driving]:
    i, flight = of
    data = data._replace(flights=_with(data.flights, i, flight))
    condition = layout.flight_facts[i].condition if layout.flight_facts else None
    model, drive, _ = linear_drive(layout, driven(layout, data, u, i), condition)
    model, inputs, linear = between_samples(model, drive.inputs, drive.inputs, layout.hold(i))
    Ad, B, U, acting = held_columns(model, drive.params, inputs, drive.dt, u.shift, linear)
    _, _, C, D = jacobians(model, drive.params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in layout.outputs[i]])
    return Matrices(Ad, B, C[rows], D[rows]), Driving(U, acting)


def by_flight(
    data: Data,
    members: list[int],
    prepared: Callable[[Any], Any],
    body: Callable[[Any, Any], Any],
    common: Any,
    each: Any,
    together: int = 4,
) -> Any:
    """`body(prepared(common), some of each)` over the flights of a group, with a leading axis.

    Args:
        prepared: what of it is the same for flights that have one vehicle.
        body: of a few flights, which have a leading axis in what it is given and what it returns.
        common: of the vehicle; with a leading axis where each flight has its own.
    """
    count = len(members)
    one_machine = _one_machine(data, members)
    # A few at a time: what is read for every line of a vehicle is then read once for all of them,
    # and what is on the way to a few sums of a flight still fits into memory.
    size = max(n for n in range(1, together + 1) if count % n == 0) if one_machine else 1
    some = jax.tree.map(lambda v: v.reshape(count // size, size, *v.shape[1:]), each)
    if one_machine:
        ready = prepared(common)
        made = jax.lax.map(lambda of: body(ready, of), some)
    else:
        made = jax.lax.map(lambda of: body(prepared(of[0]), of[1]), (common, some))
    return jax.tree.map(lambda v: v.reshape(count, *v.shape[2:]), made)


def first_machine(m: Matrices) -> Matrices:
    """The spectrum of the first flight of a group: records of one length share it.

    Args:
        m: of all of them, or with a leading axis.
    """
    return jax.tree.map(lambda v: v[0] if m.Ad.ndim == 3 else v, m)


def parts_of_group(layout: Layout, noise: Noise, members: list[int]) -> list[tuple[Record, Array]]:
    """The records of each flight of a group, with their whitening."""
    # Records of one length have one spectrum (`smoothed`): that of the first flight's serve all.
    pairs = zip(records_of(layout), noise.whitening, strict=True)
    return [(record, W) for record, W in pairs if record.flight == members[0]]


def measured(layout: Layout, data: Data, members: list[int]) -> Float[Array, "f N p"]:
    """The measured signals of a group's flights."""
    names = layout.outputs[members[0]]
    columns = [[data.flights[i].outputs[n] for n in names] for i in members]
    return jnp.stack([jnp.stack([jnp.asarray(v) for v in of], axis=1) for of in columns])


# The unknowns that all flights share, as a vector, and what hangs on them with its derivatives.


def shared_of(layout: Layout, u: Unknowns) -> Float[Array, " q"]:
    """Parameters, gains and the time shift: all but initial states, biases and offsets."""
    params, gains = [u.params[n] for n in layout.free], [u.gains[n] for n in layout.gains]
    shift = [] if u.shift is None else [u.shift]
    return jnp.stack([jnp.asarray(v) for v in (*params, *gains, *shift)])


def with_shared(layout: Layout, u: Unknowns, v: Float[Array, " q"]) -> Unknowns:
    """The unknowns with those of a vector in place.

    Args:
        v: as `shared_of` orders them.
    """
    # By the layout's order: JAX sorts the names in every dictionary that it has taken apart.
    values = dict(zip((*layout.free, *layout.gains), v, strict=False))
    return u._replace(
        params={n: values[n] for n in layout.free},
        gains={n: values[n] for n in layout.gains},
        shift=None if u.shift is None else v[-1],
    )


# The lines of a record so many at a time: what is made for one block stays in the caches.


_NUMBERS = 20_000
"""outputs times states times lines in a block at most: 256 lines of a helicopter, and the whole
record of a small vehicle, whose blocks would take longer to begin than to go through"""


_NO_END = 1e-10
"""part of the largest effect of an end's state below which a state has none"""
_ROUNDING = 1e-12
"""part of the largest power of a direction of the ends below which it is rounding: a millionth of
its size"""
_SMALL = 6
"""states up to which a substitution is written out"""
_SPARED = 0.1
"""part of a record's numbers that its ends may take, those of gusts among them"""


class Resolved(NamedTuple):
    """Responses of a vehicle at the lines of a record, by block (b, ...); without a derivative."""

    z: Complex[Array, "b k"]
    T: Complex[Array, "n n"]
    """Ad = V T V^H, triangular"""
    V: Complex[Array, "n n"]
    W: Complex[Array, "b k p p"]
    """the whitening; zero beyond the record's lines"""
    H: Complex[Array, "b k p n"]
    """W C (zI - Ad)^-1"""
    ends: Complex[Array, "b k e"]
    """what drives a state that ends elsewhere than it began and, but in a very short record, what
    does where a slow gust that pushes it does"""
    S: Float[Array, "m m"]
    """a basis of what the ends may add to whitened rows, times this, is orthonormal: columns are
    zero where a state leaves no trace"""


class Errors(NamedTuple):
    """Errors of one record of each of a few flights, with what they came of; the first two by
    block."""

    rows: Float[Array, "b f s"]
    """measured less simulated, whitened, the ends of the record taken off; zero beyond the lines"""
    X: Complex[Array, "b f k n"]
    """the states"""
    beyond: Complex[Array, "f K p"]
    """measured less what the inputs add to the outputs past the states"""


def by_block(v: Array, count: int, axis: int = 0) -> Array:
    """An array with an axis of lines cut into blocks, its first axis; the last is filled up with
    zeros."""
    lines = v.shape[axis]
    size, widths = -(-lines // count), [(0, 0)] * v.ndim
    widths[axis] = (0, count * size - lines)
    v = jnp.pad(v, widths)
    return jnp.moveaxis(v.reshape(*v.shape[:axis], count, size, *v.shape[axis + 1 :]), axis, 0)


def resolved(m: Matrices, record: Record, whitening: Complex[Array, "K p p"]) -> Resolved:
    """A vehicle at the lines of a record."""
    (p, n), K = m.C.shape, record.lines
    W = by_block(whitening, -(-K * m.C.size // _NUMBERS))
    count, size = W.shape[:2]
    # Beyond the last line those that would follow it, so that nothing is singular there.
    k = np.arange(1, count * size + 1).reshape(count, size)
    z = np.exp(2j * np.pi * k / (record.samples + 2 * size))
    z[k <= K] = np.exp(2j * np.pi * k[k <= K] / record.samples)
    z = z.astype(np.result_type(m.Ad.dtype, np.complex64))
    # A gust that ends elsewhere than it began has its leap at all lines: taken for noise of each
    # line by itself it moves slow modes by several standard deviations. Above its corner it is an
    # integrated push. Over the length, so that it is no larger than the states' own ends.
    ends = np.stack([z, z / (z - 1.0) / record.samples], axis=2)
    if 2 * n > _SPARED * 2 * p * K:
        ends = ends[:, :, :1]
    z, ends = jnp.asarray(z), jnp.asarray(ends)
    T, V = _triangle(m.Ad)
    C, back = m.C.astype(z.dtype) @ V, jnp.conj(V.T)

    def of_block(of: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        z, ends, W = of
        H = W @ (_solved(z, T, C[None], left=False) @ back)
        basis = basis_of(H, ends)
        return H, basis.T @ basis

    H, grams = jax.lax.map(of_block, (z, ends, W))
    return Resolved(z, T, V, W.astype(z.dtype), H, ends, orthonormal(jnp.sum(grams, axis=0)))


def basis_of(H: Complex[Array, "k p n"], ends: Complex[Array, "k e"]) -> Float[Array, "s m"]:
    """The additions of the ends' states, and behind these the gusts', to the rows of a block."""
    # Together with what takes a block out of all of them the products would be several times
    # slower.
    H, ends = jax.lax.optimization_barrier((H, ends))
    made = stacked(H[:, :, None, :] * ends[:, None, :, None])
    return made.reshape(2 * H.shape[0] * H.shape[1], -1)


def orthonormal(gram: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """S with S^T G S the identity, but for directions without effect, which are zero: for columns
    with the products G, those times S are orthonormal."""
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(gram), 0.0))
    # A state that no output shows has a column of rounding: that would make some direction of it,
    # another at each step, and what is taken off by it makes the sum of squares rough.
    precision = float(jnp.finfo(gram.dtype).eps)
    seen = sizes > max(_NO_END, 10.0 * precision) * jnp.max(sizes)
    over = jnp.where(seen, 1.0 / jnp.where(seen, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(gram * over[:, None] * over[None, :])
    # Squares of the sizes of directions. What remains along one that is dropped is small where the
    # others have sizes that a record can tell.
    kept = values > max(_ROUNDING, 100.0 * precision) * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    return over[:, None] * vectors * root[None, :]


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


def stacked(v: Array) -> Array:
    """Real parts and imaginary ones (K, 2, ...) of complex numbers (K, ...)."""
    return jnp.stack([jnp.real(v), jnp.imag(v)], axis=1)


def real(M: Complex[Array, "K a b"]) -> Float[Array, "K 2a 2b"]:
    """The real matrix that does to stacked vectors what M does to complex ones."""
    re, im = jnp.real(M), jnp.imag(M)
    return jnp.concatenate(
        [jnp.concatenate([re, -im], axis=2), jnp.concatenate([im, re], axis=2)], axis=1
    )


def at_lines(record: Record, v: Float[Array, "f N c"]) -> Complex[Array, "f K c"]:
    """The Fourier transform of a record's part of signals, over the root of its length.

    Args:
        v: over the whole flights; columns behind delays, so that what acted in a part was logged
            before it.
    """
    # Without a mean: the zero line is not used, and rounding would carry it to the others.
    part = v[:, record.first : record.last]
    part = part - jnp.mean(part, axis=1, keepdims=True)
    return jnp.fft.rfft(part, axis=1)[:, 1 : 1 + record.lines] * float(record.samples) ** -0.5


def errors_of_some(
    at: Resolved,
    m: Matrices,
    record: Record,
    acting: Driving,
    y: Float[Array, "f N p"],
) -> Errors:
    """Errors of one record of each of a few flights of one vehicle, with a leading axis.

    Args:
        acting: over the whole flights.
    """
    f, count = y.shape[0], len(at.z)
    # In time, where these numbers are real ones and half as many.
    beyond = at_lines(record, y - acting.held @ m.D.T)
    inputs, left = (by_block(v, count, axis=1) for v in (at_lines(record, acting.U), beyond))

    def unprojected(of: Any) -> tuple[Array, Array]:
        W, H, ends, inputs, left = of
        e = _times(W, left) - _times(H, by_real(inputs, m.B.T))
        e = jnp.stack([jnp.real(e), jnp.imag(e)], axis=2).reshape(f, -1)
        return e, e @ basis_of(H, ends)

    white, along = jax.lax.map(unprojected, (at.W, at.H, at.ends, inputs, left))
    # The ends' states of each flight, by linear least squares.
    d = (jnp.sum(along, axis=0) @ at.S) @ at.S.T
    of_ends = d.reshape(f, at.ends.shape[2], -1).astype(at.z.dtype)

    def without_ends(of: Any) -> tuple[Array, Array]:
        white, z, H, ends, inputs = of
        driving = by_real(inputs, m.B.T) + ends[None] @ of_ends
        return white - d @ basis_of(H, ends).T, states(at, z, driving)

    rows, X = jax.lax.map(without_ends, (white, at.z, at.H, at.ends, inputs))
    return Errors(rows, X, beyond)


def states(
    at: Resolved, z: Complex[Array, " k"], driving: Complex[Array, "f k n"]
) -> Complex[Array, "f k n"]:
    """(zI - Ad)^-1 of what drives them, at the lines of one block."""
    # Flights are columns of the same substitutions.
    seen = jnp.moveaxis(driving @ jnp.conj(at.V), 0, 2)
    return jnp.moveaxis(_solved(z, at.T, seen, left=True), 2, 0) @ at.V.T


def _solved(z: Complex[Array, " k"], T: Array, b: Array, *, left: bool) -> Array:
    """(zI - T)^-1 b at each line (k, ...), or b (zI - T)^-1, with T of `_triangle`."""
    n = T.shape[0]
    M = z[:, None, None] * jnp.eye(T.shape[0], dtype=z.dtype)[None] - T[None]
    b = jnp.broadcast_to(b, (z.shape[0], *b.shape[1:]))

    def whole(M: Array, b: Array) -> Array:
        if left:
            return jnp.linalg.solve(M, b)
        turned = jnp.linalg.solve(jnp.swapaxes(M, 1, 2), jnp.swapaxes(b, 1, 2))
        return jnp.swapaxes(turned, 1, 2)

    def triangle(M: Array, b: Array) -> Array:
        if n > _SMALL:
            return jax.lax.linalg.triangular_solve(M, b, left_side=left, lower=False)
        # Written out, since for each line a routine would be called that takes longer to call.
        rows = [b[:, i] if left else b[:, :, i] for i in range(n)]
        over = 1.0 / jnp.diagonal(M, axis1=1, axis2=2)
        for i in reversed(range(n)) if left else range(n):
            for j in range(i + 1, n) if left else range(i):
                rows[i] = rows[i] - (M[:, i, j] if left else M[:, j, i])[:, None] * rows[j]
            rows[i] = over[:, i, None] * rows[i]
        return jnp.stack(rows, axis=1 if left else 2)

    return jax.lax.platform_dependent(M, b, cpu=triangle, default=whole)


def by_real(v: Complex[Array, "... a"], M: Float[Array, "a b"]) -> Complex[Array, "... b"]:
    """v M, without the products of what M has no imaginary part of."""
    return jax.lax.complex(jnp.real(v) @ M, jnp.imag(v) @ M)


def _times(M: Complex[Array, "k a b"], v: Complex[Array, "f k b"]) -> Complex[Array, "f k a"]:
    # A sum: products of a small matrix and a vector each would call a routine for every line.
    return jnp.sum(M[None] * v[:, :, None, :], axis=3)


class LineErrors(NamedTuple):
    """Errors of all records."""

    errors: list[Complex[Array, "K p"]]
    """by record, its ends taken off, not whitened"""
    vehicle: Matrices
    """of the first flight"""


@jitted
def errors_of_lines(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> LineErrors:
    """The errors at the lines of every record."""
    u, errors, first = unpack(layout, data, z), {}, None
    for members in alike(layout, data):
        parts = parts_of_group(layout, noise, members)
        vehicles, y = machines_of(layout, data, u, members), measured(layout, data, members)

        def ready(m: Matrices, parts: Any = parts) -> Any:
            return m, [resolved(m, record, W) for record, W in parts]

        def of_some(common: Any, some: Any, parts: Any = parts) -> list[Any]:
            m, ats = common
            made = []
            for at, (record, _) in zip(ats, parts, strict=True):
                e = errors_of_some(at, m, record, *some)
                X = jnp.moveaxis(e.X, 0, 1).reshape(len(e.beyond), -1, len(m.Ad))
                made.append(e.beyond - by_real(X[:, : record.lines], m.C.T))
            return made

        first = first_machine(vehicles.matrices) if first is None else first
        each = (vehicles.driving, y)
        made = by_flight(data, members, ready, of_some, vehicles.matrices, each)
        for k, i in enumerate(members):
            errors[i] = [left[k] for left in made]
    assert first is not None
    return LineErrors([v for i in range(len(data.flights)) for v in errors[i]], first)
