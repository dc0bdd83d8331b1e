"""Content of a linear model's file except its matrices, checked and in SI: `content_of`.

Every problem is an InputError with one sentence that begins with the place in the file.
"""

import keyword
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from heli_jax import units
from heli_jax.dynamics.model import Axis
from heli_jax.errors import InputError, nearest
from heli_jax.linear_models.expression import Dimension
from heli_jax.vehicle import Constant

_KEYS = (
    "name", "meaning", "states", "inputs", "outputs", "parameters", "A", "B", "C", "D", "E",
    "delays", "axes",
)  # fmt: skip
# Names become fields of NamedTuples, which allow no leading underscore and no keyword. They also
# appear in expressions, whose grammar is ASCII.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")
_TITLE = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.+-]{0,59}")
_MOST = 100
"""Most states, inputs or outputs; larger dense matrices take minutes to compile."""
_TAKEN = ("seed", "sigma_w", "tau_w")
"""Names that sweeps and disturbances add."""
# Base units of `heli_jax.units` in the order of a Dimension, without the radian, since an angle is
# a plain number here.
BASE_UNITS = ("kg", "m", "s", "A")
PLAIN: Dimension = (0, 0, 0, 0)
TIME: Dimension = (0, 0, 1, 0)


class Signal(NamedTuple):
    """A state, an input or an output."""

    si: str
    """Internal unit."""
    scale: float
    """Factor from the file's unit to SI."""
    dimension: Dimension
    meaning: str


class Quantity(NamedTuple):
    """A parameter."""

    constant: Constant
    """Value and unit in SI."""
    dimension: Dimension
    positive: bool
    meaning: str


class Content(NamedTuple):
    """A checked file without its matrices."""

    name: str
    states: dict[str, Signal]
    inputs: dict[str, Signal]
    outputs: dict[str, Signal]
    parameters: dict[str, Quantity]
    delays: tuple[tuple[str, str], ...]
    axes: tuple[Axis, ...]
    meaning: str = ""


def content_of(mapping: Mapping[str, Any]) -> Content:
    """Return the content of a file from its YAML.

    Raises:
        InputError: it is wrong; the message begins with the place in the file.
    """
    # Unknown keys first, since a misspelt key is the most likely reason for a missing one.
    _known(mapping, _KEYS, "")
    needed = ("name", "states", "inputs", "outputs", "parameters", "A")
    for key in needed:
        if key not in mapping:
            raise InputError(f"{key}: missing, a linear model needs {', '.join(needed)}")
    name = mapping["name"]
    if not isinstance(name, str) or not _TITLE.fullmatch(name):
        raise InputError(f"name: expected a short name such as roll, got {name!r:.60}")
    # Outputs may share names with states, since such an output is that state.
    states, inputs, outputs = (
        {n: _signal(one, f"{key}.{n}") for n, one in _section(mapping, key).items()}
        for key in ("states", "inputs", "outputs")
    )
    parameters = {
        n: _quantity(one, f"parameters.{n}") for n, one in _section(mapping, "parameters").items()
    }
    _once({"states": states, "inputs": inputs, "parameters": parameters})
    return Content(
        name,
        states,
        inputs,
        outputs,
        parameters,
        _delays(mapping, inputs, parameters),
        _axes(mapping, states, inputs),
        _words(mapping, "meaning", name),
    )


def _known(mapping: Mapping[Any, Any], known: Iterable[str], place: str) -> None:
    for key in mapping:
        if key not in known:
            where = f"{place}.{key}" if place else f"{key}"
            raise InputError(f"{where}: unknown key{nearest(str(key), known)}")


