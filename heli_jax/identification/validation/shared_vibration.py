"""Whether vibration that stands in sticks and sensors alike is what looks like feedback.

A line of the rotor in both is foreseen by neither, since its speed wanders, and the two go
together: what a closed loop does as well. Without the line the question has an answer.
"""

import dataclasses
from collections.abc import Sequence

from heli_jax.flights.flight import Flight
from heli_jax.flights.vibration import Line, lines, notched, notched_slow
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.feedback import Feedback, feedback

_Q = 3.0
"""of the notches: wide, since the speed of a rotor wanders and nothing is fitted to what is left"""
_MOST = 3
"""lines of an output that are taken out"""


def vibration_alone(problem: Problem, found: Sequence[Feedback]) -> list[str]:
    """A sentence for each flight whose inputs follow the response no more once the lines of the
    outputs that they seem to follow are taken out of all signals.

    Args:
        problem: with the flights.
        found: of them, by `feedback_of`.
    """
    said, flights = [], problem.training
    for label, flight in zip(labels(flights), flights, strict=True):
        followed = {one.output for one in found if one.present and one.flight == label}
        hz = sorted({x.hz for name in followed for x in _lines(flight, name)})
        if not hz:
            continue
        left = feedback(_without(flight, hz), len(flights))
        if left and not any(one.present for one in left):
            listed = " and ".join(f"{each:.3g}" for each in hz)
            said.append(
                f"{label}: without the vibration at {listed} Hz, which stands in inputs and "
                "outputs alike, no input follows the response: it may be no closed loop. State "
                f"notch: [{', '.join(f'{each:.3g}' for each in hz)}] beside the log."
            )
    return said


def _lines(flight: Flight, name: str) -> list[Line]:
    rates = flight.source.rates if flight.source else {}
    found = lines(flight.outputs[name], flight.dt, None, rates.get(name))
    return [line for line in found[:_MOST] if line.hz < 0.45 / flight.dt]


def _without(flight: Flight, hz: Sequence[float]) -> Flight:
    return dataclasses.replace(
        flight,
        inputs={n: notched(x, flight.dt, hz, _Q) for n, x in flight.inputs.items()},
        outputs={n: notched_slow(y, flight.dt, hz, _Q) for n, y in flight.outputs.items()},
    )
