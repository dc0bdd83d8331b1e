"""An experiment: a validated configuration with its model and vehicle."""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pydantic
from pydantic_core import ErrorDetails

from heli_jax import models, naming
from heli_jax.config.controller_file import read_controller
from heli_jax.config.keys import json_schema
from heli_jax.config.kinematics import completed
from heli_jax.config.measurement import OpenedLogs, with_measurement
from heli_jax.config.onboard import with_onboard
from heli_jax.config.schema import Config, LinearConfig
from heli_jax.control.controller import with_controller
from heli_jax.dynamics.check_model import starting_at
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, VehicleError, located, nearest, require_kind, require_known
from heli_jax.linear_models.read import LinearModel, is_shipped, linear_model
from heli_jax.schema_keys import expected, known_keys
from heli_jax.vehicle import Vehicle, constant, read_vehicle, vehicle_from_mapping
from heli_jax.yaml_file import EDIT, parse_value, read_mapping


class Experiment(NamedTuple):
    """A validated configuration with its model, vehicle and open logs."""

    config: Config
    path: Path
    """The configuration file; relative paths begin at its folder."""
    model: Model
    vehicle: Vehicle
    logs: OpenedLogs
    """Logs that the model needed, kept open until the flights are read."""

    @contextlib.contextmanager
    def located(self, section: str) -> Iterator[None]:
        """Prefix an error with its place: the section, or the vehicle's file."""
        try:
            with located(f"{self.path}: {section}" if section else str(self.path)):
                yield
        except InputError as e:
            if isinstance(e.__cause__, VehicleError):
                raise InputError(f"{self.vehicle.path}: {e.__cause__.problem}") from e
            raise


def load(path: str | Path, overrides: Sequence[str] | Mapping[str, Any] = ()) -> Experiment:
    """Read and validate a configuration, its model and its vehicle.

    A log is opened only if its settings are part of the model.

    Args:
        path: the configuration (YAML); paths in it begin at its folder.
        overrides: `key.path=value` texts, or values by `key.path`.

    Raises:
        InputError: anything in the file or an override is wrong.
    """
    return from_content(read_overridden(path, overrides), Path(path))


def read_overridden(
    path: str | Path, overrides: Sequence[str] | Mapping[str, Any] = ()
) -> dict[str, Any]:
    """Return the content of a configuration file with overrides, as `load` does, not validated.

    Raises:
        InputError: no such file, no YAML, or an invalid override.
        TypeError: `path` is no path.
    """
    require_kind("config", path, (str, Path), "the path of a configuration, 'fit.yaml'")
    content = read_mapping(path)
    # Before the validation, so that an override is checked like the file and may add a key.
    if isinstance(overrides, Mapping):
        for key, value in overrides.items():
            set_value(content, str(key), value, f"override {key!r:.80}")
        return content
    keys: set[str] = set()
    for text in overrides:
        key, value, where = parse_override(text)
        # Otherwise the last of several would silently win.
        if key in keys:
            raise InputError(
                f"{where}: {key} is set twice, expected one value (several: heli-jax fit --over)"
            )
        keys.add(key)
        set_value(content, key, value, where)
    return content


def from_content(content: dict[str, Any], path: Path) -> Experiment:
    """Return the experiment that the content of a configuration describes.

    Args:
        content: content of the YAML file; is not kept.
        path: the file, which need not exist: messages name it, and relative paths begin at its
            folder.

    Raises:
        InputError: anything in it is wrong.
    """
    config = _validated(completed(content, str(path)), str(path))
    # The model comes before the vehicle, because its Params define the vehicle's constants.
    logs = OpenedLogs()
    model = _model(config, path, logs)
    if config.initial_state:
        in_si = _initial_state(config, model, path)
        config = config.model_copy(update={"initial_state": in_si})
    vehicle = _vehicle(config, path, model)
    return Experiment(config, path, model, vehicle, logs)


