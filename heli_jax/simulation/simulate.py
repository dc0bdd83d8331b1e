"""simulate: compute the trajectory of a model from its parameters and inputs.

Feedback, events and process noise are solvers that wrap the solver of one sample. Each acts once a
sample and leaves the step to the inner solver. Process noise is drawn once a sample, with the
covariance of a whole sample.
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
from heli_jax.simulation.options import DEFAULT, Scan, SimulationOptions
from heli_jax.simulation.solvers import (
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
"""Longest step of a fixed-step solver [s]. Flapping of a flybar, once a turn, is the fastest
motion.
"""

_OF_FASTEST = 1.4
"""Longest step times the rate of the fastest filter."""


def substeps_for(dt: float, fastest: float = 0.0) -> int:
    """Return the number of fixed steps in a sample of dt [s]: four, and more if dt exceeds 20 ms.

    Args:
        dt: sample time [s].
        fastest: rate of the fastest filter around the model [rad/s], `Model.fastest`.
    """
    # With the first-order bar, RK4 needs four steps in 20 ms for an error of 1e-6; a flybar by eq.
    # 12 turns with Omega. The 1e-9 keeps rounding from giving five steps at a dt of 0.02. RK4
    # diverges beyond 2.8 over the fastest rate. At 1.4 its error is 5 % of what a filter forgets in
    # that step.
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
    """Simulate one vehicle; each input is held until the next sample, or linear between samples.

    Args:
        model: model of one vehicle; `jax.vmap` over the other arguments simulates many.
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        **keywords: fields of SimulationOptions, which override those of `options`: `dt`, `solver`,
            `initial_state`, `delay`, `key`, `hold`, ...

    Returns:
        A Trajectory; a failed integration sets its `status` and raises nothing.

    Raises:
        ValueError: an unknown solver or hold, wrong shapes, or options that exclude each other:
            "exact" for a nonlinear model, a key without noise or with adaptive steps, feedback with
            a delay or a linear hold.
        TypeError: an unknown option.
    """
    # The Flight has dt unless it is given. From here on it is in `options`.
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
    # Computed after the run for all samples at once, since outputs and limits do not affect the
    # run.
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
    """Return the solver of a run with the extras of `simulate`: feedback and process noise."""
    method, args, term = per_sample(model, params, inputs, options, linear)
    if options.controller is not None and options.key is not None:
        # A step of the controller would need noise of another covariance.
        raise ValueError("key: drawing noise needs fixed steps, got a step-size controller")
    if options.feedback is not None:
        _check_feedback(args.delays, linear)
        method = StateFeedback(method, options.feedback)
    # Noise wraps the feedback, since it is added after the step that the feedback drove.
    if options.key is not None:
        method, args = with_process_noise(model, args, method, options, linear)
    return method, args, term


def _check_feedback(delays: Delays | None, linear: tuple[bool, ...]) -> None:
    # Feedback uses the state at the sample and is then held. A delayed or linear input would need a
    # later state.
    if delays is not None:
        raise ValueError("feedback: expected a run without a delay, got one with delay")
    if linear:
        raise ValueError(
            "feedback acts once per sample and is held until the next: expected inputs with "
            "hold='zero-order', got hold='linear' or 'mixed'"
        )


def _states(
    run: tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm],
    x0: Record,
    inputs: Record,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[Any, dfx.RESULTS]:
    """Return the states (N,), and diffrax's result."""
    # Blocks have no states between their ends, so events and feedback are impossible.
    method, args, term = run
    if options.block != 1:
        _require_blocks(method, options.block, options.events)
        return blockwise(args, options.block, x0), dfx.RESULTS.successful
    args = args.in_scalars()
    adjoint = dfx.DirectAdjoint() if options.adjoint is None else options.adjoint
    if not options.events:
        return _stepwise(method, args, term, x0, adjoint)
    over = functools.partial(any_over, options.events, args.params)
    # 1 while the run continues. diffrax needs a number, since it computes with the whole state.
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
    """Return the inputs (N,) as they acted: delayed, or with feedback added."""
    # Computing them again from the states is cheaper than carrying them through the loop.
    if options.feedback is not None:
        return jax.vmap(options.feedback)(states, inputs)
    if delays is None:
        return inputs
    return delayed(inputs, delays, jnp.arange(jax.tree.leaves(inputs)[0].shape[0]), linear)


def _times(inputs: Record, dt: Number) -> Float[Array, " N"]:
    """Return the sample times from 0 [s], in the type of dt."""
    # k dt is exact at the last of 1e6 samples; a running sum of dt is not.
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


# Steps of 1 from 0 to n - 1. One program serves every sample time, and rounding of times cannot
# change the number of steps.
def _stepwise(
    method: dfx.AbstractSolver,
    args: ZeroOrderHoldArgs,
    term: dfx.ODETerm,
    x0: Record,
    adjoint: dfx.AbstractAdjoint,
) -> tuple[Any, dfx.RESULTS]:
    """Return the states from x0, one step a sample; time is counted in samples."""
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype = jax.tree.leaves(x0)[0].dtype
    check_countable(n, dtype)
    if isinstance(adjoint, Scan):
        # Every solver of whole samples has `stepped`.
        solver: Any = method

        @jax.checkpoint
        def sample(x: Any, k: Time) -> tuple[Any, Any]:
            x, _ = solver.stepped(term, k, k + 1.0, x, args)
            return x, x

        _, later = jax.lax.scan(sample, x0, jnp.arange(n - 1, dtype=dtype))
        joined = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), x0, later)
        return joined, dfx.RESULTS.successful
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
        throw=False,  # a failing run must not stop a batch
    )
    return sol.ys, sol.result


