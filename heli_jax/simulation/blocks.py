"""The exact recurrence of a linear model in blocks: m samples a step, the rest by matrix products.

For one record this takes a fraction of the time of a step per sample; for large batches of
vehicles a step per sample is better, since the products grow with m.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.simulation.discretize import Discrete
from heli_jax.simulation.solvers import Held, at


class Blocked(NamedTuple):
    """A record cut into blocks."""

    held: Held
    """the coarse recurrence X[k+1] = A^m X[k] + w[k], whose inputs are the columns of w"""
    count: int
    """number of blocks"""
    powers: Float[Array, "m n n"]
    """A^0 ... A^(m-1)"""
    response: Float[Array, "m n r"]
    """A^j B"""
    inputs: Float[Array, "count m r"]


def blocked(held: Held, m: int) -> Blocked:
    """Cut a record into blocks of m samples; the last one is filled up with zeros."""
    assert held.discrete is not None
    A = _matrix(held.discrete.Ad)
    B, U = _columns(held)
    count = -(-U.shape[0] // m)
    U = jnp.pad(U, ((0, count * m - U.shape[0]), (0, 0))).reshape(count, m, -1)
    powers, Am = _powers(A, m)
    response = powers @ B
    w = jnp.einsum("kjr,jnr->kn", U, response[::-1])
    n = A.shape[0]
    eye = tuple(tuple(row) for row in jnp.eye(n, dtype=A.dtype))
    rows = tuple(tuple(row) for row in Am)
    coarse = Held(held.params, tuple(w.T), held.dt, None, Discrete(rows, eye, None))
    return Blocked(coarse, count, powers, response, U)


def expanded(cut: Blocked, starts: Any, n: int) -> Any:
    """All n states from those at the starts of the blocks, one state variable at a time.

    `starts` and the result are the model's State, with arrays (count,) and (n,).
    """
    X = jnp.stack(jax.tree.leaves(starts), axis=1)
    m = cut.powers.shape[0]
    lag = jnp.arange(m)[:, None] - 1 - jnp.arange(m)[None, :]
    kept = (lag >= 0)[:, :, None]

    def one(i: int) -> Array:
        past = jnp.where(kept, cut.response[jnp.maximum(lag, 0), i], 0.0)
        free = X @ cut.powers[:, i].T
        forced = cut.inputs.reshape(cut.count, -1) @ past.reshape(m, -1).T
        return (free + forced).reshape(-1)[:n]

    values = [one(i) for i in range(X.shape[1])]
    return jax.tree.unflatten(jax.tree.structure(starts), values)


def _matrix(rows: Any) -> Array:
    return jnp.stack([jnp.stack(list(row)) for row in rows])


def _columns(held: Held) -> tuple[Array, Array]:
    """B (n, r) and what it multiplies (N, r): the inputs now, then those still held before."""
    assert held.discrete is not None
    now = jax.tree.leaves(held.inputs)
    n = now[0].shape[0]
    B = _matrix(held.discrete.Bd)
    if held.delay is None:
        return B, jnp.stack(now, axis=1)
    k = jnp.arange(n) - held.delay[0]
    both = [*jax.tree.leaves(at(held.inputs, k)), *jax.tree.leaves(at(held.inputs, k - 1))]
    return jnp.concatenate([B, _matrix(held.discrete.Bp)], axis=1), jnp.stack(both, axis=1)


def _powers(A: Array, m: int) -> tuple[Array, Array]:
    """A^0 ... A^(m-1) and A^m for m a power of two, by doubling."""
    powers, top = jnp.eye(A.shape[0], dtype=A.dtype)[None], A
    while powers.shape[0] < m:
        powers, top = jnp.concatenate([powers, powers @ top]), top @ top
    return powers, top
