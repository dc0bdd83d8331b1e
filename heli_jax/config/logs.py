"""The flights of a configuration."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from heli_jax import naming, units
from heli_jax.config.experiment import Experiment
from heli_jax.config.feedthrough import follows
from heli_jax.config.kinematics import between_samples, prepared
from heli_jax.config.measurement import (
    filter_cautions,
)
from heli_jax.config.preset_signals import Resolved, resolve
from heli_jax.config.schema import (
    AlsoConfig,
    FlightConfig,
    InputConfig,
    OutputConfig,
    SignalsConfig,
    TimeConfig,
)
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, located, require_known
from heli_jax.finding import Finding, note, without_repeats
from heli_jax.flights import Also, Flight, Signal, read_flight, read_parts
from heli_jax.flights.clock import by_rate
from heli_jax.flights.flight import Source
from heli_jax.flights.log import ChannelLog, Table
from heli_jax.flights.request import unit_note

_PULSE = (800.0, 2200.0)
"""Pulse widths of receivers and servos [us]."""
_OFFSET_AND_SCALE = "such as offset: 1500, scale: 0.002"


def require_flights(experiment: Experiment) -> None:
    """Refuse a configuration without flights.

    Raises:
        InputError: it has none.
    """
    if not experiment.config.flights:
        raise InputError(f"{experiment.path}: flights: expected at least one log, got none")


def with_log(experiment: Experiment, log: str) -> Experiment:
    """Return the configuration with a log in place of its own, read like its first flight.

    Raises:
        InputError: the configuration has no flight.
    """
    config = experiment.config
    require_flights(experiment)
    whole = {"log": str(Path(log).absolute()), "window": None, "hold_out": False}
    flights = [config.flights[0].model_copy(update=whole)]
    return experiment._replace(config=config.model_copy(update={"flights": flights}))


def read_flights(experiment: Experiment, *, gain: bool = False) -> tuple[Flight, ...]:
    """Read the flights of a configuration, in SI.

    Args:
        gain: True if an input with a unit may be a plain number: an estimated gain then carries the
            unit.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    config = experiment.config
    require_flights(experiment)
    flights = tuple(
        flight
        for i, f in enumerate(config.flights)
        for flight in _read_flight(experiment, i, f, gain)
    )
    experiment.logs.close()
    return flights


def _read_flight(experiment: Experiment, i: int, f: FlightConfig, gain: bool) -> tuple[Flight, ...]:
    """Read one flight, or its parts if a gap splits it."""
    model = experiment.model
    # As the path in the configuration: flights[0].known, flights[0].signals.inputs.x_roll.unit.
    where = f"{experiment.path}: flights[{i}]"
    _check(model, f, where)
    time, path = f.signals.time, experiment.path.parent / f.log
    # The log is opened here only if its content decides the signals. Otherwise a wrong unit or a
    # reversed window is reported before minutes of reading.
    requested = f.signals.preset is not None or f.signals.ccpm is not None
    swashplate = None if f.signals.ccpm is None else f.signals.ccpm.swashplate()
    logs = experiment.logs
    opened = logs.open(path, f.flight) if requested else logs.get(path, f.flight)
    named = _resolved(experiment, f, f"{where}.signals", opened if requested else None)
    # Signals of all logs together: one log may supply what another lacks.
    everything = _with_also(named, f, where)
    inputs, outputs = _of_model(model, everything, f"{where}.signals", gain)
    instruments = _instrument_signals(model, f.signals, f"{where}.signals")
    # for errors of `Flight`, which knows no file
    with located(where):
        # A flight is split only on request, because each part has an initial state of its own.
        runs = (time.runs if time is not None else None) or ""
        flights = (read_parts if f.gaps == "split" or runs else read_flight)(
            path if opened is None else opened,
            # None is passed on: whether a log needs a clock's name is known once it is open.
            time=clock_signal(time),
            inputs={n: inputs[n] for n in named.inputs} | instruments,
            outputs={n: outputs[n] for n in named.outputs},
            rate=f.rate,
            window=None if f.window == "auto" else f.window,
            known=f.known,
            hold_out=f.hold_out,
            name=f.name or f"flight {i + 1}",
            number=f.flight,
            also=tuple(_also(experiment, a, inputs, outputs) for a in f.also),
            follows=follows(experiment, f.rate, inputs),
            runs=runs,
            swashplate=swashplate,
        )
    flights = (flights,) if isinstance(flights, Flight) else flights
    notes = (*_unstated_units(model, everything, flights[0].source), *named.notes)
    flights = tuple(_with_instruments(flight, instruments) for flight in flights)
    first, *others = (
        dataclasses.replace(prepared(model, flight, where), choose_windows=f.window == "auto")
        for flight in flights
    )
    cautions = (
        *filter_cautions(first.source, everything.outputs),
        *_pulse_width_doubts(first),
    )
    return (_with_notes(first, notes, cautions), *others)


