"""The exact recurrence of a linear model in blocks: m samples a step, the rest by matrix products.

For one record this is several times faster than a step per sample. For large batches a step per
sample is better, since the products grow with m.

Reduced runs can also take several samples a step. The state m samples after x[k] is A^m x[k] + ...,
and each output between is C A^j x[k] + ..., with coefficients of the vehicle. With four states and
one output, four samples take two thirds of the products of four steps; two samples take three
quarters.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record
from heli_jax.numerics.matrix_exponential import product
from heli_jax.simulation.discretize import Discrete, scalars
from heli_jax.simulation.hold import at
from heli_jax.simulation.solvers import ZeroOrderHoldArgs, advance, dot


def blockwise(args: ZeroOrderHoldArgs, m: int, x0: Record) -> Record:
    """Return the states (N,) of a record from x0, computed in blocks of m samples.

    Between blocks X[k+1] = A^m X[k] + w[k]. Within a block, powers of A map the first state to all
    samples at once, and A^j B the inputs.
    """
    assert args.discrete is not None
    if args.discrete.Bn is not None:
        of_next = _next_sample(args, x0)
        args = args._replace(discrete=without_next(args.discrete))
        x0 = jax.tree.map(lambda x, a: x - a[0], x0, of_next)
        return jax.tree.map(jnp.add, blockwise(args, m, x0), of_next)
    A, (B, U) = args.discrete.Ad, columns(args)
    # The last block is padded with zero inputs, and the excess is cut off.
    n, size = U.shape[0], A.shape[0]
    count = -(-n // m)
    U = jnp.pad(U, ((0, count * m - n), (0, 0))).reshape(count, m, -1)
    # N/m short steps between blocks, then all samples of all blocks at once in matrix products.
    powers, Am = _powers(A, m)
    response = powers @ B
    w = jnp.einsum("kjr,jnr->kn", U, response[::-1])

    def step(x: Array, w: Array) -> tuple[Array, Array]:
        # Am x as a sum, since a product of a small matrix and a vector calls a routine in every
        # step.
        return jnp.sum(Am * x[None, :], axis=1) + w, x

    _, starts = jax.lax.scan(step, jnp.stack(jax.tree.leaves(x0)), w)
    # Sample j of a block depends on the inputs of samples i < j, through response j - 1 - i.
    lag = jnp.arange(m)[:, None] - 1 - jnp.arange(m)[None, :]
    kept = (lag >= 0)[:, :, None]

    def state_variable(i: int) -> Array:
        past = jnp.where(kept, response[jnp.maximum(lag, 0), i], 0.0)
        free = starts @ powers[:, i].T
        forced = U.reshape(count, -1) @ past.reshape(m, -1).T
        return (free + forced).reshape(-1)[:n]

    return jax.tree.unflatten(jax.tree.structure(x0), [state_variable(i) for i in range(size)])


def columns(args: ZeroOrderHoldArgs) -> tuple[Array, Array]:
    """Return B (n, r) and its multipliers (N, r): the present, previous and next inputs."""
    assert args.discrete is not None
    _, B, before, after = args.discrete
    # With delayed or moving inputs the next state depends on two or three samples. Each adds
    # columns to B, for inputs shifted by one.
    if before is None and after is None:
        return B, jnp.stack(jax.tree.leaves(args.inputs), axis=1)
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    k = jnp.arange(n)
    taps = [(B, k), *((M, k + i) for M, i in ((before, -1), (after, 1)) if M is not None)]
    U = [u for _, at_k in taps for u in jax.tree.leaves(at(args.inputs, at_k, args.delays))]
    return jnp.concatenate([M for M, _ in taps], axis=1), jnp.stack(U, axis=1)


def without_next(discrete: Discrete) -> Discrete:
    """Return the recurrence without the next inputs, so that linear inputs are as fast as held
    ones.

    z[k] = x[k] - Bn u[k] turns x[k+1] = Ad x[k] + Bd u[k] + Bn u[k+1] into z[k+1] = Ad z[k] + (Ad
    Bn + Bd) u[k].
    """
    A, B, before, after = discrete
    return Discrete(A, product(A, after) + B, before, None)


def _next_sample(args: ZeroOrderHoldArgs, like: Record) -> Any:
    """Return Bn u as a State with arrays (N,), with the structure of `like`."""
    assert args.discrete is not None
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    U = jnp.stack(jax.tree.leaves(at(args.inputs, jnp.arange(n), args.delays)), axis=1)
    return jax.tree.unflatten(jax.tree.structure(like), list((U @ args.discrete.Bn.T).T))


def _powers(A: Array, m: int) -> tuple[Array, Array]:
    """Return A^0 ... A^(m-1), and A^m."""

    def step(P: Array, _: None) -> tuple[Array, Array]:
        return product(P, A), P

    top, powers = jax.lax.scan(step, jnp.eye(A.shape[0], dtype=A.dtype), None, length=m)
    return powers, top


# `Any` below: State, Inputs and Params are the user's classes, JAX exports no type of tree
# structures, and scalars are in nested tuples.


class Reducing(NamedTuple):
    """Reduction of a run by blocks."""

    model: Model
    params: Record
    update: Callable[[Any, Any, Any], Any]
    """value = update(value, outputs, data at that sample)."""


class _Block(NamedTuple):
    """The exact recurrence over a block of m samples, in nested tuples of scalars.

    Within a block no result depends on the one before, so XLA makes one loop over the vehicles.
    Written sample by sample, XLA would compute every sample from the block's first again.
    """

    free: Any
    """C A^j, row by row, for j = 1 ... m - 1."""
    forced: Any
    """Effect on the outputs of an input j samples before, for j = 0 ... m - 1."""
    onward: Any
    """A^m."""
    driven: Any
    """Effect of each sample's inputs on the state after the block."""
    of_next: Any
    """Bn, for inputs that are linear between samples; else None."""


