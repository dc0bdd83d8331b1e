"""Operating points: trim, or mean of a record, for the linearisation of a nonlinear model.

At zero throttle a helicopter's rotor stands still, so matrices there do not describe flight.
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

# params, state and inputs are records of a model's own classes, hence Any.


class OperatingPoint(NamedTuple):
    """State and inputs at which a model is linearised; None for a linear model."""

    state: Any
    inputs: Any
    words: str
    """Description, such as `the trim in hover`; empty for a linear model."""


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
    """Return the operating point of a record.

    For a whole helicopter it is the trim at the record's mean speed, if positions or velocities
    were measured, else hover. For others it is the mean of the inputs and of the simulated states,
    or the initial state if the simulation diverges.

    Args:
        params: the model's parameters in this flight, SI.
        inputs: acting inputs (N,), by name, SI: as logged, times a gain if one was estimated.
        outputs: measured outputs (N,), by name, SI; NaN where missing.
        dt: sample time [s].
    """
    if model.linear:
        return EVERYWHERE
    # A trim solves for the vehicle's states, without those of a disturbance.
    quiet = _undisturbed(model)
    # A trim is an equilibrium. The mean of a record is not, and its matrices would include
    # transient accelerations.
    if is_full_nonlinear(quiet):
        at_trim = _trimmed(quiet, params, mean_condition(outputs, dt))
        if at_trim is not None:
            return at_trim._replace(state=_extended(model, at_trim.state))
    return _mean(model, params, inputs, dt, substeps)


def modes_of_flight(
    model: Model, params: Any, flight: Flight, substeps: int
) -> tuple[np.ndarray, str] | None:
    """Return the eigenvalues (n,) [1/s] of a model linearised for a flight, and the point in words.

    Returns None if the matrices are not finite, or for a model with a controller, which acts at
    samples.

    Args:
        params: the model's parameters, SI; known values of the flight replace them.
    """
    if model.sampled is not None:
        return None
    here = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    # Known values of the flight come first, since an added mass changes the trim.
    at = operating_point(model, here, flight.inputs, flight.outputs, flight.dt, substeps=substeps)
    try:
        return modes(model, here, at.state, at.inputs), at.words
    except np.linalg.LinAlgError:  # matrices are not finite, so the modes are unknown
        return None


def _trimmed(model: Model, params: Any, condition: Condition) -> OperatingPoint | None:
    """Return the trim at a condition, else in hover; None if there is neither."""
    for flight in dict.fromkeys((condition, HOVER)):
        try:
            steady = trim(model, params, flight)
        except ValueError:  # the vehicle cannot fly this condition
            continue
        return OperatingPoint(steady.state, steady.inputs, f"the trim {condition_in_words(flight)}")
    return None


def _mean(
    model: Model,
    params: Any,
    inputs: Mapping[str, np.ndarray],
    dt: float,
    substeps: int,
) -> OperatingPoint:
    """Return the mean of the inputs, and of the simulated states."""
    acting = {n: np.asarray(inputs[n]) for n in naming.names(model.Inputs)}
    dtype = jnp.result_type(float)
    mean = model.Inputs(**{n: jnp.asarray(u.mean(), dtype) for n, u in acting.items()})
    driven = model.Inputs(**{n: jnp.asarray(u, dtype) for n, u in acting.items()})
    # A user's model may lack an equilibrium of the mean inputs.
    state = _mean_state(model, params, driven, jnp.asarray(dt, dtype), substeps)
    if all(bool(np.isfinite(v)) for v in jax.tree.leaves(state)):
        return OperatingPoint(state, mean, "the record's mean")
    start = jax.tree.map(lambda v: jnp.asarray(v, dtype), model.initial_state(params))
    return OperatingPoint(start, mean, "the initial state and the record's mean inputs")


@jitted
def _mean_state(model: Model, params: Any, inputs: Any, dt: Float[Array, ""], substeps: int) -> Any:
    run = simulate(model, params, inputs, dt=dt, substeps=substeps)
    return jax.tree.map(lambda x: jnp.mean(x), run.states)


# Cached, since each new Model causes compilations.
@functools.cache
def _undisturbed(model: Model) -> Model:
    """Return a helicopter's model without the states of a disturbance; other models unchanged."""
    # `with_disturbance` names its states w1, w2.
    names = naming.names(model.State)
    kept = [n for n in names if not (n[:1] == "w" and n[1:2].isdigit())]
    if len(kept) == len(names) or not of_helicopter(model.Params):
        return model
    fields = naming.fields(model.State)
    State: Any = NamedTuple("State", [(n, fields[n]) for n in kept])  # type: ignore[misc]

    def vector_field(p: Any, s: Any, u: Any) -> Any:
        """Return the model's derivatives at zero disturbance."""
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
    """Return the model's State, with zero for missing states."""
    values = naming.asdict(state)
    # Use the given dtype, since strict promotion raises for a float32 state with a float64 zero.
    zero: Array = jnp.zeros((), jnp.result_type(*(jnp.asarray(v) for v in values.values())))
    return model.State(**{n: values.get(n, zero) for n in naming.names(model.State)})


_SLOW = 0.5
"""Mean speed below which a record is hover [m/s]."""


def mean_condition(outputs: Mapping[str, np.ndarray], dt: float) -> Condition:
    """Return the mean motion of a record; hover if it is slow or not measured.

    Args:
        outputs: measured outputs (N,), by name, SI; NaN where missing.
        dt: sample time [s].
    """
    dx, dy, dz = (_mean_rate(outputs, axis, dt) for axis in "xyz")
    psi = mean_heading(outputs)
    # Convert from ground axes to the heading, which a trim uses.
    forward, lateral = dx * np.cos(psi) + dy * np.sin(psi), dy * np.cos(psi) - dx * np.sin(psi)
    # Hover records drift. Their trim must not be called forward flight.
    forward, lateral, up = (float(v) if abs(v) >= _SLOW else 0.0 for v in (forward, lateral, dz))
    return Condition(forward, lateral, up, psi) if forward or lateral or up else HOVER


def mean_heading(outputs: Mapping[str, np.ndarray]) -> float:
    """Return the mean of psi [rad]; 0 if not measured.

    Args:
        outputs: measured outputs (N,), by name, SI; NaN where missing.
    """
    psi = outputs.get("yaw")
    # A circular mean, since headings on either side of south are close but differ by 2 pi.
    return 0.0 if psi is None else float(np.angle(np.nanmean(np.exp(1j * psi))))


def _mean_rate(outputs: Mapping[str, np.ndarray], axis: str, dt: float) -> float:
    """Return the mean velocity along an axis [m/s], from the measured outputs."""
    # A measured velocity is more accurate than two noisy positions at the ends of the record.
    if f"d{axis}" in outputs:
        return float(np.nanmean(outputs[f"d{axis}"]))
    if axis in outputs:
        seen = np.flatnonzero(np.isfinite(outputs[axis]))
        if seen.size > 1:
            first, last = seen[0], seen[-1]
            return float((outputs[axis][last] - outputs[axis][first]) / ((last - first) * dt))
    return 0.0


def condition_in_words(condition: Condition) -> str:
    """Return a condition in words: `in hover`, `at 12 m/s ahead`."""
    named = (
        ("ahead", condition.forward_speed),
        ("to the right", condition.lateral_speed),
        ("up", condition.climb),
    )
    parts = [f"{v:.2g} m/s {n}" for n, v in named if v]
    return f"at {', '.join(parts)}" if parts else "in hover"
