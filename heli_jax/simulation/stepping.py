"""Solvers with one step a sample, from a model and its inputs."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array, Float, PyTree

from heli_jax import naming
from heli_jax.dynamics.check_model import check_params
from heli_jax.dynamics.model import Model, require_sample_time
from heli_jax.naming import Number, Record
from heli_jax.simulation.blocks import columns
from heli_jax.simulation.discretize import discretize
from heli_jax.simulation.hold import FlightOrInputs, delayed, delays_of
from heli_jax.simulation.options import SimulationOptions
from heli_jax.simulation.solvers import (
    RK4,
    Adaptive,
    AtSamples,
    Exact,
    PerSample,
    RampArgs,
    Time,
    ZeroOrderHoldArgs,
)


def held_inputs(model: Model, flight: FlightOrInputs, dt: Number | None) -> tuple[Record, Number]:
    """Return the model's Inputs as arrays (N,) and the sample time, from a Flight or Inputs with
    dt.

    Args:
        flight: a Flight, or Inputs with arrays (N,).
        dt: sample time [s]; default: that of the Flight.

    Raises:
        TypeError: `flight` is neither a Flight nor Inputs.
        ValueError: a needed input is missing, the lengths differ, or dt is missing or not above
            zero.
    """
    # Checked by its dictionary: any object with `inputs` and `dt` may be a flight. A model's Inputs
    # may also have a field `inputs`, but it is an array.
    by_name = getattr(flight, "inputs", None)
    if isinstance(by_name, dict):
        missing = [n for n in naming.names(model.Inputs) if n not in by_name]
        if missing:
            raise ValueError(f"the flight has no input {missing[0]!r}, which {model.name} needs")
        inputs = model.Inputs(**{n: jnp.asarray(by_name[n]) for n in naming.names(model.Inputs)})
        dt = flight.dt if dt is None else dt
    else:
        names = naming.names(model.Inputs)
        if not all(hasattr(flight, n) for n in names):
            example = ", ".join(f"{n}=..." for n in names)
            raise TypeError(
                f"flight: expected a Flight, or arrays as the model's Inputs({example}) with dt, "
                f"got {type(flight).__name__}"
            )
        inputs = jax.tree.map(jnp.asarray, flight)
    # A run with dt of zero or below would end without an error. A traced dt has no value yet.
    if dt is not None and not isinstance(dt, core.Tracer) and not np.all(np.asarray(dt) > 0):
        raise ValueError(f"dt: expected a sample time above zero [s], got {dt}")
    if dt is None:
        raise ValueError(
            "expected dt, the sample time in seconds, beside inputs given as arrays, got none"
        )
    # One sample has no interval to integrate over.
    shapes = {u.shape for u in jax.tree.leaves(inputs)}
    if len(shapes) != 1 or any(len(s) != 1 or s[0] < 2 for s in shapes):
        raise ValueError(f"inputs: expected the shape (N,) for all, N >= 2, got {sorted(shapes)}")
    return inputs, dt


def start_state(
    model: Model, params: Record, initial_state: Record | None, inputs: Record
) -> Record:
    """Return the initial state in the common dtype of parameters and inputs.

    Raises:
        TypeError: `params` are not the model's.
    """
    check_params(model.Params, params)
    # A loop needs one dtype for its state: float32 parameters stay float32 in a float64 session,
    # and an integer state becomes floating point.
    state = model.initial_state(params) if initial_state is None else initial_state
    leaves = (*jax.tree.leaves(params), *jax.tree.leaves(inputs))
    dtype = jnp.result_type(*(jnp.asarray(v) for v in leaves))
    dtype = dtype if jnp.issubdtype(dtype, jnp.inexact) else jnp.result_type(float)
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), state)


def check_countable(samples: int, dtype: Any) -> None:
    """Refuse a run whose sample numbers are not distinct in its precision.

    Raises:
        ValueError: float32 and more than 4 million samples.
    """
    # diffrax computes k from the end time and a quotient, with an error of up to two units in the
    # last place. Above this limit that is half a sample.
    most = round(0.5 / float(jnp.finfo(dtype).eps))
    if samples > most:
        raise ValueError(
            f"expected at most {most} samples in {jnp.dtype(dtype)}, got {samples}: switch to "
            "float64 (jax.config.update('jax_enable_x64', True))"
        )


_LARGE = 8
"""Number of states above which the stages of RK4 are a loop: 5 % slower, a quarter of the
compilation.
"""


def _method(model: Model, solver: str | dfx.AbstractSolver | None) -> dfx.AbstractSolver:
    if solver is None:
        solver = "exact" if model.linear else "rk4"
    if solver == "exact":
        if not model.linear:
            raise ValueError(
                f"model {model.name!r} is not linear: expected solver='rk4' or another, got 'exact'"
            )
        return Exact()
    # Without the loop, long equations would be compiled four times.
    if solver == "rk4":
        return RK4(rolled=len(naming.names(model.State)) > _LARGE)
    if isinstance(solver, dfx.AbstractSolver):
        return solver
    raise ValueError(f"solver: expected 'exact', 'rk4' or a diffrax solver, got {solver!r}")


def per_sample(
    model: Model,
    params: Record,
    inputs: Record,
    options: SimulationOptions,
    linear: tuple[bool, ...] = (),
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs, dfx.ODETerm]:
    """Return the solver, its arguments and the term, with time counted in samples.

    Args:
        options: used fields: dt, solver, substeps, delay, controller, adjoint and max_steps.
    """
    # "exact" and "rk4" have no error estimate for a controller; a controller alone selects Dopri8.
    controller, solver = options.controller, options.solver
    method = _method(model, dfx.Dopri8() if controller is not None and solver is None else solver)
    if controller is not None and isinstance(method, Exact | RK4):
        raise ValueError(
            "controller: expected a diffrax solver with an error estimate, such as Dopri8(), got "
            f"{options.solver!r}"
        )
    # Delays use the given parameters, possibly traced, since they can be estimated too.
    delays = delays_of(model, params, options.delay, options.dt)

    term = field_term(model, model.vector_field)
    dt = jnp.asarray(options.dt, jax.tree.leaves(inputs)[0].dtype)
    if isinstance(method, Exact):
        # Discretise once outside the loop, since parameters are constant during a run.
        discrete = discretize(model, params, dt, delays, linear)
        return method, ZeroOrderHoldArgs(params, inputs, dt, delays, discrete), term
    if options.substeps < 1:
        raise ValueError(f"substeps must be at least 1, got {options.substeps}")
    args = ZeroOrderHoldArgs(params, inputs, dt, delays, None)
    method = PerSample(method, options.substeps, linear=linear)
    if controller is not None:
        adjoint = dfx.DirectAdjoint() if options.adjoint is None else options.adjoint
        method = Adaptive(method.solver, 1, controller, adjoint, options.max_steps, linear=linear)
    if model.sampled is not None:
        # A traced time cannot be compared: a Problem has compared it.
        if not isinstance(options.dt, core.Tracer):
            require_sample_time(model, options.dt)
        method = AtSamples(method, model.sampled, linear)
    return method, args, term


class _Field(eqx.Module):
    """A vector field in diffrax's form; equal for equal models, so that it is compiled once."""

    State: type = eqx.field(static=True)
    vector_field: Callable[[Any, Any, Any], Any] = eqx.field(static=True)

    def __call__(self, t: Time, x: PyTree, now: PyTree) -> PyTree:
        # Other parts of the state (a running value, a flag) have zero derivative.
        if not isinstance(x, self.State):
            return jax.tree.map(jnp.zeros_like, x)
        if isinstance(now, ZeroOrderHoldArgs):
            return x  # only shapes matter here; the inputs may not be the model's
        if isinstance(now, RampArgs):
            now = now.after(t)
        return self.vector_field(now.params, x, now.inputs)


