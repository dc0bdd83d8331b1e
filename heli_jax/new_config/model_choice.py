"""Choice of the model for a log: the stated one, or that of the vehicle's axis that moves."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import models
from heli_jax.flights.log import ChannelLog, shown, wrong
from heli_jax.flights.preset import fitting_presets
from heli_jax.new_config import guess, tables
from heli_jax.new_config.logs import FEWEST, Log
from heli_jax.new_config.rate import channels_of_preset
from heli_jax.new_config.signals import is_place, moving_channels, outputs_by_name

_MEASURED = {
    "roll": ("roll_rate", "roll"),
    "pitch": ("pitch_rate", "pitch"),
    "yaw": ("yaw_rate",),
    "collective": ("down_speed",),
}
"""Signals of which one must be logged, by the stick that moves it."""
_UNITS = {"roll": "rad", "pitch": "rad", "down_speed": "m/s"} | dict.fromkeys(
    ("roll_rate", "pitch_rate", "yaw_rate"), "rad/s"
)
_OTHER = "other vehicle"
_FIRMWARE = {
    **dict.fromkeys(("ArduPlane", "APM:Plane"), "aeroplane"),
    **dict.fromkeys(("ArduRover", "Rover", "Blimp", "ArduSub", "APM:Rover"), _OTHER),
    "Betaflight": "multirotor",
    "Rotorflight": "helicopter",
}
"""Vehicle by the beginning of the firmware's name, for firmware of one kind of vehicle."""
_SETTINGS = {
    "FRAME_CLASS": {
        "helicopter": (6, 11, 13), "multirotor": (1, 2, 3, 4, 5, 7, 12, 14, 15, 17), "": (0,)
    },
    "CA_AIRFRAME": {"helicopter": (10, 11, 12), "multirotor": (0, 8), "aeroplane": (1,)},
    "MAV_TYPE": {
        "helicopter": (3, 4), "multirotor": (2, 13, 14, 15, 29, 35), "aeroplane": (1,), "": (0,)
    },
}  # fmt: skip
"""Values of settings of ArduPilot and PX4 by vehicle, by the rank of the setting."""
_ARTICLES = {"multirotor": "a multirotor", "aeroplane": "an aeroplane"}
_FULL_TRAVEL = 1.5
"""Largest value of a stick in parts of full travel; radios may exceed 1."""


def chosen_model(
    name: str | None, log: Log, path: str, folder: Path
) -> tuple[Any, str | dict[str, str], str]:
    """Return the model, its name in a configuration, and the reason for the choice.

    Args:
        name: as stated, which needs no reason; by default chosen by the vehicle and its motion.
        path: path of the log, for messages.
        folder: folder of the configuration.
    """
    reason = ""
    if name is None:
        vehicle, shown_by = vehicle_of(log.autopilot)
        offered = tables.models()["vehicles"]
        if vehicle not in ("", *offered):
            problem = f"{shown_by} is no {', '.join(offered)}"
            remedy = "expected --model NAME, see heli-jax models, or a model file of your own"
            raise wrong(path, f"{problem}; {remedy}")
        by_stick = offered[vehicle or "helicopter"]
        preset = next(iter(fitting_presets(log.format, tuple(log.series))), None)
        # The throttle of a vehicle that hovers may move most, but roll has more to identify.
        by_default = preset is not None and "collective" in by_stick
        stick = "roll" if by_default else _moving_stick(log, path, by_stick, preset)
        name = str(by_stick[stick])
        found = shown_by or "the log shows no vehicle"
        axis = f"{stick} axis, the default" if by_default else f"{stick} axis, which moves most"
        reason = f"suits {_ARTICLES.get(vehicle, 'a helicopter')} ({found}) and its {axis}"
    return *models.by_text(name, "--model", folder), reason


def vehicle_of(log: ChannelLog | None) -> tuple[str, str]:
    """Return the vehicle of an autopilot's log and what shows it; empty if it is not known.

    A vehicle is 'helicopter', 'multirotor', 'aeroplane' or, without models here, 'other vehicle'.
    """
    if log is None:
        return "", ""
    vehicle = next((v for n, v in _FIRMWARE.items() if log.firmware.startswith(n)), None)
    if vehicle is not None:
        # An aeroplane that hovers is no aeroplane in hover.
        return _OTHER if log.parameters.get("Q_ENABLE") else vehicle, log.firmware
    name = next((n for n in _SETTINGS if n in log.parameters), None)
    if name is None:
        return "", ""
    value = log.parameters[name]
    vehicle = next((v for v, values in _SETTINGS[name].items() if value in values), _OTHER)
    return vehicle, f"{name} {value:g}" if vehicle else ""


def _moving_stick(log: Log, path: str, sticks: Collection[str], preset: str | None) -> str:
    """Return the stick that moves most, of those whose motion is logged."""
    called = tables.names()
    names = tuple(n for n in log.series if not is_place(n, log.series))
    moving, still = {}, list[str]()
    for stick in sticks:
        if preset is None:
            by_name = guess.by_name(called["inputs"][stick], names, called["commands"][stick])
            by_name = by_name or guess.by_number(called["numbered"][stick], names)
            inputs = [n for n in by_name if not guess.is_excitation(n)]
            outputs = [
                n
                for m in _MEASURED[stick]
                for n in outputs_by_name(log, called["outputs"][m], _UNITS[m])
            ]
        else:
            command = {"yaw": "tail"}.get(stick, f"cyclic_{stick}")
            inputs = channels_of_preset(preset, log.series, [command])
            outputs = channels_of_preset(preset, log.series, _MEASURED[stick])
        moved = moving_channels(log, inputs)
        if moved and moving_channels(log, outputs):
            moving[stick] = log.series[moved[0]].values
        elif inputs and outputs:
            still += outputs if moved else inputs
    if not moving:
        listed = ", ".join(map(shown, names[:12])) or f"none with {FEWEST} numbers"
        problem = "no column names match a stick and a rate or angle of its axis that both move"
        if still:
            problem = f"{', '.join(map(shown, still))} does not move, expected a stick and a motion"
        remedy = "name a model by --model, then fill in the signals in the file it writes"
        raise wrong(path, f"{problem} (columns: {listed}); {remedy}")
    most = {stick: float(np.nanmax(np.abs(values))) for stick, values in moving.items()}
    # Fractions of full travel are compared directly; the full travel of other numbers is unknown.
    alike = max(most.values()) <= _FULL_TRAVEL
    size = {s: np.nanstd(values) / (1.0 if alike else most[s]) for s, values in moving.items()}
    return max(size, key=lambda stick: size[stick])


def other_models(name: str | dict[str, str]) -> tuple[tuple[str, str], ...]:
    """Return other models of the axis of a linear one, with their purposes."""
    assert isinstance(name, dict)
    return tuple(tables.models()["also"].get(name["linear"], {}).items())