def _check(model: Model, f: FlightConfig, where: str) -> None:
    """Refuse errors that are visible before the log is read."""
    # A constant of one flight belongs to the vehicle, so only a parameter can be one. A misspelt
    # name would silently keep the vehicle's value.
    known = naming.names(model.Params)
    require_known(f.known, known, f"{where}.known", f"model {model.name} has no parameter")
    if f.window == "auto" and f.hold_out:
        raise InputError(
            f"{where}.window: auto chooses data to fit, expected two numbers with hold_out"
        )


def _with_also(named: Resolved, f: FlightConfig, where: str) -> Resolved:
    """Return the signals with those of further logs."""
    merged: dict[str, dict[str, Any]] = {
        role: dict(getattr(named, role)) for role in ("inputs", "outputs")
    }
    for k, also in enumerate(f.also):
        for role, known in merged.items():
            for name, config in getattr(also.signals, role).items():
                place = f"{where}.also[{k}].signals.{role}"
                if name in known:
                    problem = f"{name!r} is taken from another log already, expected it from one"
                    raise InputError(f"{place}: {problem}")
                if getattr(config, "constant", None) is not None:
                    problem = "a constant is in no log, expected it among the flight's own signals"
                    raise InputError(f"{place}.{name}: {problem}")
                known[name] = config
    return named._replace(**merged)


def _also(
    experiment: Experiment,
    also: AlsoConfig,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
) -> Also:
    """Return a further log, with the units of its signals as checked by `signals`."""
    align, time = also.align, also.signals.time
    path = experiment.path.parent / also.log
    opened = experiment.logs.get(path, also.flight)
    return Also(
        str(path),
        "" if align is None else align.same,
        "" if align is None else align.to,
        {n: inputs[n] for n in also.signals.inputs},
        {n: outputs[n] for n in also.signals.outputs},
        clock_signal(time),
        also.flight,
        align is not None and align.reverse,
        opened,
    )


def clock_signal(time: TimeConfig | None) -> Signal | None:
    """Return the clock of a table, as a configuration states it."""
    if time is None:
        return None
    if time.rate is not None:
        return by_rate(time.rate, time.signal)
    return Signal(time.signal or "", time.unit, "s", assumed="unit" not in time.model_fields_set)


def first_signals(experiment: Experiment) -> Resolved:
    """Return the signals of the first flight by the configuration and its preset, without the log.

    Raises:
        InputError: the preset does not supply an input.
    """
    where = f"{experiment.path}: flights[0]"
    first = experiment.config.flights[0]
    return _with_also(_resolved(experiment, first, f"{where}.signals"), first, where)


def _resolved(
    experiment: Experiment, f: FlightConfig, where: str, log: Table | ChannelLog | None = None
) -> Resolved:
    """Return the signals of a flight's own log; its preset skips those in further logs."""
    elsewhere = {n for a in f.also for n in (*a.signals.inputs, *a.signals.outputs)}
    onboard = experiment.config.onboard
    stated = f.signals
    if "inputs" in stated.model_fields_set and not stated.inputs and stated.preset is None:
        # Explicitly no inputs: a free decay.
        names = [n for n in naming.names(experiment.model.Inputs) if n not in elsewhere]
        none = {n: InputConfig(constant=0.0) for n in names}
        f = f.model_copy(update={"signals": stated.model_copy(update={"inputs": none})})
    return resolve(experiment.model, f.signals, where, onboard, log, elsewhere)


