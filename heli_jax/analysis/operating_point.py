"""Operating points: the trim or the record's mean about which a nonlinear model is linearised.

The matrices of a helicopter at zero throttle say nothing of one that flies: its rotor stands still.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.linear import modes
from heli_jax.analysis.trim import HOVER, Condition, is_full_nonlinear, trim
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.simulate import simulate
from heli_jax.vehicle import of_helicopter

# params, state and inputs are Any: records of a model, whose classes may be a user's own.


class OperatingPoint(NamedTuple):
    """State and inputs about which a model is linearised; None for those of a linear model, whose
    matrices are the same everywhere."""

    state: Any
    inputs: Any
    words: str
    """`the trim in hover`; empty for a linear model"""


EVERYWHERE = OperatingPoint(None, None, "")


def operating_point(
    model: Model,
    params: Any,
    inputs: Mapping[str, np.ndarray],
    outputs: Mapping[str, np.ndarray],
    dt: float,
    *,
    substeps: int = 4,
) -> OperatingPoint:
    """The point that stands for a record.

    For a whole helicopter it is the trim at the mean speed of the record, as far as positions or
    velocities were measured, else hover. For others it is the mean of the inputs and of the states
    that they give in a simulation, or the initial state where that diverges.

    Args:
        params: its parameters, of this flight, SI.
        inputs: as they act (N,), by name, SI: as logged, times a gain where one was estimated.
        outputs: as measured (N,), by name, SI; NaN where missing.
        dt: sample time [s].
    """
    if model.linear:
        return EVERYWHERE
    # A trim solves for the states that the vehicle has; those of a disturbance are none of them.
    quiet = _undisturbed(model)
    # A trim is a place where the vehicle can stay; the mean of a record is none, and its matrices
    # would hold accelerations that were only passing.
    if is_full_nonlinear(quiet):
        at_trim = _trimmed(quiet, params, mean_condition(outputs, dt))
        if at_trim is not None:
            return at_trim._replace(state=_extended(model, at_trim.state))
    return _mean(model, params, inputs, dt, substeps)


def modes_of_flight(
    model: Model, params: Any, flight: Flight, substeps: int
) -> tuple[np.ndarray, str] | None:
    """Eigenvalues (n,) [1/s] of the model linearised for a flight, and about what, in words; None
    where there are no finite matrices.

    Args:
        params: its parameters, SI; what is known of the flight replaces them.
    """
    here = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    # What is known of this flight first: an added mass moves the trim.
    at = operating_point(model, here, flight.inputs, flight.outputs, flight.dt, substeps=substeps)
    try:
        return modes(model, here, at.state, at.inputs), at.words
    except np.linalg.LinAlgError:  # no finite matrices there: nothing is known of the modes
        return None


def _trimmed(model: Model, params: Any, condition: Condition) -> OperatingPoint | None:
    """The trim at a condition, else in hover; None where there is neither."""
    for flight in dict.fromkeys((condition, HOVER)):
        try:
            steady = trim(model, params, flight)
        except ValueError:  # the vehicle cannot fly so
            continue
        return OperatingPoint(steady.state, steady.inputs, f"the trim {flown(flight)}")
    return None


def _mean(
    model: Model,
    params: Any,
    inputs: Mapping[str, np.ndarray],
    dt: float,
    substeps: int,
) -> OperatingPoint:
    """The mean of the inputs, and of the states that they give."""
    acting = {n: np.asarray(inputs[n]) for n in naming.names(model.Inputs)}
    dtype = jnp.result_type(float)
    mean = model.Inputs(**{n: jnp.asarray(u.mean(), dtype) for n, u in acting.items()})
    driven = model.Inputs(**{n: jnp.asarray(u, dtype) for n, u in acting.items()})
    # Not the equilibrium of the mean inputs: a model of one's own may have none.
    state = _mean_state(model, params, driven, jnp.asarray(dt, dtype), substeps)
    if all(bool(np.isfinite(v)) for v in jax.tree.leaves(state)):
        return OperatingPoint(state, mean, "the record's mean")
    start = jax.tree.map(lambda v: jnp.asarray(v, dtype), model.initial_state(params))
    return OperatingPoint(start, mean, "the initial state and the record's mean inputs")


@jitted
def _mean_state(model: Model, params: Any, inputs: Any, dt: Float[Array, ""], substeps: int) -> Any:
    run = simulate(model, params, inputs, dt=dt, substeps=substeps)
    return jax.tree.map(lambda x: jnp.mean(x), run.states)


# Cached, since a new Model is a new program to every function that is compiled for one.
@functools.cache
def _undisturbed(model: Model) -> Model:
    """A helicopter's model without the states of a disturbance; any other model as it is."""
    # `with_disturbance` calls its states w1, w2.
    names = naming.names(model.State)
    kept = [n for n in names if not (n[:1] == "w" and n[1:2].isdigit())]
    if len(kept) == len(names) or not of_helicopter(model.Params):
        return model
    fields = naming.fields(model.State)
    State: Any = NamedTuple("State", [(n, fields[n]) for n in kept])  # type: ignore[misc]

    def vector_field(p: Any, s: Any, u: Any) -> Any:
        """The model's derivatives where the disturbance is zero."""
        rates = model.vector_field(p, _extended(model, s), u)
        return State(**{n: getattr(rates, n) for n in kept})

    limits = model.limits
    return Model(
        model.name,
        vector_field,
        lambda p, s, u: model.output(p, _extended(model, s), u),
        model.Params,
        State,
        model.Inputs,
        model.Outputs,
        limits=None if limits is None else lambda p, s, u: limits(p, _extended(model, s), u),
        steady_flight=model.steady_flight,
    )


