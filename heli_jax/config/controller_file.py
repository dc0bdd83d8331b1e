"""Controllers in files: `control.json` in a run directory of `heli-jax control`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import jax.numpy as jnp
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from heli_jax.control.controller import Controller
from heli_jax.control.laws import Cascade, Loop, Observer, StateFeedback
from heli_jax.errors import InputError
from heli_jax.regular_file import read_regular

_LARGEST = 10_000_000
"""Largest size of a file [bytes]."""
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Table = dict[str, dict[str, _Number]]
_Numbers = dict[str, _Number]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _StateFeedback(_Part):
    law: Literal["StateFeedback"]
    gains: _Table
    integral: _Table
    dt: _Number
    references: tuple[str, ...]
    about: _Numbers
    limits: _Numbers


class _Observer(_Part):
    law: Literal["Observer"]
    gains: _Table
    A: list[list[_Number]]
    B: list[list[_Number]]
    C: list[list[_Number]]
    M: list[list[_Number]]
    dt: _Number
    references: tuple[str, ...]
    place: dict[str, str]
    about: _Numbers
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    limits: _Numbers


class _Loop(_Part):
    p: _Number
    i: _Number | None
    d: _Number | None
    signal: str
    limit: _Number | None
    lag: _Number


class _Cascade(_Part):
    law: Literal["Cascade"]
    loops: dict[str, tuple[_Loop, ...]]
    dt: _Number
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
        read = TypeAdapter(_File).validate_json(data).controller
    except ValidationError as e:
        first = e.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise InputError(f"{path}: {place}: {first['msg']}") from None
    fields: dict[str, Any] = {
        n: jnp.asarray(v, float) if n in ("A", "B", "C", "M") else v for n, v in read if n != "law"
    }
    if isinstance(read, _Cascade):
        fields["loops"] = {n: tuple(Loop(**dict(a)) for a in by) for n, by in read.loops.items()}
    return _LAWS[read.law](**fields)