def _of_model(
    model: Model, named: Resolved, where: str, gain: bool
) -> tuple[dict[str, Signal], dict[str, Signal]]:
    """Return inputs and outputs as signals, with the origin stated by their preset."""

    def with_origins(role: str, by_name: dict[str, Signal]) -> dict[str, Signal]:
        words = {name: named.origins.get((role, name), "") for name in by_name}
        return {n: dataclasses.replace(s, origin=words[n]) for n, s in by_name.items()}

    inputs = between_samples(model, signals(model, "inputs", named.inputs, where, gain))
    return (
        with_origins("inputs", inputs),
        with_origins("outputs", signals(model, "outputs", named.outputs, where)),
    )


def _unstated_units(
    model: Model, stated: Resolved, source: Source | None = None
) -> tuple[Finding, ...]:
    """Return a note for each signal without a stated unit.

    Its numbers are read as SI, or in the file's unit. Degrees read as radians fit as well, but
    every estimate is wrong by a factor of 57.
    """
    notes = []
    as_read = ({}, {}) if source is None else (source.inputs, source.outputs)
    both = ((model.Inputs, stated.inputs), (model.Outputs, stated.outputs))
    for (record, signals), read in zip(both, as_read, strict=True):
        for name, signal in signals.items():
            if name in read and (taken := unit_note(name, read[name])):
                notes.append(taken)
                continue
            # Plain numbers have no unit that could be wrong.
            si = naming.unit(record, name)
            if signal.unit is None and si is not None and not units.is_plain(si):
                words = f"{name}: no unit stated, taken as {si}"
                notes.append(note("units.assumed", words, name))
    return tuple(notes)


def _with_notes(
    flight: Flight, notes: tuple[Finding, ...], cautions: tuple[Finding, ...]
) -> Flight:
    source = flight.source
    if source is None:
        return flight
    cautions = cautions or source.cautions
    source = dataclasses.replace(source, notes=(*source.notes, *notes), cautions=cautions)
    return dataclasses.replace(flight, source=source)


def log_notes(flights: Sequence[Flight]) -> list[Finding]:
    """Return the notes of the logs' readers; each sentence begins with its log."""
    notes = []
    for flight in flights:
        where = flight.source.path if flight.source else flight.name
        notes += [n.of(where) for n in (flight.source.notes if flight.source else ())]
        for name, reason in flight.hold_reason.items():
            # Readers expect held sticks, so these need no note.
            if flight.hold[name] == "zero-order":
                continue
            half = 0.5 * flight.logged_step(name, "input")
            words = (
                f"{where}: {name} is taken as {flight.hold[name]} between samples, because it "
                f"{reason}; if a computer commanded it, state hold: zero-order, since delays are "
                f"up to half a sample, {1e3 * half:.3g} ms, too short"
            )
            notes.append(note("hold.guessed", words, name, value=half))
    # Flights may be windows of one log, so repeated notes are removed.
    return without_repeats(notes)


def signals(
    model: Model,
    role: Literal["inputs", "outputs"],
    stated: Mapping[str, InputConfig] | Mapping[str, OutputConfig],
    where: str,
    gain: bool = False,
) -> dict[str, Signal]:
    """Return the columns of the model's inputs or outputs, with units checked.

    Args:
        role: `inputs` or `outputs`.
        stated: sections of the signals, by name.
        where: place of the section, for messages.
        gain: True if an input with a unit may be a plain number.

    Raises:
        InputError: a name that the model lacks, an input that is missing, no output at all, a unit
            that is unknown or of the wrong kind.
    """
    record = model.Inputs if role == "inputs" else model.Outputs
    known = naming.names(record)
    require_known(stated, known, f"{where}.{role}", f"model {model.name} has no {role[:-1]}")
    missing = [n for n in known if n not in stated]
    # Every input acts on the vehicle, so none may be missing; one output is enough.
    if role == "inputs" and missing:
        remedy = f"if it did not act, {missing[0]}: {{constant: 0}}"
        problem = f"{missing[0]} missing, model {model.name} needs it; {remedy}"
        raise InputError(f"{where}.inputs: {problem}")
    # Without an output there is no residual to fit, and nothing to compare a simulation with.
    if not stated:
        raise InputError(f"{where}.{role}: expected one of {', '.join(known)}, got none")
    out = {}
    for name, config in stated.items():
        place = f"{where}.{role}.{name}.unit"
        si = naming.unit(record, name)
        unit = config.unit if config.unit is not None else (si or "1")
        # Inputs have a hold and no sd; outputs have an sd and no hold.
        sd, hold = getattr(config, "sd", None), getattr(config, "hold", "auto")
        missing = [] if config.missing is None else config.missing
        out[name] = Signal(
            config.signal or "",
            unit,
            _si(unit, si, place, gain, role),
            sd,
            hold,
            getattr(config, "repeats", "auto"),
            **config.conversion,
            constant=getattr(config, "constant", None),
            missing=tuple(missing if isinstance(missing, list) else [missing]),
            assumed=config.unit is None and si is not None,
        )
    return out


