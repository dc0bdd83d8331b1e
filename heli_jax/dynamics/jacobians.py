"""Derivatives of a model about a point: the matrices that nobody writes by hand."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.model import Model, zeros


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u, in the order of the model's field names."""

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]


@explained
@eqx.filter_jit
def jacobians(model: Model, params: Any, state: Any = None, inputs: Any = None) -> StateSpace:
    """The model's A, B, C, D at a state and inputs, by forward mode.

    Unless given the state is the model's initial one and the inputs are zero.

    Raises:
        ValueError: the model's functions cannot be traced; TypeError: it is no Model.
    """
    dtype = jnp.result_type(*(jnp.asarray(v).dtype for v in jax.tree.leaves(params)))
    dtype = dtype if jnp.issubdtype(dtype, jnp.inexact) else jnp.result_type(float)
    x = model.initial_state(params) if state is None else state
    u = zeros(model.Inputs, dtype) if inputs is None else inputs

    def stacked(record: Any) -> Array:
        return jnp.stack([jnp.asarray(v, dtype) for v in naming.asdict(record).values()])

    def unstacked(record: type, vector: Array) -> Any:
        return record(**dict(zip(naming.names(record), vector, strict=True)))

    def f(xv: Array, uv: Array) -> tuple[Array, Array]:
        xr, ur = unstacked(model.State, xv), unstacked(model.Inputs, uv)
        return stacked(model.vector_field(params, xr, ur)), stacked(model.output(params, xr, ur))

    (A, B), (C, D) = jax.jacfwd(f, argnums=(0, 1))(stacked(x), stacked(u))
    return StateSpace(A, B, C, D)
