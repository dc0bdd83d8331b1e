"""Lines of vibration in the flights of a configuration: named, and taken out where it says so."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from heli_jax import naming, units
from heli_jax.config.doubts import rotor_doubt
from heli_jax.config.experiment import Experiment
from heli_jax.config.schema import FlightConfig
from heli_jax.errors import InputError
from heli_jax.flights.flight import Flight
from heli_jax.flights.vibration import Line, lines, notched

_Q = 10.0
"""of the notches: a rotor whose speed wanders by two percent stays within"""
_NAMED = 3
"""lines that are told of an output"""


def with_notches(flight: Flight, frequencies: Sequence[float], where: str) -> Flight:
    """The flight without some frequencies, in its inputs and outputs alike.

    A linear machine answers notched sticks with notched motion, so nothing is biased; notched on
    one side alone, the notch's lag would be taken for the machine's.

    Args:
        flight: as read.
        frequencies: [Hz]; none leaves it as it is.
        where: what a sentence about a wrong one begins with.

    Raises:
        InputError: a frequency that the samples do not have, or an output with missing samples.
    """
    if not frequencies:
        return flight
    for hz in frequencies:
        if not hz < 0.5 / flight.dt:
            raise InputError(
                f"{where}: expected less than half the rate of {1 / flight.dt:.4g} Hz, got "
                f"{hz:g} Hz"
            )
    for name, y in flight.outputs.items():
        if np.isnan(y).any():
            raise InputError(
                f"{where}: output {name} has missing samples, which a notch would spread; expected "
                "a window without them, or no notch"
            )
    inputs, outputs = (
        {n: notched(x, flight.dt, frequencies, _Q) for n, x in signals.items()}
        for signals in (flight.inputs, flight.outputs)
    )
    source = flight.source
    if source is not None:
        listed = ", ".join(f"{hz:g}" for hz in frequencies)
        note = f"inputs and outputs notched at {listed} Hz (Q {_Q:g})"
        source = dataclasses.replace(source, notes=(*source.notes, note))
    return dataclasses.replace(flight, inputs=inputs, outputs=outputs, source=source)


def vibration_notes(
    experiment: Experiment, flight: Flight, config: FlightConfig, where: str
) -> tuple[str, ...]:
    """A sentence for each output with strong lines in its spectrum.

    Args:
        experiment: whose vehicle may know the rotor's speed, Omega.
        flight: as read.
        config: of the flight, which may state it.
        where: the flight's place in the configuration.

    Raises:
        InputError: the stated speed has a unit that is none of a rotor.
    """
    rotor = _rotor_hz(experiment, flight, config, where)
    rates = flight.source.rates if flight.source else {}
    stated = config.vibration
    notes = [] if stated is None or rotor is None else [*rotor_doubt(stated, 2 * math.pi * rotor)]
    for name, y in flight.outputs.items():
        found = lines(y, flight.dt, rotor, rates.get(name))
        if found:
            told = "; ".join(_words(line, rotor) for line in found[:_NAMED])
            notes.append(f"{name} vibrates: {told}")
    return tuple(notes)


def _words(line: Line, rotor: float | None) -> str:
    share = f"{line.hz:.3g} Hz has {100 * line.share:.2g}% of its variance"
    if line.aliased:
        return f"{share} ({line.harmonic}/rev of the rotor, {line.of_hz:.4g} Hz, aliased)"
    if line.harmonic:
        return f"{share} ({line.harmonic}/rev of the rotor)"
    return f"{share} ({'no harmonic of the rotor' if rotor else 'of unknown origin'})"


def _rotor_hz(
    experiment: Experiment, flight: Flight, config: FlightConfig, where: str
) -> float | None:
    """Turns per second, as stated, recorded, or known of the vehicle."""
    if config.vibration is not None:
        unit = config.vibration.unit
        try:
            speed = config.vibration.rotor * units.factor(unit, "rad/s")
        except ValueError as e:
            raise InputError(f"{where}.vibration.unit: {e}") from e
        return speed / (2.0 * math.pi)
    if "Omega" in flight.inputs:
        speed = float(np.mean(flight.inputs["Omega"]))
    elif "Omega" in naming.names(experiment.model.Params):
        speed = flight.known.get("Omega", float(experiment.vehicle.params.Omega))
    else:
        return None
    return speed / (2.0 * math.pi) if math.isfinite(speed) and speed > 0 else None
