"""Linearisation of nonlinear models at the operating point of a flight, for fits in frequency.

The operating point of a full helicopter is the trim at the flight's mean speed. For other models it
is the equilibrium at the mean inputs, or the initial state if there is none. The point depends on
the parameters, with the derivative of an implicit function.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from heli_jax import naming
from heli_jax.analysis.operating_point import mean_condition, mean_heading
from heli_jax.analysis.trim import Condition, equilibrium, is_full_nonlinear, trim
from heli_jax.dynamics.jacobians import about, linearised
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.simulated_flights import Drive
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Layout

# Params, State and Inputs are Any, because they are a model's own classes.

_STEADY = 1e-6
"""Largest rates of an equilibrium, relative to those at the initial state."""


def condition_of(model: Model, flight: Flight) -> Condition | None:
    """Return the steady flight at which a full helicopter is linearised; None for other models."""
    if model.linear or not is_full_nonlinear(model):
        return None
    condition = mean_condition(flight.outputs, flight.dt)
    # The heading matters in hover too, because it mixes positions and velocities in ground axes.
    return condition._replace(heading=mean_heading(flight.outputs))


def cannot_linearise(problem: Problem) -> str | None:
    """Return the reason why a flight has no trim to linearise the model at, or None."""
    for flight in problem.training:
        condition = condition_of(problem.model, flight)
        if condition is None:
            continue
        try:
            trim(problem.model, problem.start_params(flight.known), condition)
        except ValueError as e:
            return f"the model cannot be linearised for {flight.name or 'a flight'}: {e}"
    return None


def linear_drive(layout: Layout, drive: Drive, condition: Condition | None) -> tuple[Model, Drive]:
    """Return a linear model of a flight, and its inputs and parameters.

    Args:
        condition: result of `condition_of`.
    """
    model = layout.model
    if model.linear:
        return model, drive
    if condition is None:
        inputs = jax.tree.map(jnp.mean, drive.inputs)
        state = _equilibrium_at(model, drive.params, inputs)
    else:
        steady = equilibrium(model, drive.params, condition)
        state, inputs = steady.state, steady.inputs
    return linearised(model), drive._replace(params=about(model, drive.params, state, inputs))


def _equilibrium_at(model: Model, params: Any, inputs: Any) -> Any:
    """Return the equilibrium State for constant inputs, or the initial state if there is none."""
    start = naming.ravel(model.initial_state(params), jnp.result_type(float))

    def rates(x: Array, arguments: Any) -> Array:
        p, u = arguments
        return naming.ravel(model.vector_field(p, naming.unravel(model.State, x), u), x.dtype)

    still = jax.lax.stop_gradient((params, inputs))
    # The search is damped, so that states without an equilibrium, like a heading, keep their start.
    solution = optx.root_find(
        rates,
        optx.LevenbergMarquardt(1e-12, 1e-12),
        jax.lax.stop_gradient(start),
        args=still,
        max_steps=100,
        throw=False,
    )
    x = jax.lax.stop_gradient(solution.value)
    size = 1.0 + jnp.max(jnp.abs(rates(start, still)))
    rest = jnp.max(jnp.abs(rates(x, still))) <= _STEADY * size
    inverse = jax.lax.stop_gradient(jnp.linalg.pinv(jax.jacfwd(rates)(x, still)))
    # One more Newton step has the derivative of the root by the parameters.
    x = x - inverse @ rates(x, (params, inputs))
    return naming.unravel(model.State, jnp.where(rest, x, start))
