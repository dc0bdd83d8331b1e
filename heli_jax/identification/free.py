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
    known, start = naming.names(model.Params), free.start
    if name not in known:
        raise ValueError(
            f"free.{name}: model {model.name} has no such parameter{nearest(name, known)}"
        )
    if math.isnan(start):
        raise ValueError(
            f"free.{name}.start: missing, expected a number to begin with (or, for a linear model, "
            "start: equation-error, which finds one)"
        )
    for key, value in _numbers(free).items():
        if not math.isfinite(value):
            raise ValueError(f"free.{name}.{key}: expected a finite number, got {value}")
    low = -math.inf if free.lower is None else free.lower
    high = math.inf if free.upper is None else free.upper
    bounded, positive = high - low < math.inf, name in model.positive
    keeps, since = free.sign == "keep", "since the model says that it is positive"
    wrongs = (
        (
            free.prior is not None and free.prior.sd <= 0,
            f".prior.sd must be above zero, got {free.prior and free.prior.sd}",
        ),
        (free.sign not in ("keep", "any"), f".sign: expected 'keep' or 'any', got {free.sign!r}"),
        (positive and start <= 0, f".start: expected more than zero, {since}, got {start:g}"),
        # Zero will do as a lower bound, which is open.
        (
            positive and -math.inf < low < 0,
            f".lower: expected zero or more, {since}, got {low:g}",
        ),
        (positive and not keeps, f".sign: expected keep, {since}, got any"),
        (
            keeps and bounded and low < 0 < high,
            f".sign: keep: expected bounds of one sign, got {low:g} to {high:g}",
        ),
        (low >= high, f": lower must be below upper, got {low:g} and {high:g}"),
        # Not on a bound either: in the coordinates of a bounded parameter its ends are at infinity.
        (
            not low < start < high,
            f".start: expected a value inside {low:g} to {high:g}, got {start:g}",
        ),
        # Zero has no logarithm; between two bounds the search is in another coordinate.
        (
            start == 0 and keeps and not bounded,
            ".start: expected a start of the right sign and size, or lower and upper, or sign: "
            "any; got 0 without two bounds",
        ),
    )
    for wrong, words in wrongs:
        if wrong:
            raise ValueError(f"free.{name}{words}")


def _numbers(free: Free) -> dict[str, Any]:
    """The numbers that are given, by the name of their key."""
    prior = free.prior
    numbers = {"start": free.start, "lower": free.lower, "upper": free.upper}
    if prior is not None:
        numbers |= {"prior.mean": prior.mean, "prior.sd": prior.sd}
    return {key: value for key, value in numbers.items() if value is not None}


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
    several = isinstance(flights, Sequence) and not isinstance(flights, str)
    odd = [f for f in (flights if several else [flights]) if not isinstance(f, Flight)]
    if odd or not several:
        raise TypeError(
            f"flights: expected a list of Flights, got {type((odd or [flights])[0]).__name__}; "
            "heli_jax.read_flight(path, ...) reads a log"
        )
    by_name = free if isinstance(free, Mapping) else {}
    odd = [f for f in by_name.values() if not isinstance(f, Free)]
    if odd or not isinstance(free, Mapping):
        raise TypeError(
            "free: expected Free by the parameter's name, as {'Ixx': Free(0.02)}, got "
            f"{type((odd or [free])[0]).__name__}"
        )
    for name, each in by_name.items():
        if not isinstance(each.prior, Prior | None):
            kind = type(each.prior).__name__
            raise TypeError(f"free.{name}.prior: expected Prior(mean, sd), got {kind}")
        for key, value in _numbers(each).items():
            # Of Python, NumPy or JAX; True is none, though Python counts with it.
            kind = getattr(value, "dtype", np.dtype(type(value))).kind
            if getattr(value, "shape", ()) != () or kind not in "iuf":
                raise TypeError(f"free.{name}.{key}: expected a number, got {value!r:.60}")


def warn_of_degrees(outputs: type, flights: Sequence[Flight]) -> None:
    """Warn of angles that turn further or faster than a helicopter does, as degrees would.

    Args:
        outputs: the model's class, which has the units.
        flights: those made in Python; of a log its unit is stated and checked.
    """
    angles = {n for n in naming.names(outputs) if naming.unit(outputs, n) == "rad"} - _HEADINGS
    signals = [(f, n) for f in flights if f.source is None for n in f.outputs if n in angles]
    for flight, name in signals:
        y, steps = np.asarray(flight.outputs[name], float), max(1, round(_OVER / flight.dt))
        turned = np.abs(y[steps:] - y[:-steps])
        turned = turned[np.isfinite(turned)]
        # Single wild samples are left out.
        fastest = float(np.quantile(turned, 0.98)) / (steps * flight.dt) if turned.size else 0.0
        largest = float(np.nanmax(np.abs(y), initial=0.0))
        if largest > _FURTHEST or (largest > _HALF_TURN and fastest > _FASTEST):
            warnings.warn(
                f"{flight.name or 'a flight'}: {name} reaches {largest:.3g} rad and "
                f"{fastest:.2g} rad/s, farther or faster than helicopters turn; angles are in "
                "radians here: np.radians(degrees)",
                UserWarning,
                stacklevel=4,
            )
