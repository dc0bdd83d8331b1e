"""Solvers that make one step a sample, from a model and its inputs."""

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
from heli_jax.dynamics.model import Model
from heli_jax.naming import Number, Record
from heli_jax.simulation.blocks import columns
from heli_jax.simulation.discretize import discretize
from heli_jax.simulation.hold import FlightOrInputs, delayed, delays_of
from heli_jax.simulation.options import SimulationOptions
from heli_jax.simulation.solvers import (
    RK4,
    Adaptive,
    Exact,
    PerSample,
    RampArgs,
    Time,
    ZeroOrderHoldArgs,
)


def held_inputs(model: Model, flight: FlightOrInputs, dt: Number | None) -> tuple[Record, Number]:
    """The model's Inputs as arrays (N,) and the sample time, from a Flight or from Inputs with dt.

    Args:
        flight: a Flight, or Inputs with arrays (N,).
        dt: [s]; that of the Flight unless given.

    Raises:
        TypeError: what is flown is neither a Flight nor Inputs.
        ValueError: a needed input is missing, the lengths differ, or dt is missing or not above
            zero.
    """
    # By its dictionary, not by its class: anything with `inputs` and `dt` may be a flight, and a
    # model's Inputs may have a field of that name, which is an array.
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
    # Backwards, or on the spot, a run would end like any other. Traced it has no value yet.
    if dt is not None and not isinstance(dt, core.Tracer) and not np.all(np.asarray(dt) > 0):
        raise ValueError(f"dt: expected a sample time above zero [s], got {dt}")
    if dt is None:
        raise ValueError(
            "expected dt, the sample time in seconds, beside inputs given as arrays, got none"
        )
    # Two samples at least: one has no interval, and nothing to integrate over.
    shapes = {u.shape for u in jax.tree.leaves(inputs)}
    if len(shapes) != 1 or any(len(s) != 1 or s[0] < 2 for s in shapes):
        raise ValueError(f"inputs: expected the shape (N,) for all, N >= 2, got {sorted(shapes)}")
    return inputs, dt


def start_state(
    model: Model, params: Record, initial_state: Record | None, inputs: Record
) -> Record:
    """The initial state in the dtype that the parameters and inputs give together.

    Raises:
        TypeError: `params` are none of the model's.
    """
    check_params(model.Params, params)
    # A loop needs one dtype for its state: float32 parameters in a float64 session stay float32,
    # and a state that is given in integers becomes numbers.
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
    # diffrax makes k out of the end and a quotient, off by up to two units in the last place; above
    # this they are half a sample.
    most = round(0.5 / float(jnp.finfo(dtype).eps))
    if samples > most:
        raise ValueError(
            f"expected at most {most} samples in {jnp.dtype(dtype)}, got {samples}: switch to "
            "float64 (jax.config.update('jax_enable_x64', True))"
        )


_LARGE = 8
"""States beyond which the stages of RK4 are a loop: 5 % slower, a quarter of the compilation."""


def _method(model: Model, solver: str | dfx.AbstractSolver | None) -> dfx.AbstractSolver:
    if solver is None:
        solver = "exact" if model.linear else "rk4"
    if solver == "exact":
        if not model.linear:
            raise ValueError(
                f"model {model.name!r} is not linear: expected solver='rk4' or another, got 'exact'"
            )
        return Exact()
    # Long equations are compiled four times over unless the stages are a loop.
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
    """The solver, its arguments and the term for time counted in samples.

    Args:
        options: of which dt, solver, substeps, delay, controller, adjoint and max_steps count.
    """
    # "exact" and "rk4" have no error estimate to adapt to; a controller alone means Dopri8.
    controller, solver = options.controller, options.solver
    method = _method(model, dfx.Dopri8() if controller is not None and solver is None else solver)
    if controller is not None and isinstance(method, Exact | RK4):
        raise ValueError(
            "controller: expected a diffrax solver with an error estimate, such as Dopri8(), got "
            f"{options.solver!r}"
        )
    # Of the parameters at hand, which may be traced: a delay is estimated like any other parameter.
    delays = delays_of(model, params, options.delay, options.dt)

    term = field_term(model, model.vector_field)
    dt = jnp.asarray(options.dt, jax.tree.leaves(inputs)[0].dtype)
    if isinstance(method, Exact):
        # Discretised once, outside the loop: the parameters do not change during a run.
        discrete = discretize(model, params, dt, delays, linear)
        return method, ZeroOrderHoldArgs(params, inputs, dt, delays, discrete), term
    if options.substeps < 1:
        raise ValueError(f"substeps must be at least 1, got {options.substeps}")
    args = ZeroOrderHoldArgs(params, inputs, dt, delays, None)
    if controller is None:
        return PerSample(method, options.substeps, linear=linear), args, term
    adjoint = dfx.DirectAdjoint() if options.adjoint is None else options.adjoint
    adaptive = Adaptive(method, 1, controller, adjoint, options.max_steps, linear=linear)
    return adaptive, args, term


class _Field(eqx.Module):
    """A vector field as diffrax calls it: equal for equal models, so that it is compiled once."""

    State: type = eqx.field(static=True)
    vector_field: Callable[[Any, Any, Any], Any] = eqx.field(static=True)

    def __call__(self, t: Time, x: PyTree, now: PyTree) -> PyTree:
        # What is beside the state (a running value, whether it goes on) does not change with time.
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


# Where a Kalman filter goes through the record, inputs enter as a known drive: how B and U are
# multiplied, all samples at once or some at a time, is left to the filter.
def held_columns(
    model: Model,
    params: Record,
    inputs: Record,
    dt: Number,
    delay: Number | None,
    linear: tuple[bool, ...] = (),
) -> tuple[Float[Array, "n n"], Float[Array, "n r"], Float[Array, "N r"], Float[Array, "N m"]]:
    """x[k+1] = Ad x[k] + B U[k] for a linear model: Ad, B, U, and the inputs that act at k.

    Args:
        dt: [s].
    """
    options = SimulationOptions(dt=dt, solver="exact", delay=delay)
    _, args, _ = per_sample(model, params, inputs, options, linear)
    assert args.discrete is not None
    B, U = columns(args)
    acting = inputs
    if args.delays is not None:
        acting = delayed(inputs, args.delays, jnp.arange(U.shape[0]), linear)
    return args.discrete.Ad, B, U, jnp.stack(jax.tree.leaves(acting), axis=1)