def _model(config: Config, path: Path, logs: OpenedLogs) -> Model:
    folder = path.absolute().parent
    if isinstance(config.model, LinearConfig):
        if config.corrections is not None:
            # Corrections apply to the equations of the full helicopter; a linear model's entries
            # come from its file.
            raise InputError(f"{path}: corrections: a linear model takes none")
        return _started(config, path, _linear(config.model, path).model, logs)
    model = models.by_name(config.model, f"{path}: model", folder)
    # First without corrections, so that an unknown name is an error of `model`.
    if config.corrections is not None:
        where = f"{path}: corrections"
        model = models.by_name(config.model, where, folder, corrections=config.corrections)
    return _started(config, path, model, logs)


def _linear(model: LinearConfig, path: Path) -> LinearModel:
    """Return the linear model of a configuration; each file is read once."""
    try:
        return linear_model(model.linear, path.parent)
    except InputError as e:
        raise InputError(f"{path}: model.linear: {e}") from e


def _started(config: Config, path: Path, model: Model, logs: OpenedLogs) -> Model:
    """Return the model with the configuration's devices and initial state."""
    # Devices first, because the initial state may include their states.
    model = with_onboard(model, config.onboard, path)
    # Outermost, because it models the autopilot's processing of its sensors.
    model = with_measurement(model, config.flights, path, logs)
    if config.controller is not None:
        with located(f"{path}: controller"):
            model = with_controller(model, read_controller(path.parent / config.controller))
    if not config.initial_state:
        return model
    return starting_at(model, _initial_state(config, model, path))


def in_wind(experiment: Experiment, place: str = "simulate.wind") -> Experiment:
    """Return the experiment with a model that has the wind as inputs.

    Args:
        place: key of the wind, for messages.

    Raises:
        InputError: the model takes no wind.
    """
    config, path = experiment.config, experiment.path
    if isinstance(config.model, LinearConfig):
        raise InputError(f"{path}: {place}: a linear model takes no wind")
    # Built again by name: the wind's inputs are part of the model, and so is the initial state.
    model = models.by_name(
        config.model,
        f"{path}: {place}",
        path.absolute().parent,
        corrections=config.corrections,
        wind=True,
    )
    return experiment._replace(model=_started(config, path, model, experiment.logs))


def parse_override(text: str) -> tuple[str, Any, str]:
    """Return key, value and the prefix of messages for a `key.path=value` text.

    Raises:
        InputError: it is no such text.
    """
    key, equals, value = text.partition("=")
    where = f"--set {text!r:.80}"
    if not equals or not key.strip():
        raise InputError(f"{where}: expected key.path=value")
    # Parsed as YAML, so that --set fit.seed=1 is a number and =null switches a section off.
    return key.strip(), parse_value(value, where), where


# YAML content is Any below: a mapping, a list or a value, at any depth.
def set_value(content: dict[str, Any], key: str, value: Any, where: str) -> None:
    """Set a value at `key.path`, and create missing sections.

    Raises:
        InputError: the path passes through a value that is no section or list.
    """
    *above, last = key.split(".")
    at: Any = content
    for name in above:
        at = _child(at, name, where)
    if isinstance(at, list):
        at[_index(at, last, where)] = value
    elif isinstance(at, dict):
        at[last] = value
    else:
        raise InputError(
            f"{where}: {'.'.join(above)} must be a section or a list to set a key in it"
        )


def _child(at: Any, name: str, where: str) -> Any:
    if isinstance(at, list):
        return at[_index(at, name, where)]
    if isinstance(at, dict):
        return at.setdefault(name, {})  # a misspelt section is refused later as an unknown key
    raise InputError(f"{where}: the key before {name!r} must be a section or a list")


def _index(at: list[Any], name: str, where: str) -> int:
    # Indices are not negative and not beyond the end: a list is changed, never extended.
    if not name.isdigit() or int(name) >= len(at):
        raise InputError(f"{where}: got {name!r}, expected a number from 0 to {len(at) - 1}")
    return int(name)


def _validated(content: dict[str, Any], where: str) -> Config:
    try:
        config = Config.checked(content)
    except pydantic.ValidationError as e:
        # For a key with several allowed kinds pydantic reports errors of each; those of the actual
        # kind are useful. An unknown key comes first, because it is the likeliest cause of the
        # others. Only one error is shown: a list of twenty is too long to read.
        errors = sorted(e.errors(), key=_by_usefulness)
        raise InputError(f"{where}: {_sentence(errors[0])}") from None
    # If a text is allowed, it would be taken as a channel's name or a unit.
    if places := list(_unedited_places(content)):
        others = ", ".join(map(_place, places[1:]))
        more = f"; fill in also {others}" if others else ""
        raise InputError(f"{where}: {_edit_words(places[0])}{more}")
    return config


