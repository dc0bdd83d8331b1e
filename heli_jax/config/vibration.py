"""Vibration lines in a configuration's flights: identified, and removed on request."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax.config.corrections import with_notes
from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.request import FEWEST
from heli_jax.flights.vibration import (
    folded,
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


def vibration_notes(flight: Flight) -> tuple[Finding, ...]:
    """Return a note for each output with strong lines in its spectrum."""
    notes = []
    for name, y in flight.outputs.items():
        if vibration := lines(y, flight.dt):
            each = "; ".join(
                f"{line.hz:.3g} Hz has {100 * line.share:.2g} % of its variance"
                for line in vibration[:_NAMED]
            )
            words = f"{name} vibrates: {each}"
            notes.append(note("vibration.lines", words, name, value=vibration[0].share))
    return tuple(notes)
