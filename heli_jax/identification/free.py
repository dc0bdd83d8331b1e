"""Free: a parameter to be estimated, and what makes no sense of one."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.check_model import check_params
from heli_jax.dynamics.model import Model
from heli_jax.errors import nearest
from heli_jax.flights.flight import Flight


class Prior(NamedTuple):
    """What is known of a parameter beforehand: a normal distribution, in the parameter's unit."""

    mean: float
    sd: float


Sign = Literal["keep", "any"]


class Free(NamedTuple):
    """A parameter to be estimated: where to start, between what bounds, with what prior.

    `sign` says whether the estimate may have another sign than the start: `keep` (searched in its
    logarithm) or `any` (searched in units of its start, which may then be zero). Unless given, a
    Helicopter's parameters keep theirs, and so do those that `Model.positive` names; others of a
    model of one's own may have any. Bounds that lie on one side of zero keep it in either case.
    """

    start: float = math.nan
    """the initial guess; NaN where none is stated, and one has to be found before a Problem is made
    (`equation_error_start`)"""
    lower: float | None = None
    upper: float | None = None
    prior: Prior | None = None
    sign: Sign | None = None


def check_free(name: str, free: Free, model: Model) -> None:
    """Refuse a free parameter that the model does not have, or whose numbers contradict.

    Args:
        free: its start, bounds, prior and sign; the sign is filled in.

    Raises:
        ValueError: naming the key, what was expected and what was got.
    """
    if name not in naming.names(model.Params):
        known = naming.names(model.Params)
        raise ValueError(
            f"free.{name}: model {model.name} has no such parameter{nearest(name, known)}"
        )
    if math.isnan(free.start):
        raise ValueError(
            f"free.{name}.start: missing, expected a number to begin with (or, for a linear model, "
            "start: equation-error, which finds one)"
        )
    numbers = {"start": free.start, "lower": free.lower, "upper": free.upper}
    if free.prior is not None:
        numbers |= {"prior.mean": free.prior.mean, "prior.sd": free.prior.sd}
    for key, value in numbers.items():
        if value is not None and not math.isfinite(value):
            raise ValueError(f"free.{name}.{key}: expected a finite number, got {value}")
    if free.prior is not None and free.prior.sd <= 0:
        raise ValueError(f"free.{name}.prior.sd must be above zero, got {free.prior.sd:g}")
    # None is no answer any more: the Problem has filled it in by the kind of model.
    if free.sign not in ("keep", "any"):
        raise ValueError(f"free.{name}.sign: expected 'keep' or 'any', got {free.sign!r}")
    if name in model.positive:
        _check_positive(name, free)
    _check_bounds(name, free)


def _check_bounds(name: str, free: Free) -> None:
    low, high = free.lower, free.upper
    if free.sign == "keep" and low is not None and high is not None and low < 0 < high:
        raise ValueError(
            f"free.{name}.sign: keep: expected bounds of one sign, got {low:g} to {high:g}"
        )
    if low is not None and high is not None and low >= high:
        raise ValueError(f"free.{name}: lower must be below upper, got {low:g} and {high:g}")
    # Not on a bound either: in the coordinates of a bounded parameter its ends are at infinity.
    if (low is not None and free.start <= low) or (high is not None and free.start >= high):
        shown = (
            f"{'-inf' if low is None else f'{low:g}'} to {'inf' if high is None else f'{high:g}'}"
        )
        raise ValueError(f"free.{name}.start: expected a value inside {shown}, got {free.start:g}")
    # Zero has no logarithm; between two bounds the search is in another coordinate.
    if free.start == 0 and free.sign == "keep" and (low is None or high is None):
        raise ValueError(
            f"free.{name}.start: expected a start of the right sign and size, or lower and upper, "
            "or sign: any; got 0 without two bounds"
        )


def _check_positive(name: str, free: Free) -> None:
    """Refuse what would let a parameter be zero or less that the model says is positive."""
    for key, value in (("start", free.start), ("lower", free.lower)):
        # Zero will do as a lower bound, which is open, and not as a start, which has no logarithm.
        if value is not None and (value < 0 or (key == "start" and value == 0)):
            raise ValueError(
                f"free.{name}.{key}: expected more than zero, since the model says that it is "
                f"positive, got {value:g}"
            )
    if free.sign == "any":
        raise ValueError(
            f"free.{name}.sign: expected keep, since the model says that it is positive, got any"
        )


# What a script may pass for a Problem, said in words where it passed something else.


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
