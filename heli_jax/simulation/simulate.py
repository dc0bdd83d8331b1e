"""simulate: a model, its parameters and inputs in; the trajectory out."""

import functools
import math
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model
from heli_jax.numerics.matrix_exponential import van_loan
from heli_jax.simulation.blocks import blockwise, columns
from heli_jax.simulation.discretize import discretize, process_noise, square_root
from heli_jax.simulation.events import NO_END, any_over, stopped
from heli_jax.simulation.hold import delayed, linear_inputs, refuse_delays
from heli_jax.simulation.options import DEFAULT, SimulationOptions
from heli_jax.simulation.solvers import (
    RK4,
    Adaptive,
    Exact,
    PerSample,
    RampArgs,
    StateFeedback,
    Stopping,
    WithProcessNoise,
    ZeroOrderHoldArgs,
    at,
)
from heli_jax.simulation.trajectory import Trajectory


def held_inputs(model: Model, flight: Any, dt: Any) -> tuple[Any, Any]:
    """The model's Inputs as arrays (N,) and the sample time, from a Flight or from Inputs with dt.

    Raises:
        ValueError: a needed input is missing, the lengths differ, or dt is missing.
    """
    given = getattr(flight, "inputs", None)
    if isinstance(given, dict):
        missing = [n for n in naming.names(model.Inputs) if n not in given]
        if missing:
            raise ValueError(f"the flight has no input {missing[0]!r}, which {model.name} needs")
        inputs = model.Inputs(**{n: jnp.asarray(given[n]) for n in naming.names(model.Inputs)})
        dt = flight.dt if dt is None else dt
    else:
        inputs = jax.tree.map(jnp.asarray, flight)
    if dt is None:
        raise ValueError("inputs given as arrays need dt, the sample time in seconds")
    shapes = {u.shape for u in jax.tree.leaves(inputs)}
    if len(shapes) != 1 or any(len(s) != 1 or s[0] < 2 for s in shapes):
        raise ValueError(f"inputs have shapes {sorted(shapes)}, expected (N,) for all, N >= 2")
    return inputs, dt


_LONGEST_STEP = 0.005
"""of a fixed-step solver [s]: the flapping of a flybar, once a turn, is the fastest motion"""


def substeps_for(dt: float) -> int:
    """Steps of a fixed-step solver in a sample of dt [s]: four, and more in samples over 20 ms."""
    return max(4, math.ceil(dt / _LONGEST_STEP - 1e-9))


@explained
def simulate(
    model: Model,
    params: Any,
    flight: Any,
    options: SimulationOptions = DEFAULT,
    **keywords: Any,
) -> Trajectory:
    """Simulate one machine; each input is held until the next sample, or linear between the two.

    Args:
        model: of one machine; `jax.vmap` over the other arguments simulates many.
        params: the model's Params, SI.
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
    options = options.changed(keywords)
    linear = linear_inputs(model, flight, options.hold)
    inputs, dt = held_inputs(model, flight, options.dt)
    options = options._replace(dt=dt)
    x0 = start_state(model, params, options.initial_state, inputs, dt)
    run = _method_with_extras(model, params, inputs, options, linear)
    states, result = _states(run, x0, inputs, options, linear)
    acting = _acting(inputs, states, options, linear)
    times = _times(inputs, dt)
    end = NO_END
    if options.events:
        states, end = stopped(model, params, options.events, times, states, acting, linear)
    outputs = jax.vmap(lambda x, u: model.output(params, x, u))(states, acting)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(states)]))
    outside = {}
    if model.limits is not None:
        limits = model.limits
        outside = jax.vmap(lambda x, u: limits(params, x, u))(states, acting)
    return Trajectory(times, states, outputs, acting, result, finite, outside, *end)


def _method_with_extras(
    model: Model,
    params: Any,
    inputs: Any,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm]:
    """The solver of a run with what `simulate` alone has: feedback and process noise."""
    method, args, term = per_sample(model, params, inputs, options, linear)
    if isinstance(method, Adaptive) and options.key is not None:
        # A step of the controller's choice would have noise of another covariance.
        raise ValueError("noise is drawn with fixed steps only")
    if options.feedback is not None:
        if options.delay is not None:
            raise ValueError("feedback is for runs without a delay only")
        if linear:
            raise ValueError(
                "feedback acts once a sample and is held until the next, expected are inputs with "
                "hold='zero-order'"
            )
        method = StateFeedback(method, options.feedback)
    if options.key is not None:
        method, args = _with_noise(model, args, method, options.dt, options.key)
    return method, args, term


def _states(
    run: tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm],
    x0: Any,
    inputs: Any,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[Any, dfx.RESULTS]:
    """The states (N,), and what diffrax says of the integration."""
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


def _acting(inputs: Any, states: Any, options: SimulationOptions, linear: tuple[bool, ...]) -> Any:
    """The inputs (N,) as they acted: late, or with the feedback's part."""
    if options.feedback is not None:
        return jax.vmap(options.feedback)(states, inputs)
    if options.delay is None:
        return inputs
    n = jax.tree.leaves(inputs)[0].shape[0]
    return acting_inputs(inputs, options.dt, options.delay, n, linear)


