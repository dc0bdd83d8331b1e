r"""A model's error at a record's own frequencies, whitened, without what the ends may add.

Complex numbers of a line stand as real ones, real parts first: their products are then products of
real matrices, for which libraries are fastest.

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Golub and Pereyra (1973) and Kaufman
(1975) for the projection.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.identification.estimation.frequency_blocks import Blocks, blocks_of
from heli_jax.identification.estimation.frequency_machines import (
    Machine,
    Matrices,
    Signals,
    alike,
    by_flight,
    first_machine,
    machines_of,
    measured,
    parts_of_group,
)
from heli_jax.identification.estimation.frequency_records import Record
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.numerics.jitted import jitted

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
    """What a machine does at the lines of a record, by block (b, ...); without a derivative."""

    blocks: Blocks
    z: Complex[Array, "b k"]
    T: Complex[Array, "n n"]
    """Ad = V T V^H, triangular"""
    V: Complex[Array, "n n"]
    W: Complex[Array, "b k p p"]
    """the whitening; zero beyond the lines that are used"""
    H: Complex[Array, "b k p n"]
    """W C (zI - Ad)^-1"""
    ends: Complex[Array, "b k e"]
    """what drives a state that ends elsewhere than it began and, but in a very short record, what
    does where a slow gust that pushes it does"""
    S: Float[Array, "m m"]
    """a basis of what the ends may add to whitened rows, times this, is orthonormal: columns are
    zero where a state leaves no trace"""

    def basis(self, b: Array | int) -> Float[Array, "s m"]:
        """What the ends' states, and behind these the gusts', add to the rows of a block.

        Args:
            b: number of the block.
        """
        # Together with what takes a block out of all of them the products would be several times
        # slower.
        return _basis(*jax.lax.optimization_barrier((self.H[b], self.ends[b])))


class Errors(NamedTuple):
    """Of one record of each of a few flights, with what they came of; the first three by block."""

    rows: Float[Array, "b f s"]
    """measured less simulated, whitened, the ends of the record taken off; zero beyond the lines
    that are used"""
    X: Complex[Array, "b f k n"]
    """the states; zero beyond the blocks that are used"""
    X_by: Complex[Array, "b f k n"] | None
    """those that inputs by instrument make; None without any"""
    signals: Signals
    """at all lines (f, K, ...)"""
    beyond: Complex[Array, "f K p"]
    """measured less what the inputs add to the outputs past the states"""


def resolved(
    m: Matrices, record: Record, whitening: Complex[Array, "K p p"], part: Array
) -> Resolved:
    """A machine at the lines of a record.

    Args:
        m: its matrices.
        record: which samples it is.
        whitening: of the record's lines.
        part: of the lines that are used.
    """
    blocks = blocks_of(record, part, m.C.size)
    # Beyond the last line those that would follow it, so that nothing is singular there.
    k = np.arange(1, blocks.count * blocks.size + 1).reshape(blocks.count, blocks.size)
    z = np.exp(2j * np.pi * k / (record.samples + 2 * blocks.size))
    z[k <= record.lines] = np.exp(2j * np.pi * k[k <= record.lines] / record.samples)
    z = z.astype(np.result_type(m.Ad.dtype, np.complex64))
    # A gust that ends elsewhere than it began has its leap at all lines: taken for noise of each
    # line by itself it moves slow modes by several standard deviations. Above its corner it is an
    # integrated push. Over the length, so that it is no larger than the states' own ends.
    ends = np.stack([z, z / (z - 1.0) / record.samples], axis=2)
    (p, n), K = m.C.shape, record.lines
    if 2 * n > _SPARED * 2 * p * K:
        ends = ends[:, :, :1]
    z, ends, W = jnp.asarray(z), jnp.asarray(ends), blocks.cut(whitening)
    T, V = _triangle(m.Ad)
    C, back = m.C.astype(z.dtype) @ V, jnp.conj(V.T)

    def more(b: Any, made: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        white, H, gram = made
        W_b = W[b] * blocks.within(b)[:, None, None].astype(z.dtype)
        H_b = W_b @ (_solved(z[b], T, C[None], left=False) @ back)
        basis = _basis(*jax.lax.optimization_barrier((H_b, ends[b])))
        return white.at[b].set(W_b), H.at[b].set(H_b), gram + basis.T @ basis

    m_ends = n * ends.shape[2]
    nothing = (
        jnp.zeros_like(W),
        jnp.zeros((*z.shape, p, n), z.dtype),
        jnp.zeros((m_ends, m_ends), m.Ad.dtype),
    )
    W, H, gram = blocks.over(more, nothing)
    return Resolved(blocks, z, T, V, W, H, ends, _orthonormal(gram))


def _basis(H: Complex[Array, "k p n"], ends: Complex[Array, "k e"]) -> Float[Array, "s m"]:
    made = stacked(H[:, :, None, :] * ends[:, None, :, None])
    return made.reshape(2 * H.shape[0] * H.shape[1], -1)


def _orthonormal(gram: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """S with S^T G S the identity, but for directions without effect, which are zero."""
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
        record: which samples it is.
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
    signals: Signals,
    y: Float[Array, "f N p"],
    by: tuple[Signals, Array] | None = None,
) -> Errors:
    """Of one record of each of a few flights of one machine, with a leading axis.

    Args:
        at: the machine at the record's lines.
        m: the machine.
        record: which samples it is.
        signals: over the whole flights.
        y: what was measured.
        by: the inputs by instrument, and whether their states are asked for: zero if not.
    """
    blocks, f = at.blocks, y.shape[0]
    lines = Signals(*(at_lines(record, v) for v in signals))
    # In time, where these numbers are real ones and half as many.
    beyond = at_lines(record, y - signals.acting @ m.D.T)
    # By instrument the states are those of the inputs alone: such a record has no ends.
    inputs = blocks.cut(
        lines.U if by is None else jnp.concatenate([lines.U, at_lines(record, by[0].U)]), axis=1
    )
    left = blocks.cut(beyond, axis=1)

    def unprojected(b: Any, made: tuple[Array, Array]) -> tuple[Array, Array]:
        white, along = made
        e = _times(at.W[b], left[b]) - _times(at.H[b], by_real(inputs[b, :f], m.B.T))
        e = jnp.stack([jnp.real(e), jnp.imag(e)], axis=2).reshape(f, -1)
        return white.at[b].set(e), along + e @ at.basis(b)

    size, m_ends, real_type = 2 * at.H.shape[1] * at.H.shape[2], len(at.S), m.Ad.dtype
    nothing = (
        jnp.zeros((blocks.count, f, size), real_type),
        jnp.zeros((f, m_ends), real_type),
    )
    white, along = blocks.over(unprojected, nothing)
    # The ends' states of each flight, by linear least squares.
    d = (along @ at.S) @ at.S.T
    of_ends = d.reshape(f, at.ends.shape[2], -1).astype(at.z.dtype)

    def asked_for(b: Any, driven: Array) -> Array:
        if by is None:
            return states(at, b, driven)

        def direct(v: Array) -> Array:
            return jnp.concatenate([states(at, b, v[:f]), jnp.zeros_like(v[f:])])

        return jax.lax.cond(by[1], lambda v: states(at, b, v), direct, driven)

    def without_ends(b: Any, made: tuple[Array, Array]) -> tuple[Array, Array]:
        rows, X = made
        driven = by_real(inputs[b], m.B.T).at[:f].add(at.ends[b][None] @ of_ends)
        return rows.at[b].add(-(d @ at.basis(b).T)), X.at[b].set(asked_for(b, driven))

    X = jnp.zeros((*inputs.shape[:-1], len(m.Ad)), at.z.dtype)
    rows, X = blocks.over(without_ends, (white, X))
    return Errors(rows, X[:, :f], None if by is None else X[:, f:], lines, beyond)


def states(
    at: Resolved, b: Array | int, driving: Complex[Array, "f k n"]
) -> Complex[Array, "f k n"]:
    """(zI - Ad)^-1 of what drives them.

    Args:
        at: the machine at the lines.
        b: number of the block.
        driving: B U, and the ends.
    """
    # Flights are columns of the same substitutions.
    seen = jnp.moveaxis(driving @ jnp.conj(at.V), 0, 2)
    return jnp.moveaxis(_solved(at.z[b], at.T, seen, left=True), 2, 0) @ at.V.T


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
    """v M, without the products of what M has no imaginary part of.

    Args:
        v: complex numbers.
        M: a real matrix.
    """
    return jax.lax.complex(jnp.real(v) @ M, jnp.imag(v) @ M)


def _times(M: Complex[Array, "k a b"], v: Complex[Array, "f k b"]) -> Complex[Array, "f k a"]:
    # A sum: products of a small matrix and a vector each would call a routine for every line.
    return jnp.sum(M[None] * v[:, :, None, :], axis=3)


class TakenByEnds(NamedTuple):
    """What the projection of a record's ends took of its errors."""

    numbers: Array
    """real ones, of all lines and outputs"""
    power: Array
    """(K, p) of the errors' expected power, not whitened"""


