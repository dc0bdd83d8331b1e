"""The parts of the section `signals` that say what a channel's numbers mean."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from heli_jax.config.section import Section
from heli_jax.flights.derived import Swashplate
from heli_jax.flights.flight import Signal, scale_problem
from heli_jax.flights.preset import preset, presets

_Finite = Annotated[float, Field(allow_inf_nan=False)]


class ScaledConfig(Section):
    """(number in the log - offset) scale, in the stated unit, inverted or not."""

    scale: _Finite = 1.0
    """factor of the number in the log, after offset"""
    offset: _Finite = 0.0
    """in the log's own numbers"""
    invert: bool = False
    """true: change the sign"""

    @model_validator(mode="after")
    def _sensible(self) -> "ScaledConfig":
        problem = scale_problem(Signal("", "1", "1", **self.conversion))
        if problem:
            raise ValueError(problem)
        return self

    @property
    def conversion(self) -> dict[str, Any]:
        """The keywords of a `Signal` that say it."""
        return {"scale": self.scale, "offset": self.offset, "invert": self.invert}


class LoggedInputConfig(ScaledConfig):
    """An input's channel, or its value where the log lacks it."""

    signal: str | None = None
    """a channel's or column's name in the log"""
    constant: _Finite | None = None
    """in the stated unit"""

    @model_validator(mode="after")
    def _one_of_two(self) -> "LoggedInputConfig":
        if (self.signal is None) == (self.constant is None):
            raise ValueError("expected either signal or constant")
        if self.constant is not None and self.conversion != ScaledConfig().conversion:
            raise ValueError(
                "scale, offset and invert are of a signal, expected none, got constant"
            )
        return self


Numbers = float | list[float]


class CcpmConfig(Section):
    """The servos of a swashplate and where they lift it (`heli_jax.flights.derived.Swashplate`)."""

    servos: list[str]
    """the channels of the servos"""
    angles: list[_Finite]
    """[deg] of each, clockwise from the nose, seen from above"""
    radius: Numbers = 1.0
    """distance of each servo from the mast, in any one unit"""
    offset: Numbers = 0.0
    """position of each servo at rest, in the log's numbers"""
    scale: Numbers = 1.0
    """lift for a unit of the log"""
    invert: bool | list[bool] = False
    """true for a servo that moves the other way"""
    phase: _Finite = 0.0
    """[deg] by which the plate leads the blades"""

    @model_validator(mode="after")
    def _regular(self) -> "CcpmConfig":
        self.swashplate()
        return self

    def swashplate(self) -> Swashplate:
        """The geometry.

        Raises:
            ValueError: it does not tell collective from cyclic, or a list is of the wrong length.
        """
        count = len(self.servos)

        def each(value: Any) -> tuple:
            return tuple(value) if isinstance(value, list) else (value,) * count

        return Swashplate(
            tuple(self.servos),
            tuple(self.angles),
            each(self.radius),
            each(self.offset),
            each(self.scale),
            each(self.invert),
            self.phase,
        )


def _of_those_that_ship(schema: dict[str, Any]) -> None:
    """Names the presets in the JSON schema, for editors to offer."""
    text = next(option for option in schema["anyOf"] if option["type"] == "string")
    text["enum"] = list(presets())


class PresetConfig(Section):
    """Signals that come from a table or from a geometry (docs/logs.md)."""

    preset: Annotated[str | None, Field(json_schema_extra=_of_those_that_ship)] = None
    """the table of an autopilot; what `inputs` and `outputs` name goes before it"""
    preset_outputs: list[str] | None = None
    """the outputs to take from it; all that it can supply unless given"""
    ccpm: CcpmConfig | None = None
    """swashplate servos from which `ccpm.collective`, `ccpm.roll` and `ccpm.pitch` are computed"""

    @model_validator(mode="after")
    def _known(self) -> "PresetConfig":
        if self.preset is not None:
            preset(self.preset)
        elif self.preset_outputs is not None:
            raise ValueError("preset_outputs: expected a preset with it, got none")
        return self
