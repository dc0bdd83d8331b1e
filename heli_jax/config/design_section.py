"""Sections of a sweep: its design of experiments, and what is kept of each run."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    # An unknown key is an error: a misspelt `upper` would leave an axis without its end.
    model_config = ConfigDict(extra="forbid", frozen=True)


class AxisConfig(_Strict):
    """The values of one axis: from lower to upper, a list, or a column of the table."""

    lower: Finite | None = None
    upper: Finite | None = None
    scale: Literal["linear", "log"] = "linear"
    n: int | None = None
    """points, for a grid or a list"""
    values: list[Finite] | None = None
    column: str | None = None
    """of the table; the axis's name unless given"""
    unit: str | None = None
    """of these numbers; the model's SI unit unless given"""


class DesignConfig(_Strict):
    """A design of experiments: which values the axes take, one design point after the other."""

    # Which of the other keys a kind may have is refused where the design is made, with a sentence
    # that says why.
    design: Literal["grid", "list", "lhs", "sobol", "table", "product", "zip"]
    n: int | None = None
    """design points, for lhs and sobol"""
    axes: dict[str, AxisConfig] = {}
    # A section within itself: designs nest to any depth.
    of: list["DesignConfig"] = []
    """the designs of a product or a zip"""
    file: str | None = None
    """a table: .csv, .txt, .tsv or .parquet"""
    seed: Annotated[int, Field(ge=0)] | None = None
    """of lhs and sobol; the sweep's and the place among its designs unless given"""


class ReduceConfig(_Strict):
    """A result of each run."""

    # Checked against the reducers where the sweep is put together: a path may lead to any function.
    how: str
    """a name, or package.module:function of one's own"""
    signal: str | None = None
    input: str | None = None
    gain: Finite = 1.0


class TrajectoriesConfig(_Strict):
    """Runs to keep."""

    signals: list[str]
    every: int = 1
    """samples from one kept to the next"""
