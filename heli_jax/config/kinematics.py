"""Defaults of a configuration with `model: kinematics`."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.kinematics import (
    ANGLES,
    BODY,
    FORCES,
    GROUND,
    POSITION,
    RATES,
    STEEPEST,
    is_kinematic,
    kinematics,
)
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, located
from heli_jax.flights.flight import Flight, Signal
from heli_jax.identification.problem import Free, Prior
from heli_jax.naming import Record

NAME = "kinematics"

SIZES = {
    **{f"b_{n}": 0.2 for n in RATES},
    **{f"lambda_{n}": 0.2 for n in (*RATES, *FORCES)},
    **{f"b_{n}": 2.0 for n in FORCES},
    **{f"{axis}_imu": 0.5 for axis in "xyz"},
    "delay_gyro": 0.1,
    "delay_accel": 0.1,
    "wind_n": 10.0,
    "wind_e": 10.0,
    "wind_d": 3.0,
}
"""Typical size of each error [SI]: the sd of its prior, and the unit of the search. A record
without more information does not determine the error."""

NOISES = {"noise_gyro": RATES, "noise_accel": FORCES}
"""Inputs whose noise is integrated, by the model's parameter."""


def errors_of(model: Model, outputs: Iterable[str]) -> dict[str, Free]:
    """Return the errors that can be free with a log's signals, each from zero with its prior.

    Args:
        model: from `heli_jax.dynamics.kinematics`.
        outputs: the log's outputs.
    """
    measured = set(outputs)
    # If airspeed is the only velocity, a steady wind has no effect on the motion.
    windy = "V" in measured and bool(measured & {*GROUND, *POSITION})
    known = set(naming.names(model.Params))
    return {
        n: Free(0.0, prior=Prior(0.0, size))
        for n, size in SIZES.items()
        if n in known and (windy or not n.startswith("wind_"))
    }


