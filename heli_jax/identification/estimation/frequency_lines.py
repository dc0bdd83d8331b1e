"""Fourier transforms of records, the response of linear models at their lines, and its errors.

At $z = e^{i\\omega dt}$ of a record's Fourier frequencies the model x[k+1] = Ad x[k] + B U[k] has
exactly the states $X = (zI - A_d)^{-1} [B U + z (x_0 - x_N)]$. Linear least squares gives the
effect of the record's ends ($x_0 - x_N$).

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Golub and Pereyra (1973) and Kaufman
(1975) for the projection.
"""

from collections.abc import Sequence
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
from heli_jax.identification.unknowns.layout import (
    Data,
    FlightData,
    Layout,
    Noise,
    Unknowns,
    unpack,
)
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.stepping import held_columns

# Records are flights, cut where an output has a missing sample. Each has its own ends.


class FlightFacts(NamedTuple):
    """Facts of a flight that are fixed before tracing."""

    parts: tuple[tuple[int, int], ...]
    """First sample, and the one after the last, of each part that forms a record."""
    dt: float
    """Sample time [s]."""
    condition: Condition | None = None
    """Steady flight at which a full helicopter is linearised."""


class Record(NamedTuple):
    """Part of a flight without missing samples."""

    flight: int
    """Index of the flight."""
    first: int
    last: int
    """Sample after the last one."""

    @property
    def samples(self) -> int:
        """Number of samples N."""
        return self.last - self.first

    @property
    def lines(self) -> int:
        """Number of Fourier frequencies K, without zero and the Nyquist frequency."""
        return (self.samples - 1) // 2

    @property
    def z(self) -> Complex[np.ndarray, " K"]:
        """exp(i omega dt) at these frequencies."""
        return np.exp(2j * np.pi * np.arange(1, self.lines + 1) / self.samples)


