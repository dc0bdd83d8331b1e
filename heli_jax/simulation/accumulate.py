"""Runs that are reduced to a value while they go on, and never kept: for large batches."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record
from heli_jax.numerics.hoist import hoisted
from heli_jax.numerics.matrix_exponential import product
from heli_jax.simulation.blocks import without_next
from heli_jax.simulation.delays import at
from heli_jax.simulation.discretize import Discrete, scalars
from heli_jax.simulation.hold import FlightOrInputs, linear_inputs
from heli_jax.simulation.options import DEFAULT, SimulationOptions
from heli_jax.simulation.solvers import ZeroOrderHoldArgs, acting_at, advance, dot
from heli_jax.simulation.stepping import (
    check_countable,
    field_term,
    held_inputs,
    per_sample,
    start_state,
)
from heli_jax.simulation.wrappers import Accumulating


class Accumulated(NamedTuple):
    """What is left of a run."""

    value: PyTree
    state: Record
    """the model's State at the last sample"""
    outside: dict[str, Bool[Array, ""]]
    """by name of a limit of the model, whether it was left; empty for a model without limits"""
    result: dfx.RESULTS


@explained
def accumulate(
    model: Model,
    params: Record,
    flight: FlightOrInputs,
    update: Callable[[Any, Any, Any], Any],
    start: PyTree,
    **keywords: Any,
) -> tuple[Any, dfx.RESULTS]:
    """Reduce a run to a value without keeping it: for large batches.

    Args:
        model: of one machine.
        params: the model's Params, SI.
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        update: value = update(value, outputs, data at that sample), at every sample.
        start: the value before the first sample, a pytree of numbers.
        **keywords: those of `accumulated`.

    Returns:
        The final value and diffrax's result.
    """
    run = accumulated(model, params, flight, update, start, **keywords)
    return run.value, run.result


_NOT_HERE = ("controller", "delay", "max_steps", "key", "feedback", "events")
"""options of `simulate` that a run which is not kept has not"""


def accumulated(
    model: Model,
    params: Record,
    flight: FlightOrInputs,
    update: Callable[[Any, Any, Any], Any],
    start: PyTree,
    *,
    data: PyTree = (),
    limits: bool = False,
    **keywords: Any,
) -> Accumulated:
    """As `accumulate`, with the last state and, if `limits`, whether the model's range was left.

    Args:
        model: of one machine.
        params: the model's Params, SI.
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        update: value = update(value, outputs, data at that sample), at every sample.
        start: the value before the first sample, a pytree of numbers.
        data: a pytree of arrays (N,), such as the measured outputs.
        limits: whether to look for the ends of the model's range.
        **keywords: `options`, a SimulationOptions, and single fields of it: dt, initial_state,
            solver, substeps, block, adjoint and hold.

    Raises:
        ValueError: as `simulate`; a block below 1, or above 1 for a solver that is not exact; an
            option that only `simulate` has.
        TypeError: a keyword that is no option.
    """
    options = keywords.pop("options", DEFAULT).changed(keywords)
    reducer, run, x0 = _prepared(model, params, flight, update, limits, options)
    _, args, _, _ = run
    block = options.block
    if block != 1 and (args.discrete is None or block < 1):
        raise ValueError(f"block must be 1, or more with solver='exact', got {block}")
    # Limits are looked at sample by sample, so they take the way of one step a sample; so do late
    # inputs, since a block's coefficients know no sample before its first.
    if block > 1 and reducer.limits is None and args.delays is None:
        value, state = _in_blocks(reducer, args, block, x0, start, data)
        return Accumulated(value, state, {}, dfx.RESULTS.successful)
    adjoint = dfx.DirectAdjoint() if options.adjoint is None else options.adjoint
    steps = _by_samples(reducer, run, x0, start, data)
    dtype = jax.tree.leaves(x0)[0].dtype
    sol = dfx.diffeqsolve(
        steps.term,
        steps.solver,
        t0=jnp.zeros((), dtype),
        t1=jnp.asarray(steps.samples - 1, dtype),
        dt0=jnp.ones((), dtype),
        y0=steps.carry,
        args=steps.args,
        saveat=dfx.SaveAt(
            t1=True
        ),  # the end alone: what a large batch has no memory for is the rest
        max_steps=steps.samples - 1,
        adjoint=adjoint,
        throw=False,
    )
    carry = jax.tree.map(lambda v: v[0], sol.ys)
    return steps.last(carry)._replace(result=sol.result)


def sample_by_sample(
    model: Model,
    params: Record,
    flight: FlightOrInputs,
    update: Callable[[Any, Any, Any], Any],
    start: PyTree,
    *,
    data: PyTree = (),
    limits: bool = False,
    options: SimulationOptions = DEFAULT,
) -> "Samples":
    """What `accumulated` does at each sample, for a loop that somebody else makes.

    Args and exceptions are those of `accumulated`; `options.block` does not count.
    """
    reducer, run, x0 = _prepared(model, params, flight, update, limits, options)
    return _by_samples(reducer, run, x0, start, data)


