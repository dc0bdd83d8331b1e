"""Where a model starts: an initial state with some values given, and whether it can start there."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.model import Model, field_and_output, plain
from heli_jax.naming import Record


def starting_at(model: Model, values: Mapping[str, float]) -> Model:
    """The model with an initial state that has the given values [SI] of some states.

    Raises:
        ValueError: a state that the model does not have.
    """
    for name in values:
        if name not in naming.names(model.State):
            raise ValueError(f"model {model.name} has no state {name!r}")

    def start(params: Record) -> Record:
        # The values take the dtype of what they replace, or a float32 run would become a mixed one.
        state = naming.asdict(model.initial_state(params))
        changed = {n: jnp.asarray(v, jnp.asarray(state[n]).dtype) for n, v in values.items()}
        return model.State(**{**state, **changed})

    return dataclasses.replace(model, start=start)


def cannot_start(model: Model, params: Record, inputs: Mapping[str, float] | None = None) -> str:
    """Why a model cannot begin at its initial state, with the remedy; empty where it can.

    Rates and outputs have to be finite there, and their derivatives by the states.

    Args:
        params: the model's Params, SI; concrete numbers.
        inputs: at the first sample; zero where not given.
    """
    params = plain(params)
    names = naming.names(model.State)
    state = naming.asdict(model.initial_state(params))
    x = {n: np.float64(state[n]) for n in names}
    u = model.Inputs(
        **{n: np.float64((inputs or {}).get(n, 0.0)) for n in naming.names(model.Inputs)}
    )
    # In NumPy's numbers, outside of jit: a model is asked at one point, and compiling it would take
    # longer.
    bad = _not_finite(model, params, x, u)
    if not bad:
        return ""
    # A model that divides by an airspeed cannot begin at rest, and what JAX says of it is an array
    # of NaN. So each state at zero is moved to one, to see which of them is the cause: first alone,
    # then all together, as where two of them make up a speed.
    zero = [n for n in names if x[n] == 0.0]
    cause = [n for n in zero if len(_not_finite(model, params, {**x, n: _ONE}, u)) < len(bad)]
    if not cause and not _not_finite(model, params, {**x, **dict.fromkeys(zero, _ONE)}, u):
        cause = zero
    verb = "is" if len(bad) == 1 else "are"
    what = f"model {model.name}: {' and '.join(bad)} {verb} not finite at the initial state"
    if not cause:
        where = ", ".join(f"{n} = {x[n]:g}" for n in names)
        return f"{what} ({where}); expected another Model.start, other parameters or inputs"
    where = ", ".join(f"{n} = 0" for n in cause)
    example = ", ".join(f"{n}: 1.0" for n in cause)
    return (
        f"{what}, where {where}; expected a Model.start that begins elsewhere, or in a "
        f"configuration initial_state: {{{example}}} with the value of the record"
    )


_ONE = np.float64(1.0)


def _not_finite(model: Model, params: Record, x: dict[str, Any], u: Record) -> tuple[str, ...]:
    """The rates and outputs that are not finite at a point, or whose derivatives are not."""
    with np.errstate(all="ignore"):
        rates, outputs = field_and_output(model, params, model.State(**x), u)
    values = {f"the rate of {n}": v for n, v in naming.asdict(rates).items()}
    values |= {f"output {n}": v for n, v in naming.asdict(outputs).items()}
    bad = tuple(n for n, v in values.items() if not np.isfinite(float(v)))
    # Derivatives only where the values are finite: those of a value that is none say nothing more.
    return bad or _no_slope(model, params, x, u)


def _no_slope(model: Model, params: Record, x: dict[str, Any], u: Record) -> tuple[str, ...]:
    """The rates whose derivatives by the states are not finite, such as that of a root at zero."""

    def rates(x: Array) -> Array:
        return naming.ravel(model.vector_field(params, naming.unravel(model.State, x), u))

    # By JAX, not by differences: sqrt(V2) at rest is finite and so are its differences, but a fit's
    # gradient through it is not.
    slopes = jax.jacfwd(rates)(naming.ravel(model.State(**x), jnp.result_type(float)))
    finite = np.isfinite(np.asarray(slopes)).all(axis=1)
    names = naming.names(model.State)
    return tuple(f"the slope of the rate of {names[i]}" for i in np.flatnonzero(~finite))