def _section(mapping: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a section of named items, which must not be empty; check the names."""
    section = as_mapping(mapping[key], key)
    if not section:
        hint = (
            ": for a free decay name an input that does not act, and state signals.inputs: {} in "
            "the flight"
        )
        raise InputError(f"{key}: empty, expected at least one{hint if key == 'inputs' else ''}")
    # Parameters do not enlarge matrices, so they have no limit.
    if len(section) > _MOST and key != "parameters":
        raise InputError(f"{key}: expected at most {_MOST}, got {len(section)}")
    for name in section:
        if not isinstance(name, str) or not _NAME.fullmatch(name) or keyword.iskeyword(name):
            raise InputError(
                f"{key}: expected a name of letters, digits and _ that begins with a letter, got "
                f"{name!r:.60}"
            )
        # A sweep's axis with such a name would be ambiguous.
        if name in _TAKEN:
            raise InputError(
                f"{key}.{name}: this name is reserved for sweeps and disturbances, expected another"
            )
    return section


def as_mapping(value: Any, place: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: expected names with values, got {value!r:.60}")
    return value


def _once(sections: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a name in two sections, which would make expressions ambiguous."""
    seen: dict[str, str] = {}
    for key, section in sections.items():
        for name in section:
            if name in seen:
                raise InputError(
                    f"{key}.{name}: also a name in {seen[name]}, expected another name"
                )
            seen[name] = key


def _signal(entry: Any, place: str) -> Signal:
    """Return a state, input or output from its unit, or from {unit, meaning}."""
    # A unit alone is the usual form; mappings would double the length of a file.
    entry = {"unit": entry} if isinstance(entry, str) else as_mapping(entry, place)
    _known(entry, ("unit", "meaning"), place)
    si, scale, dimension = _unit(entry, place)
    return Signal(si, scale, dimension, _words(entry, "meaning", place))


def _quantity(entry: Any, place: str) -> Quantity:
    entry = as_mapping(entry, place)
    _known(entry, ("value", "unit", "source", "meaning", "positive"), place)
    value = entry.get("value")
    # Python's true is the number 1, so it is refused explicitly, here and below.
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{place}.value: expected a number, got {value!r:.40}")
    si, scale, dimension = _unit(entry, place)
    # Checked in SI, since a large number in a large unit overflows only here.
    number = float(value) * scale
    if not math.isfinite(number):
        raise InputError(f"{place}.value: expected a finite number, got {value!r:.40}")
    positive = entry.get("positive", False)
    if not isinstance(positive, bool):
        raise InputError(f"{place}.positive: expected true or false, got {positive!r:.40}")
    source = _words(entry, "source", place)
    # Stored in SI, since all results are in SI.
    constant = Constant(number, si, source)
    return Quantity(constant, dimension, positive, _words(entry, "meaning", place))


def _words(mapping: Mapping[str, Any], key: str, place: str) -> str:
    words = mapping.get(key, "")
    if not isinstance(words, str):
        raise InputError(f"{place}.{key}: expected words, got {words!r:.40}")
    return words


def _unit(mapping: Mapping[str, Any], place: str) -> tuple[str, float, Dimension]:
    """Return the SI unit of the same kind, the factor to it, and the dimension."""
    unit = mapping.get("unit")
    # YAML reads a bare 1 as a number.
    unit = str(unit) if unit == 1 and not isinstance(unit, bool) else unit
    if not isinstance(unit, str):
        got = "nothing" if unit is None else f"{unit!r:.40}"
        raise InputError(f"{place}.unit: expected a unit such as rad/s or 1, got {got}")
    try:
        # The SI unit comes from the exponents, so that units of one kind give the same text and can
        # be compared by it.
        exponents = units.base_of(unit)
        si = units.as_text(exponents)
        scale = units.factor(unit, si)
    except ValueError as e:
        raise InputError(f"{place}.unit: {e}") from e
    # An angle is a plain number here, so rad/s and 1/s have one dimension.
    return si, scale, tuple(exponents.get(n, 0) for n in BASE_UNITS)


def _delays(
    mapping: Mapping[str, Any],
    inputs: Mapping[str, Signal],
    parameters: Mapping[str, Quantity],
) -> tuple[tuple[str, str], ...]:
    delays = []
    for name, parameter in as_mapping(mapping.get("delays", {}), "delays").items():
        place = f"delays.{name}"
        if name not in inputs:
            raise InputError(f"{place}: no such input{nearest(str(name), inputs)}")
        if not isinstance(parameter, str) or parameter not in parameters:
            raise InputError(
                f"{place}: expected the name of a parameter, got {parameter!r:.40}"
                f"{nearest(str(parameter), parameters)}"
            )
        # Any sign is allowed, since a delay is negative if two clocks differ.
        if parameters[parameter].dimension != TIME:
            raise InputError(
                f"{place}: expected a parameter in s, got {parameter} in "
                f"{parameters[parameter].constant.unit}"
            )
        delays.append((name, parameter))
    # A disturbance needs a rate among the states; a mode has a name even without an angle.
    return tuple(delays)


# Axis, states that may be its rate, state that may be its angle.
_AXES = (
    ("roll", ("p", "dphi"), "phi"),
    ("pitch", ("q", "dtheta"), "theta"),
    ("yaw", ("r", "dpsi"), "psi"),
    ("heave", ("w",), None),
)


def _axes(
    mapping: Mapping[str, Any], states: Mapping[str, Signal], inputs: Mapping[str, Signal]
) -> tuple[Axis, ...]:
    """Return the axes stated in the file, else those from the names of its states."""
    if "axes" not in mapping:
        return tuple(
            Axis(name, rate, angle if angle in states else None)
            for name, rates, angle in _AXES
            for rate in rates
            if rate in states
        )
    axes = as_mapping(mapping["axes"], "axes")
    return tuple(_axis(str(n), one, states, inputs) for n, one in axes.items())


def _axis(
    name: str, entry: Any, states: Mapping[str, Signal], inputs: Mapping[str, Signal]
) -> Axis:
    place = f"axes.{name}"
    entry = as_mapping(entry, place)
    _known(entry, ("rate", "angle", "stick", "flybar", "flapping"), place)
    if "rate" not in entry:
        raise InputError(f"{place}.rate: missing, expected a state")
    # One list, so that all names are checked in the same way.
    named = [("rate", entry["rate"], states)]
    for key in ("flybar", "flapping"):
        several = entry.get(key, [])
        if not isinstance(several, list):
            raise InputError(f"{place}.{key}: expected a list of states, got {several!r:.40}")
        named += [(key, one, states) for one in several]
    named += [
        (key, entry[key], known)
        for key, known in (("angle", states), ("stick", inputs))
        if key in entry
    ]
    for key, one, known in named:
        if not isinstance(one, str) or one not in known:
            kind = "input" if known is inputs else "state"
            raise InputError(f"{place}.{key}: no such {kind} {one!r:.40}{nearest(str(one), known)}")
    return Axis(
        name,
        entry["rate"],
        entry.get("angle"),
        stick=entry.get("stick"),
        flybar=tuple(entry.get("flybar", [])),
        tilt=tuple(entry.get("flapping", [])),
    )