class Samples(NamedTuple):
    """A run in its steps."""

    solver: dfx.AbstractSolver
    term: dfx.ODETerm
    args: Any
    carry: PyTree
    """before the first sample: the State, the value and the limits left"""
    samples: int
    last: Callable[[PyTree], Accumulated]
    """what is left of the run, from the carry at the last sample, which is not yet counted"""

    def step(self, carry: PyTree, k: Int[Array, ""]) -> PyTree:
        """The carry a sample after the k-th."""
        t = k.astype(jax.tree.leaves(carry)[0].dtype)
        return self.solver.step(self.term, t, t + 1.0, carry, self.args, None, False)[0]


type _Stepping = tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm, tuple[bool, ...]]


def _prepared(
    model: Model,
    params: Record,
    flight: FlightOrInputs,
    update: Callable[[Any, Any, Any], Any],
    limits: bool,
    options: SimulationOptions,
) -> "tuple[_Reducer, _Stepping, Record]":
    """What is done at a sample, how it is stepped from one to the next, and the first State."""
    # Refused rather than ignored: a run that is not kept cannot show that they did nothing.
    for name in _NOT_HERE:
        if getattr(options, name) is not getattr(DEFAULT, name):
            raise ValueError(f"accumulate: expected no {name}, which only simulate has")
    linear = linear_inputs(model, flight, options.hold)
    inputs, dt = held_inputs(model, flight, options.dt)
    x0 = start_state(model, params, options.initial_state, inputs)
    run = per_sample(model, params, inputs, options._replace(dt=dt), linear)
    reducer = _Reducer(model, params, update, model.limits if limits else None)
    return reducer, (*run, linear), x0


class _Reducer(NamedTuple):
    """What is done at a sample."""

    model: Model
    params: Record
    update: Callable[[Any, Any, Any], Any]
    limits: Callable[[Any, Any, Any], dict[str, Any]] | None

    def __call__(self, carried: PyTree, state: Record, inputs: Record, data: PyTree) -> Any:
        # Once left, the range stays left: a run that came back has been out of it.
        value, outside = carried
        if self.limits is not None:
            left = self.limits(self.params, state, inputs)
            outside = {name: jnp.where(left[name], 1.0, was) for name, was in outside.items()}
        return self.update(value, self.model.output(self.params, state, inputs), data), outside


def _by_samples(
    reducer: _Reducer, run: _Stepping, x0: Record, start: PyTree, data: PyTree
) -> Samples:
    """The run one step a sample."""
    method, args, term, linear = run
    model, params, inputs = reducer.model, reducer.params, args.inputs
    n = jax.tree.leaves(inputs)[0].shape[0]
    args = args.in_scalars()
    # What depends on the parameters alone is taken out of the loop over time.
    if args.discrete is None:
        values, field = hoisted(model.vector_field, params, x0, at(inputs, 0))
        term = field_term(model, field)
        args = args._replace(params=values)
    # No limits: an empty record is carried, and costs nothing.
    outside, dtype = {}, jax.tree.leaves(x0)[0].dtype
    check_countable(n, dtype)
    if reducer.limits is not None:
        # Numbers, since diffrax counts with all that it carries: 1 from where the range is left on.
        names = reducer.limits(params, x0, at(inputs, 0))
        outside = dict.fromkeys(names, jnp.zeros((), dtype))

    def last(carry: PyTree) -> Accumulated:
        # The solver updates the value before each step, so the last sample is left.
        state, carried = carry
        now = acting_at(args, n - 1, linear)
        value, left = reducer(carried, state, now, at(data, n - 1))
        left = {name: v > 0 for name, v in left.items()}
        return Accumulated(value, state, left, dfx.RESULTS.successful)

    # A function of its own: diffrax compares solvers, and a record of tracers has no hash.
    solver = Accumulating(method, lambda *now: reducer(*now), linear)
    return Samples(solver, term, (args, data), (x0, (start, outside)), n, last)


class _Block(NamedTuple):
    """The exact recurrence over a block of m samples, in nested tuples of scalars.

    Nothing depends on the result before it within a block, so XLA makes one loop over the vehicles
    of it; written out sample by sample it would compute every sample from the block's first again.
    """

    free: Any
    """C A^j, row by row, for j = 1 ... m - 1"""
    forced: Any
    """what an input of j samples before adds to the outputs, for j = 0 ... m - 1"""
    onward: Any
    """A^m"""
    driven: Any
    """what each sample's inputs add to the state after the block"""
    of_next: Any
    """Bn, for inputs that are linear between samples; else None"""


