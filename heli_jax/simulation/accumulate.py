"""Runs that are reduced to a value during the simulation and not stored, for large batches."""

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
    """The model's State at the last sample."""
    outside: dict[str, Bool[Array, ""]]
    """True for each limit of the model that was exceeded, by name; empty for a model without
    limits.
    """
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
    """Reduce a run to a value without storing it, for large batches.

    Args:
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        update: function with value = update(value, outputs, data at that sample), for every sample.
        start: value before the first sample, a pytree of numbers.

    Returns:
        The final value and diffrax's result.
    """
    run = accumulated(model, params, flight, update, start, **keywords)
    return run.value, run.result


_NOT_HERE = ("controller", "delay", "max_steps", "key", "feedback", "events")
"""Options of `simulate` that a run without storage does not have."""


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
    """Accumulate as `accumulate` does, and also return the last state and exceeded limits.

    Args:
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        update: function with value = update(value, outputs, data at that sample), for every sample.
        start: value before the first sample, a pytree of numbers.
        data: a pytree of arrays (N,), such as the measured outputs.
        limits: True to check the limits of the model's range.
        **keywords: `options`, a SimulationOptions, and single fields of it: dt, initial_state,
            solver, substeps, block, adjoint and hold.

    Raises:
        ValueError: as for `simulate`; a block below 1, or above 1 without the exact solver; an
            option of `simulate` only.
        TypeError: an unknown option.
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
        saveat=dfx.SaveAt(t1=True),  # only the end, since a large batch does not fit in memory
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
    """Return the steps of `accumulated`, for the caller's own loop.

    Arguments and exceptions are those of `accumulated`.
    """
    reducer, run, x0 = _prepared(model, params, flight, update, limits, options)
    _, args, _, _ = run
    samples = jax.tree.leaves(args.inputs)[0].shape[0]
    # Runs shorter than a block use single samples.
    if 1 < (block := _block(reducer, args, options)) < samples:
        of = blocks(reducer.of, args, block, x0, start, data)

        def last(carry: PyTree) -> Accumulated:
            return Accumulated(*of.last(carry), {}, dfx.RESULTS.successful)

        return Steps(of.carry, of.steps, of.step, last)
    each = _by_samples(reducer, run, x0, start, data)
    return Steps(each.carry, each.samples - 1, each.step, each.last)


class Steps(NamedTuple):
    """A run as single steps."""

    carry: PyTree
    """Carry before the first step."""
    steps: int
    step: Callable[[PyTree, Any], PyTree]
    """step(carry, k) returns the carry after the k-th step."""
    last: Callable[[PyTree], Accumulated]
    """Complete the run from the carry after the last step; adds the remaining samples, at least
    one.
    """


class _Samples(NamedTuple):
    """A run with one step a sample."""

    solver: dfx.AbstractSolver
    term: dfx.ODETerm
    args: Any
    carry: PyTree
    """State, value and exceeded limits before the first sample."""
    samples: int
    last: Callable[[PyTree], Accumulated]

    def step(self, carry: PyTree, k: Int[Array, ""]) -> PyTree:
        """Return the carry one sample after the k-th."""
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
    """Return the reduction at a sample, the step to the next one, and the first State."""
    # Refused, since without a stored run these options would silently have no effect.
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
    """Return the number of samples a step.

    Raises:
        ValueError: the block is not possible.
    """
    block = options.block
    if block != 1 and (args.discrete is None or block < 1):
        raise ValueError(f"block must be 1, or more with solver='exact', got {block}")
    # Limits are checked at each sample, and delayed inputs need samples before a block. Both take
    # one step a sample.
    return 1 if reducer.limits is not None or args.delays is not None else block


class _Reducer(NamedTuple):
    """Reduction at a sample."""

    of: Reducing
    limits: Callable[[Any, Any, Any], dict[str, Any]] | None

    def __call__(self, carried: PyTree, state: Record, inputs: Record, data: PyTree) -> Any:
        # A limit that was exceeded stays marked, even if the run comes back.
        value, outside = carried
        of = self.of
        if self.limits is not None:
            left = self.limits(of.params, state, inputs)
            outside = {name: jnp.where(left[name], 1.0, was) for name, was in outside.items()}
        return of.update(value, of.model.output(of.params, state, inputs), data), outside


def _by_samples(
    reducer: _Reducer, run: _Stepping, x0: Record, start: PyTree, data: PyTree
) -> _Samples:
    """Return a run with one step a sample."""
    method, args, term, linear = run
    (model, params, _), inputs = reducer.of, args.inputs
    n = jax.tree.leaves(inputs)[0].shape[0]
    args = args.in_scalars()
    # Expressions of the parameters alone are moved out of the loop over time.
    if args.discrete is None and model.sampled is None:
        values, field = hoisted(model.vector_field, params, x0, at(inputs, 0))
        term = field_term(model, field)
        args = args._replace(params=values)
    # Without limits an empty record is carried, at no cost.
    outside, dtype = {}, jax.tree.leaves(x0)[0].dtype
    check_countable(n, dtype)
    if reducer.limits is not None:
        # 1 once a limit is exceeded. diffrax needs numbers, since it computes with the whole state.
        names = reducer.limits(params, x0, at(inputs, 0))
        outside = dict.fromkeys(names, jnp.zeros((), dtype))

    def last(carry: PyTree) -> Accumulated:
        # The solver updates the value before each step, so the last sample remains.
        state, carried = carry
        now = acting_at(args, n - 1, linear)
        value, left = reducer(carried, state, now, at(data, n - 1))
        left = {name: v > 0 for name, v in left.items()}
        return Accumulated(value, state, left, dfx.RESULTS.successful)

    # A function, since diffrax compares solvers and a record of tracers has no hash.
    solver = Accumulating(method, lambda *now: reducer(*now), linear)
    return _Samples(solver, term, (args, data), (x0, (start, outside)), n, last)


class Accumulating(SolverWrapper):
    """A per-sample solver that carries a running value with the state.

    y = (state, value). At each sample, before the step, value = update(value, state, held inputs at
    that sample, k). The rest of the trajectory is not stored.
    """

    update: Callable[..., Any] = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=())
    """True for each input that moves between samples; () holds all."""

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree
    ) -> Stepped:
        """Update the value at a sample, then step from it."""
        held, data = args
        state, value = y0
        # The outputs of a sample belong to the state at its start, so the update comes first. The
        # caller must add the last sample, which has no step.
        k = sample_index(t0)
        value = self.update(value, state, acting_at(held, k, self.linear), at(data, k))
        state, result = self.solver.stepped(terms, t0, t1, state, held)
        y1 = (state, value)
        return y1, result