def _block_of(model: Model, args: ZeroOrderHoldArgs, m: int) -> tuple[_Block, Discrete]:
    """Return the recurrence over m samples, and that over one."""
    assert args.discrete is not None
    A, B, _, Bn = discrete = args.discrete
    space = jacobians(model, args.params)
    C, D = space.C.astype(A.dtype), space.D.astype(A.dtype)
    of_next = None if Bn is None else scalars(Bn)
    if Bn is not None:
        # For linear inputs, the state x - Bn u has the recurrence of held inputs.
        discrete, D = without_next(discrete), D + product(C, Bn)
        B = discrete.Bd
    # C A^j and A^j B take m - 1 products each, without powers of A.
    rows, columns, power = [C], [B], A
    for _ in range(m - 1):
        rows.append(product(rows[-1], A))
        columns.append(product(A, columns[-1]))
        power = product(A, power)
    free = [scalars(row) for row in rows[1:]]
    forced = [scalars(D)] + [scalars(product(C, column)) for column in columns[:-1]]
    onward, driven = scalars(power), [scalars(column) for column in reversed(columns)]
    # The barrier computes the coefficients once, instead of in every step.
    once = jax.lax.optimization_barrier((free, forced, onward, driven, of_next))
    return _Block(*once), discrete


class Blocks(NamedTuple):
    """A run in steps of m samples."""

    reducing: Reducing
    m: int
    block: _Block
    discrete: Discrete
    inputs: Any
    """The model's Inputs, arrays (N,)."""
    data: PyTree
    carry: Any
    """Values before the first step: states of the recurrence, and the reduced value."""
    structure: Any
    """Tree structure of the model's State."""

    @property
    def samples(self) -> int:
        """Number of samples N."""
        return jax.tree.leaves(self.inputs)[0].shape[0]

    @property
    def steps(self) -> int:
        """Number of steps. At least one sample remains, since the last has outputs but no step."""
        return (self.samples - 1) // self.m

    def step(self, carry: PyTree, k: Int[Array, ""], /) -> PyTree:
        """Return the carry after the k-th step."""
        rows = [
            jax.tree.map(lambda v, j=j: v[k * self.m + j], (self.inputs, self.data))
            for j in range(self.m)
        ]
        return self.over(carry, [jax.tree.leaves(r[0]) for r in rows], [r[1] for r in rows])

    def over(self, carry: PyTree, u: list[list[Array]], now: list[Any]) -> PyTree:
        """Return the carry after m samples with the given inputs and data."""
        x, value = carry
        value = self._reduced(x, value, u, now)
        new = []
        for i, row in enumerate(self.block.onward):
            # Input terms first, since the states depend on the previous step and the inputs do not.
            driven = [
                (c, v)
                for j in range(self.m)
                for c, v in zip(self.block.driven[j][i], u[j], strict=True)
            ]
            new.append(_sum([*driven, *zip(row, x, strict=True)]))
        return new, value

    def last(self, carry: PyTree, /) -> tuple[Any, Any]:
        """Return the value with the remaining samples, and the State at the last of them."""
        x, value = carry
        done = self.steps * self.m
        left = range(done, self.samples)
        u = [[v[k] for v in jax.tree.leaves(self.inputs)] for k in left]
        now = [jax.tree.map(lambda v, k=k: v[k], self.data) for k in left]
        value = self._reduced(x, value, u, now)
        x, discrete = list(x), self.discrete.in_scalars()
        for j in range(len(left) - 1):
            x = advance(discrete, x, u[j])
        end = jax.tree.unflatten(self.structure, x)
        inputs = jax.tree.unflatten(jax.tree.structure(self.inputs), u[-1])
        return value, _plus(end, self.block.of_next, inputs)

    def _reduced(self, x: list[Array], value: Any, u: list[list[Array]], now: list[Any]) -> Any:
        """Return the value after all samples with data, from the states at the first."""
        for j, data in enumerate(now):
            value = self.reducing.update(value, self._outputs(x, u, j), data)
        return value

    def _outputs(self, x: list[Array], u: list[list[Array]], j: int) -> Any:
        """Return the outputs of the j-th sample of a block that starts at x with the inputs
        u[0..j].
        """
        model, block = self.reducing.model, self.block
        # The first sample uses the model itself, where the recurrence saves nothing.
        if j == 0:
            now = jax.tree.unflatten(jax.tree.structure(self.inputs), u[0])
            state = _plus(jax.tree.unflatten(self.structure, x), block.of_next, now)
            return model.output(self.reducing.params, state, now)
        # y[j] = C A^j x + the effect of inputs of this sample and of earlier ones in the block.
        outputs = {}
        for i, name in enumerate(naming.names(model.Outputs)):
            forced = [
                (c, v)
                for back in range(j + 1)
                for c, v in zip(block.forced[back][i], u[j - back], strict=True)
            ]
            outputs[name] = _sum([*forced, *zip(block.free[j - 1][i], x, strict=True)])
        return model.Outputs(**outputs)


