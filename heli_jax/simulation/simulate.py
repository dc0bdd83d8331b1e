"""simulate: a model, its parameters and inputs in; the trajectory out.

Feedback, events and process noise are solvers around the one of a sample: each does one thing at a
sample and leaves the step to the solver within. Process noise is drawn once a sample, with the
covariance that a sample adds.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model
from heli_jax.naming import Number, Record, Scalar
from heli_jax.numerics.matrix_exponential import van_loan
from heli_jax.simulation.blocks import blockwise
from heli_jax.simulation.discretize import Discrete, process_noise, square_root
from heli_jax.simulation.events import NO_END, Event, any_over, stopped
from heli_jax.simulation.hold import Delays, FlightOrInputs, at, at_end, between_samples, delayed
from heli_jax.simulation.options import DEFAULT, SimulationOptions
from heli_jax.simulation.solvers import (
    Adaptive,
    Exact,
    SolverWrapper,
    Stepped,
    Time,
    ZeroOrderHoldArgs,
    sample_index,
)
from heli_jax.simulation.stepping import check_countable, held_inputs, per_sample, start_state
from heli_jax.simulation.trajectory import Trajectory

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
    """Simulate one vehicle; each input is held until the next sample, or linear between the two.

    Args:
        model: of one vehicle; `jax.vmap` over the other arguments simulates many.
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
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


def with_process_noise(
    model: Model,
    args: ZeroOrderHoldArgs,
    method: dfx.AbstractSolver,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs]:
    """Standard normal numbers as further inputs, multiplied by a root of the process noise.

    Raises:
        ValueError: the model has no noise, or the options a delay.
    """
    assert options.key is not None
    if model.noise_intensity is None:
        raise ValueError(
            f"key: expected a model with process noise, as with_disturbance makes one, got "
            f"{model.name!r}"
        )
    # A delay of all inputs is for records: nothing is drawn for them.
    if options.delay is not None:
        raise ValueError(
            "key: expected a run without a delay to draw noise for, got one with delay"
        )
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype, states = jax.tree.leaves(args.inputs)[0].dtype, len(naming.names(model.State))
    # Drawn for all samples at once: the same key gives the same record, whatever the solver does.
    if not isinstance(method, Exact) or args.discrete is None:
        feedback = method.feedback if isinstance(method, StateFeedback) else None
        draws = jax.random.normal(options.key, (n, states), dtype)
        acting = args.inputs
        if args.delays is not None:
            # The model is linearised about the inputs as they act, which are read from here.
            acting = delayed(args.inputs, args.delays, jnp.arange(n), linear)
        args = args._replace(inputs=(args.inputs, acting, tuple(draws.T)))
        return WithProcessNoise(
            method, functools.partial(add_process_noise, model, args, feedback)
        ), args
    # The recurrence of a linear model takes draws as it takes inputs: L beside Bd, no step more.
    L = square_root(process_noise(model, args.params, options.dt))
    draws = jax.random.normal(options.key, (n, L.shape[0]), L.dtype)
    # The draws are no inputs: nothing of them comes late or from the next sample.
    none, discrete = jnp.zeros_like(L), args.discrete
    discrete = Discrete(
        discrete.Ad,
        jnp.concatenate([discrete.Bd, L], axis=1),
        None if discrete.Bp is None else jnp.concatenate([discrete.Bp, none], axis=1),
        None if discrete.Bn is None else jnp.concatenate([discrete.Bn, none], axis=1),
    )
    return method, args._replace(inputs=(args.inputs, tuple(draws.T)), discrete=discrete)


def add_process_noise(
    model: Model,
    args: ZeroOrderHoldArgs,
    feedback: Callable[..., Any] | None,
    state: Record,
    inputs: Record,
    draws: Sequence[Scalar],
) -> Record:
    """The state after a sample with the noise of that sample, of the model linearised there.

    Args:
        feedback: None, or what makes the acting inputs of the given ones.
    """
    params, dt = args.params, args.dt
    # The linearisation is at the inputs that acted, which the solver within keeps to itself.
    if feedback is not None:
        inputs = feedback(state, inputs)
    x = naming.ravel(state)

    # The model itself filters the drive of a sample: its covariance is not g g^T dt, in which
    # states without a drive of their own would get none.
    def rates(x: Array) -> Array:
        derivatives = model.vector_field(params, naming.unravel(model.State, x), inputs)
        return naming.ravel(derivatives, x.dtype, naming.names(model.State))

    assert model.noise_intensity is not None
    g = naming.ravel(model.noise_intensity(params), x.dtype, naming.names(model.State))
    L = square_root(van_loan(jax.jacfwd(rates)(x), jnp.zeros_like(g), g, dt).Q)
    return naming.unravel(model.State, x + L @ jnp.stack(draws))


# The arguments of `step` are diffrax's: terms, the interval [t0, t1] in samples, the state at its
# begin, and what is known beside it; none of the solvers here keeps a state between steps.


class StateFeedback(SolverWrapper):
    """A per-sample solver whose inputs are a function of the state at the sample.

    feedback(state, given inputs of that sample) gives the inputs that are held.
    """

    feedback: Callable[..., Any]

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """A sample with the inputs that the feedback makes of the state at its begin."""
        # One sample, index 0, stands for all: `at` takes the last where the index is past the end.
        u = self.feedback(y0, at(args.inputs, sample_index(t0)))
        held = args._replace(inputs=jax.tree.map(lambda v: jnp.asarray(v)[None], u))
        return self.solver.stepped(terms, t0, t1, y0, held)


class Stopping(SolverWrapper):
    """A per-sample solver that stays where it is after the first sample at which `over` holds.

    y = (state, going), where going is 1 until then and 0 from there on.
    """

    # A number and not a truth value for `going`: diffrax takes derivatives of all that it carries.
    over: Callable[..., Any]
    linear: tuple[bool, ...] = eqx.field(static=True, default=())

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """A sample, or none where the run is over."""
        # A batch cannot stop for one of its runs, so the step is made and its result not taken.
        state, going = y0
        new, result = self.solver.stepped(terms, t0, t1, state, args)
        new = jax.tree.map(lambda a, b: jnp.where(going > 0, a, b), new, state)
        result = dfx.RESULTS.where(going > 0, result, dfx.RESULTS.successful)
        # The inputs at the end of the interval: those held since its begin, or the next ones.
        ended = self.over(new, at_end(args.inputs, sample_index(t0), self.linear))
        y1 = (new, jnp.where(ended, jnp.zeros_like(going), going))
        return y1, result


class WithProcessNoise(SolverWrapper):
    """A per-sample solver whose state gets its process noise after every sample.

    The inputs are (the model's, the same as they act, standard normal numbers); add_noise(state,
    acting inputs, numbers of that sample) gives the new state.
    """

    add_noise: Callable[..., Any]

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """A sample, and the noise that comes in over it."""
        # The draws travel as inputs: they are samples too, and diffrax carries only y and args.
        inputs, acting, draws = args.inputs
        held = args._replace(inputs=inputs)
        y, result = self.solver.stepped(terms, t0, t1, y0, held)
        k = sample_index(t0)
        y1 = self.add_noise(y, at(acting, k), at(draws, k))
        return y1, result