def _si(unit: str, si: str | None, place: str, gain: bool, role: str) -> str:
    try:
        # A user's model may state no units; the log's unit is still converted to SI.
        if si is None:
            return units.si_of(unit)
        # A stick in plain numbers: the estimated gain is then in the model's unit per 1.
        if gain and units.is_plain(unit):
            return "1"
        units.factor(unit, si)
    except ValueError as e:
        hint = ""
        # The remedy applies only to sticks logged in percent or counts.
        if si is not None and unit.strip() in ("", "1", "-", "%", "stick", "dimensionless"):
            hint = (
                "; or set fit.nuisance.input_gain: true to estimate a gain that includes the unit"
            )
        # A receiver's pulse width is a time, and no model has a stick in units of time.
        if role == "inputs" and si is not None and units.is_time(unit):
            example = f'{_OFFSET_AND_SCALE}, unit: "1"'
            if not units.is_plain(si):
                example = f"such as offset: 1500, scale in {si} per {unit.strip()}, unit: {si}"
            hint = f"; for pulse widths state offset, scale and the unit after scaling, {example}"
        raise InputError(f"{place}: {e}{hint}") from e
    return si


def _pulse_width_doubts(flight: Flight) -> tuple[Finding, ...]:
    """Return a doubt for each input that looks like pulse widths but has another unit."""
    doubts = []
    for name, signal in (flight.source.inputs if flight.source else {}).items():
        # A rotor's speed in rpm has such numbers too.
        if signal.constant is not None or signal.offset or signal.si in ("rad/s", "1/s", "Hz"):
            continue
        numbers = signal.from_si(flight.inputs[name])
        low, high = float(np.min(numbers)), float(np.max(numbers))
        if low < _PULSE[0] or high > _PULSE[1]:
            continue
        taken = "plain numbers" if units.is_plain(signal.unit) else signal.unit
        if signal.scale != 1.0:
            taken = f"{signal.scale:g} {taken} each"
        words = (
            f"{name}: {low:.4g} to {high:.4g} in the log look like pulse widths in us but are "
            f"taken as {taken} without offset: state offset and scale, {_OFFSET_AND_SCALE}"
        )
        doubts.append(Finding("units.unlikely", "doubt", words, high, "largest number", (name,)))
    return tuple(doubts)


_PREFIX = "instrument of "


def _instrument_signals(model: Model, config: SignalsConfig, where: str) -> dict[str, Signal]:
    """Return the instruments as further inputs of the log, named after the excited input.

    Raises:
        InputError: an input that the model lacks, a constant, or a unit that is unknown.
    """
    signals = {}
    for name, stated in config.instruments.items():
        place = f"{where}.instruments.{name}"
        known = naming.names(model.Inputs)
        require_known([name], known, place, f"model {model.name} has no input")
        if stated.signal is None:
            raise InputError(f"{place}: expected a signal of the log, got a constant")
        unit = stated.unit or "1"
        with located(f"{place}.unit"):
            # The size does not matter: an instrumental response is a quotient of two.
            si = units.si_of(unit)
        signals[_PREFIX + name] = Signal(
            stated.signal, unit, si, hold=stated.hold, **stated.conversion
        )
    return signals


def _with_instruments(flight: Flight, instruments: Mapping[str, Signal]) -> Flight:
    """Separate the instruments of a flight from its inputs.

    Args:
        instruments: names from `_instrument_signals`.
    """
    if not instruments:
        return flight

    def apart(by_input: dict) -> dict:
        return {n: v for n, v in by_input.items() if n not in instruments}

    source = flight.source
    if source is not None:
        source = dataclasses.replace(source, inputs=apart(dict(source.inputs)))
    return dataclasses.replace(
        flight,
        inputs=apart(flight.inputs),
        hold=apart(flight.hold),
        hold_reason=apart(flight.hold_reason),
        instruments={n.removeprefix(_PREFIX): flight.inputs[n] for n in instruments},
        source=source,
    )
