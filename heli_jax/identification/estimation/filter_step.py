"""What a Kalman filter runs on: the drive of a record, and what a step needs of a model."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from heli_jax.dynamics.model import Model
from heli_jax.simulation.options import SimulationOptions

# Params and Inputs are a model's own classes: they are annotated Any.

type Estimate = tuple[Float[Array, " n"], Float[Array, "n n"]]
"""a state and its covariance"""


class Drive(NamedTuple):
    """A model, what drives it along one record, and what is measured of it."""

    model: Model
    params: Any
    inputs: Any
    """the model's Inputs, arrays (N,)"""
    options: SimulationOptions
    linear: tuple[bool, ...]
    """of each input whether it moves between samples; () where none does"""
    rows: Array
    """where the measured outputs stand among the model's (p,)"""


class Filter(NamedTuple):
    """What a step of the filter needs of a model; `samples` is a pytree of arrays (N, ...)."""

    samples: Any
    measure: Callable[[Array, Any], tuple[Array, Array]]
    """(state, sample) -> C (p, n) and what C x leaves of the predicted outputs (p,)"""
    move: Callable[[Array, Array, Any], Estimate]
    """(state, its covariance, sample) -> both at the next sample"""
