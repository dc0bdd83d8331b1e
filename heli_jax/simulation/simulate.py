"""simulate: a model, its parameters and inputs in; the trajectory out."""

import functools
import math
from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model
from heli_jax.naming import Number, Record
from heli_jax.simulation.blocks import blockwise
from heli_jax.simulation.delays import Delays, at
from heli_jax.simulation.events import NO_END, Event, any_over, stopped
from heli_jax.simulation.hold import FlightOrInputs, between_samples, delayed
from heli_jax.simulation.options import DEFAULT, SimulationOptions
from heli_jax.simulation.process_noise import with_process_noise
from heli_jax.simulation.solvers import (
    Adaptive,
    Exact,
    ZeroOrderHoldArgs,
)
from heli_jax.simulation.stepping import check_countable, held_inputs, per_sample, start_state
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.simulation.wrappers import StateFeedback, Stopping

_LONGEST_STEP = 0.005
"""of a fixed-step solver [s]: the flapping of a flybar, once a turn, is the fastest motion"""

_OF_FASTEST = 1.4
"""longest step times the rate of the fastest filter"""


def substeps_for(dt: float, fastest: float = 0.0) -> int:
    """Steps of a fixed-step solver in a sample of dt [s]: four, and more in samples over 20 ms.

    Args:
        dt: [s].
        fastest: rate of the fastest filter around the model [rad/s], `Model.fastest`.
    """
    # RK4 needs four in 20 ms for 1e-6 with the first-order bar; a flybar by eq. 12 turns with
    # Omega. 1e-9: a dt of 0.02 must not become five steps by a rounding error.
    # RK4 diverges beyond 2.8 of the reciprocal of a rate; at 1.4 it is off by a twentieth in what
    # a filter forgets within that step anyway.
    longest = min(_LONGEST_STEP, _OF_FASTEST / fastest) if fastest > 0 else _LONGEST_STEP
    return max(4, math.ceil(dt / longest - 1e-9))


@explained
def simulate(
    model: Model,
    params: Record,
    flight: FlightOrInputs,
    options: SimulationOptions = DEFAULT,
    **keywords: Any,
) -> Trajectory:
    """Simulate one machine; each input is held until the next sample, or linear between the two.

    Args:
        model: of one machine; `jax.vmap` over the other arguments simulates many.
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        options: how; all defaults unless given.
        **keywords: fields of SimulationOptions, in place of those of `options`: `dt`, `solver`,
            `initial_state`, `delay`, `key`, `hold`, ...

    Returns:
        A Trajectory; a failed integration is in its `status`, never an exception.

    Raises:
        ValueError: "exact" for a model that is not linear, an unknown solver, wrong shapes, a key
            for a model without noise or with adaptive steps, feedback with a delay or with a
            linear hold, or an unknown hold.
        TypeError: a keyword that is no option.
    """
    # dt belongs to the Flight unless it is given: from here on `options` has it.
    options = options.changed(keywords)
    given = model
    inputs, dt = held_inputs(model, flight, options.dt)
    between = between_samples(model, flight, inputs, options.hold)
    model, inputs, linear = between
    options = options._replace(dt=dt)
    if model is not given and options.events:
        events = {
            n: lambda p, x, u, event=event: event(p, x, between.merged(u, given))
            for n, event in options.events.items()
        }
        options = options._replace(events=events)
    x0 = start_state(model, params, options.initial_state, inputs)
    run = _method_with_extras(model, params, inputs, options, linear)
    states, result = _states(run, x0, inputs, options, linear)
    acting = _acting(inputs, states, options, run[1].delays, linear)
    times = _times(inputs, dt)
    end = NO_END
    if options.events:
        states, end = stopped(model, params, options.events, times, states, acting, linear)
    # After the run, all samples side by side: outputs and limits feed nothing back into it.
    outputs = jax.vmap(lambda x, u: model.output(params, x, u))(states, acting)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(states)]))
    outside = {}
    if model.limits is not None:
        limits = model.limits
        outside = jax.vmap(lambda x, u: limits(params, x, u))(states, acting)
    acting = between.merged(acting, given)
    return Trajectory(times, states, outputs, acting, result, finite, outside, *end)


