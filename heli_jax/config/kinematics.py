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
"""how large an error may well be, SI: the sd of its prior, and the unit of the search. A record
that says no more than this does not determine the error"""

NOISES = {"noise_gyro": RATES, "noise_accel": FORCES}
"""of what is integrated, by the model's parameter"""


def errors_of(model: Model, outputs: Iterable[str]) -> dict[str, Free]:
    """The errors that a log's signals allow to be free, each from zero with a prior of its size.

    Args:
        model: of `heli_jax.dynamics.kinematics`.
    """
    measured = set(outputs)
    # An airspeed alone is the only velocity there is: a steady wind is then no part of the motion.
    windy = "V" in measured and bool(measured & {*GROUND, *POSITION})
    known = set(naming.names(model.Params))
    return {
        n: Free(0.0, prior=Prior(0.0, size))
        for n, size in SIZES.items()
        if n in known and (windy or not n.startswith("wind_"))
    }


def completed(content: dict[str, Any], where: str) -> dict[str, Any]:
    """A configuration's content with what `model: kinematics` leaves out filled in: the model that
    its signals allow, all errors free, no bias beside them.

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
        return content  # the validation says what is wrong with it
    vehicle = content.get("vehicle")
    given = {str(n) for n in vehicle} if isinstance(vehicle, dict) else set()
    free = {
        n: {"start": f.start, "prior": {"mean": f.prior.mean, "sd": f.prior.sd}}
        for n, f in errors_of(model, outputs).items()
        # Who gives a value knows the error: it is not searched for.
        if f.prior is not None and n not in given
    }
    # A bias of the outputs or an offset of the inputs would be a second name of the same error, and
    # one delay among so many needs no search over its valleys.
    nuisance = {"bias": False, "input_offset": False, **fit.get("nuisance", {})}
    # Gyros are inputs, and their noise is integrated: a filter knows that, a simulation does not.
    fit = {"method": "filter-error", "free": free, "starts": 1, **fit, "nuisance": nuisance}
    # No baseline: recursive least squares takes one output of one stick.
    return {"vehicle": {}, "rls": None, **content, "model": model.name, "fit": fit}


def between_samples(model: Model, inputs: Mapping[str, Signal]) -> dict[str, Signal]:
    """The inputs of a kinematic model, moving between samples where the configuration says nothing
    of it: a rate is measured, nobody commands it in steps.
    """
    if not is_kinematic(model):
        return dict(inputs)
    return {
        n: dataclasses.replace(u, hold="linear") if u.hold == "auto" else u
        for n, u in inputs.items()
    }


def _names(content: dict[str, Any], role: str) -> set[str]:
    """The inputs or outputs that any flight names; none where the configuration is malformed, which
    its validation says."""
    names: set[str] = set()
    flights = content.get("flights")
    for flight in flights if isinstance(flights, list) else []:
        also = flight.get("also") if isinstance(flight, dict) else None
        for log in (flight, *(also if isinstance(also, list) else ())):
            signals = log.get("signals") if isinstance(log, dict) else None
            names |= _named(signals, role) if isinstance(signals, dict) else set()
    return names


def _named(signals: dict[str, Any], role: str) -> set[str]:
    """Return the named signals of one log; a preset supplies all inputs that the outputs asked of
    it need."""
    named, asked = signals.get(role), signals.get("preset_outputs")
    names = {str(n) for n in named} if isinstance(named, dict) else set()
    asked = {str(n) for n in asked} if isinstance(asked, list) else set()
    if role == "outputs":
        return names | asked
    return names | ({*FORCES} if asked & {*GROUND, *BODY, *POSITION, "V"} else set())


_STRAIGHT_UP = 1.6
"""rad"""
_FASTEST = 75.0
"""rad/s; gyros go to 2000 deg/s, a few to 4000"""


def prepared(model: Model, flight: Flight, where: str) -> Flight:
    """A flight for a kinematic model: roll and yaw without jumps of a turn.

    Args:
        model: any; the flight of another than a kinematic one stays as it is.

    Raises:
        InputError: the vehicle points so steeply up or down that its angles mean nothing, turns
            faster than gyros measure, or a channel never moves.
    """
    if not is_kinematic(model):
        return flight
    theta = flight.outputs.get("theta")
    reached = 0.0 if theta is None else np.nanmax(np.abs(theta), initial=0.0)
    if reached > STEEPEST:
        # No pitch angle is beyond 90 degrees.
        remedy = "choose another window" if reached < _STRAIGHT_UP else "is its unit another?"
        raise InputError(
            f"{where}: theta reaches {np.degrees(reached):.0f} deg, expected at most "
            f"{np.degrees(STEEPEST):.0f} deg, beyond which roll and yaw are one turn: {remedy}"
        )
    _check_rates(flight, where)
    _check_moving(flight, where)
    # The kinematics turn on where a log begins again at -180 deg.
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
                "more than gyros measure: check its unit"
            )


def _check_moving(flight: Flight, where: str) -> None:
    signals = {} if flight.source is None else flight.source.inputs
    stated = {n for n, u in signals.items() if u.constant is not None}
    for n, x in {**flight.inputs, **flight.outputs}.items():
        seen = x[np.isfinite(x)]
        # Fitted to a channel that stands still, every scale of the others would run away.
        if n not in stated and seen.size and np.ptp(seen) == 0.0:
            raise InputError(
                f"{where}: {n} is {seen[0]:g} in all samples, expected a signal that moves: "
                "remove the sensor, or choose another window"
            )


def _unwrapped(angle: np.ndarray) -> np.ndarray:
    """Without jumps of a turn (N,) [rad]; samples that are missing stay so."""
    out, seen = angle.copy(), np.isfinite(angle)
    out[seen] = np.unwrap(angle[seen])
    return out


def noise_of(model: Model, flights: Sequence[Flight]) -> dict[str, float]:
    """Return the drift of angles and velocities in a second by the noise of gyros and
    accelerometers, by the model's parameter, from the third differences of the logged signals.

    Args:
        model: of `heli_jax.dynamics.kinematics`.
    """
    known, noise = naming.names(model.Params), {}
    for parameter, names in NOISES.items():
        if parameter in known:
            # White noise of sd s in every sample adds s dt to an angle: s sqrt(dt) in a second.
            # Imported here: a second, of which models without sensors' errors have no need.
            from heli_jax.numerics.white_noise import noise_guess

            walks = [noise_guess(f.inputs[n]) * f.dt**0.5 for f in flights for n in names]
            # One intensity for three axes, as the model has it: their rms.
            noise[parameter] = float(np.sqrt(np.mean(np.square(walks))))
    return noise


_FAINTEST = 1e-6
"""of a drift in a second, SI: below what any log shows, and above zero, which has no logarithm"""


def free_noise(model: Model, params: Record, flights: Sequence[Flight]) -> dict[str, Free]:
    """The noise of a kinematic model's inputs as parameters to be estimated, where nobody stated
    it: third differences are where the search begins, but a filter before the log takes all noise
    out of them, and none of what gyros and angles differ by otherwise is in them.

    Args:
        model: any; none of another than a kinematic one.
    """
    if not is_kinematic(model):
        return {}
    # Zero is the default and no statement: no gyro is without noise.
    missing = {n: v for n, v in noise_of(model, flights).items() if not getattr(params, n) > 0}
    return {n: Free(max(v, _FAINTEST), sign="keep") for n, v in missing.items()}


def sharpened(model: Model, flight: Flight) -> Flight:
    r"""The flight with rates and forces whose straight lines between samples have the area of the
    motion.

    Lines cut corners: of a motion at omega they keep 1 - (omega dt)^2 / 12 of the area, which a fit
    would take for the sensor's scale. Each sample less a twelfth of its second difference brings
    it back, but for (omega dt)^4 / 240; of white noise in the samples it changes the drift by what
    the first and the last add (Euler and Maclaurin's correction of the trapezoidal rule).

    Args:
        model: any; the flight of another than a kinematic one stays as it is.
    """
    if not is_kinematic(model):
        return flight
    # Second differences, at the ends those of their neighbours.
    inputs = {
        n: u - np.pad(np.diff(u, 2), 1, mode="edge") / 12.0
        if flight.hold.get(n) == "linear" and u.size > 2
        else u
        for n, u in flight.inputs.items()
    }
    return dataclasses.replace(flight, inputs=inputs)


_STEP, _EXPLICIT = 0.005, 0.02
"""s; a local linearisation holds the derivatives of the kinematics as they are at a step's begin,
and misses r' theta' h^2/3 of a rate: at 20 ms as much as the noise of a gyro leaves unknown of its
bias. Explicit steps follow them to the fourth order"""


def substeps_of(model: Model, flights: Sequence[Flight]) -> int:
    """Steps in a sample for a kinematic model, which has no fast dynamics of its own.

    Args:
        model: of `heli_jax.dynamics.kinematics`, bare or with devices around it.
    """
    step = _EXPLICIT if model.explicit else _STEP
    return max(1, *(math.ceil(f.dt / step - 1e-9) for f in flights))
