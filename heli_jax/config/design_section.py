"""Sections of a sweep: its design of experiments, and what is kept of each run."""

from typing import Annotated, Literal

from pydantic import Field

from heli_jax.config.section import Section
from heli_jax.config.simulate_section import StartConfig

Finite = Annotated[float, Field(allow_inf_nan=False)]


class AxisConfig(Section):
    """The values of one axis: from lower to upper, a list, or a column of the table."""

    lower: Finite | None = None
    """end of the range"""
    upper: Finite | None = None
    """end of the range"""
    scale: Literal["linear", "log"] = "linear"
    """how values lie between the ends"""
    n: int | None = None
    """points, for a grid or a list"""
    values: list[Finite] | None = None
    """the points themselves, in place of a range"""
    column: str | None = None
    """of the table; the axis's name unless given"""
    unit: str | None = None
    """of these numbers; the model's SI unit unless given"""


class DesignConfig(Section):
    """A design of experiments: which values the axes take, one design point after the other."""

    # Which of the other keys a kind may have is refused where the design is made, with a sentence
    # that says why.
    design: Literal["grid", "list", "lhs", "sobol", "table", "product", "zip"]
    """how the axes are combined"""
    n: int | None = None
    """design points, for lhs and sobol"""
    axes: dict[str, AxisConfig] = {}
    """by what varies: a parameter, initial.STATE, gain.INPUT, offset.INPUT, delay, seed"""
    # A section within itself: designs nest to any depth.
    of: list["DesignConfig"] = []
    """the designs of a product or a zip"""
    file: str | None = None
    """a table: .csv, .txt, .tsv or .parquet"""
    seed: Annotated[int, Field(ge=0)] | None = None
    """of lhs and sobol; the sweep's and the place among its designs unless given"""


class ReduceConfig(Section):
    """A result of each run."""

    # Checked against the reducers where the sweep is put together: a path may lead to any function.
    how: str
    """a name, or package.module:function of one's own"""
    signal: str | None = None
    """the output it is taken of"""
    input: str | None = None
    """of margins: the input that the loop moves"""
    gain: Finite = 1.0
    """of margins: the feedback, input = -gain signal"""


class TrajectoriesConfig(Section):
    """Runs to keep."""

    signals: list[str]
    """outputs to keep over time"""
    every: int = 1
    """samples from one kept to the next"""


class SweepConfig(DesignConfig):
    """Many runs: a design, what is kept of each run, and how it is computed."""

    reduce: dict[str, ReduceConfig] = Field(default_factory=dict)
    """what is kept of each run, by a name of your own"""
    trajectories: TrajectoriesConfig | None = None
    """runs to keep whole"""
    inputs: Literal["flights", "simulate"] | None = None
    """where the inputs come from; the flights unless there are none"""
    start: StartConfig | None = None
    """the steady flight in which each run of a whole helicopter begins, the flights' sticks as
    they are; what `simulate` makes begins as it says there"""
    solver: str | None = None
    """exact, rk4 or one of diffrax's; exact for linear models"""
    substeps: int | None = None
    """steps of the solver in a sample"""
    precision: Literal["float64", "float32"] = "float64"
    """of the computation"""
    chunk: int | None = None
    """design points written at a time"""
    lanes: int | None = None
    """batch size: design points computed side by side on a device"""
    backend: Literal["auto", "xla", "fused"] = "auto"
    """what computes each run over time: xla, sample by sample for a batch; fused, one program of
    machine code for a whole run; auto, fused on CPUs where it can be"""
