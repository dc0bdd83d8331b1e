"""The flights that a configuration names."""

from collections.abc import Mapping
from typing import Any, Literal

from heli_jax import naming, units
from heli_jax.config.experiment import Experiment
from heli_jax.config.schema import FlightConfig
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.flights import Flight, Signal, read_flight


def read_flights(
    experiment: Experiment, *, gain: bool = False, moving_inputs: bool = True
) -> tuple[Flight, ...]:
    """The flights that a configuration names, in SI.

    `gain` allows a plain number for an input with a unit: an estimated gain then carries the unit.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    config, path = experiment.config, experiment.path
    if not config.flights:
        raise InputError(f"{path}: flights: none given, wanted is at least one log")
    return tuple(
        _read_flight(experiment, i, f, gain, moving_inputs) for i, f in enumerate(config.flights)
    )


def _read_flight(
    experiment: Experiment, i: int, f: FlightConfig, gain: bool, moving: bool
) -> Flight:
    model = experiment.model
    where = f"{experiment.path}: flights[{i}]"
    for name in f.known:
        if name not in naming.names(model.Params):
            raise InputError(
                f"{where}.known: model {model.name} has no parameter {name!r}"
                f"{nearest(name, naming.names(model.Params))}"
            )
    try:
        flight = read_flight(
            experiment.path.parent / f.log,
            time=Signal(f.signals.time.signal, f.signals.time.unit, "s"),
            inputs=signals(model, "inputs", f.signals.inputs, f"{where}.signals", gain),
            outputs=signals(model, "outputs", f.signals.outputs, f"{where}.signals"),
            rate=f.rate,
            window=f.window,
            known=f.known,
            hold_out=f.hold_out,
            name=f.name or f"flight {i + 1}",
            moving_inputs=moving,
        )
    except InputError:
        raise
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e
    return flight


def signals(
    model: Model,
    role: Literal["inputs", "outputs"],
    given: Mapping[str, Any],
    where: str,
    gain: bool = False,
) -> dict[str, Signal]:
    """Which column is which of the model's inputs or outputs, with units checked.

    Raises:
        InputError: a name that the model lacks, an input that is missing, no output at all, a
            unit that is unknown or of the wrong kind.
    """
    record = model.Inputs if role == "inputs" else model.Outputs
    known = naming.names(record)
    for name in given:
        if name not in known:
            raise InputError(
                f"{where}.{role}: model {model.name} has no {role[:-1]} {name!r}"
                f"{nearest(name, known)}"
            )
    missing = [n for n in known if n not in given]
    if role == "inputs" and missing:
        raise InputError(f"{where}.inputs: {missing[0]} missing, model {model.name} needs it")
    if not given:
        raise InputError(f"{where}.{role}: none given, wanted is one of {', '.join(known)}")
    out = {}
    for name, one in given.items():
        place = f"{where}.{role}.{name}.unit"
        si = naming.unit(record, name)
        unit = one.unit if one.unit is not None else (si or "1")
        sd, hold = getattr(one, "sd", None), getattr(one, "hold", "auto")
        out[name] = Signal(one.signal, unit, _si(unit, si, place, gain), sd, hold)
    return out


def _si(unit: str, si: str | None, place: str, gain: bool) -> str:
    try:
        if si is None:
            return units.si_of(unit)
        if gain and units.is_plain(unit):
            return "1"
        units.factor(unit, si)
    except ValueError as e:
        hint = ""
        if si is not None and unit.strip() in ("", "1", "-", "%", "stick", "dimensionless"):
            hint = "; or set fit.nuisance.input_gain: true, and the estimated gain carries the unit"
        raise InputError(f"{place}: {e}{hint}") from e
    return si
