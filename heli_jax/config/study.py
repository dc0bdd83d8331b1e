"""Study of fits of a configuration: keys that take several values."""

import copy
import glob
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from heli_jax.config.experiment import (
    from_content,
    parse_override,
    read_overridden,
    resolved,
    set_value,
)
from heli_jax.errors import InputError
from heli_jax.yaml_file import parse_value

_MOST = 100_000
"""Most fits; each has a directory of its own."""

_LONGEST_PATTERN = 4096
"""Longest pattern [characters], the length of a path."""

# YAML content is Any below: a number, a text, a list or a section.
Axes = dict[str, tuple[Any, ...]]


class Study(NamedTuple):
    """A configuration in which some keys take several values."""

    path: Path
    """The configuration file; relative paths begin at its folder."""
    content: dict[str, Any]
    """Content of the YAML file without the study."""
    axes: Axes
    """Values by key, in the order of the Dataset's dimensions."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis."""
        return tuple(len(values) for values in self.axes.values())

    @property
    def size(self) -> int:
        """Number of fits."""
        return math.prod(self.shape)

    def points(self) -> list[dict[str, Any]]:
        """Return the value of each key by fit, the last axis fastest."""
        rows = itertools.product(*self.axes.values())
        return [dict(zip(self.axes, row, strict=True)) for row in rows]

    def content_at(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """Return the configuration of one fit.

        Args:
            point: one of `points`.
        """
        content = copy.deepcopy(self.content)
        for key, value in point.items():
            # A value may be a section in which the next key sets a value.
            set_value(content, key, copy.deepcopy(value), f"{self.path}: study.{key}")
        return content

    def described(self) -> dict[str, Any]:
        """Return all settings of the fits as plain data; logs by their paths.

        Raises:
            InputError: the first fit's configuration is wrong.
        """
        axes = {key: list(values) for key, values in self.axes.items()}
        first = from_content(self.content_at(self.points()[0]), self.path)
        return {"axes": axes, "configuration": resolved(first)}


def read_study(
    path: str | Path,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    over: Sequence[str] | Mapping[str, Sequence[Any]] = (),
) -> Study | None:
    """Return the study of a configuration or its overrides; None for a single fit.

    Args:
        path: the configuration file.
        overrides: as in `load`.
        over: values by key, or as on the command line, `fit.free.a.start=4,5,6`: a YAML list
            without its brackets after =.

    Raises:
        InputError: something in the file or an option is wrong.
    """
    path = Path(path)
    content = read_overridden(path, overrides)
    # An override replaces an axis of the file, as for any other key.
    named = overrides
    if not isinstance(overrides, Mapping):
        named = [parse_override(text)[0] for text in overrides]
    stated = {k: v for k, v in _section(content, path).items() if k not in named}
    axes = {**_listed_logs(content, path), **stated, **_over(over)}
    if not axes:
        return None
    axes = {key: _logs(key, values, path) for key, values in axes.items()}
    for key, values in axes.items():
        if len({repr(v) for v in values}) < len(values):
            raise InputError(f"{path}: study.{key}: a value is given twice, expected each once")
    study = Study(path, content, axes)
    if study.size > _MOST:
        raise InputError(f"{path}: study: expected at most {_MOST} fits, got {study.size}")
    return study


def _over(over: Sequence[str] | Mapping[str, Sequence[Any]]) -> Axes:
    if isinstance(over, Mapping):
        return {key: _values(values, f"over {key!r:.80}") for key, values in over.items()}
    axes: Axes = {}
    for text in over:
        key, equals, values = text.partition("=")
        key, where = key.strip(), f"--over {text!r:.80}"
        if not equals or not key:
            raise InputError(f"{where}: expected key.path=value,value,...")
        if key in axes:
            raise InputError(f"{where}: {key} is given twice, expected all its values in one")
        listed = parse_value(f"[{values}]", where)
        # One value in brackets is a list as a value, for example of windows.
        if not isinstance(listed, list) or len(listed) < 2:
            raise InputError(
                f"{where}: expected at least two values, separated by commas and without brackets"
            )
        axes[key] = tuple(listed)
    return axes


def _listed_logs(content: dict[str, Any], path: Path) -> Axes:
    """Return the flights that have a list of logs."""
    axes: Axes = {}
    flights = content.get("flights")
    for i, flight in enumerate(flights if isinstance(flights, list) else ()):
        if isinstance(flight, dict) and isinstance(flight.get("log"), list):
            axes[f"flights.{i}.log"] = _values(flight["log"], f"{path}: flights[{i}].log")
    return axes


def _section(content: dict[str, Any], path: Path) -> Axes:
    """Remove the section `study` from the configuration and return it."""
    stated = content.pop("study", None)
    if stated is None:
        return {}
    if not isinstance(stated, dict):
        raise InputError(f"{path}: study: expected keys with lists of values, got {stated!r:.60}")
    return {str(key): _values(values, f"{path}: study.{key}") for key, values in stated.items()}


def _values(values: Any, where: str) -> tuple[Any, ...]:
    # Values from a script may be NumPy arrays.
    values = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(values, str | Mapping) or not isinstance(values, Sequence) or not values:
        raise InputError(f"{where}: expected a list of values, got {values!r:.60}")
    return tuple(values)


def _logs(key: str, values: tuple[Any, ...], path: Path) -> tuple[Any, ...]:
    """Replace patterns of log names in the values by the matching files."""
    if not key.endswith(".log"):
        return values
    folder = path.absolute().parent
    named: list[Any] = []
    for value in values:
        if isinstance(value, str) and len(value) > _LONGEST_PATTERN:
            problem = f"expected a name of at most {_LONGEST_PATTERN} letters, got {len(value)}"
            raise InputError(f"{path}: {key}: {problem}")
        # A file may have a name that looks like a pattern.
        if not isinstance(value, str) or not glob.has_magic(value) or (folder / value).exists():
            named.append(value)
            continue
        files = sorted(glob.glob(value, root_dir=folder))
        if not files:
            raise InputError(f"{path}: {key}: no file {os.fspath(folder / value)}")
        named += files
    return tuple(named)
