r"""What a linear machine does over a record, stable or not, but for what its ends add.

With $z = e^{i \pi (2 k + 1) / N}$ the sums $X = (zI - A_d)^{-1} B U$ are those of the solution with
$x_N = -x_0$. It is bounded where a simulation diverges, and what a machine does in the record is
this and $n$ numbers times the effects of the ends: those of stable modes decay from the beginning
on, those of unstable ones towards the end. Lines half a line away from those of Fourier have no
pole of an integrator among them.

Sources: Pintelon and Schoukens (2012), chapter 6; Devasia, Chen and Paden (1996) for bounded
solutions of unstable machines.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.identification.estimation.linear_machine import Machine

_NO_END = 1e-10
"""part of the largest effect of an end below which a state has none"""


def bounded_outputs(machine: Machine, ends: Float[Array, " n"] | None) -> Float[Array, "p N"]:
    """The outputs over the record.

    Args:
        machine: with the inputs of a flight.
        ends: of the states, those of `ends_outputs`; zero unless given.
    """
    N = machine.U.shape[0]
    z, turns = _lines(N)
    V = jnp.fft.fft(machine.U.astype(z.dtype) * np.conj(turns)[:, None], axis=0)[: z.size]
    driving = V @ machine.B.T.astype(z.dtype)
    if ends is not None:
        driving = driving + z[:, None] * ends.astype(z.dtype)[None, :]
    states = jnp.einsum("kij,kj->ki", _resolvent(machine, z), driving)
    outputs = _in_time(states @ machine.C.T.astype(z.dtype), turns)
    return (outputs + machine.acting @ machine.D.T).T


def ends_outputs(machine: Machine) -> Float[Array, "n p N"]:
    """What the ends of the record add to the outputs, for each state.

    Args:
        machine: with the inputs of a flight.
    """
    N = machine.U.shape[0]
    z, turns = _lines(N)
    effects = machine.C.astype(z.dtype)[None] @ _resolvent(machine, z) * z[:, None, None]
    p, n = machine.C.shape
    return jnp.transpose(_in_time(effects.reshape(z.size, -1), turns).reshape(N, p, n), (2, 1, 0))


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


def _resolvent(machine: Machine, z: Complex[np.ndarray, " K"]) -> Complex[Array, "K n n"]:
    identity = jnp.eye(machine.Ad.shape[0], dtype=z.dtype)
    return jnp.linalg.inv(z[:, None, None] * identity[None] - machine.Ad.astype(z.dtype)[None])


def _in_time(lines: Complex[Array, "K c"], turns: Complex[np.ndarray, " N"]) -> Float[Array, "N c"]:
    N, K = turns.size, lines.shape[0]
    weights = np.full(K, 2.0, turns.dtype)
    if N % 2:
        weights[-1] = 1.0
    whole = jnp.fft.ifft(lines * weights[:, None], N, axis=0)
    return jnp.real(whole * turns[:, None])