class LineErrors(NamedTuple):
    """Of all records."""

    errors: list[Complex[Array, "K p"]]
    """by record, its ends taken off, not whitened"""
    machine: Machine
    """of the first flight"""
    ends: list[TakenByEnds]
    """by record; empty unless asked for"""


@jitted
def errors_of_lines(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"], *, ends: bool = False
) -> LineErrors:
    """The errors at the lines of every record.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: with the whitening of each record.
        z: the unknowns.
        ends: whether to say what the ends took.
    """
    u, errors, taken, first = unpack(layout, data, z), {}, {}, None
    for members in alike(layout, data):
        parts = parts_of_group(layout, noise, members)
        machines, y = machines_of(layout, data, u, members), measured(layout, data, members)

        def ready(m: Matrices, parts: Any = parts) -> Any:
            return m, [resolved(m, record, W, jnp.asarray(noise.part_used)) for record, W in parts]

        def of_some(common: Any, some: Any, parts: Any = parts) -> list[Any]:
            m, ats = common
            made = []
            for at, (record, _) in zip(ats, parts, strict=True):
                e = errors_of_some(at, m, record, *some)
                left = e.beyond - by_real(at.blocks.joined(e.X, axis=1), m.C.T)
                same = jax.tree.map(
                    lambda v, f=len(left): jnp.broadcast_to(v, (f, *v.shape)),
                    _taken_by_ends(at) if ends else None,
                )
                made.append((left, same))
            return made

        first = first_machine(machines.matrices) if first is None else first
        each = (machines.signals, y)
        made = by_flight(data, members, ready, of_some, machines.matrices, each)
        for k, i in enumerate(members):
            errors[i] = [left[k] for left, _ in made]
            taken[i] = [jax.tree.map(lambda v, k=k: v[k], same) for _, same in made if ends]
    assert first is not None
    errors, taken = ([v for i in range(len(data.flights)) for v in of[i]] for of in (errors, taken))
    return LineErrors(errors, first, taken)


def _taken_by_ends(at: Resolved) -> TakenByEnds:
    def more(b: Any, power: Array) -> Array:
        # Lines that are not used have a whitening of zero.
        used = jnp.any(at.W[b] != 0, axis=(1, 2))[:, None, None]
        W = jnp.where(used, at.W[b], jnp.eye(at.W.shape[2], dtype=at.W.dtype))
        H = jnp.linalg.solve(W, at.H[b])
        ends = (H[:, :, None, :] * at.ends[b][:, None, :, None]).reshape(*H.shape[:2], -1)
        # Of a complex number of power 1 the real and the imaginary part have a half each.
        made = ends @ at.S.astype(ends.dtype)
        return power.at[b].set(0.5 * jnp.sum(jnp.real(made * jnp.conj(made)), axis=2))

    power = at.blocks.over(more, jnp.zeros(at.H.shape[:3], at.S.dtype))
    return TakenByEnds(jnp.sum(jnp.any(at.S != 0, axis=0)), at.blocks.joined(power))
