r"""What a linear machine does over a record, stable or not, but for what its ends add.

With $z = e^{i \pi (2 k + 1) / N}$ the sums $X = (zI - A_d)^{-1} B U$ are those of the solution with
$x_N = -x_0$. It is bounded where a simulation diverges, and what a machine does in the record is
this and $n$ numbers times the effects of the ends: those of stable modes decay from the beginning
on, those of unstable ones towards the end. Lines half a line away from those of Fourier have no
pole of an integrator among them. With $H = C (zI - A_d)^{-1}$ the derivative of the outputs is
$H (dA_d X + dB\,U) + dC X + dD\,U$.

Sources: Pintelon and Schoukens (2012), chapters 6 and 9; Devasia, Chen and Paden (1996) for bounded
solutions of unstable machines.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.identification.estimation.linear_machine import Machine

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