def _unedited_places(at: Any, place: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the places that the user still has to fill in."""
    if at == EDIT and place:
        yield place
    children = at.items() if isinstance(at, dict) else enumerate(at) if isinstance(at, list) else ()
    for key, value in children:
        yield from _unedited_places(value, (*place, key))


def _edit_words(place: tuple[str | int, ...]) -> str:
    expected = _MEANT.get(str(place[-1]), "your number")
    return f"fill in {_place(place)}: {expected}"


_KIND = re.compile(r"(str|int|float|bool|[A-Z]\w*Config|(list|dict|tuple|literal|constrained)\W.*)")
"""Member of a union, which pydantic inserts into places as if it were a key."""


def _by_usefulness(error: ErrorDetails) -> tuple[bool, bool]:
    """Sort key of errors: those of another kind than the actual value come last."""
    return _is_of_another_kind(error), error["type"] != "extra_forbidden"


def _is_of_another_kind(error: ErrorDetails) -> bool:
    kinds = [part for part in error["loc"] if isinstance(part, str) and _KIND.fullmatch(part)]
    # Only if the value as a whole is not the error.
    return bool(kinds) and error["loc"][-1] == kinds[-1] and not error["type"].startswith("value")


def _sentence(error: ErrorDetails) -> str:
    place = _place(error["loc"])
    value = error.get("input")
    # pydantic inserts members of unions.
    keys = [part for part in error["loc"] if not _KIND.fullmatch(str(part))]
    if error["type"] == "extra_forbidden":
        # Only keys of the same section are useful suggestions.
        known = known_keys(json_schema(), keys[:-1])
        return f"{place}: unknown key{nearest(str(keys[-1]), known)}"
    if error["type"] == "missing":
        return f"{place}: missing"
    if value == EDIT:
        return _edit_words(error["loc"])
    if _is_of_another_kind(error):
        return f"{place}: got {value!r:.60}, expected {expected(json_schema(), keys)}"
    # pydantic's sentence without its beginning becomes part of ours: "Input should be ...".
    message = str(error["msg"]).removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    if error["type"] == "list_type" and isinstance(value, str | int | float):
        return f"{place}: expected a list, such as [{value!s:.40}], got {value!r:.60}"
    if error["type"] in ("model_type", "dict_type"):
        without = "; left out, it has its defaults" if value is None else ""
        keys = f"see heli-jax keys {place.partition('[')[0]}"
        return (
            f"{place}: got {value!r:.60}, expected a section of keys and values ({keys}){without}"
        )
    # A section states its place; quoting it would fill the line. Our own validators already quote
    # the value.
    if isinstance(value, dict | list) or error["type"] == "value_error":
        return f"{place}: {message}"
    return f"{place}: got {value!r:.60}, {message.replace('input should be', 'expected')}"


_MEANT = {
    "signal": "the channel in the log; delete an output that was not logged; an input that did "
    "not move is {constant: 0}",
    "unit": "the unit of the channel's numbers in the log",
    "rate": "samples a second, in Hz",
    "scale": "the input for one unit of the log (full travel over full travel in the log)",
    "start": "a start value, within a factor of about three",
}
"""Values that `heli-jax new` cannot know, by the last word of the key."""


def _place(loc: tuple[int | str, ...]) -> str:
    text = ""
    for part in loc:
        if isinstance(part, int):
            text += f"[{part}]"
        elif not _KIND.fullmatch(part):
            text += f".{part}" if text else str(part)
    return text or "the configuration"


def _vehicle(config: Config, path: Path, model: Model) -> Vehicle:
    if isinstance(config.model, LinearConfig):
        vehicle = _of_linear(config, config.model, path, model)
    else:
        vehicle = _of_model(config, path, model)
    # Checked here for all kinds of models: a mass or a time constant of zero divides, and later
    # errors would not name it.
    for name in model.positive:
        constant = vehicle.constants.get(name)
        if constant is not None and constant.value <= 0:
            raise InputError(f"{vehicle.path}: {name} must be above zero, got {constant.value:g}")
    return vehicle


def _of_model(config: Config, path: Path, model: Model) -> Vehicle:
    """Return the vehicle of a model in Python, whose Params define the constants and units."""
    fitted = _found_by_fit(config)
    if config.vehicle is None and not fitted:
        raise InputError(
            f"{path}: vehicle: missing, expected the file with the constants of {model.name}, or "
            f"these themselves: {', '.join(naming.names(model.Params)[:3])}, ... (heli-jax new LOG "
            f"--model {model.name} writes a file to fill in)"
        )
    if isinstance(config.vehicle, str):
        return read_vehicle(path.parent / config.vehicle, model.Params, fitted)
    return vehicle_from_mapping(config.vehicle or {}, f"{path}: vehicle", model.Params, fitted)


def _found_by_fit(config: Config) -> tuple[str, ...]:
    """Return the parameters that a fit finds without a start value."""
    # A regression of the records needs no start, so neither the configuration nor the vehicle must
    # have one.
    if config.fit is None or config.fit.start == "given":
        return ()
    return tuple(config.fit.free)


def _of_linear(config: Config, model: LinearConfig, path: Path, built: Model) -> Vehicle:
    """Return the values of a linear model's file, overridden by the configuration."""
    read = _linear(model, path)
    vehicle, where = config.vehicle, f"{path}: vehicle"
    if isinstance(vehicle, str):
        where = str(path.parent / vehicle)
        vehicle = read_mapping(path.parent / vehicle)
    if vehicle is None:
        own = read.vehicle()
        vehicle, where = {}, own.path
    else:
        known = naming.names(built.Params)
        require_known(vehicle, known, where, "unknown constant")
        own = read.vehicle(
            {n: v for n, v in vehicle.items() if n in naming.names(read.model.Params)}, where
        )
    if built.Params is read.model.Params:
        return own
    # Devices around the model have parameters that the file does not contain.
    entries = {n: c._asdict() for n, c in own.constants.items()}
    return vehicle_from_mapping({**vehicle, **entries}, where, built.Params)


def resolved(experiment: Experiment) -> dict[str, Any]:
    """Return the complete configuration, so that it runs again from anywhere.

    Paths of logs become absolute; the vehicle is included with units and sources.
    """
    config, path = experiment.config, experiment.path
    # Without None: a missing key means the same, and stays right if a default changes.
    content = config.model_dump(mode="json", exclude_none=True, by_alias=True)
    # Except the one key whose absence has another meaning.
    if config.rls is None:
        content["rls"] = None
    if config.controller is not None:
        content["controller"] = str((path.parent / config.controller).resolve())
    # A shipped model keeps its name, which is valid on any computer.
    if isinstance(config.model, LinearConfig) and not is_shipped(config.model.linear):
        content["model"] = {"linear": str((path.parent / config.model.linear).resolve())}
    for free in content.get("fit", {}).get("free", {}).values():
        if math.isnan(free["start"]):  # left out, and YAML's .nan is refused
            del free["start"]
    for flight in content.get("flights", []):
        # Links are resolved too, because the run's config.yaml is read from its own directory.
        for log in (flight, *flight["also"]):
            log["log"] = str((path.parent / log["log"]).resolve())
    for design in _designs(content.get("sweep")):
        if "file" in design:
            design["file"] = str((path.parent / design["file"]).resolve())
    # As read, not as converted: a reader of the copy sees the number and unit of the source.
    content["vehicle"] = {
        name: {"value": c.value, "unit": c.unit, "source": c.source}
        for name, c in experiment.vehicle.constants.items()
    }
    return content


def _designs(design: dict[str, Any] | None) -> Iterator[dict[str, Any]]:
    """Yield a design's section and those in it."""
    if design is not None:
        yield design
        for part in design.get("of", []):
            yield from _designs(part)


def _initial_state(config: Config, model: Model, path: Path) -> dict[str, float]:
    """Return the configuration's initial state [SI]."""
    where, states = f"{path}: initial_state", naming.names(model.State)
    require_known(config.initial_state, states, where, f"model {model.name} has no state")
    return {
        name: constant(entry, name, naming.unit(model.State, name), where).value
        for name, entry in config.initial_state.items()
    }
