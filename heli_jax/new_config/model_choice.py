"""Choice of the model for a log: the stated one, or that of the axis that moves."""

from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import models
from heli_jax.flights.log import ChannelLog, shown, wrong
from heli_jax.flights.preset import fitting_presets
from heli_jax.linear_models import read as linear_models
from heli_jax.new_config import guess, tables
from heli_jax.new_config.logs import FEWEST, Log
from heli_jax.new_config.signals import is_place, moving_channels, outputs_by_name

_AXES = {
    "roll": ("roll-flybarless", ("roll_rate", "roll")),
    "pitch": ("pitch-flybarless", ("pitch_rate", "pitch")),
    "yaw": ("yaw", ("yaw_rate",)),
    "collective": ("heave", ("down_speed",)),
}
"""Linear model of the axis by stick, and the signals that must be logged for it."""
_UNITS = {"roll": "rad", "pitch": "rad", "down_speed": "m/s"} | dict.fromkeys(
    ("roll_rate", "pitch_rate", "yaw_rate"), "rad/s"
)
_OTHER_FIRMWARE = ("ArduPlane", "ArduRover", "Rover", "Blimp", "ArduSub", "APM:Plane", "APM:Rover")
"""Names of ArduPilot firmware for other vehicles."""
_HELICOPTERS = {"FRAME_CLASS": (0, 6, 11, 13), "CA_AIRFRAME": (10, 11, 12), "MAV_TYPE": (0, 3, 4)}
"""Values for helicopters, and 0 for none, of settings of ArduPilot and PX4 by their rank."""
_FULL_TRAVEL = 1.5
"""Largest value of a stick in parts of full travel; radios may exceed 1."""


def chosen_model(
    name: str | None, log: Log, path: str, folder: Path
) -> tuple[Any, str | dict[str, str], bool]:
    """Return the model, its name in a configuration, and True if it is linear from a file.

    Args:
        name: as stated; by default chosen from the signals that move.
        path: path of the log, for messages.
        folder: folder of the configuration.
    """
    if name is None:
        vehicle = other_vehicle(log.autopilot)
        if vehicle:
            problem = f"the log is of {vehicle}, and new chooses only helicopter models"
            remedy = "expected --model NAME, such as linear:FILE.yaml, a model file of your own"
            raise wrong(path, f"{problem}; {remedy}")
        name = _by_moving_stick(log, path)
    # For roll and pitch there are the paper's model and a linear one: {linear: roll} is the latter.
    stated = name.strip().removeprefix("{").removesuffix("}")
    linear = stated.startswith("linear:")
    stated = stated.removeprefix("linear:").strip()
    file = linear_models.is_shipped(stated) or stated.endswith((".yaml", ".yml"))
    if not linear and (not file or stated in ("roll", "pitch")):
        return models.by_name(stated, "--model", folder), stated, False
    return linear_models.linear_model(stated).model, {"linear": stated}, True


def other_vehicle(log: ChannelLog | None) -> str:
    """Return why an autopilot's log is of no helicopter; empty if it may be of one."""
    if log is None:
        return ""
    if log.firmware.startswith(_OTHER_FIRMWARE):
        return f"no helicopter ({log.firmware})"
    name = next((n for n in _HELICOPTERS if n in log.parameters), None)
    if name is None or log.parameters[name] in _HELICOPTERS[name]:
        return ""
    return f"no helicopter ({name} {log.parameters[name]})"


def _by_moving_stick(log: Log, path: str) -> str:
    """Return the linear model of the axis whose stick moves most and whose motion is logged."""
    called = tables.names()
    names = tuple(n for n in log.series if not is_place(n, log.series))
    moving, still = {}, list[str]()
    for stick, (model, measured) in _AXES.items():
        by_name = guess.by_name(called["inputs"][stick], names, called["commands"][stick])
        by_name = by_name or guess.by_number(called["numbered"][stick], names)
        sticks = [n for n in by_name if not guess.is_excitation(n)]
        outputs = [
            n for m in measured for n in outputs_by_name(log, called["outputs"][m], _UNITS[m])
        ]
        moved = moving_channels(log, sticks)
        if moved and moving_channels(log, outputs):
            moving[model] = log.series[moved[0]].values
        elif sticks and outputs:
            still += outputs if moved else sticks
    if fitting_presets(log.format, names):
        return "roll-flybarless"
    if not moving:
        listed = ", ".join(map(shown, names[:12])) or f"none with {FEWEST} numbers"
        problem = "no column names match a stick and a rate or angle of its axis that both move"
        if still:
            problem = f"{', '.join(map(shown, still))} does not move, expected a stick and a motion"
        remedy = "name a model by --model, then fill in the signals in the file it writes"
        raise wrong(path, f"{problem} (columns: {listed}); {remedy}")
    most = {model: float(np.nanmax(np.abs(values))) for model, values in moving.items()}
    # Fractions of full travel are compared directly; the full travel of other numbers is unknown.
    alike = max(most.values()) <= _FULL_TRAVEL
    size = {m: np.nanstd(values) / (1.0 if alike else most[m]) for m, values in moving.items()}
    return max(size, key=lambda model: size[model])


def other_models(name: str | dict[str, str]) -> tuple[tuple[str, str], ...]:
    """Return other models of the axis of a linear one, with their purposes."""
    assert isinstance(name, dict)
    return tuple(tables.models()["also"].get(name["linear"], {}).items())
