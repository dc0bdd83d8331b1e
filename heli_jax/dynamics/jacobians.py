"""Derivatives of a model at a point, as matrices.

`linearised` converts any model to the linear model of small motion about a point. The point is part
of its parameters, so that it can be traced, changed and differentiated.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model, field_and_output, zeros
from heli_jax.naming import Record
from heli_jax.numerics.jitted import jitted


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u, in the order of the model's field names."""

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]


@explained
@jitted
def jacobians(
    model: Model, params: Record, state: Record | None = None, inputs: Record | None = None
) -> StateSpace:
    """Return the model's A, B, C, D at a state and inputs.

    Args:
        model: model of one vehicle, with n states, m inputs and p outputs.
        state: state of the point; default: the model's initial state.
        inputs: inputs of the point; default: zero.

    Raises:
        ValueError: the model's functions cannot be traced; TypeError: it is no Model.
    """
    # The dtype is that of the parameters, so a float32 vehicle has float32 matrices in a float64
    # session.
    dtype = jnp.result_type(*(jnp.asarray(v).dtype for v in jax.tree.leaves(params)))
    dtype = dtype if jnp.issubdtype(dtype, jnp.inexact) else jnp.result_type(float)
    x = model.initial_state(params) if state is None else state
    u = zeros(model.Inputs, dtype) if inputs is None else inputs

    def rates_and_outputs(x: Array, u: Array) -> tuple[Array, Array]:
        state, inputs = naming.unravel(model.State, x), naming.unravel(model.Inputs, u)
        rates, outputs = field_and_output(model, params, state, inputs)
        return naming.ravel(rates, dtype), naming.ravel(outputs, dtype)

    # Forward mode needs one column per state and input, and stores no graph. Rates and outputs
    # share most computations, so they are differentiated together.
    at_state, at_inputs = naming.ravel(x, dtype), naming.ravel(u, dtype)
    (A, B), (C, D) = jax.jacfwd(rates_and_outputs, argnums=(0, 1))(at_state, at_inputs)
    return StateSpace(A, B, C, D)


_STATE, _INPUT = "about_state_", "about_input_"
"""Prefixes of the point's values among the parameters."""


# Cached, since each new Model causes compilations.
@functools.cache
def linearised(model: Model) -> Model:
    """Return the model whose states, inputs and outputs are small deviations from a point.

    Its Params (`about`) have the model's own fields and the point's. Delays, disturbances and other
    references to parameters stay.
    """
    more = {_STATE + n: naming.fields(model.State)[n] for n in naming.names(model.State)}
    more |= {_INPUT + n: naming.fields(model.Inputs)[n] for n in naming.names(model.Inputs)}
    Params = naming.extended(
        model.Params, f"{model.Params.__name__}About", {n: (a, None) for n, a in more.items()}
    )

    def own(p: Record) -> Record:
        return model.Params(**{n: getattr(p, n) for n in naming.names(model.Params)})

    def vector_field(p: Record, x: Record, u: Record) -> Record:
        """Return the deviation of the derivatives, to first order."""
        return _slope(lambda s, v: model.vector_field(own(p), s, v), point(model, p), (x, u))

    def output(p: Record, x: Record, u: Record) -> Record:
        """Return the deviation of the outputs, to first order."""
        return _slope(lambda s, v: model.output(own(p), s, v), point(model, p), (x, u))

    return dataclasses.replace(
        model,
        name=f"{model.name}-linearised",
        vector_field=vector_field,
        output=output,
        Params=Params,
        linear=True,
        start=None,
        limits=None,
        steady_flight=None,
        within=None,
    )


def about(model: Model, params: Record, state: Record, inputs: Record) -> Record:
    """Return the Params of `linearised(model)` at a point."""
    values = {_STATE + n: v for n, v in naming.asdict(state).items()}
    values |= {_INPUT + n: v for n, v in naming.asdict(inputs).items()}
    return linearised(model).Params(**naming.asdict(params), **values)


def point(model: Model, params: Record) -> tuple[Record, Record]:
    """Return State and Inputs of the point in the Params of `linearised(model)`."""
    return (
        model.State(**{n: getattr(params, _STATE + n) for n in naming.names(model.State)}),
        model.Inputs(**{n: getattr(params, _INPUT + n) for n in naming.names(model.Inputs)}),
    )


def _slope(function: Any, at: tuple[Record, Record], by: tuple[Record, Record]) -> Record:
    return jax.jvp(function, at, by)[1]
