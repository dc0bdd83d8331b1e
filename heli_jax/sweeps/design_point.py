"""One element of a sweep: values of the axes in, results and status out; traced by JAX."""

# `Any` below: State, Inputs, Outputs, Params and the results of functions are the user's types.

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.trim import equilibrium, is_trimmed
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.simulation.accumulate import Accumulated, Steps, accumulated, in_steps
from heli_jax.simulation.options import SimulationOptions
from heli_jax.simulation.simulate import simulate
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.sweeps import reducers
from heli_jax.sweeps.reducers import Measured
from heli_jax.sweeps.spec import Job, Plan

Scalars = dict[str, jax.Array]
"""Numbers () by name."""


class FlightNumbers(NamedTuple):
    """Numbers of a flight and of the vehicle, in the sweep's precision."""

    # Arguments of the compiled part, not constants in it. A flight of the same length, or another
    # vehicle, needs no new program.

    base: dict[str, Any]
    """The vehicle's numbers."""
    dt: Any
    inputs: Any
    known: dict[str, Any]
    measured: dict[str, Measured]
    """Measured signals by result, for results that compare with the flight."""
    pilot: Any


def flight_numbers(job: Job, index: int) -> FlightNumbers:
    """Return the numbers of one of the job's flights."""
    # All numbers are cast here, once: a single float64 would make JAX compute in float64.
    dtype, flight, model = np.dtype(job.options.precision), job.flights[index], job.model
    inputs = {n: flight.inputs[n].astype(dtype) for n in naming.names(model.Inputs)}
    against = {
        name: reducers.measured(flight.outputs[str(r.signal)], dtype)
        for name, r in job.reduce.items()
        if (s := reducers.streaming(r)) is not None and s.against_flight
    }
    return FlightNumbers(
        {n: np.asarray(v, dtype) for n, v in job.params.items()},
        np.asarray(flight.dt, dtype),
        model.Inputs(**inputs),
        {n: np.asarray(v, dtype) for n, v in flight.known.items()},
        against,
        jax.tree.map(lambda v: np.asarray(v, dtype), job.options.pilot),
    )


class InitialTrim(NamedTuple):
    """Steady flight in which an element begins."""

    state: Any
    sticks: Any
    """The model's Inputs, added to the flight's."""
    sound: Any
    """True if there is such a flight."""


def params_of(plan: Plan, numbers: FlightNumbers, values: Scalars) -> tuple[Any, Scalars]:
    """Return the element's parameters, and the axes that are not among them."""
    names = naming.names(plan.model.Params)
    swept = {n: v for n, v in values.items() if n in names}
    # In this order: the flight's known values override the vehicle's, and an axis overrides both.
    params = plan.model.Params(**{**numbers.base, **numbers.known, **swept})
    return params, {n: v for n, v in values.items() if n not in names}


def steady(plan: Plan, numbers: FlightNumbers, values: Scalars) -> InitialTrim:
    """Return the steady flight of one element.

    Args:
        plan: compiled plan; its `trimmed` defines the flight.
        numbers: numbers of the flight and the vehicle, SI.
        values: values of the axes, scalars, SI.
    """
    assert plan.options.trimmed is not None
    whole, dtype = plan.options.trimmed.of or plan.model, numbers.dt.dtype
    params, _ = params_of(plan, numbers, values)
    plain = whole.Params(**{n: getattr(params, n) for n in naming.names(whole.Params)})
    # In the default precision for any sweep: in float32 the final residuals are too large to prove
    # a steady flight.
    plain, condition, wind = jax.tree.map(
        lambda v: jnp.asarray(v, jnp.result_type(float)),
        (plain, plan.options.trimmed.condition, tuple(plan.options.trimmed.wind)),
    )
    # Without a disturbance: a steady flight is in still air or steady wind.
    trim = equilibrium(whole, plain, condition, wind)
    sound = is_trimmed(trim)
    # The states of a disturbance have no trim and keep their own initial values.
    state = naming.replace(plan.model.initial_state(params), **naming.asdict(trim.state))
    share = 1.0 if plan.options.trimmed.sticks else 0.0
    sticks = jax.tree.map(lambda v: jnp.asarray(share * v, dtype), trim.inputs)
    state = jax.tree.map(lambda v: jnp.asarray(v, dtype), state)
    return InitialTrim(state, sticks, sound)


