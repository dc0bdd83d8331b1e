"""Controllers in files: `control.json` in a run directory of `heli-jax control`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import jax.numpy as jnp
from pydantic import BaseModel, Field, ValidationError

from heli_jax.config.section import Finite, Positive, Section
from heli_jax.control.controller import Controller
from heli_jax.control.laws import Cascade, Loop, Observer, StateFeedback
from heli_jax.errors import InputError
from heli_jax.regular_file import read_regular

_LARGEST = 10_000_000
"""Largest size of a file [bytes]."""
_Table = dict[str, dict[str, Finite]]
_Numbers = dict[str, Finite]


class _StateFeedback(Section):
    law: Literal["StateFeedback"]
    gains: _Table
    integral: _Table
    dt: Positive
    references: tuple[str, ...]
    about: _Numbers
    limits: _Numbers


class _Observer(Section):
    law: Literal["Observer"]
    gains: _Table
    A: list[list[Finite]]
    B: list[list[Finite]]
    C: list[list[Finite]]
    M: list[list[Finite]]
    dt: Positive
    references: tuple[str, ...]
    place: dict[str, str]
    about: _Numbers
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    limits: _Numbers


class _Loop(Section):
    p: Finite
    i: Finite | None
    d: Finite | None
    signal: str
    limit: Finite | None
    lag: Finite


class _Cascade(Section):
    law: Literal["Cascade"]
    loops: dict[str, tuple[_Loop, ...]]
    dt: Positive
    references: tuple[str, ...]
    about: _Numbers


class _File(BaseModel):
    controller: Annotated[_StateFeedback | _Observer | _Cascade, Field(discriminator="law")]


_LAWS = {kind.__name__: kind for kind in (StateFeedback, Observer, Cascade)}


def read_controller(path: str | Path) -> Controller:
    """Return the controller of a run directory of `heli-jax control`, or of its control.json.

    Raises:
        InputError: no such file, or no controller in it.
    """
    path = Path(path)
    path = path / "control.json" if path.is_dir() else path
    data = read_regular(path, "the control.json of `heli-jax control`", _LARGEST)
    try:
        read = _File.model_validate_json(data, strict=True).controller
    except ValidationError as e:
        first = e.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        got = f", got {first['input']!r:.60}" if first["loc"] else ""
        raise InputError(f"{path}: {place}: {first['msg']}{got}") from None
    fields: dict[str, Any] = {
        n: jnp.asarray(v, float) if n in ("A", "B", "C", "M") else v for n, v in read if n != "law"
    }
    if isinstance(read, _Cascade):
        fields["loops"] = {n: tuple(Loop(**dict(a)) for a in by) for n, by in read.loops.items()}
    return _LAWS[read.law](**fields)