def _method_with_extras(
    model: Model,
    params: Record,
    inputs: Record,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm]:
    """The solver of a run with what `simulate` alone has: feedback and process noise."""
    method, args, term = per_sample(model, params, inputs, options, linear)
    if isinstance(method, Adaptive) and options.key is not None:
        # A step of the controller's choice would have noise of another covariance.
        raise ValueError("key: expected fixed steps to draw noise with, got a step-size controller")
    if options.feedback is not None:
        _check_feedback(args.delays, linear)
        method = StateFeedback(method, options.feedback)
    # Around the feedback, not within: the noise comes after the step that the feedback drove.
    if options.key is not None:
        method, args = with_process_noise(model, args, method, options, linear)
    return method, args, term


def _check_feedback(delays: Delays | None, linear: tuple[bool, ...]) -> None:
    # Feedback is a function of the state at the sample and is held from there: a late input, or one
    # on its way to the next sample's, would need a state that is not there yet.
    if delays is not None:
        raise ValueError("feedback: expected a run without a delay, got one with delay")
    if linear:
        raise ValueError(
            "feedback acts once a sample and is held until the next: expected inputs with "
            "hold='zero-order', got hold='linear' or 'mixed'"
        )


def _states(
    run: tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm],
    x0: Record,
    inputs: Record,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[Any, dfx.RESULTS]:
    """The states (N,), and what diffrax says of the integration."""
    # Blocks know no events and no feedback: nobody looks at the state between their ends.
    method, args, term = run
    if options.block != 1:
        _require_blocks(method, options.block, options.events)
        return blockwise(args, options.block, x0), dfx.RESULTS.successful
    args = args.in_scalars()
    adjoint = dfx.DirectAdjoint() if options.adjoint is None else options.adjoint
    if not options.events:
        return _stepwise(method, args, term, x0, adjoint)
    over = functools.partial(any_over, options.events, args.params)
    # A number, since diffrax counts with all that it carries: 1 while the run goes on.
    going = 1.0 - over(x0, at(inputs, 0)).astype(jax.tree.leaves(x0)[0].dtype)
    (states, _), result = _stepwise(
        Stopping(method, over, linear), args, term, (x0, going), adjoint
    )
    return states, result


def _acting(
    inputs: Record,
    states: Record,
    options: SimulationOptions,
    delays: Delays | None,
    linear: tuple[bool, ...],
) -> Any:
    """The inputs (N,) as they acted: late, or with the feedback's part."""
    # Computed again from the states, which is cheaper than to carry them through the loop.
    if options.feedback is not None:
        return jax.vmap(options.feedback)(states, inputs)
    if delays is None:
        return inputs
    return delayed(inputs, delays, jnp.arange(jax.tree.leaves(inputs)[0].shape[0]), linear)


def _times(inputs: Record, dt: Number) -> Float[Array, " N"]:
    """The samples' times from 0 [s], in the type of dt."""
    # k dt, not a running sum of dt: the last of 1e6 samples is at the right time.
    step = jnp.asarray(dt, jnp.result_type(dt) if hasattr(dt, "dtype") else float)
    return jnp.arange(jax.tree.leaves(inputs)[0].shape[0], dtype=step.dtype) * step


def _require_blocks(
    method: dfx.AbstractSolver, block: int, events: Mapping[str, Event] | None
) -> None:
    if block < 1:
        raise ValueError(f"block must be at least 1, got {block}")
    if not isinstance(method, Exact) or events:
        raise ValueError(
            f"block: expected solver='exact' without feedback and events, or 1, got {block}"
        )


# Steps of 1 from 0 to n - 1: the same program for every sample time, and no rounding of times
# decides on the number of steps.
def _stepwise(
    method: dfx.AbstractSolver,
    args: ZeroOrderHoldArgs,
    term: dfx.ODETerm,
    x0: Record,
    adjoint: dfx.AbstractAdjoint,
) -> tuple[Any, dfx.RESULTS]:
    """The states from x0 on, one step a sample: time is counted in samples."""
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype = jax.tree.leaves(x0)[0].dtype
    check_countable(n, dtype)
    sol = dfx.diffeqsolve(
        term,
        method,
        t0=jnp.zeros((), dtype),
        t1=jnp.asarray(n - 1, dtype),
        dt0=jnp.ones((), dtype),
        y0=x0,
        args=args,
        saveat=dfx.SaveAt(t0=True, steps=True),
        max_steps=n - 1,
        adjoint=adjoint,
        throw=False,  # one run of a batch that fails must not end the others
    )
    return sol.ys, sol.result
