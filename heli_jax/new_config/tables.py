"""Tables of `new` on models and names, from the files beside it."""

from importlib import resources
from typing import Any

from heli_jax.yaml_file import parse_mapping


def names() -> dict[str, Any]:
    """Return usual names of sticks, motions and clocks."""
    return _file("names.yaml")


def models() -> dict[str, Any]:
    """By model what is free in it, and what other models there are of its axis."""
    return _file("models.yaml")


def _file(name: str) -> dict[str, Any]:
    file = resources.files("heli_jax.new_config").joinpath(name)
    return parse_mapping(file.read_text(encoding="utf-8"), name)