def _times(inputs: Any, dt: Any) -> Float[Array, " N"]:
    """The samples' times from 0 [s], in the type of dt."""
    step = jnp.asarray(dt, jnp.result_type(dt) if hasattr(dt, "dtype") else float)
    return jnp.arange(jax.tree.leaves(inputs)[0].shape[0], dtype=step.dtype) * step


def start_state(model: Model, params: Any, initial_state: Any, inputs: Any, dt: Any) -> Any:
    """The initial state in the dtype that the parameters and inputs give together."""
    state = model.initial_state(params) if initial_state is None else initial_state
    leaves = (*jax.tree.leaves(params), *jax.tree.leaves(inputs))
    dtype = jnp.result_type(*(jnp.asarray(v) for v in leaves))
    dtype = dtype if jnp.issubdtype(dtype, jnp.inexact) else jnp.result_type(float)
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), state)


_LARGE = 8
"""States beyond which the stages of RK4 are a loop: 5 % slower, a quarter of the compilation."""


def _method(model: Model, solver: str | dfx.AbstractSolver | None) -> dfx.AbstractSolver:
    if solver is None:
        solver = "exact" if model.linear else "rk4"
    if solver == "exact":
        if not model.linear:
            raise ValueError(f"model {model.name!r} is not linear: use solver='rk4' or another")
        return Exact()
    if solver == "rk4":
        return RK4(rolled=len(naming.names(model.State)) > _LARGE)
    if isinstance(solver, dfx.AbstractSolver):
        return solver
    raise ValueError(f"unknown solver {solver!r}: use 'exact', 'rk4' or a diffrax solver")


def split_delay(delay: Any, dt: Any) -> tuple[Any, Any]:
    """A delay as whole samples and the rest as a fraction of a sample in [0, 1)."""
    samples = jnp.asarray(delay) / dt
    whole = jnp.floor(jax.lax.stop_gradient(samples))
    return whole.astype(int), samples - whole


def per_sample(
    model: Model,
    params: Any,
    inputs: Any,
    options: SimulationOptions,
    linear: tuple[bool, ...] = (),
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm]:
    """The solver, its arguments and the term for time counted in samples.

    Args:
        model: of one machine.
        params: the model's Params, SI.
        inputs: the model's Inputs, arrays (N,).
        options: of which dt, solver, substeps, delay, controller, adjoint and max_steps count.
        linear: of each input whether it is linear between samples; () holds all.
    """
    refuse_delays(model)
    controller, solver = options.controller, options.solver
    method = _method(model, dfx.Dopri8() if controller is not None and solver is None else solver)
    if controller is not None and isinstance(method, Exact | RK4):
        raise ValueError("adaptive steps need a diffrax solver with an error estimate: Dopri8()")
    parts = None if options.delay is None else split_delay(options.delay, options.dt)

    term = field_term(model, model.vector_field)
    dt = jnp.asarray(options.dt, jax.tree.leaves(inputs)[0].dtype)
    if isinstance(method, Exact):
        late = None if parts is None else parts[1] * dt
        discrete = discretize(model, params, dt, late, linear)
        return method, ZeroOrderHoldArgs(params, inputs, dt, parts, discrete), term
    if options.substeps < 1:
        raise ValueError(f"substeps must be at least 1, got {options.substeps}")
    args = ZeroOrderHoldArgs(params, inputs, dt, parts, None)
    if controller is None:
        return PerSample(method, options.substeps, linear=linear), args, term
    adjoint = dfx.DirectAdjoint() if options.adjoint is None else options.adjoint
    adaptive = Adaptive(method, 1, controller, adjoint, options.max_steps, linear=linear)
    return adaptive, args, term


def held_columns(
    model: Model,
    params: Any,
    inputs: Any,
    dt: Any,
    delay: Any,
    linear: tuple[bool, ...] = (),
) -> tuple[Float[Array, "n n"], Float[Array, "N n"], Float[Array, "N m"]]:
    """x[k+1] = Ad x[k] + drive[k] for a linear model: Ad, drive, and the inputs that act at k.

    Args:
        model: linear, with n states and m inputs.
        params: the model's Params, SI.
        inputs: the model's Inputs, arrays (N,).
        dt: [s].
        delay: as in `SimulationOptions`.
        linear: of each input whether it is linear between samples; () holds all.
    """
    options = SimulationOptions(dt=dt, solver="exact", delay=delay)
    _, args, _ = per_sample(model, params, inputs, options, linear)
    assert args.discrete is not None
    B, U = columns(args)
    n = U.shape[0]
    acting = inputs if delay is None else acting_inputs(inputs, dt, delay, n, linear)
    return args.discrete.Ad, U @ B.T, jnp.stack(jax.tree.leaves(acting), axis=1)


