"""The section `simulate`: a run that the project makes itself."""

import warnings
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from heli_jax.config.section import Section

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class StickConfig(Section):
    """How one input moves in a simulation."""

    # "sweep" is the older name of "chirp".
    kind: Literal["random-steps", "3-2-1-1", "chirp", "sweep", "neutral"] = "random-steps"
    """how it moves"""
    amplitude: Positive
    """largest deflection, in `unit`"""
    unit: str | None = None
    """the model's SI unit unless given"""
    hold: tuple[Positive, Positive] = (0.3, 2.0)
    """shortest and longest step of random-steps [s]"""
    step: Positive = 0.3
    """unit length of 3-2-1-1 [s]"""
    pause: Positive = 2.0
    """neutral between two 3-2-1-1 [s]"""
    band: tuple[Positive, Positive] = (0.05, 5.0)
    """first and last frequency of a chirp [Hz]"""

    @model_validator(mode="after")
    def _ordered(self) -> "StickConfig":
        if self.hold[0] > self.hold[1]:
            raise ValueError(f"hold: expected the shortest time first, got {list(self.hold)}")
        return self


class NoiseConfig(Section):
    sd: Positive
    """standard deviation, in `unit`"""
    unit: str | None = None
    """the output's SI unit unless given"""


class StartConfig(Section):
    """The steady flight in which a run of the whole helicopter begins."""

    forward_speed: Finite = 0.0
    """speed over the ground along the heading [m/s]"""
    lateral_speed: Finite = 0.0
    """to the right of it [m/s]"""
    climb: Finite = 0.0
    """[m/s]"""
    heading: Finite = 0.0
    """psi [rad]"""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, content: Any) -> Any:
        """The keys under which the speeds stood before, accepted with a warning."""
        if not isinstance(content, dict):
            return content
        content = dict(content)
        for old, new in (("ahead", "forward_speed"), ("aside", "lateral_speed")):
            if old not in content:
                continue
            if new in content:
                raise ValueError(f"expected {new} alone, got {old} and {new}, which mean the same")
            warnings.warn(f"{old} is deprecated, expected {new}", DeprecationWarning, stacklevel=2)
            content[new] = content.pop(old)
        return content


class SimulateConfig(Section):
    """A run that the project makes itself.

    The whole helicopter begins in a trimmed flight, and `inputs` are added to the trim's sticks;
    start, wind, hold_attitude and ground are for it alone.
    """

    duration: Positive
    """[s]"""
    rate: Positive
    """samples a second [Hz]"""
    inputs: dict[str, StickConfig] = {}
    """how each input moves; those not named stay at rest"""
    noise: dict[str, NoiseConfig] = {}
    """white noise added to the outputs, by name"""
    seed: Annotated[int, Field(ge=0)] = 0
    """of inputs, noise and disturbance"""
    start: StartConfig | None = None
    """hover unless given"""
    wind: tuple[Finite, Finite, Finite] | None = None
    """velocity of the air along x, y and z (up) [m/s]"""
    hold_attitude: bool = False
    """whether a pilot's gentle feedback is added to the sticks, so that a long manoeuvre does not
    diverge (`heli_jax.analysis.pilot`)"""
    ground: Annotated[float, Field(lt=0, allow_inf_nan=False)] | None = None
    """height at which the run ends [m]; it begins at a height of zero"""

    @model_validator(mode="after")
    def _bounded(self) -> "SimulateConfig":
        # 8: no reader takes fewer. 1e8 samples of ten signals fill 8 GB.
        if not 8 <= self.duration * self.rate <= 1e8:
            raise ValueError(
                f"duration times rate is {self.duration * self.rate:g} samples, expected 8 to 1e8"
            )
        return self
