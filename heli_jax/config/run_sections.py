"""Sections of simulated runs: `simulate`, and the design of a sweep."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from heli_jax.config.section import Finite, Positive, Section
from heli_jax.simulation.inputs import KINDS


class ExcitedConfig(Section):
    """Limits of an excitation."""

    amplitude: Positive
    """largest deflection, in `unit`"""
    unit: str | None = None
    """unit; default the model's SI unit"""
    rate: Positive | None = None
    """largest rate of change, in `unit` a second; steps become ramps, sines smaller; default:
    none"""


class StickConfig(ExcitedConfig):
    """Movement of one input in a simulation."""

    kind: Literal[tuple(k.name for k in KINDS)] = "random-steps"  # pyright: ignore[reportInvalidTypeForm]
    """kind of motion"""
    hold: tuple[Positive, Positive] = (0.3, 2.0)
    """shortest and longest step of random-steps [s]"""
    step: Positive = 0.3
    """shortest step of doublet, 3-2-1-1 and prbs [s]"""
    pause: Positive = 2.0
    """pause between two of doublet and 3-2-1-1 [s]"""
    band: tuple[Positive, Positive] = (0.05, 5.0)
    """lowest and highest frequency of chirp and multisine [Hz]"""
    fade: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """time in which a chirp grows at its begin and fades at its end [s]"""

    @model_validator(mode="after")
    def _ordered(self) -> "StickConfig":
        if self.hold[0] > self.hold[1]:
            raise ValueError(f"hold: expected the shortest time first, got {list(self.hold)}")
        if self.band[0] >= self.band[1]:
            raise ValueError(f"band: expected the lowest frequency first, got {list(self.band)}")
        return self


class NoiseConfig(Section):
    sd: Positive
    """standard deviation, in `unit`"""
    unit: str | None = None
    """unit; default the output's SI unit"""


class StartConfig(Section):
    """Steady flight in which a run of the full helicopter begins."""

    forward_speed: Finite = 0.0
    """speed over the ground along the heading [m/s]"""
    lateral_speed: Finite = 0.0
    """speed to the right of the heading [m/s]"""
    climb: Finite = 0.0
    """climb rate [m/s]"""
    heading: Finite = 0.0
    """heading psi [rad]"""


class SimulateConfig(Section):
    """A simulated run.

    The full helicopter begins in a trimmed flight, and `inputs` are added to the trim's sticks;
    start, wind, hold_attitude and ground are only for this model.
    """

    duration: Positive
    """duration [s]"""
    rate: Positive
    """samples a second [Hz]"""
    inputs: dict[str, StickConfig] = {}
    """motion of each input; others stay at rest"""
    noise: dict[str, NoiseConfig] = {}
    """white noise added to the outputs, by name"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of inputs, noise and disturbance"""
    start: StartConfig | None = None
    """trimmed flight at the start; default hover"""
    wind: tuple[Finite, Finite, Finite] | None = None
    """velocity of the air along x, y and z (up) [m/s]"""
    hold_attitude: bool = False
    """true: add a pilot's attitude feedback, so that a long manoeuvre does not diverge
    (`heli_jax.control.pilot`)"""
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
    """Values of one axis: from lower to upper, a list, or a column of the table."""

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
    """Design of experiments: the values of the axes at each design point."""

    # The design itself refuses keys that its kind cannot have, with a reason.
    design: Literal["grid", "list", "lhs", "sobol", "table", "product", "zip"]
    """kind of design"""
    n: int | None = None
    """design points, for lhs and sobol"""
    axes: dict[str, AxisConfig] = {}
    """axes by name: a parameter, initial.STATE, gain.INPUT, offset.INPUT, delay, seed"""
    # Recursive: designs nest to any depth.
    of: list["DesignConfig"] = []
    """the designs of a product or a zip"""
    file: str | None = None
    """file of a table: .csv, .txt, .tsv or .parquet"""
    seed: Annotated[int, Field(ge=0)] | None = None
    """seed of lhs and sobol; default from the sweep's"""


class ReduceConfig(Section):
    """A result of each run."""

    # Checked against the reducers where the sweep is assembled: a path may name any function.
    how: str
    """name of a reducer, or package.module:function of your own"""
    signal: str | None = None
    """output that is reduced"""
    input: str | None = None
    """for margins: the input of the loop"""
    gain: Finite = 1.0
    """for margins: the feedback, input = -gain signal"""


class TrajectoriesConfig(Section):
    """Runs to keep."""

    signals: list[str]
    """outputs to keep over time"""
    every: int = 1
    """samples between two kept ones"""


class SweepConfig(DesignConfig):
    """Many runs: a design, the results of each run, and options of the computation."""

    reduce: dict[str, ReduceConfig] = Field(default_factory=dict)
    """results of each run, by a name of your own"""
    trajectories: TrajectoriesConfig | None = None
    """runs to keep in full"""
    inputs: Literal["flights", "simulate"] | None = None
    """source of the inputs; default the flights, if there are any"""
    start: StartConfig | None = None
    """steady flight in which each run of a full helicopter begins, with the flights' sticks
    unchanged; runs of `simulate` begin as stated there"""
    solver: str | None = None
    """exact, rk4 or a solver of diffrax; default exact for linear models"""
    substeps: Annotated[int, Field(ge=1)] | None = None
    """steps of the solver per sample"""
    precision: Literal["float64", "float32"] = "float64"
    """precision of the computation"""
    chunk: int | None = None
    """design points written at a time"""
    lanes: int | None = None
    """batch size: design points computed in parallel on a device"""
    backend: Literal["auto", "xla", "fused"] = "auto"
    """backend of the simulation: xla, sample by sample for a batch; fused, one program of machine
    code for a run; auto, fused on CPUs if possible"""
