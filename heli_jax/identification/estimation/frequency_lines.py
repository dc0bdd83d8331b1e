r"""A model's error at a record's own frequencies, whitened, without what the ends may add.

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Golub and Pereyra (1973) and Kaufman
(1975) for the projection.
"""

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

_NO_END = 1e-10
"""part of the largest effect of an end's state below which a state has none"""


class Lines(NamedTuple):
    """A record at its own frequencies k = 1 ... K, below the Nyquist frequency."""

    error: Complex[Array, "K p"]
    """measured less simulated, the ends of the record taken off"""
    rows: Float[Array, " s"]
    """the same whitened, real parts and then imaginary ones; of white noise of variance 1"""
    ends: Float[Array, " n"]
    """the components of `rows` along what the ends of the record may add: zero but for their
    derivatives"""
    by: Float[Array, " s"]
    """minus the response to the inputs by instrument, whitened likewise; () without"""
    by_ends: Float[Array, " n"]
    """its components along what the ends may add; () without"""


def all_lines(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> list[Lines]:
    """Of every record.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: with the whitening of each record.
        u: the unknowns, in the units of the model.
    """
    by_flight: dict[int, list[Lines]] = {}
    for members in _alike(layout, data):
        # Flights that are alike side by side: one of them is compiled, not each.
        first, flights = members[0], [data.flights[i] for i in members]
        stacked = jax.tree.map(lambda *v: jnp.stack(v), *flights)
        # Records of one length have one spectrum (`smoothed`), and with one sample time all that
        # does not hang on the signals is computed once.
        whitening = _of_flight(layout, noise.whitening, first)

        def of_one(flight: Any, i: int = first, whitening: Any = whitening) -> list[Lines]:
            flight = flight._replace(dt=data.flights[i].dt)
            own = (*data.flights[:i], flight, *data.flights[i + 1 :])
            return _of_records(layout, data._replace(flights=own), u, i, whitening)

        made = jax.vmap(of_one)(stacked)
        for k, i in enumerate(members):
            by_flight[i] = jax.tree.map(lambda v, k=k: v[k], made)
    return [one for i in range(len(data.flights)) for one in by_flight[i]]


@eqx.filter_jit
def errors_of_lines(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> list[Complex[Array, "K p"]]:
    """By record the errors, its ends taken off, not whitened.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: with the whitening of each record.
        z: the unknowns.
    """
    return [one.error for one in all_lines(layout, data, noise, unpack(layout, data, z))]


def _alike(layout: Layout, data: Data) -> list[list[int]]:
    """The flights in groups that differ in numbers alone."""
    groups: dict[Any, list[int]] = {}
    for i, flight in enumerate(data.flights):
        n = next(iter(flight.outputs.values())).shape[0]
        key = (n, layout.outputs[i], layout.holds[i], layout.of_flights[i], tuple(flight.known))
        # An offset of its own moves the point about which a flight is linearised.
        key = key if layout.model.linear else (i, *key)
        groups.setdefault(key, []).append(i)
    return list(groups.values())


def _of_flight(layout: Layout, whitening: Any, i: int) -> list[Array]:
    pairs = zip(records_of(layout), whitening, strict=True)
    return [w for record, w in pairs if record.flight == i]


def _of_records(
    layout: Layout, data: Data, u: Unknowns, i: int, whitening: list[Array]
) -> list[Lines]:
    """The records of one flight, each with its whitening."""
    # Once for all parts of a flight.
    flight = data.flights[i]
    machine, by = _machine(layout, data, u, i), None
    if flight.by_instrument is not None:
        alike = flight._replace(inputs=flight.by_instrument)
        flights = (*data.flights[:i], alike, *data.flights[i + 1 :])
        by = _machine(layout, data._replace(flights=flights), u, i)
    y = jnp.stack([flight.outputs[n] for n in layout.outputs[i]], axis=1)
    records = [r for r in records_of(layout) if r.flight == i]
    return [_lines(machine, by, y, r, w) for r, w in zip(records, whitening, strict=True)]


class _Machine(NamedTuple):
    """What a flight's states and outputs follow, sample by sample."""

    Ad: Float[Array, "n n"]
    B: Float[Array, "n r"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]
    U: Float[Array, "N r"]
    """what B multiplies"""
    acting: Float[Array, "N m"]
    """the inputs that act at the samples"""


def _machine(layout: Layout, data: Data, u: Unknowns, i: int) -> _Machine:
    condition = layout.of_flights[i].condition
    model, drive, _ = linear_drive(layout, driven(layout, data, u, i), condition)
    linear = linear_inputs(model, drive.inputs, layout.hold(i))
    Ad, B, U, acting = held_columns(model, drive.params, drive.inputs, drive.dt, u.shift, linear)
    _, _, C, D = jacobians(model, drive.params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in layout.outputs[i]])
    return _Machine(Ad, B, C[rows], D[rows], U, acting)


class _Fixed(NamedTuple):
    """What does not move with the unknowns while they are differentiated by."""

    P: Complex[Array, "K n n"]
    """(zI - Ad)^-1"""
    W: Complex[Array, "K p p"]
    """the whitening"""
    H: Complex[Array, "K p n"]
    """W C P"""


def _lines(
    machine: _Machine, by: _Machine | None, y: Array, record: Record, whitening: Array
) -> Lines:
    Ad, _, C, *_ = machine
    N, part = record.samples, slice(record.first, record.last)
    k = np.arange(1, record.lines + 1)
    z = jnp.asarray(np.exp(2j * np.pi * k / N))
    still, C_still = (jax.lax.stop_gradient(v).astype(z.dtype) for v in (Ad, C))
    identity = jnp.eye(Ad.shape[0], dtype=z.dtype)
    P = jnp.linalg.inv(z[:, None, None] * identity[None] - still[None])
    fixed = _Fixed(P, whitening, whitening @ (C_still[None] @ P))

    def lines(v: Array) -> Array:
        # Cut behind the inputs' delays: what acted in a part was logged before it. Without a mean:
        # the zero line is not used, and rounding would carry it to the others.
        v = v[part] - jnp.mean(v[part], axis=0, keepdims=True)
        return jnp.fft.rfft(v, axis=0)[k] * float(N) ** -0.5

    def answered(m: _Machine) -> tuple[Array, Array]:
        """What drives the states, and what passes by them, whitened."""
        passing = lines(m.acting) @ m.D.T.astype(z.dtype)
        return lines(m.U) @ m.B.T.astype(z.dtype), jnp.einsum("kij,kj->ki", whitening, passing)

    Y, (driving, passing) = jnp.einsum("kij,kj->ki", whitening, lines(y)), answered(machine)
    # The ends of the record: what they explain is found by linear least squares.
    basis = _span(_real(z[:, None, None] * fixed.H))
    white = _stacked(Y - passing - _response(fixed, Ad, C, driving))
    d = jax.lax.stop_gradient(basis.solution @ (basis.Q.T @ white))
    driving = driving + z[:, None] * d.astype(z.dtype)[None, :]
    white = Y - passing - _response(fixed, Ad, C, driving)
    error, rows = jnp.linalg.solve(whitening, white[:, :, None])[:, :, 0], _stacked(white)
    nothing = jnp.zeros(0, rows.dtype)
    if by is None:
        return Lines(error, rows, basis.Q.T @ rows, nothing, nothing)
    driving, passing = answered(by)
    response = -_stacked(passing + _response(fixed, by.Ad, by.C, driving))
    return Lines(error, rows, basis.Q.T @ rows, response, basis.Q.T @ response)


class _Span(NamedTuple):
    """The space of what the ends of a record may add."""

    Q: Float[Array, "s n"]
    """orthonormal; zero where a state leaves no trace"""
    solution: Float[Array, "n n"]
    """from the components along Q to the ends' states"""


def _span(basis: Float[Array, "s n"]) -> _Span:
    basis = 2.0**0.5 * jax.lax.stop_gradient(basis)
    Q, R = jnp.linalg.qr(basis)
    # A state that no output shows has a column of rounding, and QR makes some direction of it,
    # another at each step: what that takes off makes the sum of squares rough.
    U, sizes, Vt = jnp.linalg.svd(R)
    kept = sizes > _NO_END * sizes[0]
    over = jnp.where(kept, 1.0 / jnp.where(kept, sizes, 1.0), 0.0)
    return _Span(jnp.where(kept[None, :], Q @ U, 0.0), Vt.T * over[None, :])


def _stacked(v: Complex[Array, "K p"]) -> Float[Array, " s"]:
    # Of a complex normal error each part has half of the variance.
    return 2.0**0.5 * _real(v.reshape(1, -1, 1))[:, 0]


def _real(v: Complex[Array, "K p n"]) -> Float[Array, "s n"]:
    v = v.reshape(-1, v.shape[2])
    return jnp.concatenate([jnp.real(v), jnp.imag(v)])


@jax.custom_jvp
def _response(fixed: _Fixed, Ad: Array, C: Array, b: Array) -> Array:
    """W C (zI - Ad)^-1 b at every line (K, p)."""
    X = jnp.einsum("kij,kj->ki", fixed.P, b)
    return jnp.einsum("kij,kj->ki", fixed.W, X @ C.T.astype(X.dtype))


def _response_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    fixed, _Ad, C, b = primals
    _, dA, dC, db = tangents
    X = jnp.einsum("kij,kj->ki", fixed.P, b)
    y = jnp.einsum("kij,kj->ki", fixed.W, X @ C.T.astype(X.dtype))
    # One product for each line in place of a solution: H is the same for all unknowns.
    moved = jnp.zeros_like(b) if _is_zero(db) else db
    if not _is_zero(dA):
        # Real matrices: half of a complex product.
        moved = moved + jax.lax.complex(jnp.real(X) @ dA.T, jnp.imag(X) @ dA.T)
    dy = jnp.einsum("kij,kj->ki", fixed.H, moved)
    if not _is_zero(dC):
        dy = dy + jnp.einsum("kij,kj->ki", fixed.W, X @ dC.T.astype(X.dtype))
    return y, dy


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


_response.defjvp(_response_jvp, symbolic_zeros=True)