_Run = tuple[Scalars, dict[str, jax.Array], Any, list[jax.Array]]
"""Results, trajectories (samples kept,), the last State, and True for each exceeded limit."""

OK, DIVERGED, OUT_OF_RANGE, NOT_RUN = 0, 1, 2, 255
MEANINGS = {OK: "ok", DIVERGED: "diverged", OUT_OF_RANGE: "out_of_range", NOT_RUN: "not_run"}
"""Status of an element. Diverged: a state or an axis is not finite, or a state is beyond `RUNAWAY`.
Out of range: a parameter is impossible for a helicopter, the model's range was left, or there is no
steady flight to begin with."""

RUNAWAY = 1e12
"""Magnitude [SI] above which a state is not that of a helicopter."""

# Samples per step of the exact solver: fastest with many elements in parallel (see
# `SimulationOptions.block`).
_BLOCK = 4
# The same for one program per run, where more coefficients per vehicle take longer to compute than
# they save. Measured with the roll model, AVX2, a busy computer, a whole sweep, one or two runs
# each: 7.5 and 8.0 us a vehicle with 2, 7.9 with 3, 8.4 with 4.
_FUSED_BLOCK = 2
# Number of states and inputs above which a step is one sample. hybrid-flybarless has 15: 3000
# samples of a vehicle took 119 us with 1 and 187 with 2, by XLA 116 and 140. These are medians of
# four processor times (AVX2, busy computer). Values between 5 and 15 were not measured.
_FUSED_BLOCK_FITS = 8


class ElementResults(NamedTuple):
    """Results of the compiled part for an element."""

    results: dict[str, Any]
    trajectories: dict[str, Any]
    matrices: Any
    """Linearisation at the start of the run, if a result needs it."""
    status: Any


def design_point(
    plan: Plan, numbers: FlightNumbers, values: Scalars, trim: InitialTrim | None
) -> ElementResults:
    """Compute one element.

    Args:
        plan: compiled plan.
        numbers: numbers of the flight and the vehicle, SI.
        values: values of the axes, scalars, SI.
        trim: steady flight to begin in; None for the model's initial state.
    """
    params, special = params_of(plan, numbers, values)
    state, inputs = _initial_state_and_inputs(plan.model, params, numbers, special, trim)
    if trim is not None and numbers.pilot is not None:
        # The gains are those for the given vehicle; the flight is this element's own.
        numbers = numbers._replace(pilot=numbers.pilot._replace(trimmed=trim.state))
    run = None
    if plan.simulated:
        # Streamed if possible: the run is then not stored, and a device has room for more runs.
        if plan.streamed:
            run = _streamed(plan, numbers, params, state, inputs)
        else:
            run = _whole(plan, numbers, params, state, inputs, special)
    return _concluded(plan, numbers, values, trim, run)


def steps_of(
    plan: Plan, numbers: FlightNumbers, values: Scalars, trim: InitialTrim | None
) -> Steps:
    """Return the run of one element in steps; arguments as in `design_point`, plan streamed."""
    params, special = params_of(plan, numbers, values)
    state, inputs = _initial_state_and_inputs(plan.model, params, numbers, special, trim)
    update, start, data = _streaming(plan, numbers)
    size = len(naming.names(plan.model.State)) + len(naming.names(plan.model.Inputs))
    block = _FUSED_BLOCK if size <= _FUSED_BLOCK_FITS else 1
    return in_steps(
        plan.model,
        params,
        inputs,
        update,
        start,
        data=data,
        limits=True,
        options=_streamed_options(plan, numbers, state, block),
    )


def of_steps(
    plan: Plan,
    numbers: FlightNumbers,
    values: Scalars,
    trim: InitialTrim | None,
    reduced: Accumulated,
) -> ElementResults:
    """Return the results of an element from the end of `steps_of`.

    Args:
        plan, numbers, values, trim: as in `design_point`.
    """
    return _concluded(plan, numbers, values, trim, _of_reduced(plan, numbers, reduced))


