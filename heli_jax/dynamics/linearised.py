"""The linear model of small motion about a point, for any model.

The point is part of its parameters, so that it may be traced, moved and differentiated.
"""

import dataclasses
import functools
from typing import Any

import jax

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record

_STATE, _INPUT = "about_state_", "about_input_"
"""how the point's numbers are called among the parameters"""


# Cached, since a new Model is a new program to every function that is compiled for one.
@functools.cache
def linearised(model: Model) -> Model:
    """The model whose states, inputs and outputs are small deviations from a point.

    Its Params (`about`) have the model's own fields and the point's. Delays, disturbances and what
    else is named by parameters stay as they are.
    """
    more = {_STATE + n: naming.fields(model.State)[n] for n in naming.names(model.State)}
    more |= {_INPUT + n: naming.fields(model.Inputs)[n] for n in naming.names(model.Inputs)}
    Params = naming.extended(
        model.Params, f"{model.Params.__name__}About", {n: (a, None) for n, a in more.items()}
    )

    def own(p: Record) -> Record:
        return model.Params(**{n: getattr(p, n) for n in naming.names(model.Params)})

    def vector_field(p: Record, x: Record, u: Record) -> Record:
        """The derivatives' deviation, to first order."""
        return _slope(lambda s, v: model.vector_field(own(p), s, v), point(model, p), (x, u))

    def output(p: Record, x: Record, u: Record) -> Record:
        """The outputs' deviation, to first order."""
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
        without_stand=None,
        within=None,
    )


def about(model: Model, params: Record, state: Record, inputs: Record) -> Record:
    """The Params of `linearised(model)` at a point."""
    values = {_STATE + n: v for n, v in naming.asdict(state).items()}
    values |= {_INPUT + n: v for n, v in naming.asdict(inputs).items()}
    return linearised(model).Params(**naming.asdict(params), **values)


def point(model: Model, params: Record) -> tuple[Record, Record]:
    """State and Inputs of the point that Params of `linearised(model)` hold."""
    return (
        model.State(**{n: getattr(params, _STATE + n) for n in naming.names(model.State)}),
        model.Inputs(**{n: getattr(params, _INPUT + n) for n in naming.names(model.Inputs)}),
    )


def _slope(function: Any, at: tuple[Record, Record], by: tuple[Record, Record]) -> Record:
    return jax.jvp(function, at, by)[1]
