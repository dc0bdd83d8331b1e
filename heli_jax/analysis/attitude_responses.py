"""Responses of a model and of flights for handling qualities."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.analysis.flight_responses import FlightResponses, steady_sd
from heli_jax.analysis.handling_qualities import (
    HandlingQualities,
    Kind,
    handling_qualities,
)
from heli_jax.analysis.response_curves import (
    Curve,
    integrated,
    measured_curve,
    times,
    without_hold,
)
from heli_jax.dynamics.model import Axis, Model, axes_of

_ATTITUDES = {"roll": "p", "pitch": "q", "yaw": "r"}
"""Axes, and the usual name of an output with the rate about each."""
_ANGLES = {"roll": "phi", "pitch": "theta", "yaw": "psi"}
_STICKS = {"roll": "lat", "pitch": "lon", "yaw": "ped"}
"""Usual name of each axis's input in models that do not name the stick."""


class HandlingPair(NamedTuple):
    """A response for handling qualities."""

    input: str
    output: str
    kind: Kind = "rate"
    integrated: bool = False
    """True if the output is a rate, whose response is divided by i omega."""
    gain: float = 1.0
    """Gain of an open loop."""

    @property
    def words(self) -> str:
        """Description, such as `lat to p, integrated`."""
        return f"{self.input} to {self.output}" + (", integrated" if self.integrated else "")


class Handling(NamedTuple):
    """Handling qualities of one pair by model and data; text: reason; None: not requested."""

    pair: HandlingPair
    model: HandlingQualities | str | None
    data: HandlingQualities | str | None


def handling_pairs(model: Model, outputs: Collection[str]) -> tuple[HandlingPair, ...]:
    """Return for roll, pitch and yaw the stick with the angle, or else the rate, of the outputs."""
    pairs = []
    for axis in axes_of(model):
        stick = _stick(model, axis)
        if stick is None:
            continue
        # Outputs have the names of states, or their own, such as roll for phi.
        angles = [n for n in (axis.angle, axis.name) if n in outputs]
        rates = [n for n in (axis.rate, _ATTITUDES[axis.name]) if n in outputs]
        if angles:
            pairs.append(HandlingPair(stick, str(angles[0])))
        elif rates:
            pairs.append(HandlingPair(stick, rates[0], integrated=True))
    return tuple(pairs)


def _stick(model: Model, axis: Axis) -> str | None:
    """Return the input that turns the vehicle about a roll, pitch or yaw axis."""
    inputs = naming.names(model.Inputs)
    named = (axis.stick, _STICKS.get(axis.name))
    return next((str(n) for n in named if n in inputs), None) if axis.name in _ATTITUDES else None


def handling_gaps(model: Model, outputs: Collection[str]) -> tuple[str, ...]:
    """Return a sentence for each axis with a logged angle or rate but no stick."""
    axes = axes_of(model)
    with_stick = {a.name for a in axes if _stick(model, a) is not None}
    # An axis of another name is not an aircraft's, such as a pendulum's with the angle theta.
    other = {o for a in axes if a.name not in _ATTITUDES for o in (a.angle, a.rate)}
    logged_outputs = {
        n: [o for o in (_ANGLES[n], n, r) if o in outputs and o not in other]
        for n, r in _ATTITUDES.items()
    }
    inputs = ", ".join(naming.names(model.Inputs))
    return tuple(
        f"no handling qualities of {name}: model {model.name} does not say which input is its "
        f"stick; write axes: {{{name}: {{stick: INPUT}}}} in its file, or in the configuration "
        f"frequency: {{handling: [{{input: INPUT, output: {logged[0]}}}]}}, with one of {inputs}"
        for name, logged in logged_outputs.items()
        if logged and name not in with_stick
    )


def prepared(pair: HandlingPair, curve: Curve) -> Curve:
    """Return the curve of an attitude, or of an open loop with its gain."""
    curve = integrated(curve) if pair.integrated else curve
    return times(curve, pair.gain) if pair.gain != 1.0 else curve


def measured_handling(
    flight_responses: FlightResponses, pair: HandlingPair
) -> HandlingQualities | str:
    """Return the handling qualities of a measured response, or the reason why there are none."""
    output = flight_responses.outputs.get(pair.output)
    response = None if output is None else output.pairs.get(pair.input)
    if output is None or response is None:
        return "the flights have no such response"
    omega, window = flight_responses.omega, flight_responses.window
    steady, _ = steady_sd(omega, output, pair.input, window)
    with np.errstate(all="ignore"):
        H = without_hold(omega, response.H, flight_responses.holds[pair.input])
        sd = steady * np.abs(H / response.H)
    curve = measured_curve(omega, H, sd, response.coherence, window)
    return curve if isinstance(curve, str) else handling_qualities(prepared(pair, curve), pair.kind)
