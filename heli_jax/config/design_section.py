"""Section `design`: limits and criterion of a designed flight."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from heli_jax.config.run_sections import ExcitedConfig
from heli_jax.config.section import Finite, Positive, Section
from heli_jax.identification.design.autopilots import ARDUPILOT


class DesignedInputConfig(ExcitedConfig):
    """Limits of an input that is excited."""

    set_point: str | None = None
    """state of `feedback` to whose set point the excitation is added, in the state's unit; default:
    it is added to the input itself"""
    ardupilot: Literal[tuple(ARDUPILOT)] | None = None  # pyright: ignore[reportInvalidTypeForm]
    """where ArduPilot adds a chirp: writes its SID_* parameters"""
    betaflight: Literal["roll", "pitch", "yaw"] | None = None
    """axis of Betaflight's chirp: writes its commands"""
    full_stick: Positive | None = None
    """deflection at full stick, in `unit`: writes a script for transmitters with EdgeTX"""

    @model_validator(mode="after")
    def _within_the_stick(self) -> "DesignedInputConfig":
        if self.full_stick is not None and self.full_stick < self.amplitude:
            raise ValueError(
                f"full_stick: expected at least the amplitude, {self.amplitude:g}, got "
                f"{self.full_stick:g}"
            )
        return self


class MotionConfig(Section):
    """Limit of an output, a state or an input as it acts."""

    most: Positive
    """largest absolute value, in `unit`"""
    unit: str | None = None
    """unit; default the model's SI unit"""


class RunConfig(Section):
    """One of several runs that are designed together."""

    known: dict[str, Finite | tuple[Finite, Finite]] = {}
    """model parameters known for this run, in SI; two values: the design chooses between them"""


class FlightDesignConfig(Section):
    """Limits and criterion of the inputs that `heli-jax design` computes."""

    inputs: dict[str, DesignedInputConfig]
    """inputs to excite, by name"""
    motion: dict[str, MotionConfig] = {}
    """limits of outputs, states and inputs, by name; of an input as it acts, with the feedback's
    part"""
    criterion: str = "D"
    """D: determinant of the covariance; A: its trace; E: its largest eigenvalue; or a free
    parameter, or a product such as a/Ixx, whose sd is made small"""
    feedback: dict[str, dict[str, Finite]] = {}
    """gains by input and state, in SI, of the loop that flies: input = excitation - gain state"""
    runs: Annotated[list[RunConfig], Field(min_length=1)] = [RunConfig()]
    """runs that are designed together, each as long as `simulate.duration`"""
    vehicles: Annotated[int, Field(ge=1, le=1000)] = 1
    """vehicles, drawn from priors or bounds, for which the design is good on average"""
    wanted: dict[str, Positive] = {}
    """relative sd of parameters that is enough: {a: 0.02}"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of the vehicles"""
    max_steps: Annotated[int, Field(ge=0)] = 400
    """most steps of the optimiser; 0: only the library is rated"""

    @model_validator(mode="after")
    def _moves(self) -> "FlightDesignConfig":
        if not self.inputs:
            raise ValueError("inputs: expected an input to excite, got none")
        for name, limit in self.inputs.items():
            if limit.set_point is not None and limit.set_point not in self.feedback.get(name, {}):
                raise ValueError(
                    f"inputs.{name}.set_point: expected a state of feedback.{name}, got "
                    f"{limit.set_point!r}"
                )
        return self