def _block_of(model: Model, args: ZeroOrderHoldArgs, m: int) -> tuple[_Block, Discrete]:
    """The recurrence over m samples, and that over one."""
    assert args.discrete is not None
    A, B, _, Bn = discrete = args.discrete
    space = jacobians(model, args.params)
    C, D = space.C.astype(A.dtype), space.D.astype(A.dtype)
    of_next = None if Bn is None else scalars(Bn)
    if Bn is not None:
        # Inputs that are linear between samples: another state, x - Bn u, has the recurrence of
        # held ones.
        discrete, D = without_next(discrete), D + product(C, Bn)
        B = discrete.Bd
    # C A^j and A^j B for all j in m - 1 products each, in place of powers of A.
    rows, columns, power = [C], [B], A
    for _ in range(m - 1):
        rows.append(product(rows[-1], A))
        columns.append(product(A, columns[-1]))
        power = product(A, power)
    free = [scalars(row) for row in rows[1:]]
    forced = [scalars(D)] + [scalars(product(C, column)) for column in columns[:-1]]
    onward, driven = scalars(power), [scalars(column) for column in reversed(columns)]
    # Behind a barrier the coefficients are computed once, not for every step that reads them.
    once = jax.lax.optimization_barrier((free, forced, onward, driven, of_next))
    return _Block(*once), discrete


def _in_blocks(
    reducer: _Reducer, args: ZeroOrderHoldArgs, m: int, x0: Record, start: PyTree, data: PyTree
) -> tuple[Any, Any]:
    """The exact recurrence m samples a step: x[k+m] = A^m x[k] + ..., and each output between
    from x[k] directly, C A^j x[k] + ..., with coefficients of the vehicle's own."""
    # Unrolled over the m samples, and a loop over the blocks: a block is a few hundred operations,
    # all of them on vectors over the batch.
    block, discrete = _block_of(reducer.model, args, m)
    x0 = _plus(x0, block.of_next, at(args.inputs, 0), -1.0)
    structure, inputs = jax.tree.structure(x0), jax.tree.structure(args.inputs)
    U = jax.tree.leaves(args.inputs)
    n = U[0].shape[0]
    # At least one sample is left over: the last one has outputs but no step after it.
    steps = (n - 1) // m
    outputs = functools.partial(_outputs_in_block, reducer, block, structure, inputs)

    def samples(
        x: list[Array], value: PyTree, u: list[list[Array]], now: PyTree, count: int
    ) -> PyTree:
        """The value after `count` samples of a block.

        Args:
            x: the states at its begin.
            value: before.
            u: by sample the inputs.
            now: the data of these samples.
            count: how many, m at most.
        """
        for j in range(count):
            data_now = jax.tree.map(lambda v, j=j: v[j], now)
            value = reducer.update(value, outputs(x, u, j), data_now)
        return value

    def step(carried: PyTree, slices: tuple[list[Array], PyTree]) -> tuple[PyTree, None]:
        x, value = carried
        rows, now = slices
        u = [[v[j] for v in rows] for j in range(m)]
        value = samples(x, value, u, now, m)
        new = [dot(row, x) for row in block.onward]
        for j in range(m):
            new = [v + dot(row, u[j]) for v, row in zip(new, block.driven[j], strict=True)]
        return (new, value), None

    def cut(v: Array) -> Array:
        return v[: steps * m].reshape(steps, m, *v.shape[1:])

    slices = jax.tree.map(cut, (U, data))
    (x, value), _ = jax.lax.scan(step, (jax.tree.leaves(x0), start), slices)
    # The samples that are left, at least one, and the state at the last of them.
    rest = n - steps * m
    u = [[v[steps * m + j] for v in U] for j in range(rest)]
    value = samples(x, value, u, jax.tree.map(lambda v: v[steps * m :], data), rest)
    last, discrete = list(x), discrete.in_scalars()
    for j in range(rest - 1):
        last = advance(discrete, last, u[j])
    end = jax.tree.unflatten(structure, last)
    return value, _plus(end, block.of_next, jax.tree.unflatten(inputs, u[rest - 1]))


def _outputs_in_block(
    reducer: _Reducer,
    block: _Block,
    structure: Any,  # tree structures, of which JAX exports no type
    inputs: Any,
    x: list[Array],
    u: list[list[Array]],
    j: int,
) -> Any:
    """The outputs of the j-th sample of a block that begins at x with the inputs u[0..j]."""
    model = reducer.model
    # The first sample by the model itself: nothing is gained there by the recurrence.
    if j == 0:
        now = jax.tree.unflatten(inputs, u[0])
        state = _plus(jax.tree.unflatten(structure, x), block.of_next, now)
        return model.output(reducer.params, state, now)
    # y[j] = C A^j x + the inputs of this sample and of those before it in the block.
    outputs = {}
    for i, name in enumerate(naming.names(model.Outputs)):
        total = dot(block.free[j - 1][i], x)
        for back in range(j + 1):
            total = total + dot(block.forced[back][i], u[j - back])
        outputs[name] = total
    return model.Outputs(**outputs)


def _plus(state: Record, rows: Any, inputs: Record, sign: float = 1.0) -> Record:
    """A State plus (or minus) a matrix, row by row in scalars, times the inputs; None adds none."""
    if rows is None:
        return state
    u = jax.tree.leaves(inputs)
    new = [x + sign * dot(row, u) for x, row in zip(jax.tree.leaves(state), rows, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(state), new)