def completed(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Fill in a configuration's content for `model: kinematics`.

    The defaults are the model for its signals, all errors free, and no bias besides them.

    Raises:
        InputError: accelerometers without a velocity to compare them with, or the reverse.
    """
    if content.get("model") != NAME:
        return content
    inputs, outputs = (_names(content, role) for role in ("inputs", "outputs"))
    with located(f"{where}: flights"):
        model = kinematics(inputs, outputs)
    fit = content.get("fit") or {}
    if not isinstance(fit, dict) or not isinstance(fit.get("nuisance", {}), dict):
        return content  # the validation reports the error
    vehicle = content.get("vehicle")
    given = {str(n) for n in vehicle} if isinstance(vehicle, dict) else set()
    free = {
        n: {"start": f.start, "prior": {"mean": f.prior.mean, "sd": f.prior.sd}}
        for n, f in errors_of(model, outputs).items()
        # A stated value means that the error is known, so it is not free.
        if f.prior is not None and n not in given
    }
    # A bias of the outputs or an offset of the inputs would duplicate an error. A delay among many
    # errors needs no search over its local minima.
    nuisance = {"bias": False, "input_offset": False, **fit.get("nuisance", {})}
    # Gyros are inputs, and their noise is integrated; a filter models that, a simulation does not.
    fit = {"method": "filter-error", "free": free, "starts": 1, **fit, "nuisance": nuisance}
    # There is no baseline, because recursive least squares takes one output of one stick.
    return {"vehicle": {}, "rls": None, **content, "model": model.name, "fit": fit}


def between_samples(model: Model, inputs: Mapping[str, Signal]) -> dict[str, Signal]:
    """Return the inputs of a kinematic model, linear between samples by default.

    A rate is measured, not commanded in steps.
    """
    if not is_kinematic(model):
        return dict(inputs)
    return {
        n: dataclasses.replace(u, hold="linear") if u.hold == "auto" else u
        for n, u in inputs.items()
    }


def _names(content: dict[str, Any], role: str) -> set[str]:
    """Return the inputs or outputs that any flight names.

    It is empty if the configuration is malformed, which its validation reports.
    """
    names: set[str] = set()
    flights = content.get("flights")
    for flight in flights if isinstance(flights, list) else []:
        also = flight.get("also") if isinstance(flight, dict) else None
        for log in (flight, *(also if isinstance(also, list) else ())):
            signals = log.get("signals") if isinstance(log, dict) else None
            names |= _named(signals, role) if isinstance(signals, dict) else set()
    return names


def _named(signals: dict[str, Any], role: str) -> set[str]:
    """Return the named signals of one log, with all inputs that its preset's outputs need."""
    named, requested = signals.get(role), signals.get("preset_outputs")
    names = {str(n) for n in named} if isinstance(named, dict) else set()
    requested = {str(n) for n in requested} if isinstance(requested, list) else set()
    if role == "outputs":
        return names | requested
    return names | ({*FORCES} if requested & {*GROUND, *BODY, *POSITION, "V"} else set())


_STRAIGHT_UP = 1.6
"""Pitch angle beyond which the unit is wrong [rad]."""
_FASTEST = 75.0
"""Fastest rate [rad/s]; gyros go to 2000 deg/s, a few to 4000."""


def prepared(model: Model, flight: Flight, where: str) -> Flight:
    """Return a flight for a kinematic model, with roll and yaw unwrapped.

    Args:
        model: any model; only a kinematic one changes the flight.
        where: place in the configuration, for messages.

    Raises:
        InputError: the vehicle's pitch is too steep for Euler angles, it turns faster than gyros
            measure, or a channel never moves.
    """
    if not is_kinematic(model):
        return flight
    theta = flight.outputs.get("theta")
    reached = 0.0 if theta is None else np.nanmax(np.abs(theta), initial=0.0)
    if reached > STEEPEST:
        # Pitch angles do not exceed 90 degrees.
        remedy = "choose another window" if reached < _STRAIGHT_UP else "is its unit another?"
        raise InputError(
            f"{where}: theta reaches {np.degrees(reached):.0f} deg, expected at most "
            f"{np.degrees(STEEPEST):.0f} deg, since beyond it roll and yaw cannot be separated: "
            f"{remedy}"
        )
    _check_rates(flight, where)
    _check_moving(flight, where)
    # The kinematics continue past -180 deg, where a log wraps.
    turned = {n: _unwrapped(y) for n, y in flight.outputs.items() if n in ANGLES}
    if all(np.array_equal(y, flight.outputs[n], equal_nan=True) for n, y in turned.items()):
        return flight
    return dataclasses.replace(flight, outputs={**flight.outputs, **turned})


def _check_rates(flight: Flight, where: str) -> None:
    for n in RATES:
        rate = flight.inputs.get(n)
        fastest = 0.0 if rate is None else np.nanmax(np.abs(rate), initial=0.0)
        if fastest > _FASTEST:
            raise InputError(
                f"{where}: {n} reaches {fastest:.0f} rad/s, expected at most {_FASTEST:g} rad/s, "
                "the limit of gyros: check its unit"
            )


def _check_moving(flight: Flight, where: str) -> None:
    signals = {} if flight.source is None else flight.source.inputs
    stated = {n for n, u in signals.items() if u.constant is not None}
    for n, x in {**flight.inputs, **flight.outputs}.items():
        seen = x[np.isfinite(x)]
        # In a fit to a constant channel, the scales of the others would diverge.
        if n not in stated and seen.size and np.ptp(seen) == 0.0:
            raise InputError(
                f"{where}: {n} is {seen[0]:g} in all samples, expected a signal that moves: "
                "remove the sensor, or choose another window"
            )


def _unwrapped(angle: np.ndarray) -> np.ndarray:
    """Unwrap an angle (N,) [rad]; missing samples stay missing."""
    out, seen = angle.copy(), np.isfinite(angle)
    out[seen] = np.unwrap(angle[seen])
    return out


def noise_of(model: Model, flights: Sequence[Flight]) -> dict[str, float]:
    """Return the drift of angles and velocities in a second from sensor noise, by parameter.

    It comes from the third differences of the logged gyro and accelerometer signals.

    Args:
        model: from `heli_jax.dynamics.kinematics`.
    """
    known, noise = naming.names(model.Params), {}
    for parameter, names in NOISES.items():
        if parameter in known:
            # White noise of sd s in every sample adds s dt to an angle: s sqrt(dt) in a second.
            # Imported here, because it takes a second that other models do not need.
            from heli_jax.numerics.white_noise import noise_guess

            walks = [noise_guess(f.inputs[n]) * f.dt**0.5 for f in flights for n in names]
            # The model has one intensity for three axes: their rms.
            noise[parameter] = float(np.sqrt(np.mean(np.square(walks))))
    return noise


_FAINTEST = 1e-6
"""Smallest drift in a second [SI]: below the resolution of any log, and above zero for the
logarithm."""


def free_noise(model: Model, params: Record, flights: Sequence[Flight]) -> dict[str, Free]:
    """Return the input noise of a kinematic model as free parameters, unless stated.

    The start is from third differences. It is not the result, because a filter before the log
    removes that noise, and other differences between gyros and angles are not in it.

    Args:
        model: any model; empty unless it is kinematic.
    """
    if not is_kinematic(model):
        return {}
    # Zero is the default, not a statement: no gyro is without noise.
    missing = {n: v for n, v in noise_of(model, flights).items() if not getattr(params, n) > 0}
    return {n: Free(max(v, _FAINTEST), sign="keep") for n, v in missing.items()}


def sharpened(model: Model, flight: Flight) -> Flight:
    r"""Correct rates and forces so that lines between samples have the integral of the motion.

    Lines cut corners. They keep 1 - (omega dt)^2 / 12 of the integral of a motion at omega. A fit
    would attribute the rest to the sensor's scale. Each sample minus a twelfth of its second
    difference restores it up to (omega dt)^4 / 240. With white noise in the samples, only the first
    and the last sample change the drift (Euler and Maclaurin's correction of the trapezoidal rule).

    Args:
        model: any model; only a kinematic one changes the flight.
    """
    if not is_kinematic(model):
        return flight
    # Second differences; the ends copy those of their neighbours.
    inputs = {
        n: u - np.pad(np.diff(u, 2), 1, mode="edge") / 12.0
        if flight.hold.get(n) == "linear" and u.size > 2
        else u
        for n, u in flight.inputs.items()
    }
    return dataclasses.replace(flight, inputs=inputs)


_STEP, _EXPLICIT = 0.005, 0.02
"""Longest steps of integration [s], for local linearisation and for explicit methods. Local
linearisation keeps the derivatives at the start of a step and misses r' theta' h^2/3 of a rate. At
20 ms that equals the uncertainty of a gyro's bias from its noise. Explicit steps are of fourth
order."""


def substeps_of(model: Model, flights: Sequence[Flight]) -> int:
    """Return the steps per sample for a kinematic model, which has no fast dynamics.

    Args:
        model: from `heli_jax.dynamics.kinematics`, bare or with devices around it.
    """
    step = _EXPLICIT if model.explicit else _STEP
    return max(1, *(math.ceil(f.dt / step - 1e-9) for f in flights))
