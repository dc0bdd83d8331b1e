"""Numbers of a configuration that may have a unit of their own, `{value: 3, unit: deg}`, in SI."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from heli_jax import naming
from heli_jax.config.schema import Config
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.vehicle import constant


def in_si(config: Config, model: Model, path: Path) -> Config:
    """The configuration with plain numbers in SI for the initial state and the disturbance.

    Args:
        config: as it stands in the file.
        model: with the configuration's devices around it.
        path: of the configuration, for errors.

    Raises:
        InputError: a unit that is unknown or of another kind, or no such state.
    """
    changes: dict[str, Any] = {}
    if config.initial_state:
        changes["initial_state"] = initial_state(config, model, path)
    disturbance = config.disturbance
    if disturbance is not None and disturbance.has_units:
        where = f"{path}: disturbance"
        try:
            params = with_disturbance(model, disturbance.names, disturbance.poles).Params
        except ValueError as e:
            raise InputError(f"{where}: {e}") from e
        converted = {}
        for key in ("sigma_w", "tau_w"):
            # The units are those that the disturbed model gives to its parameters.
            of_key = {n: _si(n, params) for n in disturbance.parameters if n.startswith(key)}
            converted[key] = _converted(getattr(disturbance, key), key, of_key, where)
        changes["disturbance"] = disturbance.model_copy(update=converted)
    return config.model_copy(update=changes)


def initial_state(config: Config, model: Model, path: Path) -> dict[str, float]:
    """The configuration's initial state [SI].

    Args:
        config: as it stands in the file.
        model: with the configuration's devices around it.
        path: of the configuration, for errors.

    Raises:
        InputError: no such state, or its number is wrong.
    """
    where, states = f"{path}: initial_state", naming.names(model.State)
    for name in config.initial_state:
        if name not in states:
            raise InputError(
                f"{where}: model {model.name} has no state {name!r}{nearest(name, states)}"
            )
    return {
        name: constant(entry, name, _si(name, model.State), where).value
        for name, entry in config.initial_state.items()
    }


def _si(name: str, record: type) -> str | None:
    return naming.unit(record, name)


# Any: None, a number, {value, unit}, or one of these for each of several disturbances by name.
def _converted(value: Any, key: str, si: Mapping[str, str | None], where: str) -> Any:
    """A disturbance's sizes or time constants, in the shape in which they stand in the file."""
    if isinstance(value, Mapping) and "value" not in value:
        return {
            n: _one(v, f"{key}.{n}", si.get(f"{key}_{n}", si.get(key)), where)
            for n, v in value.items()
        }
    # One number for several may only be a time constant, whose unit is that of all.
    return None if value is None else _one(value, key, next(iter(si.values())), where)


def _one(entry: Any, place: str, si: str | None, where: str) -> float:
    return constant(entry, place, si, where).value
