"""The flights that a configuration names."""

import dataclasses
from collections.abc import Mapping
from typing import Literal

from heli_jax import naming, units
from heli_jax.config.corrections import read_corrections, with_corrections
from heli_jax.config.experiment import Experiment
from heli_jax.config.kinematics import prepared
from heli_jax.config.schema import FlightConfig, InputConfig, OutputConfig, SignalsConfig
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.flights import Flight, Signal, read_flight


def read_flights(
    experiment: Experiment, *, gain: bool = False, moving_inputs: bool = True
) -> tuple[Flight, ...]:
    """The flights that a configuration names, in SI.

    Args:
        experiment: the configuration, with its model at hand.
        gain: whether a plain number is allowed for an input with a unit: an estimated gain then
            carries the unit.
        moving_inputs: whether a run in which no input ever moves is refused.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    config, path = experiment.config, experiment.path
    if not config.flights:
        raise InputError(f"{path}: flights: expected at least one log, got none")
    return tuple(
        _read_flight(experiment, i, f, gain, moving_inputs) for i, f in enumerate(config.flights)
    )


def _read_flight(
    experiment: Experiment, i: int, f: FlightConfig, gain: bool, moving: bool
) -> Flight:
    model = experiment.model
    # As the path in the configuration: flights[0].known, flights[0].signals.inputs.x_roll.unit.
    where = f"{experiment.path}: flights[{i}]"
    for name in f.known:
        # A constant of one flight alone is part of the machine, so only a parameter can be one: a
        # misspelt name would leave the vehicle's value in its place without a word.
        if name not in naming.names(model.Params):
            raise InputError(
                f"{where}.known: model {model.name} has no parameter {name!r}"
                f"{nearest(name, naming.names(model.Params))}"
            )
    time = f.signals.time
    try:
        flight = read_flight(
            experiment.path.parent / f.log,
            # None is passed on: whether a log needs the name of its clock is known once it is open.
            time=None if time is None else Signal(time.signal, time.unit, "s"),
            inputs=signals(model, "inputs", f.signals.inputs, f"{where}.signals", gain),
            outputs=signals(model, "outputs", f.signals.outputs, f"{where}.signals"),
            rate=f.rate,
            window=f.window,
            known=f.known,
            hold_out=f.hold_out,
            name=f.name or f"flight {i + 1}",
            moving_inputs=moving,
            number=f.flight,
        )
    except InputError:
        raise  # it names the log and the line already
    except ValueError as e:  # of `Flight`, which knows no file
        raise InputError(f"{where}: {e}") from e
    flight = prepared(model, flight, where)
    if f.corrections is not None:
        place = f"{where}.corrections"
        found = read_corrections(experiment.path.parent / f.corrections, place)
        flight = with_corrections(model, flight, f.signals, found, where)
    return _with_notes(flight, _unstated_units(model, f.signals))


def _unstated_units(model: Model, stated: SignalsConfig) -> tuple[str, ...]:
    """A sentence for each signal whose numbers are read as SI because no unit is stated.

    Numbers in degrees that are read as radians fit as well, and every estimate is wrong by 57.
    """
    notes = []
    for record, signals in ((model.Inputs, stated.inputs), (model.Outputs, stated.outputs)):
        for name, signal in signals.items():
            # Plain numbers have no unit to mistake.
            si = naming.unit(record, name)
            if signal.unit is None and si is not None and not units.is_plain(si):
                notes.append(f"{name}: no unit stated, taken as {si}")
    return tuple(notes)


def _with_notes(flight: Flight, notes: tuple[str, ...]) -> Flight:
    # A flight that a script made has no source, and nobody who would read a note on it.
    if not notes or flight.source is None:
        return flight
    source = dataclasses.replace(flight.source, notes=(*flight.source.notes, *notes))
    return dataclasses.replace(flight, source=source)


def signals(
    model: Model,
    role: Literal["inputs", "outputs"],
    stated: Mapping[str, InputConfig] | Mapping[str, OutputConfig],
    where: str,
    gain: bool = False,
) -> dict[str, Signal]:
    """Which column is which of the model's inputs or outputs, with units checked.

    Args:
        model: what the names are of.
        role: whether they are its inputs or its outputs.
        stated: a configuration's signals by the model's name.
        where: what a sentence about a wrong one begins with.
        gain: whether a plain number is allowed for an input with a unit.

    Raises:
        InputError: a name that the model lacks, an input that is missing, no output at all, a
            unit that is unknown or of the wrong kind.
    """
    record = model.Inputs if role == "inputs" else model.Outputs
    known = naming.names(record)
    for name in stated:
        if name not in known:
            raise InputError(
                f"{where}.{role}: model {model.name} has no {role[:-1]} {name!r}"
                f"{nearest(name, known)}"
            )
    missing = [n for n in known if n not in stated]
    # Every input acts on the machine, so none can be left out; of the outputs one is enough.
    if role == "inputs" and missing:
        raise InputError(f"{where}.inputs: {missing[0]} missing, model {model.name} needs it")
    # No output, no residual: there would be nothing to fit, and nothing to compare a simulation
    # with.
    if not stated:
        raise InputError(f"{where}.{role}: expected one of {', '.join(known)}, got none")
    out = {}
    for name, config in stated.items():
        place = f"{where}.{role}.{name}.unit"
        si = naming.unit(record, name)
        unit = config.unit if config.unit is not None else (si or "1")
        # Inputs have a hold and no sd, outputs the reverse.
        sd, hold = getattr(config, "sd", None), getattr(config, "hold", "auto")
        out[name] = Signal(config.signal, unit, _si(unit, si, place, gain), sd, hold)
    return out


def _si(unit: str, si: str | None, place: str, gain: bool) -> str:
    try:
        # A model of one's own may state no units: the log's unit is converted to SI all the same.
        if si is None:
            return units.si_of(unit)
        # A stick in plain numbers: the estimated gain is then in the model's unit per 1.
        if gain and units.is_plain(unit):
            return "1"
        units.factor(unit, si)
    except ValueError as e:
        hint = ""
        # The remedy only where it is one: for sticks logged in percent or counts.
        if si is not None and unit.strip() in ("", "1", "-", "%", "stick", "dimensionless"):
            hint = "; or set fit.nuisance.input_gain: true, and the estimated gain carries the unit"
        raise InputError(f"{place}: {e}{hint}") from e
    return si