def _concluded(
    plan: Plan,
    numbers: FlightNumbers,
    values: Scalars,
    trim: InitialTrim | None,
    run: _Run | None,
) -> ElementResults:
    """Return results and status from the reduced run."""
    model, dtype = plan.model, numbers.dt.dtype
    # A later status overrides an earlier one, so the order of these steps is that of importance.
    status = jnp.asarray(OK)
    results: Scalars = {}
    kept: dict[str, jax.Array] = {}
    if run is not None:
        results, kept, last, outside = run
        for left in outside:
            status = jnp.where(left, OUT_OF_RANGE, status)
        # NaN compares as false, so it counts here too. This follows the range check, because a run
        # that left the range and then diverged has no valid numbers.
        sound = jnp.stack([jnp.abs(v) < RUNAWAY for v in jax.tree.leaves(last)])
        status = jnp.where(jnp.all(sound), status, DIVERGED)
    if trim is not None:
        # Last, because such an element begins with NaN, which would look like a divergence.
        status = jnp.where(trim.sound, status, OUT_OF_RANGE)
    matrices = None
    if any(r.how in reducers.LINEAR for _, r in plan.reduce):
        # NumPy computes eigenvalues and margins from these after the chunk, in float64 on any
        # device.
        params, special = params_of(plan, numbers, values)
        state, inputs = _initial_state_and_inputs(model, params, numbers, special, trim)
        at_start = jax.tree.map(lambda u: u[0], inputs)
        matrices = jacobians(model, params, state, at_start)
    results = {n: jnp.asarray(v, dtype) for n, v in results.items()}
    return ElementResults(results, kept, matrices, status.astype(np.uint8))


def _initial_state_and_inputs(
    model: Model, params: Any, numbers: FlightNumbers, special: Scalars, trim: InitialTrim | None
) -> tuple[Any, Any]:
    """Return the state at the first sample and the inputs (N,) of an element."""
    inputs = numbers.inputs
    if trim is None:
        dtype = numbers.dt.dtype
        state = jax.tree.map(lambda v: jnp.asarray(v, dtype), model.initial_state(params))
    else:
        # Without a steady flight the run is not valid, and NaN marks it.
        state = jax.tree.map(lambda v: jnp.where(trim.sound, v, jnp.nan), trim.state)
        inputs = jax.tree.map(lambda u, stick: u + stick, inputs, trim.sticks)
    initial = {
        n.removeprefix("initial."): v for n, v in special.items() if n.startswith("initial.")
    }
    return naming.replace(state, **initial), _gained_and_offset(inputs, special)


def _gained_and_offset(inputs: Any, special: Scalars) -> Any:
    """Return the element's inputs: the flight's times a gain, plus an offset."""
    changed = {}
    for name, u in naming.asdict(inputs).items():
        gain, offset = special.get(f"gain.{name}"), special.get(f"offset.{name}")
        # The gain does not multiply the offset, so the axes are independent.
        u = u if gain is None else gain * u
        changed[name] = u if offset is None else u + offset
    return type(inputs)(**changed)


def _streaming(plan: Plan, numbers: FlightNumbers) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Return the streaming reducers' update, their first values, and the measured signals (N,)."""
    dtype = numbers.dt.dtype
    signals = {n: r.signal for n, r in plan.reduce}
    streams = {n: s for n, r in plan.reduce if (s := reducers.streaming(r)) is not None}
    start = {n: jax.tree.map(lambda v: jnp.asarray(v, dtype), s.start) for n, s in streams.items()}
    data = {n: (m.values, m.seen) for n, m in numbers.measured.items()}

    def measured(name: str, now: dict[str, Any]) -> Measured | None:
        if name not in now:
            return None
        # The signal's moments stay those of the whole record.
        return numbers.measured[name]._replace(values=now[name][0], seen=now[name][1])

    def update(value: dict[str, Any], outputs: Any, now: dict[str, Any]) -> dict[str, Any]:
        """Return the running values after one more sample."""
        new = {}
        for name, stream in streams.items():
            y = outputs if (signal := signals[name]) is None else getattr(outputs, signal)
            new[name] = stream.update(value[name], y, measured(name, now))
        return new

    return update, start, data


