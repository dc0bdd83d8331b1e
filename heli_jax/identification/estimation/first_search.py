"""The search from the start values, by what takes least time to search with."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Progress, Search
from heli_jax.identification.unknowns.layout import Data, Layout, Noise


class FirstGuess(NamedTuple):
    """A problem at its first guess."""

    layout: Layout
    data: Data
    noise: Noise
    z: Float[Array, " q"]
    e: Evaluation
    begun: Data
    """what the first search goes by"""


class FirstOptima(NamedTuple):
    """Where each start led, and by what."""

    search: Search
    noise: Noise
    points: Float[Array, "s q"]
    optima: list[Optimum]


def first_optima(
    search: Search,
    at: FirstGuess,
    starts: Callable[[Noise, tuple[Any, Any]], Float[Array, "s q"]],
    report: Progress | None = None,
) -> FirstOptima:
    """An optimum for each start, after which the noise is relaxed.

    Args:
        search: the optimiser over the problem.
        at: its first guess.
        starts: makes them of the noise to begin with, and of residuals and Jacobian at the guess.
        report: called with a sentence after each of several.
    """
    layout, estimator = at.layout, at.layout.estimator
    r_J: tuple[Any, Any] = (at.e.r, at.e.J)
    first = Search(search.problem, layout, at.begun, search.max_steps)
    quick, quickly = estimator.to_begin_with(layout, at.data, at.noise, at.z, r_J)
    points = starts(quick, quickly)

    def run(noise: Noise, known: tuple[Array, Array]) -> list[Optimum]:
        # Residuals at the first start are those of the first guess.
        same = at.begun is at.data and bool(np.array_equal(points[0], at.z))
        ends = known if same else None
        return first.run(noise, points, report, nearing=estimator.nearing, known=ends)

    optima = run(quick, quickly)
    # What a part of the data leads to nowhere may be found by all of them.
    if quick is not at.noise and not any(bool(o.converged) for o in optima):
        quick, optima = at.noise, run(at.noise, r_J)
    return FirstOptima(first, quick, points, optima)