def lines_of[A: (np.ndarray, Array)](v: A) -> A:
    """Return the Fourier transform (K, c) of signals (N, c) divided by sqrt(N), without zero and
    the Nyquist frequency."""
    xp = jnp if isinstance(v, jax.Array) else np
    N = len(v)
    # The mean is subtracted, because rounding would spread it to the other lines.
    return (
        xp.fft.rfft(v - v.mean(axis=0, keepdims=True), axis=0)[1 : 1 + (N - 1) // 2]
        / float(N) ** 0.5
    )


def in_time_of(lines: Complex[np.ndarray, "K c"], samples: int) -> Float[np.ndarray, "N c"]:
    """Return signals of zero mean: the inverse of `lines_of`."""
    whole = np.zeros((samples // 2 + 1, lines.shape[1]), complex)
    whole[1 : 1 + len(lines)] = lines * np.sqrt(samples)
    return np.fft.irfft(whole, samples, axis=0)


def parts_of(flight: Flight) -> tuple[tuple[int, int], ...]:
    """Return first sample, and the one after the last, of each long part with all outputs."""
    seen = spans(flight.outputs.values())
    if seen == [(0, flight.n_samples)]:
        return tuple(seen)
    # As with `gaps: split`, short parts hardly determine their ends.
    least = max(FEWEST, int(np.ceil(SHORTEST / flight.dt)))
    return tuple((a, b) for a, b in seen if b - a >= least)


def records_of(layout: Layout) -> list[Record]:
    """Return all records, flight after flight."""
    return [Record(i, a, b) for i, facts in enumerate(layout.flight_facts) for a, b in facts.parts]


def without_parts(flights: Sequence[Flight]) -> str | None:
    """Return which flight gives no record and the remedy, or None."""
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
    """Return which flight lacks an output of others and the remedy, or None."""
    # The noise's spectrum is one matrix over the outputs, so all flights need them.
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
    """Return a note for each flight that was cut."""
    notes = []
    for i, (flight, facts) in enumerate(zip(data.flights, layout.flight_facts, strict=True)):
        n = next(iter(flight.outputs.values())).shape[0]
        used = sum(b - a for a, b in facts.parts)
        if used == n:
            continue
        lacking = [name for name, y in flight.outputs.items() if not np.isfinite(y).all()]
        words = (
            f"{names[i] if len(data.flights) > 1 else 'The flight'} was cut where samples of "
            f"{', '.join(lacking)} are missing: {used * facts.dt:.4g} of {n * facts.dt:.4g} s are "
            f"used, in {len(facts.parts)} {'parts' if len(facts.parts) > 1 else 'part'} with ends "
            "of their own."
        )
        notes.append(note("frequency.flight-cut", words, *lacking))
    return notes


# Discretised models of groups of flights with equal layouts.


class Matrices(NamedTuple):
    """x[k+1] = Ad x[k] + B U[k], y[k] = C x[k] + D held[k]; n states, p measured outputs."""

    Ad: Float[Array, "n n"]
    B: Float[Array, "n r"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]


class Driving(NamedTuple):
    """Inputs of a discretised model."""

    U: Float[Array, "N r"]
    """Inputs of the states, multiplied by B."""
    held: Float[Array, "N m"]
    """Inputs at the samples, multiplied by D."""


def alike(layout: Layout, data: Data) -> list[list[int]]:
    """Return groups of flights that share one model and differ only in their signals."""
    groups: dict[Any, list[int]] = {}
    for i, flight in enumerate(data.flights):
        n = next(iter(flight.outputs.values())).shape[0]
        key = (n, layout.outputs[i], layout.holds[i], layout.flight_facts[i : i + 1])
        # A flight's own offset changes its point of linearisation.
        own = bool(flight.known) or not layout.model.linear
        groups.setdefault((i, *key) if own else key, []).append(i)
    return list(groups.values())


def discretised(
    layout: Layout, data: Data, u: Unknowns, members: Sequence[int], *, by_instrument: bool = False
) -> tuple[Matrices, Driving]:
    """Return the model of a group of flights, and its inputs with a leading axis of flights.

    Args:
        by_instrument: take the part of the inputs that follows the instruments.
    """
    first = members[0]

    def of_one(own: tuple[FlightData, Any, Any]) -> tuple[Matrices, Driving]:
        flight, state, offset = own
        # With one sample time, everything independent of the signals is computed once. The point of
        # linearisation depends only on means, which inputs by instrument share.
        flight = flight._replace(
            dt=data.flights[first].dt,
            inputs=flight.by_instrument if by_instrument else flight.inputs,
        )
        numbers = data._replace(flights=_with(data.flights, first, flight))
        here = u._replace(
            states=_with(u.states, first, state), offsets=_with(u.offsets, first, offset)
        )
        condition = layout.flight_facts[first].condition if layout.flight_facts else None
        model, drive = linear_drive(layout, driven(layout, numbers, here, first), condition)
        model, inputs, linear = between_samples(
            model, drive.inputs, drive.inputs, layout.hold(first)
        )
        Ad, B, U, acting = held_columns(model, drive.params, inputs, drive.dt, u.shift, linear)
        _, _, C, D = jacobians(model, drive.params)
        rows = np.asarray([naming.names(model.Outputs).index(n) for n in layout.outputs[first]])
        return Matrices(Ad, B, C[rows], D[rows]), Driving(U, acting)

    own = [(data.flights[i], u.states[i], u.offsets[i]) for i in members]
    if len(members) == 1:
        # A model that depends on a flight's values would gain an axis in vmap.
        m, driving = of_one(own[0])
        return m, jax.tree.map(lambda v: v[None], driving)
    axes: Any = (None, 0)
    return jax.vmap(of_one, out_axes=axes)(jax.tree.map(lambda *v: jnp.stack(v), *own))


def _with(values: tuple[Any, ...], i: int, value: Any) -> tuple[Any, ...]:
    return (*values[:i], value, *values[i + 1 :])


def shared_of(layout: Layout, u: Unknowns) -> Float[Array, " q"]:
    """Return the unknowns that all flights share: parameters, gains and the time shift."""
    params, gains = [u.params[n] for n in layout.free], [u.gains[n] for n in layout.gains]
    shift = [] if u.shift is None else [u.shift]
    return jnp.stack([jnp.asarray(v) for v in (*params, *gains, *shift)])


def with_shared(layout: Layout, u: Unknowns, v: Float[Array, " q"]) -> Unknowns:
    """Return the unknowns with the shared ones replaced, in the order of `shared_of`."""
    # The layout's order is used because JAX sorts the keys of dictionaries.
    values = dict(zip((*layout.free, *layout.gains), v, strict=False))
    return u._replace(
        params={n: values[n] for n in layout.free},
        gains={n: values[n] for n in layout.gains},
        shift=None if u.shift is None else v[-1],
    )


# Complex vectors are stored as real ones, [re, im], because products of real matrices are faster.


def stacked(v: Complex[Array, "K *c"]) -> Float[Array, "K 2 *c"]:
    """Return real and imaginary parts on a second axis."""
    return jnp.stack([jnp.real(v), jnp.imag(v)], axis=1)


def real(M: Complex[Array, "K a b"]) -> Float[Array, "K 2a 2b"]:
    """Return the real matrix that acts on stacked vectors as M does on complex ones."""
    re, im = jnp.real(M), jnp.imag(M)
    parts = jnp.stack([jnp.stack([re, -im], axis=2), jnp.stack([im, re], axis=2)], axis=1)
    return parts.reshape(len(M), 2 * M.shape[1], 2 * M.shape[2])


def times(M: Float[Array, "K 2a 2b"], v: Float[Array, "K 2 b *f"]) -> Float[Array, "K 2 a *f"]:
    """Return the products at each line."""
    made = M @ v.reshape(len(v), M.shape[2], -1)
    return made.reshape(len(v), 2, -1, *v.shape[3:])


_NO_END = 1e-10
"""Effect of a state, relative to the largest one, below which it has none."""
_ROUNDING = 1e-12
"""Power of a direction, relative to the largest one, below which it is rounding."""


def orthonormal(gram: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return S with S^T G S the identity, but zero for directions without effect.

    Args:
        gram: products G of columns; the columns times S are orthonormal.
    """
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(gram), 0.0))
    # The column of a state without effect on the outputs is rounding, and its direction changes at
    # each step. Projecting it out would make the sum of squares rough.
    precision = float(jnp.finfo(gram.dtype).eps)
    seen = sizes > max(_NO_END, 10.0 * precision) * jnp.max(sizes)
    over = jnp.where(seen, 1.0 / jnp.where(seen, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(gram * over[:, None] * over[None, :])
    kept = values > max(_ROUNDING, 100.0 * precision) * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    return over[:, None] * vectors * root[None, :]


# Errors of a record, and the effects of its ends.


_NUMBERS = 20_000
"""Largest product of outputs, states and lines in a block: 256 lines of a helicopter, or the whole
record of a small vehicle."""
_SPARED = 0.1
"""Largest fraction of a record's degrees of freedom for its ends and those of gusts."""


class Resolved(NamedTuple):
    """Model at the lines of a record, without derivatives, in b blocks of k lines that fit the
    processor's caches."""

    record: Record
    W: Float[Array, "b k 2p 2p"]
    """Whitening to rows of variance 1; zero beyond the record's lines."""
    R: Float[Array, "b k 2n 2n"]
    """(zI - Ad)^-1."""
    H: Float[Array, "b k 2p 2n"]
    """W C (zI - Ad)^-1."""
    effects: Float[Array, "b k 2 e"]
    """Spectrum of a jump of a state between the ends and, except in a very short record, of a slow
    gust on it."""
    S: Float[Array, "m m"]
    """Makes `basis_of` orthonormal; zero columns for states without effect."""

    def lines(self, v: Float[Array, "f N *c"]) -> Float[Array, "b k 2 *c f"]:
        """Return the transform of the record's part of signals over whole flights, by block."""
        # Signals are delayed before they are cut, because an input may be logged before it acts.
        part = jnp.moveaxis(v[:, self.record.first : self.record.last], 0, -1)
        return by_block(stacked(lines_of(part)), len(self.W))


def by_block(v: Array, count: int) -> Array:
    """Return lines (K, ...) in blocks (b, k, ...), the last one padded with zeros."""
    size = -(-len(v) // count)
    v = jnp.pad(v, [(0, count * size - len(v)), *((0, 0) for _ in v.shape[1:])])
    return v.reshape(count, size, *v.shape[1:])


def resolved(m: Matrices, record: Record, whitening: Complex[Array, "K p p"]) -> Resolved:
    """Evaluate a model at the lines of a record."""
    (p, n), K = m.C.shape, record.lines
    # The real part of a complex normal error has half of its variance.
    W = by_block(2.0**0.5 * real(whitening).astype(m.C.dtype), -(-K * m.C.size // _NUMBERS))
    count, size = W.shape[:2]
    # The padding continues the lines to avoid singular matrices.
    k = np.arange(1, count * size + 1)
    z = np.exp(2j * np.pi * k / np.where(k <= K, record.samples, record.samples + 2 * size))
    z = z.astype(np.result_type(m.Ad.dtype, np.complex64))
    # A gust that does not end where it began has a jump, which affects all lines. Treated as
    # independent noise of each line, it would shift slow modes by several standard deviations.
    # Above its corner frequency it is an integrated push; dividing by the length keeps it
    # comparable to the states' ends.
    effects = np.stack([z, z / (z - 1.0) / record.samples], axis=1)
    if 2 * n > _SPARED * 2 * p * K:
        effects = effects[:, :1]
    effects = by_block(stacked(jnp.asarray(effects)), count)

    def of_block(of: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        z, W, effects = of
        unit = jnp.eye(n, dtype=z.dtype)[None]
        R = jnp.linalg.inv(z[:, None, None] * unit - m.Ad[None].astype(z.dtype))
        H = W @ real(m.C[None].astype(z.dtype) @ R)
        basis = basis_of(H, effects)
        return real(R), H, basis.T @ basis

    R, H, grams = jax.lax.map(of_block, (jnp.asarray(z).reshape(count, size), W, effects))
    return Resolved(record, W, R, H, effects, orthonormal(jnp.sum(grams, axis=0)))


def basis_of(H: Float[Array, "k 2p 2n"], effects: Float[Array, "k 2 e"]) -> Float[Array, "s m"]:
    """Return the effects of the states' ends, then of the gusts' ends, on the rows of a block."""
    n = H.shape[2] // 2
    re, im = H[:, :, None, :n], H[:, :, None, n:]
    made = re * effects[:, None, 0, :, None] + im * effects[:, None, 1, :, None]
    return made.reshape(-1, effects.shape[2] * n)


class Errors(NamedTuple):
    """Errors of one record of each flight of a group, by block."""

    rows: Float[Array, "b s f"]
    """Measured less modelled, whitened, without the effects of the ends; zero in the padding."""
    X: Float[Array, "b k 2 n f"]
    """States."""
    y: Float[Array, "b k 2 p f"]
    """Measured outputs less the direct feedthrough of the inputs."""


def errors_of_record(
    at: Resolved, m: Matrices, driving: Driving, outputs: Float[Array, "f N p"]
) -> Errors:
    """Return the errors of one record of each flight of a group.

    Args:
        driving: inputs over the whole flights, like `outputs`.
    """
    inputs = jnp.einsum("nr,bkcrf->bkcnf", m.B, at.lines(driving.U))
    y = at.lines(outputs - driving.held @ m.D.T)

    def unprojected(of: Any) -> tuple[Array, Array]:
        W, H, effects, inputs, y = of
        rows = (times(W, y) - times(H, inputs)).reshape(-1, y.shape[-1])
        return rows, basis_of(H, effects).T @ rows

    rows, along = jax.lax.map(unprojected, (at.W, at.H, at.effects, inputs, y))
    # Linear least squares gives the states' ends of each flight.
    ends = at.S @ (at.S.T @ jnp.sum(along, axis=0))

    def without_ends(of: Any) -> tuple[Array, Array]:
        R, H, effects, inputs, rows = of
        of_ends = ends.reshape(effects.shape[2], -1, ends.shape[1])
        X = times(R, inputs + jnp.einsum("kce,enf->kcnf", effects, of_ends))
        return rows - basis_of(H, effects) @ ends, X

    rows, X = jax.lax.map(without_ends, (at.R, at.H, at.effects, inputs, rows))
    return Errors(rows, X, y)


def parts_of_group(layout: Layout, noise: Noise, members: list[int]) -> list[tuple[Record, Array]]:
    """Return the records of each flight of a group, with their whitening."""
    # Records of equal length share one spectrum (`smoothed`), that of the first flight.
    pairs = zip(records_of(layout), noise.whitening, strict=True)
    return [(record, W) for record, W in pairs if record.flight == members[0]]


def measured(layout: Layout, data: Data, members: list[int]) -> Float[Array, "f N p"]:
    """Return the measured outputs of a group's flights."""
    names = layout.outputs[members[0]]
    columns = [[data.flights[i].outputs[n] for n in names] for i in members]
    return jnp.stack([jnp.stack([jnp.asarray(v) for v in of], axis=1) for of in columns])


class LineErrors(NamedTuple):
    """Errors of all records."""

    errors: list[Complex[Array, "K p"]]
    """Errors by record, without the effects of its ends, not whitened."""
    model: Matrices
    """Model of the first flight."""


@jitted
def errors_of_lines(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> LineErrors:
    """Return the errors at the lines of every record."""
    u, errors, first = unpack(layout, data, z), dict[tuple[int, int], Array](), None
    for members in alike(layout, data):
        m, driving = discretised(layout, data, u, members)
        first = m if first is None else first
        y = measured(layout, data, members)
        for k, (record, W) in enumerate(parts_of_group(layout, noise, members)):
            made = errors_of_record(resolved(m, record, W), m, driving, y)
            left = made.y - jnp.einsum("pn,bkcnf->bkcpf", m.C, made.X)
            left = left.reshape(-1, *left.shape[2:])[: record.lines]
            for j, i in enumerate(members):
                errors[i, k] = jax.lax.complex(left[:, 0, :, j], left[:, 1, :, j])
    assert first is not None
    return LineErrors([errors[at] for at in sorted(errors)], first)
