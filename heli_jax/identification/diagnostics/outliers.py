"""Outliers: a few samples far from their neighbours, such as dropouts to zero.

The simulation explains most of the motion, so its residual shows outliers that the record hides. A
running median leaves gusts, and a response that the model lacks: they are no outliers. A second
search without the outliers gives their effect on the estimates.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

from heli_jax.identification.estimation.evaluation import Evaluation, named
from heli_jax.identification.estimation.simulated_flights import signals
from heli_jax.identification.problem import Problem
from heli_jax.identification.search import first_guess, search
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.numerics.white_noise import noise_guess, robust_sd

_FAR = 10.0
"""Distance of an outlier from the running median [robust sds of the white noise]."""
_NEIGHBOURS = 11
"""Samples of the running median, which sees up to five outliers in a row."""
_MOST = 0.05
"""Largest share of outliers; more belong to the noise."""
_SMALL = 0.05
"""Distance over the output's sd below which an outlier does no harm."""
_STEPS = 100
"""Most steps of each run of the optimiser without the outliers."""


class Outliers(NamedTuple):
    """Outliers of one output."""

    output: str
    share: float
    """Share of the output's samples."""
    values: Float[np.ndarray, " k"]
    """Measured values [SI]."""
    shifts: dict[str, float]
    """Estimates, less those without any outlier [SI]; empty if that search did not converge."""


def outliers(problem: Problem, at: Solution, e: Evaluation) -> list[Outliers]:
    """Return the outliers of each output at the optimum of a fit in time."""
    found: dict[str, list[tuple[np.ndarray, int]]] = {}
    flights = [dict(f.outputs) for f in at.data.flights]
    for i, name in signals(at.layout):
        y, raw = np.asarray(flights[i][name]), np.asarray(e.raw[i][name])
        seen = np.isfinite(y) & np.isfinite(raw)
        error, least = raw[seen], _SMALL * float(np.std(y[seen])) if seen.any() else 0.0
        far, away = _outlying(error, least)
        found.setdefault(name, []).append((y[seen][far], error.size))
        # The output's own motion takes their place: missing samples would change the program.
        y = y.copy()
        y[np.flatnonzero(seen)[far]] -= away[far]
        flights[i][name] = y
    if not any(values.size for parts in found.values() for values, _ in parts):
        return []
    shifts, out = _shifts(problem, at, e, flights), []
    for name, parts in found.items():
        values, total = np.concatenate([v for v, _ in parts]), sum(size for _, size in parts)
        if values.size:
            out.append(Outliers(name, values.size / total, values, shifts))
    return out


def _outlying(
    error: Float[np.ndarray, " N"], least: float
) -> tuple[Bool[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return a mask of the outliers of a residual, and the distances from its running median.

    Args:
        least: least distance of an outlier.
    """
    if error.size < 2 * _NEIGHBOURS:
        return np.zeros(error.shape, bool), np.zeros(error.shape)
    away = error - np.median(_around(error), axis=1)
    # Third differences leave noise and jumps, and remove smooth motion. A jump to an outlier leaves
    # at least its own size.
    rough = np.pad(np.abs(np.diff(error, 3)), (1, 2), "edge")
    # A smoothed log has no noise, but its residual still bends.
    noise = max(noise_guess(error), robust_sd(away))
    far = np.abs(away) > max(_FAR * noise, least)
    far &= np.max(_around(rough), axis=1) > np.abs(away)
    return far & (np.mean(far) <= _MOST), away


def _around(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N k"]:
    """Return each sample with its neighbours."""
    return sliding_window_view(np.pad(x, _NEIGHBOURS // 2, "edge"), _NEIGHBOURS)


def _shifts(
    problem: Problem, at: Solution, e: Evaluation, outputs: list[dict[str, np.ndarray]]
) -> dict[str, float]:
    """Return the estimates, less those of a search with other outputs."""
    flights = [replace(f, outputs=y) for f, y in zip(problem.training, outputs, strict=True)]
    without = replace(problem, flights=flights)
    ended = search(without, first_guess(without), None, 0, _STEPS, lambda _: None)
    if not ended.optimum.best.converged:
        return {}
    there = named(at.layout, ended.search.data, ended.optimum.best.z)[0]
    change = zip(at.layout.of_interest, np.asarray(e.named) - np.asarray(there), strict=True)
    return {n: float(v) for n, v in change if n not in at.layout.disturbance}