def _finished(plan: Plan, numbers: FlightNumbers, value: dict[str, Any], n: int) -> Scalars:
    """Return the results of the streaming reducers after n samples, by name."""
    results: Scalars = {}
    count = jnp.asarray(n, numbers.dt.dtype)
    for name, reducer in plan.reduce:
        stream = reducers.streaming(reducer)
        if stream is not None:
            result = stream.finish(value[name], count, numbers.measured.get(name))
            results |= _named(name, result)
    return results


def _of_function(name: str, function: Callable[[Trajectory], Any], run: Trajectory) -> Scalars:
    """Return the results of a user's function for a run, by name."""
    called = getattr(function, "__qualname__", str(function))
    try:
        results = {n: jnp.asarray(v) for n, v in _named(name, function(run)).items()}
    except Exception as e:  # whatever the function raises
        # JAX's messages are pages long.
        first = str(e).partition("\n")[0]
        raise ValueError(
            f"reduce.{name}: {called} cannot be computed ({type(e).__name__}: {first:.200}), "
            "expected a function of a Trajectory that uses jax.numpy, does not branch on its "
            "values, and returns a number or numbers by name"
        ) from e
    for n, v in results.items():
        if not (jnp.issubdtype(v.dtype, jnp.number) or v.dtype == jnp.bool_) or (
            jnp.issubdtype(v.dtype, jnp.complexfloating)
        ):
            raise ValueError(
                f"reduce.{name}: {called} gives {n} as {v.dtype}, expected a real number"
            )
    return results


def _named(name: str, result: Any) -> dict[str, Any]:
    """Return a result by name; several of one function by name and key."""
    if isinstance(result, dict):
        return {f"{name}_{key}": v for key, v in result.items()}
    return {name: result}


def _streamed(plan: Plan, numbers: FlightNumbers, params: Any, state: Any, inputs: Any) -> _Run:
    """Return the run, reduced during the simulation."""
    update, start, data = _streaming(plan, numbers)
    options = _streamed_options(plan, numbers, state, _BLOCK)
    reduced = accumulated(
        plan.model,
        params,
        inputs,
        update,
        start,
        data=data,
        limits=True,
        options=options,
    )
    return _of_reduced(plan, numbers, reduced)


def _streamed_options(
    plan: Plan, numbers: FlightNumbers, state: Any, block: int
) -> SimulationOptions:
    block = block if plan.options.solver == "exact" else 1
    return plan.simulation(dt=numbers.dt, initial_state=state, block=block)


def _of_reduced(plan: Plan, numbers: FlightNumbers, reduced: Accumulated) -> _Run:
    """Return the results of a run that was not stored."""
    n = jax.tree.leaves(numbers.inputs)[0].shape[0]
    results = _finished(plan, numbers, reduced.value, n)
    return results, {}, reduced.state, list(reduced.outside.values())


def _whole(
    plan: Plan, numbers: FlightNumbers, params: Any, state: Any, inputs: Any, special: Scalars
) -> _Run:
    """Return the stored run, for functions of it and for trajectories to keep."""
    options = plan.simulation(
        dt=numbers.dt,
        initial_state=state,
        delay=special.get("delay"),
        key=jax.random.key(special["seed"]) if "seed" in special else None,
        feedback=numbers.pilot,
    )
    run: Trajectory = simulate(plan.model, params, inputs, options)
    update, start, data = _streaming(plan, numbers)
    # Sample by sample here too, so that each result has one definition for any kind of run.
    value, _ = jax.lax.scan(lambda v, now: (update(v, *now), None), start, (run.outputs, data))
    n = run.times.shape[0]
    results = _finished(plan, numbers, value, n)
    for name, reducer in plan.reduce:
        if callable(reducer.how) and reducers.streaming(reducer) is None:
            results |= _of_function(name, reducer.how, run)
    kept = {}
    if plan.options.trajectories is not None:
        every = plan.options.trajectories.every
        kept = {n: getattr(run.outputs, n)[::every] for n in plan.options.trajectories.signals}
    last = jax.tree.map(lambda v: v[-1], run.states)
    return results, kept, last, [jnp.any(out) for out in run.outside.values()]
