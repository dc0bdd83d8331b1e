"""The model that a log is fitted with: the one that is named, or that of the axis that moves."""

from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import models
from heli_jax.flights.preset import fitting_presets
from heli_jax.flights.table import shown, wrong
from heli_jax.linear_models import read as linear_models
from heli_jax.new_config import guess, tables
from heli_jax.new_config.logs import Log
from heli_jax.new_config.places import is_place
from heli_jax.new_config.signals import outputs_called, that_move

_AXES = {
    "roll": ("roll-flybarless", ("roll_rate", "roll")),
    "pitch": ("pitch-flybarless", ("pitch_rate", "pitch")),
    "yaw": ("yaw", ("yaw_rate",)),
    "collective": ("heave", ("down_speed",)),
}
"""by stick the linear model of its axis, and what has to be logged for it"""
_UNITS = {"roll": "rad", "pitch": "rad", "down_speed": "m/s"} | dict.fromkeys(
    ("roll_rate", "pitch_rate", "yaw_rate"), "rad/s"
)
_FULL_TRAVEL = 1.5
"""of a stick in parts of it, which radios let exceed 1"""


def chosen_model(
    name: str | None, log: Log, path: str, folder: Path
) -> tuple[Any, str | dict[str, str], bool]:
    """The model, what a configuration calls it, and whether it is linear from a file.

    Args:
        name: as stated; chosen by what moves unless given.
        log: of which signals are known.
        path: of the log.
        folder: of the configuration, where a module of one's own lies.
    """
    if name is None:
        name = _by_what_moves(log, path)
    # Of roll and pitch there are the paper's model and a linear one: the latter by {linear: roll}.
    stated = name.strip().removeprefix("{").removesuffix("}")
    linear = stated.startswith("linear:")
    stated = stated.removeprefix("linear:").strip()
    file = linear_models.is_shipped(stated) or stated.endswith((".yaml", ".yml"))
    if not linear and (not file or stated in ("roll", "pitch")):
        return models.by_name(stated, "--model", folder), stated, False
    return linear_models.linear_model(stated).model, {"linear": stated}, True


def _by_what_moves(log: Log, path: str) -> str:
    """The linear model of the axis whose stick moves most, of those whose motion is logged."""
    called = tables.names()
    names = tuple(n for n in log.series if not is_place(n, log.series))
    moving = {}
    for stick, (model, measured) in _AXES.items():
        by_name = guess.by_name(called["inputs"][stick], names, called["commands"][stick])
        by_name = by_name or guess.by_number(called["numbered"][stick], names)
        sticks = that_move(log, [n for n in by_name if not guess.is_excitation(n)])
        outputs = [
            n for m in measured for n in outputs_called(log, called["outputs"][m], _UNITS[m])
        ]
        if sticks and that_move(log, outputs):
            moving[model] = log.series[sticks[0]].values
    if fitting_presets(log.format, names):
        return "roll-flybarless"
    if not moving:
        listed = ", ".join(map(shown, names[:12]))
        problem = "found no stick beside a rate or an angle of its axis by their names, expected"
        raise wrong(path, f"{problem} --model and then the signals by hand; it holds {listed}")
    most = {model: float(np.nanmax(np.abs(values))) for model, values in moving.items()}
    # Parts of full travel are compared as they are; of other numbers nobody knows full travel.
    alike = max(most.values()) <= _FULL_TRAVEL
    size = {m: np.nanstd(values) / (1.0 if alike else most[m]) for m, values in moving.items()}
    return max(size, key=lambda model: size[model])


def other_models(name: str | dict[str, str]) -> tuple[tuple[str, str], ...]:
    """Other models of the axis of a linear one, with what each is for."""
    assert isinstance(name, dict)
    return tuple(tables.models()["also"].get(name["linear"], {}).items())
