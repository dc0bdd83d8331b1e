"""The exact recurrence of a linear model in blocks: m samples a step, the rest by matrix products.

For one record this takes a fraction of the time of a step per sample; for large batches of
vehicles a step per sample is better, since the products grow with m.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax.simulation.discretize import product
from heli_jax.simulation.solvers import Held, at


def blockwise(held: Held, m: int, x0: Any) -> Any:
    """The states (N,) of a record from x0, cut into blocks of m samples.

    From block to block X[k+1] = A^m X[k] + w[k]; within a block the powers of A take the state at
    its start, and A^j B the inputs, to all its samples at once, one state variable at a time.
    """
    assert held.discrete is not None
    A, (B, U) = held.discrete.Ad, columns(held)
    n, size = U.shape[0], A.shape[0]
    count = -(-n // m)
    U = jnp.pad(U, ((0, count * m - n), (0, 0))).reshape(count, m, -1)
    powers, Am = _powers(A, m)
    response = powers @ B
    w = jnp.einsum("kjr,jnr->kn", U, response[::-1])

    def step(x: Array, w: Array) -> tuple[Array, Array]:
        return jnp.sum(Am * x[None, :], axis=1) + w, x

    _, starts = jax.lax.scan(step, jnp.stack(jax.tree.leaves(x0)), w)
    lag = jnp.arange(m)[:, None] - 1 - jnp.arange(m)[None, :]
    kept = (lag >= 0)[:, :, None]

    def one(i: int) -> Array:
        past = jnp.where(kept, response[jnp.maximum(lag, 0), i], 0.0)
        free = starts @ powers[:, i].T
        forced = U.reshape(count, -1) @ past.reshape(m, -1).T
        return (free + forced).reshape(-1)[:n]

    return jax.tree.unflatten(jax.tree.structure(x0), [one(i) for i in range(size)])


def columns(held: Held) -> tuple[Array, Array]:
    """B (n, r) and what it multiplies (N, r): the inputs now, then those still held before."""
    assert held.discrete is not None
    now = jax.tree.leaves(held.inputs)
    n = now[0].shape[0]
    B = held.discrete.Bd
    if held.delay is None:
        return B, jnp.stack(now, axis=1)
    k = jnp.arange(n) - held.delay[0]
    both = [*jax.tree.leaves(at(held.inputs, k)), *jax.tree.leaves(at(held.inputs, k - 1))]
    return jnp.concatenate([B, held.discrete.Bp], axis=1), jnp.stack(both, axis=1)


def _powers(A: Array, m: int) -> tuple[Array, Array]:
    """A^0 ... A^(m-1) and A^m."""

    def step(P: Array, _: None) -> tuple[Array, Array]:
        return product(P, A), P

    top, powers = jax.lax.scan(step, jnp.eye(A.shape[0], dtype=A.dtype), None, length=m)
    return powers, top
