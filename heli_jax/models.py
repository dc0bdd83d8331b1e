"""The shipped models, and look-up of a model by its name in a configuration."""

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