def _extended(model: Model, state: Any) -> Any:
    """The model's State with zero where the given one has nothing."""
    values = naming.asdict(state)
    # Of the given dtype: strict promotion raises where a float32 state meets a float64 zero.
    zero: Array = jnp.zeros((), jnp.result_type(*(jnp.asarray(v) for v in values.values())))
    return model.State(**{n: values.get(n, zero) for n in naming.names(model.State)})


_SLOW = 0.5
"""m/s: a record of less mean speed is of hover"""


def mean_condition(outputs: Mapping[str, np.ndarray], dt: float) -> Condition:
    """The mean motion of a record; hover where it is slow or nothing tells.

    Args:
        outputs: as measured (N,), by name, SI; NaN where missing.
        dt: sample time [s].
    """
    dx, dy, dz = (_mean_rate(outputs, axis, dt) for axis in "xyz")
    psi = mean_heading(outputs)
    # From the axes of the ground to those of the heading, which a trim speaks of.
    forward, lateral = dx * np.cos(psi) + dy * np.sin(psi), dy * np.cos(psi) - dx * np.sin(psi)
    # Records of hover drift: their trim would be called one of forward flight.
    forward, lateral, up = (float(v) if abs(v) >= _SLOW else 0.0 for v in (forward, lateral, dz))
    return Condition(forward, lateral, up, psi) if forward or lateral or up else HOVER


def mean_heading(outputs: Mapping[str, np.ndarray]) -> float:
    """The mean of psi [rad]; 0 where it was not measured.

    Args:
        outputs: as measured (N,), by name, SI; NaN where missing.
    """
    psi = outputs.get("yaw")
    # A circular mean: headings on either side of south are near one another, and far in numbers.
    return 0.0 if psi is None else float(np.angle(np.nanmean(np.exp(1j * psi))))


def _mean_rate(outputs: Mapping[str, np.ndarray], axis: str, dt: float) -> float:
    """Mean velocity along an axis [m/s], from what was measured of it."""
    # A measured velocity tells more than two noisy positions at the ends of the record.
    if f"d{axis}" in outputs:
        return float(np.nanmean(outputs[f"d{axis}"]))
    if axis in outputs:
        seen = np.flatnonzero(np.isfinite(outputs[axis]))
        if seen.size > 1:
            first, last = seen[0], seen[-1]
            return float((outputs[axis][last] - outputs[axis][first]) / ((last - first) * dt))
    return 0.0


def flown(condition: Condition) -> str:
    """A condition in words: `in hover`, `at 12 m/s ahead`."""
    named = (
        ("ahead", condition.forward_speed),
        ("to the right", condition.lateral_speed),
        ("up", condition.climb),
    )
    parts = [f"{v:.2g} m/s {n}" for n, v in named if v]
    return f"at {', '.join(parts)}" if parts else "in hover"