def field_term(model: Model, vector_field: Callable[[Any, Any, Any], Any]) -> dfx.ODETerm:
    """Return the vector field, per second, within one sample, with the parameters of
    `ZeroOrderHoldArgs`.

    diffrax also evaluates it with the solver's own arguments and state, to compare shapes.
    """
    return dfx.ODETerm(_Field(model.State, vector_field))


# Kalman filters take inputs as a known drive and choose how to multiply B and U: all samples at
# once or in parts.
def held_columns(
    model: Model,
    params: Record,
    inputs: Record,
    dt: Number,
    delay: Number | None,
    linear: tuple[bool, ...] = (),
) -> tuple[Float[Array, "n n"], Float[Array, "n r"], Float[Array, "N r"], Float[Array, "N m"]]:
    """Return Ad, B, U of x[k+1] = Ad x[k] + B U[k] for a linear model, and the inputs acting at k.

    Args:
        dt: sample time [s].
    """
    options = SimulationOptions(dt=dt, solver="exact", delay=delay)
    _, args, _ = per_sample(model, params, inputs, options, linear)
    assert args.discrete is not None
    B, U = columns(args)
    acting = inputs
    if args.delays is not None:
        acting = delayed(inputs, args.delays, jnp.arange(U.shape[0]), linear)
    return args.discrete.Ad, B, U, jnp.stack(jax.tree.leaves(acting), axis=1)
