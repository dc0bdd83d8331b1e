"""Channels of a log for the inputs and outputs of a model."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.model import axes_of
from heli_jax.flights.clock import words_in
from heli_jax.flights.preset import model_inputs, model_outputs
from heli_jax.new_config import guess, scales, tables, text
from heli_jax.new_config.guess import Guess, Series
from heli_jax.new_config.logs import Log
from heli_jax.numerics.white_noise import has_coloured_noise, without_noise


def signals_of(model: Any, log: Log) -> text.Signals:
    """Return channels for inputs and outputs of the model, and the channels left over."""
    called, taken = tables.names(), []
    inputs: dict[str, Guess | None] = {}
    numbered: dict[str, list[str]] = {}
    excitations: dict[str, str] = {}
    sticks = [n for n in log.series if not (guess.is_excitation(n) or is_place(n, log.series))]
    for name in naming.names(model.Inputs):
        stick = _stick(name)
        known = called["rotor_speed"] if name == "Omega" else []
        commands: list[str] = []
        if stick is not None:
            known, commands = called["inputs"][stick], called["commands"][stick]
            numbered[name] = guess.by_number(called["numbered"][stick], sticks)
        unit, known = naming.unit(model.Inputs, name) or "1", [words_of(name), *known]
        allowed = [n for n in sticks if guess.may_be_input(n, log.series[n], unit)]
        found = guess.by_name(known, allowed, commands)
        inputs[name] = _found(log, found, unit, taken, is_input=True)
        for channel in moving_channels(log, guess.excitations(known, tuple(log.series)))[:1]:
            excitations[name] = channel
    taken += excitations.values()
    outputs: dict[str, Guess] = {}
    for name in naming.names(model.Outputs):
        unit = naming.unit(model.Outputs, name) or "1"
        output = _found(log, outputs_by_name(log, names_of_output(name), unit), unit, taken)
        if output is not None:
            outputs[name] = output
    _by_number(model, log, inputs, numbered, taken)
    speed = guess.by_name(called["rotor_speed"], tuple(log.series))
    known = {}
    if speed and "Omega" in naming.names(model.Params):
        known = {"Omega": (speed[0], scales.rotor_speed(speed[0], log.series[speed[0]]))}
        taken.append(speed[0])
    rest = tuple(n for n in log.series if n not in taken)
    measured = [log.series[g.channel].values for g in outputs.values()]
    smooth = bool(measured) and all(map(without_noise, measured))
    wandering = {} if smooth else _wandering(model, log, outputs)
    outputs = {n: g for n, g in outputs.items() if n not in wandering}
    ranges = {n: (np.nanmin(x := log.series[n].values), np.nanmax(x)) for n in rest}
    return text.Signals(inputs, outputs, known, rest, excitations, wandering, smooth, ranges)


def rate_by_angle(model: Any) -> dict[str, str]:
    """Return the rate by angle, for a model whose only outputs are one axis's rate and angle.

    The angle then adds no information to the rate.
    """
    pairs = {a.angle: a.rate for a in axes_of(model) if a.angle is not None}
    outputs = set(naming.names(model.Outputs))
    return {angle: rate for angle, rate in pairs.items() if {angle, rate} == outputs}


def _wandering(model: Any, log: Log, outputs: Mapping[str, Guess]) -> dict[str, Guess]:
    """Return angles with a drift error, as from a rate integrated by an autopilot."""
    return {
        angle: outputs[angle]
        for angle, rate in rate_by_angle(model).items()
        if {angle, rate} <= set(outputs)
        and has_coloured_noise(log.series[outputs[angle].channel].values)
    }


def names_of_output(name: str) -> list[str]:
    """Return usual names of an output of a model, words separated by blanks."""
    return [words_of(name), *tables.names()["outputs"].get(model_outputs().get(name, name), [])]


def _stick(name: str) -> str | None:
    """Return the stick of a model's input, as in the table of names; None for other inputs."""
    signal = model_inputs().get(name)
    if signal is None or name == "Omega":
        return None
    return signal.command.removeprefix("cyclic_").replace("tail", "yaw")


def words_of(name: str) -> str:
    """Return the model's name of a signal, as words."""
    return " ".join(guess.words_of(name))


def outputs_by_name(log: Log, called: Sequence[str], si: str) -> list[str]:
    """Return channels that may be an output, the likeliest first."""
    # Spelled out among all names, because neighbouring names may decide the meaning.
    spelled = guess.spelled_out(tuple(log.series))
    names = {
        spelled.get(n, n): n
        for n, s in log.series.items()
        if guess.may_be(spelled.get(n, n), s, called, si)
    }
    return [names[n] for n in guess.by_name(called, list(names))]


def moving_channels(log: Log, names: Sequence[str]) -> list[str]:
    """Return the channels that move."""
    return [n for n in names if np.nanstd(log.series[n].values) > 0]


def _found(
    log: Log, names: Sequence[str], si: str, taken: list[str], is_input: bool = False
) -> Guess | None:
    candidates = [n for n in names if n not in taken]
    # A constant channel is a trim or not connected, but better than none.
    candidates = moving_channels(log, candidates) or candidates
    if not candidates:
        return None
    chosen = guess.of_known_unit(candidates, log.series, si)
    taken.append(chosen)
    scaled = scales.scaled(chosen, log.series[chosen], si, is_input=is_input)
    others = [n for n in candidates if n != chosen]
    if not others:
        return scaled
    remark = f"could be {', '.join(others[:3])} as well"
    return scaled._replace(remarks=(*scaled.remarks, remark))


def _by_number(
    model: Any,
    log: Log,
    inputs: dict[str, Guess | None],
    numbered: Mapping[str, list[str]],
    taken: list[str],
) -> None:
    """Assign inputs to channels with numbers as names, in the usual order."""
    for name, input in inputs.items():
        si = naming.unit(model.Inputs, name) or "1"
        names = [n for n in numbered.get(name, ()) if guess.may_be_input(n, log.series[n], si)]
        made = None if input is not None else _found(log, names, si, taken, is_input=True)
        if made is not None:
            why = "GUESS: by its number, in the order roll, pitch, throttle, yaw"
            inputs[name] = made._replace(remarks=(why, *made.remarks))


_CALLED = {"lat", "lon", "lng", "long", "latitude", "longitude"}
_STEADY = 50.0
"""Smallest ratio of a position to its range in a flight."""
_PARTS, _DEGREES, _INTEGERS = 1.5, 180.0, 1e6
"""Limits of a fraction of full travel, of half a circle [deg], and of a GPS receiver's integer
counts."""


def is_place(name: str, log: Mapping[str, Series]) -> bool:
    """True if a channel is a latitude or a longitude.

    The criterion is its name and its numbers, or a `Lng` beside it.
    """
    words = words_in(name)
    if not words or words[-1] not in _CALLED:
        return False
    siblings = {other for other in log if other.rpartition(".")[0] == name.rpartition(".")[0]}
    if any(words_in(other)[-1:] in (("lng",), ("longitude",)) for other in siblings):
        return True
    values = log[name].values[np.isfinite(log[name].values)]
    if not values.size:
        return False
    smallest, largest = float(np.min(np.abs(values))), float(np.max(np.abs(values)))
    # Pulse widths of a stick at rest are between the two.
    scaled = _PARTS < largest <= _DEGREES or largest > _INTEGERS
    return scaled and smallest > _STEADY * float(np.ptp(values))