def _require_blocks(method: Any, block: int, events: Any) -> None:
    if block < 1:
        raise ValueError(f"block must be at least 1, got {block}")
    if not isinstance(method, Exact) or events:
        raise ValueError("block is for solver='exact' without feedback and events only")


def _with_noise(
    model: Model, args: ZeroOrderHoldArgs, method: Any, dt: Any, key: Any
) -> tuple[Any, ZeroOrderHoldArgs]:
    """Standard normal numbers as further inputs, multiplied by a root of the process noise."""
    if model.noise_intensity is None:
        raise ValueError(f"model {model.name!r} has no noise to draw: see with_disturbance")
    if args.delay is not None:
        raise ValueError("noise is drawn without a delay only")
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype, states = jax.tree.leaves(args.inputs)[0].dtype, len(naming.names(model.State))
    if not isinstance(method, Exact) or args.discrete is None:
        feedback = method.feedback if isinstance(method, StateFeedback) else None
        draws = jax.random.normal(key, (n, states), dtype)
        args = args._replace(inputs=(args.inputs, tuple(draws.T)))
        return WithProcessNoise(
            method, functools.partial(add_process_noise, model, args, feedback)
        ), args
    L = square_root(process_noise(model, args.params, dt))
    draws = jax.random.normal(key, (n, L.shape[0]), L.dtype)
    discrete = args.discrete._replace(Bd=jnp.concatenate([args.discrete.Bd, L], axis=1))
    if discrete.Bn is not None:
        # The draws are no inputs: nothing of them comes from the next sample.
        Bn = jnp.concatenate([discrete.Bn, jnp.zeros_like(L)], axis=1)
        discrete = discrete._replace(Bn=Bn)
    return method, args._replace(inputs=(args.inputs, tuple(draws.T)), discrete=discrete)


def add_process_noise(
    model: Model, args: ZeroOrderHoldArgs, feedback: Any, state: Any, inputs: Any, draws: Any
) -> Any:
    """The state after a sample with the noise of that sample, of the model linearised there.

    Args:
        model: one with a noise intensity, n states.
        args: of which the parameters and dt count.
        feedback: None, or what makes the acting inputs of the given ones.
        state: before the noise is added.
        inputs: of the sample.
        draws: n standard normal numbers.
    """
    params, dt = args.params, args.dt
    if feedback is not None:
        inputs = feedback(state, inputs)
    x = naming.ravel(state)

    def rates(x: Array) -> Array:
        derivatives = model.vector_field(params, naming.unravel(model.State, x), inputs)
        return naming.ravel(derivatives, x.dtype, naming.names(model.State))

    assert model.noise_intensity is not None
    g = naming.ravel(model.noise_intensity(params), x.dtype, naming.names(model.State))
    L = square_root(van_loan(jax.jacfwd(rates)(x), jnp.zeros_like(g), g, dt).Q)
    return naming.unravel(model.State, x + L @ jnp.stack(draws))


class _Field(eqx.Module):
    """A vector field as diffrax calls it: equal for equal models, so that it is compiled once."""

    State: type = eqx.field(static=True)
    vector_field: Callable[[Any, Any, Any], Any] = eqx.field(static=True)

    def __call__(self, t: Any, x: Any, now: Any) -> Any:
        if not isinstance(x, self.State):
            return jax.tree.map(jnp.zeros_like, x)
        if isinstance(now, ZeroOrderHoldArgs):
            return x  # only the shapes are asked for; the inputs may not be the model's
        if isinstance(now, RampArgs):
            now = now.after(t)
        return self.vector_field(now.params, x, now.inputs)


def field_term(model: Model, vector_field: Callable[[Any, Any, Any], Any]) -> dfx.ODETerm:
    """The vector field, per second, within one sample; of its parameters as those of
    `ZeroOrderHoldArgs`.

    diffrax also evaluates it with the solver's own arguments and state, to compare shapes.
    """
    return dfx.ODETerm(_Field(model.State, vector_field))


def _stepwise(
    method: Any,
    args: ZeroOrderHoldArgs,
    term: dfx.ODETerm,
    x0: Any,
    adjoint: dfx.AbstractAdjoint,
) -> tuple[Any, dfx.RESULTS]:
    """The states from x0 on, one step a sample: time is counted in samples."""
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype = jax.tree.leaves(x0)[0].dtype
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
        throw=False,
    )
    return sol.ys, sol.result


def acting_inputs(inputs: Any, dt: Any, delay: Any, n: int, linear: tuple[bool, ...] = ()) -> Any:
    """The inputs that act at the n samples when they come late."""
    return delayed(inputs, *split_delay(delay, dt), n, linear)
