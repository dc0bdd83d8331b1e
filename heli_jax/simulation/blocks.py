"""The exact recurrence of a linear model in blocks: m samples a step, the rest by matrix products.

For one record this takes a fraction of the time of a step per sample; for large batches of
vehicles a step per sample is better, since the products grow with m.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax.naming import Record
from heli_jax.numerics.matrix_exponential import product
from heli_jax.simulation.discretize import Discrete
from heli_jax.simulation.solvers import ZeroOrderHoldArgs, at


def blockwise(args: ZeroOrderHoldArgs, m: int, x0: Record) -> Record:
    """The states (N,) of a record from x0, cut into blocks of m samples.

    From block to block X[k+1] = A^m X[k] + w[k]; within a block the powers of A take the state at
    its start, and A^j B the inputs, to all its samples at once, one state variable at a time.

    Args:
        args: with the recurrence, in matrices, and the inputs (N,).
        x0: the model's State at the first sample.
    """
    assert args.discrete is not None
    if args.discrete.Bn is not None:
        of_next = _next_sample(args, x0)
        args = args._replace(discrete=without_next(args.discrete))
        x0 = jax.tree.map(lambda x, a: x - a[0], x0, of_next)
        return jax.tree.map(jnp.add, blockwise(args, m, x0), of_next)
    A, (B, U) = args.discrete.Ad, columns(args)
    # The last block is filled up with inputs of zero, and what they drive is cut off again.
    n, size = U.shape[0], A.shape[0]
    count = -(-n // m)
    U = jnp.pad(U, ((0, count * m - n), (0, 0))).reshape(count, m, -1)
    # From block to block one step after another, then all samples of all blocks at once: N/m short
    # steps in place of N, and the rest in matrix products.
    powers, Am = _powers(A, m)
    response = powers @ B
    w = jnp.einsum("kjr,jnr->kn", U, response[::-1])

    def step(x: Array, w: Array) -> tuple[Array, Array]:
        # Am x as a sum: a product of a small matrix and a vector calls a routine in every step.
        return jnp.sum(Am * x[None, :], axis=1) + w, x

    _, starts = jax.lax.scan(step, jnp.stack(jax.tree.leaves(x0)), w)
    # Sample j of a block has the inputs of the samples i < j behind it, by the response j - 1 - i.
    lag = jnp.arange(m)[:, None] - 1 - jnp.arange(m)[None, :]
    kept = (lag >= 0)[:, :, None]

    def state_variable(i: int) -> Array:
        past = jnp.where(kept, response[jnp.maximum(lag, 0), i], 0.0)
        free = starts @ powers[:, i].T
        forced = U.reshape(count, -1) @ past.reshape(m, -1).T
        return (free + forced).reshape(-1)[:n]

    return jax.tree.unflatten(jax.tree.structure(x0), [state_variable(i) for i in range(size)])


def columns(args: ZeroOrderHoldArgs) -> tuple[Array, Array]:
    """B (n, r) and what it multiplies (N, r): the inputs now, those before, and the next ones."""
    assert args.discrete is not None
    _, B, before, after = args.discrete
    # A late or a moving input makes a sample's state depend on two or three samples of it: columns
    # beside B, for inputs that are shifted by one.
    if before is None and after is None:
        return B, jnp.stack(jax.tree.leaves(args.inputs), axis=1)
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    k = jnp.arange(n)
    taps = [(B, k), *((M, k + i) for M, i in ((before, -1), (after, 1)) if M is not None)]
    U = [u for _, at_k in taps for u in jax.tree.leaves(at(args.inputs, at_k, args.delays))]
    return jnp.concatenate([M for M, _ in taps], axis=1), jnp.stack(U, axis=1)


def without_next(discrete: Discrete) -> Discrete:
    """The recurrence without the inputs one sample ahead: linear inputs cost what held ones do.

    z[k] = x[k] - Bn u[k] turns x[k+1] = Ad x[k] + Bd u[k] + Bn u[k+1] into
    z[k+1] = Ad z[k] + (Ad Bn + Bd) u[k].
    """
    A, B, before, after = discrete
    return Discrete(A, product(A, after) + B, before, None)


def _next_sample(args: ZeroOrderHoldArgs, like: Record) -> Any:
    """Bn u as a State with arrays (N,), built as `like` is."""
    assert args.discrete is not None
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    U = jnp.stack(jax.tree.leaves(at(args.inputs, jnp.arange(n), args.delays)), axis=1)
    return jax.tree.unflatten(jax.tree.structure(like), list((U @ args.discrete.Bn.T).T))


def _powers(A: Array, m: int) -> tuple[Array, Array]:
    """A^0 ... A^(m-1) and A^m."""

    def step(P: Array, _: None) -> tuple[Array, Array]:
        return product(P, A), P

    top, powers = jax.lax.scan(step, jnp.eye(A.shape[0], dtype=A.dtype), None, length=m)
    return powers, top
