"""Sensor errors, found by `heli-jax compatibility` and removed from the signals of a flight."""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pydantic
from pydantic import Field

from heli_jax import naming, units
from heli_jax.config.section import Section
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, located
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight, Signal
from heli_jax.yaml_file import read_mapping

Finite = Annotated[float, Field(allow_inf_nan=False)]
_LATEST = 1.0
"""Longest delay [s]; a longer one indicates another unit or another clock."""


class Conversion(Section):
    """Conversion of the log's numbers, as in `signals`."""

    scale: Finite = 1.0
    offset: Finite = 0.0
    invert: bool = False

    @property
    def words(self) -> str:
        """Text as in a configuration."""
        return f"{{scale: {self.scale:g}, offset: {self.offset:g}, invert: {self.invert}}}".lower()


class SignalCorrection(Section):
    """Correction of one signal of a log: (1 + scale) truth + bias, late by the delay."""

    of: str = ""
    """description of the signal, for the reader"""
    unit: str
    """unit of the log's numbers and of the bias"""
    scale: Annotated[Finite, Field(gt=-0.9)] = 0.0
    bias: Finite = 0.0
    delay: Annotated[Finite, Field(ge=-_LATEST, le=_LATEST)] = 0.0
    """delay [s]"""
    conversion: Conversion = Conversion()
    """conversion of the log's numbers when the error was found"""


class Corrections(Section):
    """A file of corrections."""

    found_by: str = ""
    verdict: str = ""
    """summary for the reader; no corrections if the log's signals are inconsistent"""
    signals: dict[str, SignalCorrection] = {}
    """corrections by name in the log"""
    lever_arm: dict[str, Finite] = {}
    """x_imu, y_imu, z_imu [m]"""
    not_determined: list[str] = []
    """errors that are not identifiable from the record and therefore not corrected"""


def read_corrections(path: Path, where: str) -> Corrections:
    """Read a file of corrections.

    Raises:
        InputError: it cannot be read, or something in it is wrong.
    """
    content = read_mapping(path)
    try:
        return Corrections.checked(content)
    except pydantic.ValidationError as e:
        error = e.errors()[0]
        place = ".".join(str(part) for part in error["loc"])
        got = "" if error["type"] == "missing" else f", got {error['input']!r:.60}"
        message = str(error["msg"])
        message = message[0].lower() + message[1:]
        raise InputError(f"{where}: {path}: {place}: {message}{got}") from None


class Logged(NamedTuple):
    """A signal of the model and its signal in the log."""

    role: str
    """`inputs` or `outputs`."""
    name: str
    """Name in the model."""
    signal: Signal


def logged_signals(flight: Flight) -> Iterator[Logged]:
    """Yield the signals that a flight has from its logs, inputs first."""
    if flight.source is None:
        return
    for role, signals in (("inputs", flight.source.inputs), ("outputs", flight.source.outputs)):
        for name, signal in signals.items():
            if signal.constant is None:  # a constant is stated, not measured
                yield Logged(role, name, signal)


def conversion_of(signal: Signal) -> Conversion:
    """Return the conversion of the log's numbers."""
    return Conversion(scale=signal.scale, offset=signal.offset, invert=signal.invert)


def with_corrections(model: Model, flight: Flight, corrections: Corrections, where: str) -> Flight:
    """Return the flight without its sensor errors; its notes list the corrections.

    Raises:
        InputError: none of its signals is corrected, or a unit is not that of the correction.
    """
    samples = {"inputs": dict(flight.inputs), "outputs": dict(flight.outputs)}
    notes = []
    for each in logged_signals(flight):
        correction = corrections.signals.get(each.signal.name)
        if correction is None:
            continue
        factor = _factor(each, correction, where)
        x = samples[each.role][each.name]
        x = (x - correction.bias * factor) / (1.0 + correction.scale)
        samples[each.role][each.name] = _earlier(x, correction.delay / flight.dt, each.role)
        words = (
            f"{each.name}: corrected by scale {correction.scale:+.3g}, bias {correction.bias:.3g} "
            f"{correction.unit}, delay {correction.delay:.3g} s"
        )
        notes.append(note("corrections.applied", words, each.name))
    if not notes:
        raise InputError(
            f"{where}.corrections: expected a signal of this flight, got corrections of "
            f"{', '.join(corrections.signals) or 'none'}"
        )
    known, words = _lever_arm(model, flight, corrections)
    notes += words
    if corrections.not_determined:
        words = (
            "not corrected, because the record does not determine it: "
            f"{', '.join(corrections.not_determined)}"
        )
        notes.append(note("corrections.left-out", words, *corrections.not_determined))
    flight = dataclasses.replace(flight, **samples, known={**flight.known, **known})
    return with_notes(flight, notes)


def with_notes(flight: Flight, notes: Iterable[Finding]) -> Flight:
    """Return the flight with further notes from its reader."""
    # A flight made by a script has no source for notes.
    if flight.source is None:
        return flight
    source = dataclasses.replace(flight.source, notes=(*flight.source.notes, *notes))
    return dataclasses.replace(flight, source=source)


def _factor(each: Logged, correction: SignalCorrection, where: str) -> float:
    """Return the factor from the stated unit to SI."""
    signal = each.signal
    place = f"{where}.corrections: {signal.name}"
    with located(place):
        stated, of_correction = (units.factor(u, signal.si) for u in (signal.unit, correction.unit))
    # With different units, one of the two fits used wrong numbers.
    if not np.isclose(stated, of_correction, rtol=1e-9):
        raise InputError(
            f"{place}: expected the unit that it was corrected in, {correction.unit}, "
            f"got {signal.unit}"
        )
    # With another sign or offset, the correction would add the errors.
    here, there = conversion_of(signal), correction.conversion
    if here != there:
        raise InputError(
            f"{place}: expected the conversion that it was corrected with, {there.words}, got "
            f"{here.words}"
        )
    return stated


def _earlier(x: np.ndarray, samples: float, role: str) -> np.ndarray:
    """Return a signal (N,) at its own time; it was logged late by `samples`."""
    if not samples:
        return x
    n = np.arange(x.size)
    # A sample beside a gap is between a known and a missing value: NaN.
    moved = np.interp(n + samples, n, x)
    moved[(n + samples > x.size - 1) | (n + samples < 0)] = np.nan
    if role == "outputs":
        return moved
    # An input acts all the time, so it is constant at the ends.
    return np.interp(n + samples, n, x)


def _lever_arm(
    model: Model, flight: Flight, corrections: Corrections
) -> tuple[dict[str, float], list[Finding]]:
    """Return the position of a model's accelerometers, and a note on it."""
    arm = corrections.lever_arm
    if not arm:
        return {}, []
    words = ", ".join(f"{n} {v:.3g} m" for n, v in arm.items())
    if not set(arm) <= set(naming.names(model.Params)):
        words = f"lever arm not used, model {model.name} has none: {words}"
        return {}, [note("corrections.left-out", words, *arm)]
    # The configuration's value for this flight has priority.
    new = {n: v for n, v in arm.items() if n not in flight.known}
    return new, [note("corrections.applied", f"lever arm of the accelerometer: {words}", *arm)]
