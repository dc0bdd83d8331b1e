"""Whether the inputs of a problem's flights follow the response."""

import math
from collections.abc import Mapping

import numpy as np

from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.validation.follows_response import (
    RATE,
    Feedback,
    Untested,
    decimated,
    feedback,
    rates_of,
    tested_at,
)


def why_untested(problem: Problem) -> Untested | None:
    """Why nothing was tested of any flight; None where something was."""
    reasons = {
        label: tested
        for label, f in zip(labels(problem.training), problem.training, strict=True)
        if isinstance(tested := tested_at(f, {}, rates_of(f)[0]), Untested)
    }
    kinds = list(dict.fromkeys(reasons.values()))
    if len(kinds) < 2:
        return kinds[0] if kinds else None
    return Untested("; ".join(f"{label}: {one.reason}" for label, one in reasons.items()))


def feedback_of(
    problem: Problem, delays: Mapping[str, tuple[float, float | None]] | None = None
) -> tuple[Feedback, ...]:
    """Of all flights that are fitted; nothing where sensors are compared with each other, of which
    none is a stick that anybody moves.

    Args:
        delays: value and sd of what a fit found, among it `time_shift` and the parameters that are
            delays [s]; None before a fit, and of one that did not arrive.
    """
    if is_kinematic(problem.model):
        return ()
    flights, made = problem.training, []
    for label, flight in zip(labels(flights), flights, strict=True):
        of_inputs = {n: _delay(problem, flight, n, delays or {}) for n in flight.inputs}
        # As early as its interval has it: what is left of a late log would still be an alarm. One
        # that may be zero is none: an input that is moved for nothing hides a fast controller.
        earlier = {n: 2.0 * sd - d for n, (d, sd, _) in of_inputs.items() if d + 2.0 * sd < 0}
        made += [
            one._replace(flight=label, delay_known=of_inputs[one.input][2])
            for one in feedback(flight, len(flights), earlier)
        ]
    return tuple(made)


def _delay(
    problem: Problem, flight: Flight, name: str, delays: Mapping[str, tuple[float, float | None]]
) -> tuple[float, float, bool]:
    """Of an input its delay and its sd [s], as far as they are known, and whether that was
    estimated."""
    delay, variance, estimated = 0.0, 0.0, False
    own = dict(problem.model.delays).get(name)
    if own is not None and own not in delays:
        stated = flight.known.get(own)
        delay = float(getattr(problem.vehicle, own) if stated is None else stated)
    for parameter in ("time_shift", own):
        value, sd = delays.get(parameter or "", (0.0, None))
        if sd is not None:
            delay, variance, estimated = delay + value, variance + sd**2, True
    return delay, math.sqrt(variance), estimated


def untested(problem: Problem) -> dict[tuple[str, ...], list[str]]:
    """By outputs of which feedback cannot be told, since too much is missing, the flights."""
    lacking: dict[tuple[str, ...], list[str]] = {}
    for label, flight in zip(labels(problem.training), problem.training, strict=True):
        tested = decimated(flight, {}, RATE).outputs
        gappy = [n for n, y in flight.outputs.items() if n not in tested and np.isnan(y).any()]
        if gappy:
            lacking.setdefault(tuple(gappy), []).append(label)
    return lacking
