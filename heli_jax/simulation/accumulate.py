"""Runs that are reduced to a value while they go on, and never kept: for large batches."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record
from heli_jax.numerics.hoist import hoisted
from heli_jax.simulation.blocks import Reducing, blocks, of_whole_run
from heli_jax.simulation.hold import FlightOrInputs, at, between_samples
from heli_jax.simulation.options import DEFAULT, SimulationOptions
from heli_jax.simulation.solvers import (
    SolverWrapper,
    Stepped,
    Time,
    ZeroOrderHoldArgs,
    acting_at,
    sample_index,
)
from heli_jax.simulation.stepping import (
    check_countable,
    field_term,
    held_inputs,
    per_sample,
    start_state,
)


class Accumulated(NamedTuple):
    """Result of an accumulated run."""

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
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        update: value = update(value, outputs, data at that sample), at every sample.
        start: the value before the first sample, a pytree of numbers.

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
    """Accumulate as `accumulate` does, with the last state and, if `limits`, whether the model's
    range was left.

    Args:
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
    if (block := _block(reducer, args, options)) > 1:
        value, state = of_whole_run(reducer.of, args, block, x0, start, data)
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


def in_steps(
    model: Model,
    params: Record,
    flight: FlightOrInputs,
    update: Callable[[Any, Any, Any], Any],
    start: PyTree,
    *,
    data: PyTree = (),
    limits: bool = False,
    options: SimulationOptions = DEFAULT,
) -> "Steps":
    """Return the steps of `accumulated`, for a loop that the caller makes.

    Args and exceptions are those of `accumulated`.
    """
    reducer, run, x0 = _prepared(model, params, flight, update, limits, options)
    _, args, _, _ = run
    samples = jax.tree.leaves(args.inputs)[0].shape[0]
    # Fewer samples than a block has make none.
    if 1 < (block := _block(reducer, args, options)) < samples:
        of = blocks(reducer.of, args, block, x0, start, data)

        def last(carry: PyTree) -> Accumulated:
            return Accumulated(*of.last(carry), {}, dfx.RESULTS.successful)

        return Steps(of.carry, of.steps, of.step, last)
    each = _by_samples(reducer, run, x0, start, data)
    return Steps(each.carry, each.samples - 1, each.step, each.last)


class Steps(NamedTuple):
    """A run in its steps."""

    carry: PyTree
    """before the first"""
    steps: int
    step: Callable[[PyTree, Any], PyTree]
    """of (the carry, k): the carry after the k-th"""
    last: Callable[[PyTree], Accumulated]
    """what is left of the run, from the carry after the last step, which has not yet counted the
    samples that no step begins with, one at least"""


class _Samples(NamedTuple):
    """A run of one step a sample."""

    solver: dfx.AbstractSolver
    term: dfx.ODETerm
    args: Any
    carry: PyTree
    """before the first sample: the State, the value and the limits left"""
    samples: int
    last: Callable[[PyTree], Accumulated]

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
    """Return the work at a sample, the step to the next one, and the first State."""
    # Refused rather than ignored: a run that is not kept cannot show that they did nothing.
    for name in _NOT_HERE:
        if getattr(options, name) is not getattr(DEFAULT, name):
            raise ValueError(f"accumulate: expected no {name}, which only simulate has")
    inputs, dt = held_inputs(model, flight, options.dt)
    model, inputs, linear = between_samples(model, flight, inputs, options.hold)
    x0 = start_state(model, params, options.initial_state, inputs)
    run = per_sample(model, params, inputs, options._replace(dt=dt), linear)
    reducer = _Reducer(Reducing(model, params, update), model.limits if limits else None)
    return reducer, (*run, linear), x0


def _block(reducer: "_Reducer", args: ZeroOrderHoldArgs, options: SimulationOptions) -> int:
    """Samples a step.

    Raises:
        ValueError: what is asked for cannot be.
    """
    block = options.block
    if block != 1 and (args.discrete is None or block < 1):
        raise ValueError(f"block must be 1, or more with solver='exact', got {block}")
    # Limits are looked at sample by sample, so they take the way of one step a sample; so do late
    # inputs, since a block's coefficients know no sample before its first.
    return 1 if reducer.limits is not None or args.delays is not None else block


class _Reducer(NamedTuple):
    """Reduction at a sample."""

    of: Reducing
    limits: Callable[[Any, Any, Any], dict[str, Any]] | None

    def __call__(self, carried: PyTree, state: Record, inputs: Record, data: PyTree) -> Any:
        # Once left, the range stays left: a run that came back has been out of it.
        value, outside = carried
        of = self.of
        if self.limits is not None:
            left = self.limits(of.params, state, inputs)
            outside = {name: jnp.where(left[name], 1.0, was) for name, was in outside.items()}
        return of.update(value, of.model.output(of.params, state, inputs), data), outside


def _by_samples(
    reducer: _Reducer, run: _Stepping, x0: Record, start: PyTree, data: PyTree
) -> _Samples:
    """The run one step a sample."""
    method, args, term, linear = run
    (model, params, _), inputs = reducer.of, args.inputs
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
    return _Samples(solver, term, (args, data), (x0, (start, outside)), n, last)


class Accumulating(SolverWrapper):
    """A per-sample solver that carries a running value beside the state.

    y = (state, value); at each sample, before the step, value = update(value, state, held inputs
    at that sample, k). Nothing else of the trajectory is kept.
    """

    update: Callable[..., Any] = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=())
    """of each input whether it moves between samples; () holds all"""

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree
    ) -> Stepped:
        """The value at a sample, then the step from it."""
        held, data = args
        state, value = y0
        # Before the step: the outputs of a sample belong to the state at its beginning. Whoever
        # runs this has to add the last sample, which no step begins with.
        k = sample_index(t0)
        value = self.update(value, state, acting_at(held, k, self.linear), at(data, k))
        state, result = self.solver.stepped(terms, t0, t1, state, held)
        y1 = (state, value)
        return y1, result
