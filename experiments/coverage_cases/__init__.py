"""Cases of `experiments/coverage.py`: each module has the cases of one subject.

A module has a function `cases()` that returns a list of `Case`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from heli_jax import Fit

BENCH = Path(__file__).parents[2] / "configs" / "vehicles" / "bench-30.yaml"
"""Path of the vehicle file, independent of the working folder."""


class Interval(NamedTuple):
    """An estimate with its 95 % interval, and the truth."""

    value: float
    sd: float
    lower: float
    upper: float
    truth: float


@dataclass(frozen=True)
class Run:
    """Result of one record."""

    status: str
    """Status of the fit; runs that did not converge are counted, but left out of the statistics."""
    parameters: dict[str, Interval] = field(default_factory=dict)
    flags: dict[str, bool] = field(default_factory=dict)
    """Events that must not happen, by name; their number is reported."""


@dataclass(frozen=True)
class Case:
    """Many records of one kind."""

    name: str
    one_run: Callable[[int], Run]
    """Function from a seed to the result of its record."""
    runs: int = 200
    """Number of runs at full size."""


def intervals(result: Fit, truth: dict[str, float]) -> Run:
    """Return the intervals of a fit's estimates (or nuisances), with the truth."""
    everything = {**result.nuisance, **result.estimates}
    parameters = {}
    for name, true in truth.items():
        e = everything[name]
        if e.sd is not None and e.lower95 is not None and e.upper95 is not None:
            parameters[name] = Interval(e.value, e.sd, e.lower95, e.upper95, true)
    return Run(result.status, parameters)
