"""Vibration lines in a configuration's flights: identified, and removed on request."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax import naming, units
from heli_jax.config.corrections import with_notes
from heli_jax.config.experiment import Experiment
from heli_jax.config.onboard import VibrationConfig
from heli_jax.config.schema import FlightConfig
from heli_jax.errors import InputError, located
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.request import FEWEST
from heli_jax.flights.vibration import (
    folded,
    line_words,
    lines,
    notched,
    notched_slow,
    settling,
    slow_step,
)

_Q = 10.0
"""Q of the notches: a rotor speed that varies by two percent stays within."""
_LEFT = 0.5
"""Smallest share of an output's samples that notches must leave."""
_NAMED = 3
"""Most lines in the note of an output."""
_FASTEST_ROTOR = 500.0
"""Fastest rotor [rad/s], or 4800 rpm; the smallest vehicles stay below."""


def with_notches(flight: Flight, frequencies: Sequence[float], where: str) -> Flight:
    """Return the flight with notches at some frequencies in its inputs and outputs alike.

    A linear vehicle responds to notched sticks with notched motion, so this does not bias
    estimates. An output sampled too slowly for a frequency is not notched there; the lag that is
    missing is at most 3 % of its step.

    Args:
        frequencies: [Hz].
        where: place in the configuration, for messages.

    Raises:
        InputError: a frequency above the Nyquist frequency, or an output with too many gaps for the
            notches to settle.
    """
    if not frequencies:
        return flight
    for hz in frequencies:
        if not hz < 0.5 / flight.dt:
            raise InputError(
                f"{where}: expected less than half the rate of {1 / flight.dt:.4g} Hz, got "
                f"{hz:g} Hz"
            )
    inputs, outputs, instruments = (
        {n: notch(x, flight.dt, frequencies, _Q) for n, x in signals.items()}
        for notch, signals in (
            (notched, flight.inputs),
            (notched_slow, flight.outputs),
            (notched, flight.instruments),
        )
    )
    slow = _too_slow(flight, frequencies)
    lost = _lost(flight, outputs, settling(frequencies, _Q), where)
    listed = ", ".join(f"{hz:g}" for hz in frequencies)
    done = note("notches.taken-out", f"inputs and outputs notched at {listed} Hz (Q {_Q:g})")
    flight = dataclasses.replace(flight, inputs=inputs, outputs=outputs, instruments=instruments)
    return with_notes(flight, (done, *slow, *lost))


def _too_slow(flight: Flight, frequencies: Sequence[float]) -> tuple[Finding, ...]:
    """Return a note for each output that is sampled too slowly for some frequencies."""
    notes = []
    for name, y in flight.outputs.items():
        rate = 1.0 / (slow_step(y) * flight.dt)
        above = [hz for hz in frequencies if not hz < 0.5 * rate]
        if above:
            listed = ", ".join(f"{hz:g}" for hz in above)
            at = ", ".join(f"{folded(hz, rate):.3g}" for hz in above)
            words = (
                f"{name} at about {rate:.4g} Hz is not notched at {listed} Hz: a vibration there "
                f"appears at {at} Hz in this signal, where a notch would also remove the "
                "vehicle's motion"
            )
            notes.append(note("notches.too-slow", words, name, value=rate))
    return tuple(notes)


def _lost(
    flight: Flight, outputs: Mapping[str, np.ndarray], settled: float, where: str
) -> tuple[Finding, ...]:
    """Return a note for each output on the samples lost by notches that restart after a gap."""
    notes = []
    for name, y in flight.outputs.items():
        there, left = int(np.isfinite(y).sum()), int(np.isfinite(outputs[name]).sum())
        if left == there:
            continue
        words = f"after missing samples of {name} the notches take {settled:.2g} s to settle"
        if left < max(FEWEST, _LEFT * there):
            raise InputError(
                f"{where}: {words}, which leaves {left} of its {there} samples; expected a window "
                "with fewer gaps, `gaps: split` where they are long, a rate as low as that of the "
                "slowest output, or no notch"
            )
        words += f", and {there - left} of {there} samples are left out for this"
        notes.append(note("notches.samples-lost", words, name, value=there - left))
    return tuple(notes)


def vibration_notes(
    experiment: Experiment, flight: Flight, config: FlightConfig, where: str
) -> tuple[Finding, ...]:
    """Return a note for each output with strong lines in its spectrum.

    Raises:
        InputError: the stated speed has a unit that is none of a rotor.
    """
    rotor = _rotor_hz(experiment, flight, config, where)
    rates = flight.source.rates if flight.source else {}
    stated = config.vibration
    notes = [] if stated is None or rotor is None else [*_rotor_doubt(stated, 2 * math.pi * rotor)]
    for name, y in flight.outputs.items():
        vibration = lines(y, flight.dt, rotor, rates.get(name))
        if vibration:
            words = "; ".join(line_words(line, rotor) for line in vibration[:_NAMED])
            largest = max(line.share for line in vibration)
            notes.append(note("vibration.lines", f"{name} vibrates: {words}", name, value=largest))
    return tuple(notes)


def _rotor_hz(
    experiment: Experiment, flight: Flight, config: FlightConfig, where: str
) -> float | None:
    """Return turns per second, as stated, recorded, or known for the vehicle."""
    if config.vibration is not None:
        unit = config.vibration.unit
        with located(f"{where}.vibration.unit"):
            speed = config.vibration.rotor * units.factor(unit, "rad/s")
        return speed / (2.0 * math.pi)
    if "Omega" in flight.inputs:
        speed = float(np.mean(flight.inputs["Omega"]))
    elif "Omega" in naming.names(experiment.model.Params):
        speed = flight.known.get("Omega", float(experiment.vehicle.params.Omega))
    else:
        return None
    return speed / (2.0 * math.pi) if math.isfinite(speed) and speed > 0 else None


def _rotor_doubt(vibration: VibrationConfig, speed: float) -> tuple[Finding, ...]:
    """Return a finding if a rotor's stated speed is implausible, or its unit is not stated.

    Args:
        speed: stated speed [rad/s].
    """
    if speed > _FASTEST_ROTOR:
        words = (
            f"vibration: a rotor of {speed:.4g} rad/s turns at {speed * 30 / np.pi:.0f} rpm, "
            f"expected less than {_FASTEST_ROTOR:g} rad/s; was unit: rpm meant?"
        )
        criterion = f"rad/s, {_FASTEST_ROTOR:g}"
        return (Finding("units.unlikely", "doubt", words, speed, criterion),)
    if "unit" not in vibration.model_fields_set:
        words = f"vibration: rotor: no unit stated, {speed:g} taken as rad/s"
        return (note("units.assumed", words, value=speed),)
    return ()
