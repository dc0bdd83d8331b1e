"""The shipped models, and look-up of a model by its name in a configuration."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from heli_jax.dynamics import kinematics
from heli_jax.dynamics.check_model import check_model, description_of
from heli_jax.dynamics.helicopter import Corrections, helicopter
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.delays import with_delays
from heli_jax.dynamics.onboard.filters import Filter, with_filters
from heli_jax.dynamics.onboard.rate_loop import with_gyro, with_rate_loop
from heli_jax.dynamics.onboard.sensors import with_sensors
from heli_jax.dynamics.onboard.servos import with_servos
from heli_jax.dynamics.roll import on_stand, pitch, roll
from heli_jax.errors import InputError, located, nearest, require_known
from heli_jax.import_path import by_path, is_path
from heli_jax.linear_models import read as linear_models

roll_on_stand = on_stand(roll)
pitch_on_stand = on_stand(pitch)

__all__ = [
    "Filter",
    "by_name",
    "helicopter",
    "on_stand",
    "pitch",
    "pitch_on_stand",
    "roll",
    "roll_on_stand",
    "with_delays",
    "with_filters",
    "with_gyro",
    "with_rate_loop",
    "with_sensors",
    "with_servos",
]

# Names as used by the configuration, fit.json and the report; in Python the names are attributes.
_SHIPPED = {
    model.name: model
    for model in (
        *(roll, roll_on_stand, pitch, pitch_on_stand),
        *(kinematics.attitude, kinematics.velocity, kinematics.position),
    )
}
_HELICOPTERS: dict[str, Literal["paper", "consistent", "full"]] = {
    "helicopter": "full",
    "helicopter-consistent": "consistent",
    "helicopter-paper": "paper",
}
_MEANINGS = {
    "roll": "Roll with a Bell-Hiller flybar (Kim and Tilbury, eqs 21-22)",
    "roll-on-stand": "Roll with a Bell-Hiller flybar, on a stand with stiffness and damping",
    "pitch": "Pitch with a Bell-Hiller flybar (Kim and Tilbury, eqs 21-22)",
    "pitch-on-stand": "Pitch with a Bell-Hiller flybar, on a stand with stiffness and damping",
    "kinematics-attitude": "Angles from gyros, for data compatibility",
    "kinematics-velocity": "Angles and speeds from gyros and accelerometers",
    "kinematics-position": "Angles, speeds and positions from gyros and accelerometers",
    "helicopter": "Whole helicopter with tip-path plane, inflow, tail rotor and governor",
    "helicopter-consistent": "Whole helicopter of Kim and Tilbury with corrections",
    "helicopter-paper": "Whole helicopter of Kim and Tilbury as printed (eqs 2-20)",
}


def by_name(
    name: str,
    where: str = "model",
    folder: str | Path | None = None,
    *,
    corrections: Mapping[str, bool] | None = None,
    wind: bool = False,
) -> Model:
    """Return the shipped model of that name, or a user's own at 'package.module:name'.

    Args:
        name: such as 'roll', 'helicopter-paper' or 'package.module:name'.
        where: start of error messages, such as the file and the key.
        corrections: corrections of `helicopter`, for the whole helicopter only.
        wind: wind of `helicopter`, also for the whole helicopter only.

    Raises:
        InputError: no such model exists, or it takes no such correction or no wind; `where` begins
            the message.
    """
    if name in _HELICOPTERS:
        known = Corrections._fields
        require_known(corrections or {}, known, where, "the helicopter has no correction")
        # With a fixed order the cache returns the same model for the same switches.
        switches = dict(sorted((corrections or {}).items()))
        return helicopter(_HELICOPTERS[name], wind=wind, **switches)
    model = _SHIPPED[name] if name in _SHIPPED else _imported(name, where, folder)
    # An empty `corrections` is refused too, since the user expects an effect.
    if corrections is not None or wind:
        what = "wind" if wind else "corrections"
        raise InputError(
            f"{where}: {name!r} has no {what}, expected one of {', '.join(_HELICOPTERS)}"
        )
    return model


def names() -> tuple[str, ...]:
    """Return the names of the shipped models, without those from files."""
    return (*_SHIPPED, *_HELICOPTERS)


def listed() -> dict[str, str]:
    """Return a line on each shipped model, by its name for `by_text`."""
    linear = {f"linear:{n}": linear_models.linear_model(n) for n in linear_models.shipped()}
    return _MEANINGS | {n: re.split(r"[.:;] ", m.content.meaning)[0] for n, m in linear.items()}


def by_text(
    text: str, where: str = "model", folder: str | Path | None = None
) -> tuple[Model, str | dict[str, str]]:
    """Return the model that a command line names, and its name in a configuration.

    Args:
        text: such as 'helicopter', 'linear:roll', 'yaw', 'mine.yaml' or 'package.module:name'.
        where: start of error messages.
        folder: folder of modules.
    """
    # For roll and pitch there are the paper's model and a linear one: {linear: roll} is the latter.
    stated = text.strip().removeprefix("{").removesuffix("}")
    linear = stated.startswith("linear:")
    stated = stated.removeprefix("linear:").strip()
    file = linear_models.is_shipped(stated) or stated.endswith((".yaml", ".yml"))
    if linear or (file and stated not in _SHIPPED):
        return linear_models.linear_model(stated).model, {"linear": stated}
    return by_name(stated, where, folder), stated


def _imported(name: str, where: str, folder: str | Path | None) -> Model:
    if not is_path(name):
        # Spelling of the configuration: linear models are named by their file.
        files = (name,) if name.endswith((".yaml", ".yml")) else linear_models.shipped()
        known = [*names(), *(f"{{linear: {n}}}" for n in files), "package.module:name"]
        raise InputError(f"{where}: unknown model {name!r}{nearest(name, known)}")
    model = by_path(name, where, folder)
    if not isinstance(model, Model):
        kind = "nothing" if model is None else description_of(model)
        raise InputError(f"{where}: expected a heli_jax.Model at {name!r}, got {kind}")
    # Check here, so that the message can name the configuration's key.
    with located(where):
        check_model(model)
    return model
