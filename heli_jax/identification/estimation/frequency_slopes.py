r"""Products of errors, their derivatives by the unknowns, and instruments, over all lines.

With $H = W C (zI - A_d)^{-1}$ the derivative of the whitened response is
$H (dA_d X + dB\,U) + W (dC X + dD\,U)$: one product for each line and unknown in place of a
solution, of which all unknowns share the first factor.

Source: Pintelon and Schoukens (2012), chapter 9.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from heli_jax.identification.estimation.frequency_lines import (
    Errors,
    Matrices,
    Record,
    Resolved,
    Signals,
    alike,
    at_lines,
    by_flight,
    errors_of_some,
    machines_of,
    measured,
    parts_of_group,
    real,
    resolved,
    stacked,
)
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns

# The unknowns that all flights share, as a vector, and what hangs on them with its derivatives.


def shared_of(layout: Layout, u: Unknowns) -> Float[Array, " q"]:
    """Parameters, gains and the time shift: all but initial states, biases and offsets.

    Args:
        u: the unknowns, in the units of the model.
    """
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


def differentiated[T](make: Callable[[Array], T], v: Float[Array, " q"]) -> tuple[T, T]:
    """Arrays in tuples and their derivatives by v, a last axis; None in place of those that are
    zero.

    Args:
        v: where.
    """

    moving: list[bool] = []

    # Called beside `make`: which derivatives are zero shows as they are made, and to trace a model
    # once more for it takes as long as to differentiate it.
    @jax.custom_jvp
    def look(*leaves: Array) -> Array:
        return jnp.zeros((), v.dtype)

    def rule(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
        zero = jax.custom_derivatives.SymbolicZero
        moving[:] = [not isinstance(t, zero) for t in tangents]
        return jnp.zeros((), v.dtype), jnp.zeros((), v.dtype)

    look.defjvp(rule, symbolic_zeros=True)

    def looked_at(v: Array) -> T:
        made = make(v)
        look(*jax.tree.leaves(made))
        return made

    def along(direction: Array) -> tuple[T, T]:
        return jax.jvp(looked_at, (v,), (direction,))

    value, slopes = jax.vmap(along, out_axes=(None, -1))(jnp.eye(v.size, dtype=v.dtype))
    leaves, structure = jax.tree.flatten(slopes)
    kept = [d if moves else None for d, moves in zip(leaves, moving, strict=True)]
    return value, jax.tree.unflatten(structure, kept)


class Products(NamedTuple):
    """Of whitened errors e (of white noise of variance 1), their derivatives J by the unknowns and
    instruments Z, all without what the ends of the records may add."""

    ee: Float[Array, ""]
    Ze: Float[Array, " q"]
    ZZ: Float[Array, "q q"]
    ZJ: Float[Array, "q q"]


class _Driven(NamedTuple):
    """Lines of a block: the states, what drives them, and the derivatives of that."""

    X: Complex[Array, "k n"]
    lines: Signals
    slopes: Signals
    """(k, c, q); None for those that do not move"""


class _Shared(NamedTuple):
    """Of a block what flights of one machine have in common."""

    H: Array
    """for each line the real matrix of it (k, 2p, 2n)"""
    W: Array | None
    """the same (k, 2p, 2p); None where nothing that it multiplies moves"""
    basis: Float[Array, "s m"]
    """of what the ends may add"""


class _Own(NamedTuple):
    """What each flight has of its own."""

    e: Float[Array, " s"]
    driven: _Driven
    by: _Driven | None = None
    """by instrument, where that is what Z is of"""


class _Sums(NamedTuple):
    """Products, and the components along what the ends may add."""

    ee: Array
    Ze: Array
    ZZ: Array
    ZJ: Array
    Qe: Array
    QZ: Array
    QJ: Array

    def along(self, S: Float[Array, "m m"]) -> "_Sums":
        """With components along an orthonormal basis.

        Args:
            S: makes it of the basis that the sums are of.
        """
        Qe, QZ, QJ = (S.T @ v for v in (self.Qe, self.QZ, self.QJ))
        return self._replace(Qe=Qe, QZ=QZ, QJ=QJ)

    def products(self) -> Products:
        """Z P e and Z P J with the projection P: only the small products change (Kaufman)."""
        made = Products(
            self.ee - self.Qe @ self.Qe,
            -(self.Ze - self.Qe @ self.QZ),
            self.ZZ - self.QZ.T @ self.QZ,
            self.ZJ - self.QZ.T @ self.QJ,
        )
        # Of a complex normal error each part has half of the variance.
        return jax.tree.map(lambda v: 2.0 * v, made)


def products_of_lines(
    layout: Layout,
    data: Data,
    noise: Noise,
    v: Float[Array, " q"],
    unknowns: Callable[[Array], Unknowns],
) -> Products:
    """Over all records. Directly Z = J; by instrument the derivatives of the response to the inputs
    by instrument.

    Args:
        noise: with the whitening of each record, and whether instruments are used.
    """
    total = []
    for members in alike(layout, data):
        parts = parts_of_group(layout, noise, members)
        machines, slopes = differentiated(
            lambda v, members=members: machines_of(layout, data, unknowns(v), members), v
        )

        def ready(common: Any, parts: Any = parts) -> Any:
            m, dm = common
            return (
                m,
                dm,
                [resolved(m, record, W) for record, W in parts],
            )

        def of_some(common: Any, some: Any, parts: Any = parts) -> Products:
            m, dm, ats = common
            made = []
            for at, (record, _) in zip(ats, parts, strict=True):
                sums = _of_record((at, m, dm), record, noise.by_instrument, *some)
                made.append(jax.vmap(lambda of, S=at.S: of.along(S).products())(sums))
            return jax.tree.map(lambda *v: sum(v), *made)

        measured_signals = (machines.signals, slopes.signals, measured(layout, data, members))
        each = (measured_signals, None if machines.by is None else (machines.by, slopes.by))
        common = (machines.matrices, slopes.matrices)
        made = by_flight(data, members, ready, of_some, common, each)
        total.append(jax.tree.map(lambda v: jnp.sum(v, axis=0), made))
    return jax.tree.map(lambda *v: sum(v), *total)


def _of_record(
    common: tuple[Resolved, Matrices, Matrices],
    record: Record,
    by_instrument: Array,
    measured_signals: tuple[Signals, Signals, Array],
    instruments: tuple[Signals, Signals] | None,
) -> _Sums:
    """Of one record of a few flights, with a leading axis."""
    (at, m, dm), (signals, ds, y) = common, measured_signals
    by_them = None if instruments is None else (instruments[0], by_instrument > 0.5)
    e = errors_of_some(at, m, record, signals, y, by_them)
    driven: list[tuple[Any, Signals, Signals]] = [(e.X, e.signals, _lines(record, ds))]
    if instruments is not None:
        by, dby = instruments
        lines = Signals(*(at_lines(record, v) for v in by))
        driven.append((e.X_by, lines, _lines(record, dby)))
    return _summed(at, (m, dm), e, driven, by_instrument)


def _summed(
    at: Resolved,
    matrices: tuple[Matrices, Matrices],
    e: Errors,
    driven: list[tuple[Any, Signals, Signals]],
    by_instrument: Array,
) -> _Sums:
    """Over the lines that are used, block by block: the derivatives of all would leave every cache.

    Args:
        driven: states by block, signals at all lines and their derivatives; and by instrument.
    """
    blocks, (_, dm) = at.blocks, matrices
    # What passes a machine by, without its states, hangs on no unknown of most.
    passes = any(v is not None for v in (dm.C, dm.D, driven[0][2].acting))
    of_blocks = [
        _Driven(X, *jax.tree.map(lambda v: blocks.cut(v, axis=1), (lines, slopes)))
        for X, lines, slopes in driven
    ]

    def made(b: Any) -> _Sums:
        W = real(at.W[b]) if passes else None
        shared = _Shared(real(at.H[b]), W, at.basis(b))
        own = _Own(*jax.tree.map(lambda v: v[b], (e.rows, *of_blocks)))
        return jax.lax.map(lambda one: _sums(matrices, shared, one, by_instrument), own)

    shapes = jax.eval_shape(made, 0)
    zeros = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
    return blocks.over(lambda b, total: jax.tree.map(jnp.add, total, made(b)), zeros)


def _sums(
    matrices: tuple[Matrices, Matrices], lines: _Shared, own: _Own, by_instrument: Array
) -> _Sums:
    e, Q = own.e[:, None], lines.basis

    def slopes(of: _Driven) -> Float[Array, "s q"]:
        made = _slopes(lines, *matrices, of)
        return made.reshape(e.shape[0], -1)

    # J and Z are minus the derivatives: a sign that `products` gives back to Z e.
    def directly() -> _Sums:
        J = slopes(own.driven)
        # One product of tall matrices in place of several: each is read once.
        q, P = J.shape[1], jnp.concatenate([J, e, Q], axis=1).T @ jnp.concatenate([J, e], axis=1)
        ZZ, QJ = P[:q, :q], P[q + 1 :, :q]
        return _Sums(P[q, q], P[:q, q], ZZ, ZZ, P[q + 1 :, q], QJ, QJ)

    if own.by is None:
        return directly()
    by = own.by

    def with_instruments() -> _Sums:
        J, Z = slopes(own.driven), slopes(by)
        q = J.shape[1]
        P = jnp.concatenate([Z, e, Q], axis=1).T @ jnp.concatenate([Z, e, J], axis=1)
        of_Z, of_Q = ((rows[:, q], rows[:, :q], rows[:, q + 1 :]) for rows in (P[:q], P[q + 1 :]))
        return _Sums(P[q, q], *of_Z, *of_Q)

    # One program for both: the direct estimate is where the search by instrument begins. Block by
    # block, since what is made for all lines would be copied into the branch that is taken.
    return jax.lax.cond(by_instrument > 0.5, with_instruments, directly)


def _lines(record: Record, ds: Signals) -> Signals:
    """At the lines the derivatives (f, N, c, q) of signals; None where there are none."""

    def lines(v: Array) -> Array:
        flat = at_lines(record, v.reshape(*v.shape[:2], -1))
        return flat.reshape(*flat.shape[:2], *v.shape[2:])

    return jax.tree.map(lines, ds)


def _slopes(lines: _Shared, m: Matrices, dm: Matrices, of: _Driven) -> Float[Array, "K a q"]:
    """The derivatives of the whitened response, real parts and imaginary ones."""
    driving = _moved(of.X, of.lines.U, (dm.Ad, dm.B), (m.B, of.slopes.U))
    passing = _moved(of.X, of.lines.acting, (dm.C, dm.D), (m.D, of.slopes.acting))
    pairs = ((lines.H, driving), (lines.W, passing))
    made = [M @ v for M, v in pairs if M is not None and v is not None]
    return made[0] if len(made) == 1 else made[0] + made[1]


def _moved(
    X: Complex[Array, "K n"],
    u: Complex[Array, "K r"],
    slopes: tuple[Any, Any],
    of_signals: tuple[Array, Any],
) -> Any:
    """dF X + dG u + G du (K, 2a, q), real parts and imaginary ones; None where all are zero.

    Args:
        slopes: dF (a, n, q) and dG (a, r, q), None where zero.
        of_signals: G (a, r) and du (K, r, q), None where zero.
    """
    total, K = None, X.shape[0]
    pairs = [(v, d) for v, d in zip((X, u), slopes, strict=True) if d is not None]
    if pairs:
        # One product of large real matrices: real and imaginary parts are rows of the first.
        v = stacked(jnp.concatenate([v for v, _ in pairs], axis=1)).reshape(2 * K, -1)
        d = jnp.concatenate([d for _, d in pairs], axis=1)
        a, c, q = d.shape
        total = (v @ jnp.swapaxes(d, 0, 1).reshape(c, a * q)).reshape(K, 2 * a, q)
    G, du = of_signals
    if du is not None:
        part = jnp.einsum("ar,ksrq->ksaq", G, stacked(du)).reshape(K, 2 * G.shape[0], -1)
        total = part if total is None else total + part
    return total


# The rows that frequency error makes small: as many as unknowns, and one for what is left.
#
# With whitened errors $e$, their derivatives $J$ by the unknowns and instruments $Z$, the estimate
# solves $Z^T e = 0$. The rows $r = R^{-T} Z^T e$ with $R^T R = Z^T Z$ have the identity as their
# covariance, and their derivative $R^{-T} Z^T J$ the information of the estimate, $M^T (Z^T Z)^{-1}
# M$ with $M = Z^T J$. Directly $Z = J$, and with the row $|e - J J^+ e|$ beside them the sum of
# squares is that of all errors: maximum likelihood, in a few rows. By instrument $Z$ are the
# derivatives of the response to what of the inputs follows the instruments.
#
# Sources: Söderström and Stoica (1983) for estimates by instrument and their covariance; Pintelon
# and Schoukens (2012), chapter 9.


_NOTHING = 100.0
"""times the machine's precision: what of the information, of columns of one size, is rounding"""