def blocks(
    reducing: Reducing, args: ZeroOrderHoldArgs, m: int, x0: Record, start: PyTree, data: PyTree
) -> Blocks:
    """Return a run in steps of m samples."""
    block, discrete = _block_of(reducing.model, args, m)
    x0 = _plus(x0, block.of_next, at(args.inputs, 0), -1.0)
    carry = jax.tree.leaves(x0), start
    structure = jax.tree.structure(x0)
    return Blocks(reducing, m, block, discrete, args.inputs, data, carry, structure)


def of_whole_run(
    reducing: Reducing, args: ZeroOrderHoldArgs, m: int, x0: Record, start: PyTree, data: PyTree
) -> tuple[Any, Any]:
    """Return the value of a run and its last State, by XLA; arguments as for `blocks`."""
    # Unrolled over m samples, with a loop over blocks. A block is a few hundred operations on
    # vectors over the batch.
    run = blocks(reducing, args, m, x0, start, data)

    def step(carry: PyTree, slices: tuple[list[Array], PyTree]) -> tuple[PyTree, None]:
        rows, now = slices
        u = [[v[j] for v in rows] for j in range(m)]
        return run.over(carry, u, [jax.tree.map(lambda v, j=j: v[j], now) for j in range(m)]), None

    def cut(v: Array) -> Array:
        return v[: run.steps * m].reshape(run.steps, m, *v.shape[1:])

    slices = jax.tree.map(cut, (jax.tree.leaves(args.inputs), data))
    carry, _ = jax.lax.scan(step, run.carry, slices)
    return run.last(carry)


def _plus(state: Record, rows: Any, inputs: Record, sign: float = 1.0) -> Record:
    """Return a State plus (or minus) a matrix times the inputs, row by row in scalars; None adds
    nothing.
    """
    if rows is None:
        return state
    u = jax.tree.leaves(inputs)
    new = [x + sign * dot(row, u) for x, row in zip(jax.tree.leaves(state), rows, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(state), new)


def _sum(terms: list[tuple[Array, Array]]) -> Array:
    """Add products in order."""
    total = terms[0][0] * terms[0][1]
    for a, b in terms[1:]:
        total = total + a * b
    return total
