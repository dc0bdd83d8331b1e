"""What a script may pass for a Problem, said in words where it passed something else."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.check_model import check_params
from heli_jax.flights.flight import Flight
from heli_jax.identification.free import Free, Prior

_HEADINGS = {"psi", "yaw"}
"""angles that may go on for more than a turn"""
_FURTHEST = 6 * math.pi
"""rad: linear models of an axis roll over in long records, with no pilot to hold them"""
_HALF_TURN = 1.1 * math.pi
"""rad that nothing but an unwrapped roll or loop goes beyond"""
_FASTEST, _OVER = 15.0, 0.1
"""rad/s, 860 deg/s: no helicopter turns as fast for that many seconds"""


def check_arguments(params: type, vehicle: Any, flights: Any, free: Any) -> None:
    """Refuse what is of another kind than it has to be.

    Args:
        params: the model's class of parameters.
        vehicle: should be one of these.
        flights: should be a sequence of Flights.
        free: should be Free by name.

    Raises:
        TypeError: naming the argument, what was expected and what was found.
    """
    check_params(params, vehicle)
    if isinstance(flights, Flight):
        raise TypeError("flights: expected a list of Flights, got one; pass [flight]")
    if not isinstance(flights, Sequence) or not all(isinstance(f, Flight) for f in flights):
        raise TypeError(f"flights: expected a list of Flights, got {_kinds(flights)}")
    if not isinstance(free, Mapping):
        raise TypeError(
            "free: expected Free by the parameter's name, as {'Ixx': Free(0.02)}, got "
            f"{type(free).__name__}"
        )
    for name, each in free.items():
        if not isinstance(each, Free):
            got = f"the number {each:g}" if isinstance(each, int | float) else type(each).__name__
            example = f"Free({each:g})" if isinstance(each, int | float) else "Free(start)"
            raise TypeError(f"free: {name}: expected {example}, got {got}")
        numbers = {"start": each.start, "lower": each.lower, "upper": each.upper}
        if isinstance(each.prior, Prior):
            numbers |= {"prior.mean": each.prior.mean, "prior.sd": each.prior.sd}
        elif each.prior is not None:
            raise TypeError(
                f"free.{name}.prior: expected Prior(mean, sd), got {type(each.prior).__name__}"
            )
        for key, value in numbers.items():
            if value is not None and not _is_number(value):
                raise TypeError(f"free.{name}.{key}: expected a number, got {value!r:.60}")


def _is_number(value: Any) -> bool:
    """Of Python, NumPy or JAX; True is none, though Python counts with it."""
    shape, kind = getattr(value, "shape", ()), getattr(value, "dtype", np.dtype(type(value))).kind
    return shape == () and kind in "iuf"


def _kinds(flights: Any) -> str:
    if isinstance(flights, str | bytes) or not isinstance(flights, Sequence):
        return type(flights).__name__
    other = next(f for f in flights if not isinstance(f, Flight))
    return f"{type(other).__name__} among them; heli_jax.read_flight(path, ...) reads a log"


def warn_of_degrees(outputs: type, flights: Sequence[Flight]) -> None:
    """Warn of angles that turn further or faster than a helicopter does, as degrees would.

    Args:
        outputs: the model's class, which has the units.
        flights: those made in Python; of a log its unit is stated and checked.
    """
    for flight in flights:
        for name, values in flight.outputs.items():
            of_angle = name in naming.names(outputs) and naming.unit(outputs, name) == "rad"
            if flight.source is not None or not of_angle or name in _HEADINGS:
                continue
            y = np.asarray(values, float)
            largest, fastest = float(np.nanmax(np.abs(y), initial=0.0)), _rate(y, flight.dt)
            if largest > _FURTHEST:
                found = f"{largest:.4g} rad, more than three turns"
            elif largest > _HALF_TURN and fastest > _FASTEST:
                found = f"{largest:.3g} rad and {fastest:.2g} rad/s, faster than helicopters turn"
            else:
                continue
            warnings.warn(
                f"{flight.name or 'a flight'}: {name} reaches {found}; angles are in radians here: "
                "np.radians(degrees)",
                UserWarning,
                stacklevel=4,
            )


def _rate(y: np.ndarray, dt: float) -> float:
    """How fast an angle (N,) [rad] turns at its fastest [rad/s], single wild samples left out."""
    steps = max(1, round(_OVER / dt))
    turned = np.abs(y[steps:] - y[:-steps])
    turned = turned[np.isfinite(turned)]
    return float(np.quantile(turned, 0.98)) / (steps * dt) if turned.size else 0.0