def with_process_noise(
    model: Model,
    args: ZeroOrderHoldArgs,
    method: dfx.AbstractSolver,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs]:
    """Add process noise: standard normal inputs times a square root of its covariance.

    Raises:
        ValueError: the model has no noise, or the options a delay.
    """
    assert options.key is not None
    if model.noise_intensity is None:
        raise ValueError(
            f"key: expected a model with process noise, as with_disturbance makes one, got "
            f"{model.name!r}"
        )
    # A delay of all inputs is for fits to records, which draw no noise.
    if options.delay is not None:
        raise ValueError("key: drawing noise needs a run without delay, got one with delay")
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype, states = jax.tree.leaves(args.inputs)[0].dtype, len(naming.names(model.State))
    # All samples are drawn at once, so that a key gives the same record with any solver.
    if not isinstance(method, Exact) or args.discrete is None:
        feedback = method.feedback if isinstance(method, StateFeedback) else None
        draws = jax.random.normal(options.key, (n, states), dtype)
        acting = args.inputs
        if args.delays is not None:
            # The model is linearised at the acting inputs, which are read from here.
            acting = delayed(args.inputs, args.delays, jnp.arange(n), linear)
        args = args._replace(inputs=(args.inputs, acting, tuple(draws.T)))
        return WithProcessNoise(
            method, functools.partial(add_process_noise, model, args, feedback)
        ), args
    # The recurrence of a linear model treats draws as inputs, with L beside Bd and no extra step.
    L = square_root(process_noise(model, args.params, options.dt))
    draws = jax.random.normal(options.key, (n, L.shape[0]), L.dtype)
    # The draws are not delayed and do not use the next sample.
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
    """Return the state after a sample with its noise, from the model linearised there.

    Args:
        feedback: None, or the function from given to acting inputs.
    """
    params, dt = args.params, args.dt
    # The inner solver does not return the inputs that acted, so they are computed here.
    if feedback is not None:
        inputs = feedback(state, inputs)
    x = naming.ravel(state)

    # The model itself filters the drive during a sample. With covariance g g^T dt, states without a
    # drive of their own would get no noise.
    def rates(x: Array) -> Array:
        derivatives = model.vector_field(params, naming.unravel(model.State, x), inputs)
        return naming.ravel(derivatives, x.dtype, naming.names(model.State))

    assert model.noise_intensity is not None
    g = naming.ravel(model.noise_intensity(params), x.dtype, naming.names(model.State))
    L = square_root(van_loan(jax.jacfwd(rates)(x), jnp.zeros_like(g), g, dt).Q)
    return naming.unravel(model.State, x + L @ jnp.stack(draws))


# Arguments of `step` are diffrax's: terms, the interval [t0, t1] in samples, its first state, and
# args. Solvers here keep no state between steps.


class StateFeedback(SolverWrapper):
    """A per-sample solver whose inputs are a function of the state at the sample.

    feedback(state, given inputs of that sample) returns the inputs to hold.
    """

    feedback: Callable[..., Any]

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """Integrate one sample with the inputs from the feedback at its first state."""
        # A single sample at index 0 serves all, since `at` clips indices beyond the end.
        u = self.feedback(y0, at(args.inputs, sample_index(t0)))
        held = args._replace(inputs=jax.tree.map(lambda v: jnp.asarray(v)[None], u))
        return self.solver.stepped(terms, t0, t1, y0, held)


class Stopping(SolverWrapper):
    """A per-sample solver that keeps the state after the first sample at which `over` is True.

    y = (state, going), where going is 1 until then and 0 afterwards.
    """

    # `going` is a number, since diffrax differentiates its whole state.
    over: Callable[..., Any]
    linear: tuple[bool, ...] = eqx.field(static=True, default=())

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """Integrate one sample; keep the state if the run is over."""
        # A batch cannot stop for one run, so the step is computed and discarded.
        state, going = y0
        new, result = self.solver.stepped(terms, t0, t1, state, args)
        new = jax.tree.map(lambda a, b: jnp.where(going > 0, a, b), new, state)
        result = dfx.RESULTS.where(going > 0, result, dfx.RESULTS.successful)
        # Inputs at the end of the interval: those held since its start, or the next ones.
        ended = self.over(new, at_end(args.inputs, sample_index(t0), self.linear))
        y1 = (new, jnp.where(ended, jnp.zeros_like(going), going))
        return y1, result


class WithProcessNoise(SolverWrapper):
    """A per-sample solver that adds process noise after every sample.

    The inputs are (the model's inputs, the acting inputs, standard normal numbers).
    add_noise(state, acting inputs, numbers of that sample) returns the new state.
    """

    add_noise: Callable[..., Any]

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """Integrate one sample and add its noise."""
        # Draws are passed as inputs, since diffrax carries only y and args.
        inputs, acting, draws = args.inputs
        held = args._replace(inputs=inputs)
        y, result = self.solver.stepped(terms, t0, t1, y0, held)
        k = sample_index(t0)
        y1 = self.add_noise(y, at(acting, k), at(draws, k))
        return y1, result
