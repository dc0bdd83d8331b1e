"""Parts of the section `signals` that define the meaning of a channel's numbers."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from heli_jax.config.section import Finite, Section
from heli_jax.flights.derived import Swashplate
from heli_jax.flights.flight import Signal, scale_problem
from heli_jax.flights.preset import preset, presets


class ScaledConfig(Section):
    """(number in the log - offset) scale, in the stated unit, inverted or not."""

    scale: Finite = 1.0
    """factor of the number in the log, after offset"""
    offset: Finite = 0.0
    """offset in the log's own numbers"""
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
        """Keywords of an equivalent `Signal`."""
        return {"scale": self.scale, "offset": self.offset, "invert": self.invert}


class LoggedInputConfig(ScaledConfig):
    """An input's channel, or its value if the log lacks it."""

    signal: str | None = None
    """a channel's or column's name in the log"""
    constant: Finite | None = None
    """value in the stated unit"""

    @model_validator(mode="after")
    def _one_of_two(self) -> "LoggedInputConfig":
        if (self.signal is None) == (self.constant is None):
            raise ValueError("expected either signal or constant")
        if self.constant is not None and self.conversion != ScaledConfig().conversion:
            raise ValueError(
                "scale, offset and invert need a signal, expected none with a constant"
            )
        return self


Numbers = float | list[float]


class CcpmConfig(Section):
    """Servos of a swashplate and their geometry (`heli_jax.flights.derived.Swashplate`)."""

    servos: list[str]
    """the channels of the servos"""
    angles: list[Finite]
    """angle of each servo [deg], clockwise from the nose, seen from above"""
    radius: Numbers = 1.0
    """distance of each servo from the mast, in any one unit"""
    offset: Numbers = 0.0
    """position of each servo at rest, in the log's numbers"""
    scale: Numbers = 1.0
    """lift per unit of the log"""
    invert: bool | list[bool] = False
    """true for a servo that moves the other way"""
    phase: Finite = 0.0
    """angle by which the plate leads the blades [deg]"""

    @model_validator(mode="after")
    def _regular(self) -> "CcpmConfig":
        self.swashplate()
        return self

    def swashplate(self) -> Swashplate:
        """Return the geometry.

        Raises:
            ValueError: it does not separate collective from cyclic, or a list has the wrong length.
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


def _list_shipped_presets(schema: dict[str, Any]) -> None:
    """List the presets in the JSON schema, as suggestions for editors."""
    text = next(option for option in schema["anyOf"] if option["type"] == "string")
    text["enum"] = list(presets())


class PresetConfig(Section):
    """Signals from a table or from a geometry (docs/logs.md)."""

    preset: Annotated[str | None, Field(json_schema_extra=_list_shipped_presets)] = None
    """table of an autopilot; `inputs` and `outputs` override it"""
    preset_outputs: list[str] | None = None
    """outputs to take from it; default all that it can supply"""
    ccpm: CcpmConfig | None = None
    """swashplate servos from which `ccpm.collective`, `ccpm.roll` and `ccpm.pitch` are computed"""

    @model_validator(mode="after")
    def _known(self) -> "PresetConfig":
        if self.preset is not None:
            preset(self.preset)
        elif self.preset_outputs is not None:
            raise ValueError("preset_outputs: expected a preset with it, got none")
        return self
