"""Tables of models and names for `new`, from the YAML files in this folder."""

from importlib import resources
from typing import Any

from heli_jax.yaml_file import parse_mapping


def names() -> dict[str, Any]:
    """Return usual names of sticks, motions and clocks."""
    return _file("names.yaml")


def models() -> dict[str, Any]:
    """Return the free parameters by model, and other models of its axis."""
    return _file("models.yaml")


def _file(name: str) -> dict[str, Any]:
    file = resources.files("heli_jax.new_config").joinpath(name)
    return parse_mapping(file.read_text(encoding="utf-8"), name)
