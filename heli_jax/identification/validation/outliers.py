"""Outliers of the residuals: single samples far from their neighbours, such as dropouts to zero.

The model explains the motion, so its residual shows outliers that the record hides. A running
median removes what varies slowly: a response that the model lacks is no outlier. The estimates
without these samples follow to first order.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.simulated_flights import signals
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.shifts import change_with

_FAR = 10.0
"""Distance of an outlier from the running median [robust sds of that distance]."""
_LARGE = 4.0
"""Least distance [sds of the noise], for residuals that are rounding."""
_NEIGHBOURS = 5
"""Samples of the running median."""
_MEDIAN = 0.6745
"""Median size of a standard normal number."""
_MOST = 0.05
"""Largest share of outliers; more belong to the noise."""


class Outliers(NamedTuple):
    """Outliers of one output."""

    output: str
    count: int
    share: float
    """Share of the output's samples."""
    values: np.ndarray
    """Measured values (count,) [SI]."""
    shifts: dict[str, float]
    """Change of each estimate with these samples, over that without any outlier [SI]."""


def outliers(at: Solution, e: Evaluation) -> list[Outliers]:
    """Return the outliers of each output at an optimum of a fit in time."""
    found: dict[str, list[np.ndarray]] = {}
    flights, first = [dict(f.outputs) for f in at.data.flights], 0
    for i, name in signals(at.layout):
        y = np.asarray(flights[i][name])
        far = _outlying(np.asarray(e.r[first : first + y.size]), np.isfinite(y))
        first += y.size
        found.setdefault(name, []).append(y[far])
        # The expected value has no residual, as a missing sample.
        error = e.innovations[i].error[name] if e.innovations else e.raw[i][name]
        flights[i][name] = np.where(far, y - np.asarray(error), y)
    if not any(v.size for parts in found.values() for v in parts):
        return []
    data = at.data._replace(
        flights=tuple(f._replace(outputs=y) for f, y in zip(at.data.flights, flights, strict=True))
    )
    shifts = {n: -change for n, change in change_with(at, e, data).items()}
    out = []
    for name, parts in found.items():
        values = np.concatenate(parts)
        total = sum(
            np.isfinite(f.outputs[name]).sum() for f in at.data.flights if name in f.outputs
        )
        if values.size:
            out.append(Outliers(name, values.size, values.size / int(total), values, shifts))
    return out


def _outlying(r: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return a mask of the outliers of whitened residuals (N,), of which some are measured."""
    far, rows = np.zeros(r.shape, bool), r[seen]
    if rows.size < 2 * _NEIGHBOURS:
        return far
    around = sliding_window_view(np.pad(rows, _NEIGHBOURS // 2, "edge"), _NEIGHBOURS)
    distance = np.abs(rows - np.median(around, axis=1))
    least = max(_LARGE, _FAR * float(np.median(distance)) / _MEDIAN)
    if 0 < np.mean(distance > least) <= _MOST:
        far[seen] = distance > least
    return far
