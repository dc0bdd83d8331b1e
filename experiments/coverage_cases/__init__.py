"""What `experiments/coverage.py` runs: each module of this folder holds the cases of one subject.

A module has a function `cases()` that returns a list of `Case`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from heli_jax import Fit

BENCH = Path(__file__).parents[2] / "configs" / "vehicles" / "bench-30.yaml"
"""the vehicle file, from wherever a study is started"""


class Interval(NamedTuple):
    """An estimate with its 95 % interval, and the truth."""

    value: float
    sd: float
    lower: float
    upper: float
    truth: float


@dataclass(frozen=True)
class Run:
    """What one record says."""

    status: str
    """of the fit; runs that did not converge are counted and left out of the statistics"""
    parameters: dict[str, Interval] = field(default_factory=dict)
    flags: dict[str, bool] = field(default_factory=dict)
    """what must not happen, by name: how often each is true is counted"""


@dataclass(frozen=True)
class Case:
    """Many records of one kind."""

    name: str
    one_run: Callable[[int], Run]
    """a seed to what its record says"""
    runs: int = 200
    """at full size"""


def intervals(result: Fit, truth: dict[str, float]) -> Run:
    """The intervals of a fit's estimates (or nuisances) beside the truth."""
    everything = {**result.nuisance, **result.estimates}
    parameters = {}
    for name, true in truth.items():
        e = everything[name]
        if e.sd is not None and e.lower95 is not None and e.upper95 is not None:
            parameters[name] = Interval(e.value, e.sd, e.lower95, e.upper95, true)
    return Run(result.status, parameters)