def rows_of_lines(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Float[Array, " r"]:
    """Those rows, with the derivative that a step of Gauss and Newton needs.

    Args:
        noise: with the whitening of each record, and whether instruments are used.
        u: the unknowns, in the units of the model.
    """
    v = shared_of(layout, u)
    at, rest = jax.lax.stop_gradient((v, u))
    made = products_of_lines(layout, data, noise, at, lambda v: with_shared(layout, rest, v))
    r, M = _weighed(made)
    left = jnp.sqrt(jnp.maximum(made.ee - jnp.sum(r**2), 0.0))
    left = jnp.where(noise.by_instrument > 0.5, 0.0, left)
    r, M, left = jax.lax.stop_gradient((r, M, left))
    # The derivative is exactly M, whatever else moves with the unknowns.
    return jnp.append(r + M @ (v - at), left)


def _weighed(of: Products) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """R^-T Z e and R^-T Z J^T, with R^T R = Z Z^T; zero along what is no direction of Z."""
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(of.ZZ), 0.0))
    # Of one size: units do not decide what is rounding.
    over = jnp.where(sizes > 0, 1.0 / jnp.where(sizes > 0, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(of.ZZ * over[:, None] * over[None, :])
    kept = values > _NOTHING * jnp.finfo(values.dtype).eps * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    along = root[:, None] * vectors.T * over[None, :]
    return along @ of.Ze, along @ of.ZJ
