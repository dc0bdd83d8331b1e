"""Sections of runs that the project makes itself: `simulate`, and the design of a sweep."""

import warnings
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from heli_jax.config.section import Section

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class StickConfig(Section):
    """Movement of one input in a simulation."""

    # "sweep" is the older name of "chirp".
    kind: Literal["random-steps", "3-2-1-1", "chirp", "sweep", "neutral"] = "random-steps"
    """kind of motion"""
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
    """motion of each input; others stay at rest"""
    noise: dict[str, NoiseConfig] = {}
    """white noise added to the outputs, by name"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of inputs, noise and disturbance"""
    start: StartConfig | None = None
    """hover unless given"""
    wind: tuple[Finite, Finite, Finite] | None = None
    """velocity of the air along x, y and z (up) [m/s]"""
    hold_attitude: bool = False
    """true: add a pilot's attitude feedback, so that a long manoeuvre does not diverge
    (`heli_jax.analysis.pilot`)"""
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


class AxisConfig(Section):
    """The values of one axis: from lower to upper, a list, or a column of the table."""

    lower: Finite | None = None
    """end of the range"""
    upper: Finite | None = None
    """end of the range"""
    scale: Literal["linear", "log"] = "linear"
    """spacing of the values between the ends"""
    n: int | None = None
    """points, for a grid or a list"""
    values: list[Finite] | None = None
    """the points themselves, in place of a range"""
    column: str | None = None
    """column of the table; default the axis's name"""
    unit: str | None = None
    """unit of these numbers; default the model's SI unit"""


class DesignConfig(Section):
    """A design of experiments: which values the axes take, one design point after the other."""

    # Which of the other keys a kind may have is refused where the design is made, with a sentence
    # that says why.
    design: Literal["grid", "list", "lhs", "sobol", "table", "product", "zip"]
    """combination of the axes"""
    n: int | None = None
    """design points, for lhs and sobol"""
    axes: dict[str, AxisConfig] = {}
    """axes by name: a parameter, initial.STATE, gain.INPUT, offset.INPUT, delay, seed"""
    # A section within itself: designs nest to any depth.
    of: list["DesignConfig"] = []
    """the designs of a product or a zip"""
    file: str | None = None
    """a table: .csv, .txt, .tsv or .parquet"""
    seed: Annotated[int, Field(ge=0)] | None = None
    """seed of lhs and sobol; default from the sweep's"""


class ReduceConfig(Section):
    """A result of each run."""

    # Checked against the reducers where the sweep is put together: a path may lead to any function.
    how: str
    """a name, or package.module:function of one's own"""
    signal: str | None = None
    """the output it is taken of"""
    input: str | None = None
    """for margins: the input that the loop moves"""
    gain: Finite = 1.0
    """for margins: the feedback, input = -gain signal"""


class TrajectoriesConfig(Section):
    """Runs to keep."""

    signals: list[str]
    """outputs to keep over time"""
    every: int = 1
    """samples from one kept to the next"""


class SweepConfig(DesignConfig):
    """Many runs: a design, what is kept of each run, and how it is computed."""

    reduce: dict[str, ReduceConfig] = Field(default_factory=dict)
    """results of each run, by a name of your own"""
    trajectories: TrajectoriesConfig | None = None
    """runs to keep whole"""
    inputs: Literal["flights", "simulate"] | None = None
    """source of the inputs; default the flights, if there are any"""
    start: StartConfig | None = None
    """the steady flight in which each run of a whole helicopter begins, the flights' sticks as
    they are; what `simulate` makes begins as it says there"""
    solver: str | None = None
    """exact, rk4 or one of diffrax's; exact for linear models"""
    substeps: int | None = None
    """steps of the solver in a sample"""
    precision: Literal["float64", "float32"] = "float64"
    """precision of the computation"""
    chunk: int | None = None
    """design points written at a time"""
    lanes: int | None = None
    """batch size: design points computed side by side on a device"""
    backend: Literal["auto", "xla", "fused"] = "auto"
    """backend of the simulation: xla, sample by sample for a batch; fused, one program of
    machine code for a run; auto, fused on CPUs if possible"""
