"""The numbers that an element of a sweep is made of, and the steady flight it may begin in."""

# `Any` below: State, Inputs, Outputs and Params are the user's own classes.

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.trim import STICKS, Trim, equilibrium, plausible
from heli_jax.sweeps import reducers
from heli_jax.sweeps.reducers import Measured
from heli_jax.sweeps.spec import Job, Plan

Scalars = dict[str, jax.Array]
"""numbers () by name"""

# Accelerations [SI] below which a flight is steady. `trim` asks for 1e-10 and tries from several
# places; an element of a batch has one try, and may end a little above.
_TRIMMED = 1e-6


class FlightNumbers(NamedTuple):
    """The numbers of a flight and of the vehicle, in the sweep's precision."""

    # Arguments of the compiled part and no constants in it: another flight of the same length, or
    # another vehicle, needs no new program.

    base: dict[str, Any]
    """the vehicle's"""
    dt: Any
    inputs: Any
    known: dict[str, Any]
    measured: dict[str, Measured]
    """by result, of those that compare with the flight"""
    pilot: Any


def flight_numbers(job: Job, index: int) -> FlightNumbers:
    """The numbers of one of the job's flights."""
    # All numbers are cast here, once: a single float64 among them would make JAX compute in
    # float64.
    dtype, flight, model = np.dtype(job.precision), job.flights[index], job.model
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
        jax.tree.map(lambda v: np.asarray(v, dtype), job.pilot),
    )


class InitialTrim(NamedTuple):
    """The steady flight that an element begins in."""

    state: Any
    sticks: Any
    """the model's Inputs, added to the flight's"""
    sound: Any
    """whether there is such a flight"""


def params_of(plan: Plan, numbers: FlightNumbers, values: Scalars) -> tuple[Any, Scalars]:
    """The element's parameters, and the axes that are not among them."""
    names = naming.names(plan.model.Params)
    swept = {n: v for n, v in values.items() if n in names}
    # In this order: what a flight knows of its machine goes before the vehicle's, an axis before
    # both.
    params = plan.model.Params(**{**numbers.base, **numbers.known, **swept})
    return params, {n: v for n, v in values.items() if n not in names}


def steady(plan: Plan, numbers: FlightNumbers, values: Scalars) -> InitialTrim:
    """The steady flight of one element.

    Args:
        plan: what is compiled; its `trimmed` says which flight.
        numbers: of the flight and the vehicle, SI.
        values: of the axes, scalars, SI.
    """
    assert plan.trimmed is not None
    whole, dtype = plan.trimmed.of or plan.model, numbers.dt.dtype
    params, _ = params_of(plan, numbers, values)
    plain = whole.Params(**{n: getattr(params, n) for n in naming.names(whole.Params)})
    # In the default precision whatever the sweep's: an iteration in float32 ends at residuals that
    # are no proof of a steady flight.
    plain, condition, wind = jax.tree.map(
        lambda v: jnp.asarray(v, jnp.result_type(float)),
        (plain, plan.trimmed.condition, tuple(plan.trimmed.wind)),
    )
    # Of the model without a disturbance: a steady flight is one in still air or steady wind.
    trim = equilibrium(whole, plain, condition, wind)
    sound = _is_trimmed(trim)
    # The states of a disturbance have no trim and keep their own beginning.
    state = naming.replace(plan.model.initial_state(params), **naming.asdict(trim.state))
    share = 1.0 if plan.trimmed.sticks else 0.0
    sticks = jax.tree.map(lambda v: jnp.asarray(share * v, dtype), trim.inputs)
    state = jax.tree.map(lambda v: jnp.asarray(v, dtype), state)
    return InitialTrim(state, sticks, sound)


def _is_trimmed(trim: Trim) -> jax.Array:
    """Whether it is a steady flight that the sticks' travel allows."""
    # `trim` raises where there is none; one of a batch can only be flagged.
    sound = plausible(trim) & (trim.residual < _TRIMMED)
    for name, (low, high) in STICKS.items():
        if not hasattr(trim.inputs, name):
            continue
        stick = getattr(trim.inputs, name)
        # A governor's stick stands at its end, which rounding may pass.
        sound = sound & (stick >= low - _TRIMMED) & (stick <= high + _TRIMMED)
    return sound
