"""simulate: a model, its parameters and inputs in; the trajectory out."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model
from heli_jax.simulation.blocks import blockwise, columns
from heli_jax.simulation.discretize import discretize, moved, process_noise, square_root
from heli_jax.simulation.events import NO_END, Event, any_over, stopped
from heli_jax.simulation.hold import Hold, delayed, linear_inputs
from heli_jax.simulation.solvers import (
    RK4,
    Adaptive,
    Exact,
    Fed,
    Held,
    Moving,
    Noisy,
    PerSample,
    Stopping,
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
        raise ValueError(f"inputs have shapes {sorted(shapes)}, wanted is (N,) for all, N >= 2")
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
    *,
    dt: Any = None,
    initial_state: Any = None,
    solver: str | dfx.AbstractSolver | None = None,
    substeps: int = 4,
    controller: dfx.AbstractStepSizeController | None = None,
    delay: Any = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int = 4096,
    key: Any = None,
    block: int = 1,
    feedback: Callable[[Any, Any], Any] | None = None,
    events: Mapping[str, Event] | None = None,
    hold: Hold = None,
) -> Trajectory:
    """Simulate one machine; each input is held until the next sample, or linear between the two.

    Args:
        flight: a Flight, or the model's Inputs with arrays (N,) and `dt` [s].
        initial_state: the model's State at the first sample; `model.initial_state` unless given.
        solver: "exact" (linear models, the default there), "rk4" (the default elsewhere), or any
            diffrax solver.
        substeps: steps per sample for fixed-step solvers.
        controller: a diffrax step-size controller makes the steps adaptive, with Dopri8 unless
            another solver is given; they end at every sample.
        delay: the inputs act this much later (+) or earlier (-) than given [s]; differentiable.
            Before the first sample its value holds, after the last the last one's.
        adjoint: `diffrax.DirectAdjoint()` unless given: forward and reverse mode both work.
            `ForwardMode()` compiles faster, `RecursiveCheckpointAdjoint()` saves memory in
            reverse mode.
        max_steps: bound on adaptive steps a sample; where it ends a run, `result` says so.
        key: a JAX random key: the model's own noise is drawn with it, by the discrete process
            noise of a sample: exact for linear models with solver "exact", of the model linearised
            at each sample for others with fixed steps; without it there is none.
        block: samples per step of solver "exact"; 32 is three times as fast as 1 for a single
            record, 1 is best for large batches.
        feedback: feedback(state, inputs) -> Inputs that act, once a sample; `inputs` are the given
            ones at that sample (references, or what is added).
        events: by name, event(params, state, inputs) -> a number that is above zero while the run
            goes on (see `heli_jax.simulation.events`). The first to fall to zero or below ends
            the run: from there on the state stays as it was at that moment.
        hold: what the inputs do between samples: "zero-order" (each sample stays until the next)
            or "linear" (straight lines), for all or by input. Unless given, as the Flight says;
            given as arrays they stay.

    Returns:
        A Trajectory; a failed integration is in its `status`, never an exception.

    Raises:
        ValueError: "exact" for a model that is not linear, an unknown solver, wrong shapes, a key
            for a model without noise or with adaptive steps, feedback with a delay or with a
            linear hold, or an unknown hold.
    """
    linear = linear_inputs(model, flight, hold)
    inputs, dt = held_inputs(model, flight, dt)
    n = jax.tree.leaves(inputs)[0].shape[0]
    x0 = start_state(model, params, initial_state, inputs, dt)
    adjoint = dfx.DirectAdjoint() if adjoint is None else adjoint
    method, held, term = per_sample(
        model, params, inputs, dt, solver, substeps, delay, controller, linear
    )
    if isinstance(method, Adaptive):
        method = dataclasses.replace(method, adjoint=adjoint, max_steps=max_steps)
        if key is not None:
            raise ValueError("noise is drawn with fixed steps only")
    if feedback is not None:
        if delay is not None:
            raise ValueError("feedback is for runs without a delay only")
        if linear:
            raise ValueError(
                "feedback acts once a sample and is held until the next, expected are inputs with "
                "hold='zero-order'"
            )
        method = Fed(method, feedback)
    if key is not None:
        method, held = _with_noise(model, held, method, dt, key)
    if block != 1:
        _require_blocks(method, block, events)
        states, result = blockwise(held, block, x0), dfx.RESULTS.successful
    else:
        held = held.in_scalars()
        states, result, dtype = None, None, jax.tree.leaves(x0)[0].dtype
        if events:
            over = functools.partial(any_over, events, params)
            first = 1.0 - over(x0, at(inputs, 0)).astype(dtype)
            stopping = Stopping(method, over, linear)
            (states, _), result = _stepwise(stopping, held, term, (x0, first), n, adjoint)
        else:
            states, result = _stepwise(method, held, term, x0, n, adjoint)
    acting = inputs
    if delay is not None:
        acting = acting_inputs(inputs, dt, delay, n, linear)
    if feedback is not None:
        acting = jax.vmap(feedback)(states, inputs)
    step = jnp.asarray(dt, jnp.result_type(dt) if hasattr(dt, "dtype") else float)
    times = jnp.arange(n, dtype=step.dtype) * step
    end = NO_END
    if events:
        states, end = stopped(model, params, events, times, states, acting, linear)
    outputs = jax.vmap(lambda x, u: model.output(params, x, u))(states, acting)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(states)]))
    outside = {}
    if model.limits is not None:
        limits = model.limits
        outside = jax.vmap(lambda x, u: limits(params, x, u))(states, acting)
    return Trajectory(times, states, outputs, acting, result, finite, outside, *end)


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
    dt: Any,
    solver: Any,
    substeps: int,
    delay: Any,
    controller: dfx.AbstractStepSizeController | None,
    linear: tuple[bool, ...] = (),
) -> tuple[dfx.AbstractSolver, Held, dfx.ODETerm]:
    """The solver, its arguments and the term for time counted in samples."""
    method = _method(model, dfx.Dopri8() if controller is not None and solver is None else solver)
    if controller is not None and isinstance(method, Exact | RK4):
        raise ValueError("adaptive steps need a diffrax solver with an error estimate: Dopri8()")
    parts = None if delay is None else split_delay(delay, dt)

    term = field_term(model, model.vector_field)
    dt = jnp.asarray(dt, jax.tree.leaves(inputs)[0].dtype)
    if isinstance(method, Exact):
        late = None if parts is None else parts[1] * dt
        discrete = discretize(model, params, dt, late, linear)
        return method, Held(params, inputs, dt, parts, discrete), term
    if substeps < 1:
        raise ValueError(f"substeps is {substeps}, wanted is at least 1")
    held = Held(params, inputs, dt, parts, None)
    if controller is not None:
        adaptive = Adaptive(method, 1, controller, dfx.DirectAdjoint(), 4096, linear=linear)
        return adaptive, held, term
    return PerSample(method, substeps, linear=linear), held, term


def held_columns(
    model: Model,
    params: Any,
    inputs: Any,
    dt: Any,
    delay: Any,
    linear: tuple[bool, ...] = (),
) -> tuple[Float[Array, "n n"], Float[Array, "N n"], Float[Array, "N m"]]:
    """x[k+1] = Ad x[k] + drive[k] for a linear model: Ad, drive, and the inputs that act at k."""
    _, held, _ = per_sample(model, params, inputs, dt, "exact", 1, delay, None, linear)
    assert held.discrete is not None
    B, U = columns(held)
    n = U.shape[0]
    acting = inputs if delay is None else acting_inputs(inputs, dt, delay, n, linear)
    return held.discrete.Ad, U @ B.T, jnp.stack(jax.tree.leaves(acting), axis=1)


def _require_blocks(method: Any, block: int, events: Any) -> None:
    if block < 1:
        raise ValueError(f"block is {block}, wanted is at least 1")
    if not isinstance(method, Exact) or events:
        raise ValueError("block is for solver='exact' without feedback and events only")


def _with_noise(model: Model, held: Held, method: Any, dt: Any, key: Any) -> tuple[Any, Held]:
    """Standard normal numbers as further inputs, multiplied by a root of the process noise."""
    if model.noise_intensity is None:
        raise ValueError(f"model {model.name!r} has no noise to draw: see with_disturbance")
    if held.delay is not None:
        raise ValueError("noise is drawn without a delay only")
    n = jax.tree.leaves(held.inputs)[0].shape[0]
    dtype, states = jax.tree.leaves(held.inputs)[0].dtype, len(naming.names(model.State))
    if not isinstance(method, Exact) or held.discrete is None:
        feedback = method.feedback if isinstance(method, Fed) else None
        draws = jax.random.normal(key, (n, states), dtype)
        held = held._replace(inputs=(held.inputs, tuple(draws.T)))
        return Noisy(method, functools.partial(_kick, model, held.params, held.dt, feedback)), held
    L = square_root(process_noise(model, held.params, dt))
    draws = jax.random.normal(key, (n, L.shape[0]), L.dtype)
    discrete = held.discrete._replace(Bd=jnp.concatenate([held.discrete.Bd, L], axis=1))
    if discrete.Bn is not None:
        # The draws are no inputs: nothing of them comes from the next sample.
        Bn = jnp.concatenate([discrete.Bn, jnp.zeros_like(L)], axis=1)
        discrete = discrete._replace(Bn=Bn)
    return method, held._replace(inputs=(held.inputs, tuple(draws.T)), discrete=discrete)


def _kick(
    model: Model, params: Any, dt: Any, feedback: Any, state: Any, inputs: Any, draws: Any
) -> Any:
    """The state after a sample with the noise of that sample, of the model linearised there."""
    if feedback is not None:
        inputs = feedback(state, inputs)
    x = naming.ravel(state)

    def rates(x: Array) -> Array:
        derivatives = model.vector_field(params, naming.unravel(model.State, x), inputs)
        return naming.ravel(derivatives, x.dtype, naming.names(model.State))

    assert model.noise_intensity is not None
    g = naming.ravel(model.noise_intensity(params), x.dtype, naming.names(model.State))
    L = square_root(moved(jax.jacfwd(rates)(x), jnp.zeros_like(g), g, dt).Q)
    return naming.unravel(model.State, x + L @ jnp.stack(draws))


class _Field(eqx.Module):
    """A vector field as diffrax calls it: equal for equal models, so that it is compiled once."""

    State: type = eqx.field(static=True)
    vector_field: Callable[[Any, Any, Any], Any] = eqx.field(static=True)

    def __call__(self, t: Any, x: Any, now: Any) -> Any:
        if not isinstance(x, self.State):
            return jax.tree.map(jnp.zeros_like, x)
        if isinstance(now, Held):
            return x  # only the shapes are asked for; the inputs may not be the model's
        if isinstance(now, Moving):
            now = now.after(t)
        return self.vector_field(now.params, x, now.inputs)


def field_term(model: Model, vector_field: Callable[[Any, Any, Any], Any]) -> dfx.ODETerm:
    """The vector field, per second, within one sample; of its parameters as `Held` has them.

    diffrax also evaluates it with the solver's own arguments and state, to compare shapes.
    """
    return dfx.ODETerm(_Field(model.State, vector_field))


def _stepwise(
    method: Any, held: Held, term: dfx.ODETerm, x0: Any, n: int, adjoint: Any
) -> tuple[Any, dfx.RESULTS]:
    dtype = jax.tree.leaves(x0)[0].dtype
    sol = dfx.diffeqsolve(
        term,
        method,
        t0=jnp.zeros((), dtype),
        t1=jnp.asarray(n - 1, dtype),
        dt0=jnp.ones((), dtype),
        y0=x0,
        args=held,
        saveat=dfx.SaveAt(t0=True, steps=True),
        max_steps=n - 1,
        adjoint=adjoint,
        throw=False,
    )
    return sol.ys, sol.result


def acting_inputs(inputs: Any, dt: Any, delay: Any, n: int, linear: tuple[bool, ...] = ()) -> Any:
    """The inputs that act at the n samples when they come late."""
    return delayed(inputs, *split_delay(delay, dt), n, linear)
