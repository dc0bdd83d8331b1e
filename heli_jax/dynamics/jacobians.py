"""Derivatives of a model about a point: the matrices that nobody writes by hand."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model, field_and_output, zeros
from heli_jax.naming import Record


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u, in the order of the model's field names."""

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]


@explained
@eqx.filter_jit
def jacobians(
    model: Model, params: Record, state: Record | None = None, inputs: Record | None = None
) -> StateSpace:
    """The model's A, B, C, D at a state and inputs.

    Args:
        model: of one machine, with n states, m inputs and p outputs.
        state: where to differentiate; the model's initial state unless given.
        inputs: likewise; zero unless given.

    Raises:
        ValueError: the model's functions cannot be traced; TypeError: it is no Model.
    """
    # The dtype of the parameters: a float32 vehicle has float32 matrices, in a float64 session too.
    dtype = jnp.result_type(*(jnp.asarray(v).dtype for v in jax.tree.leaves(params)))
    dtype = dtype if jnp.issubdtype(dtype, jnp.inexact) else jnp.result_type(float)
    x = model.initial_state(params) if state is None else state
    u = zeros(model.Inputs, dtype) if inputs is None else inputs

    def rates_and_outputs(x: Array, u: Array) -> tuple[Array, Array]:
        state, inputs = naming.unravel(model.State, x), naming.unravel(model.Inputs, u)
        rates, outputs = field_and_output(model, params, state, inputs)
        return naming.ravel(rates, dtype), naming.ravel(outputs, dtype)

    # Forward mode: as many columns as states and inputs, and no graph of the model is kept. Rates
    # and outputs in one pass, since they share most of what they compute.
    at_state, at_inputs = naming.ravel(x, dtype), naming.ravel(u, dtype)
    (A, B), (C, D) = jax.jacfwd(rates_and_outputs, argnums=(0, 1))(at_state, at_inputs)
    return StateSpace(A, B, C, D)
