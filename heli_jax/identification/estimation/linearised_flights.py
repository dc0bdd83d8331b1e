"""Models that are not linear, for a method that needs one that is: linearised where they fly.

Of a whole helicopter that is the trim at the flight's mean speed; of other models the equilibrium
at the mean of its inputs, or where there is none the model's initial state. The point moves with
the parameters: its derivative is that of an implicit function.
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

# Params, State and Inputs are a model's own classes: they are annotated Any.

_STEADY = 1e-6
"""of the rates at the initial state, and [SI], below which those of an equilibrium are zero"""


def condition_of(model: Model, flight: Flight) -> Condition | None:
    """The steady flight about which a flight of a whole helicopter is linearised; None for others.

    Args:
        model: of the machine.
        flight: as measured.
    """
    if model.linear or not is_full_nonlinear(model):
        return None
    condition = mean_condition(flight.outputs, flight.dt)
    # Positions and velocities along the ground's axes mix with the heading in hover too.
    return condition._replace(heading=mean_heading(flight.outputs))


def cannot_linearise(problem: Problem) -> str | None:
    """Why a flight's model has no point to be linearised about; None where each has one.

    Args:
        problem: with the vehicle at its start values.
    """
    for flight in problem.training:
        condition = condition_of(problem.model, flight)
        if condition is None:
            continue
        known = {n: jnp.asarray(v) for n, v in flight.known.items()}
        try:
            trim(problem.model, naming.replace(problem.start_params(), **known), condition)
        except ValueError as e:
            return f"the model cannot be linearised for {flight.name or 'a flight'}: {e}"
    return None


def linear_drive(
    layout: Layout, drive: Drive, condition: Condition | None
) -> tuple[Model, Drive, Array]:
    """A linear model of a flight, what drives it, and whether its point is one of rest.

    Args:
        layout: of the problem.
        drive: of the model itself.
        condition: of `condition_of`.
    """
    model = layout.model
    if model.linear:
        return model, drive, jnp.asarray(True)
    if condition is None:
        inputs = jax.tree.map(jnp.mean, drive.inputs)
        state, rest = _rest(model, drive.params, inputs)
    else:
        steady = equilibrium(model, drive.params, condition)
        state, inputs, rest = steady.state, steady.inputs, steady.residual < _STEADY
    params = about(model, drive.params, state, inputs)
    return linearised(model), drive._replace(params=params), rest


def _rest(model: Model, params: Any, inputs: Any) -> tuple[Any, Array]:
    """The State at which constant inputs leave the model, and whether there is one; else the
    initial state."""
    start = naming.ravel(model.initial_state(params), jnp.result_type(float))

    def rates(x: Array, arguments: Any) -> Array:
        p, u = arguments
        return naming.ravel(model.vector_field(p, naming.unravel(model.State, x), u), x.dtype)

    still = jax.lax.stop_gradient((params, inputs))
    # Damped: what has no place of its own, as a heading, stays where the model begins.
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
    # One more step of Newton's, which has the derivative of the root by the parameters.
    x = x - inverse @ rates(x, (params, inputs))
    return naming.unravel(model.State, jnp.where(rest, x, start)), rest
