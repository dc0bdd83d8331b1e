"""Products of powers, such as a/Ixx, and sums, such as La + Lb, that the data may determine where
the parameters are not: by the slopes at one point, which `equivalents` asks far from it."""

import math
from collections.abc import Mapping

import numpy as np

from heli_jax.identification.identifiability.directions import TAKES_PART, unit_vector
from heli_jax.identification.identifiability.verdict import Z95, Combination, Unknown

_ROUNDED = 0.02
"""of a power or factor that is a quarter or nothing: what the record's noise leaves of a/Ixx is
a/Ixx^0.99"""
_LARGEST_FACTOR = 4.0
"""of a parameter in a sum that is worth naming"""
_LARGEST = 700.0
"""log of the largest value: exp overflows at 709"""


def combinations(
    null: list[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    units: Mapping[str, str | None] | None = None,
) -> tuple[Combination, ...]:
    """Return the products of powers that do not change along the null directions; with `units` the
    sums of parameters of one unit.

    Args:
        null: unit directions (q,) in relative coordinates.
        covariance: (q, q) of what is determined, in the same.
        unknowns: (q,) what the coordinates are.
    """
    # From a relative coordinate to log |value|, whose powers these are, or to the value itself.
    to = np.array([u.per_log for u in unknowns])
    if units is not None:
        to = to * [u.value if u.logarithmic else 0.0 for u in unknowns]
    moved = [v * to for v in null]
    if not null or not all(np.linalg.norm(v) > 0 for v in moved):
        return ()
    W, pivots = row_reduced(np.array([unit_vector(v) for v in moved]), unknowns)
    found = []
    for i in range(W.shape[1]):
        # One that takes no part in any null direction is determined by itself.
        if i in pivots or not np.any(abs(W[:, i]) >= (TAKES_PART if units is None else _ROUNDED)):
            continue
        # W holds the identity in the pivots' columns: unknown i less W[:, i] times those of the
        # pivots is the same all along the null directions.
        weights = np.zeros(W.shape[1])
        weights[i] = 1.0
        weights[pivots] = -W[:, i]
        weights = np.array([_rounded(w, units is not None) for w in weights])
        members = [unknowns[k] for k in np.flatnonzero(weights)]
        # What may be zero or change its sign has no power.
        if not all(u.logarithmic for u in members):
            continue
        if units is None:
            # a/Ixx rather than Ixx/a
            weights = -weights if weights[pivots].sum() < 0 else weights
        elif (
            len(members) < 2
            or np.abs(weights).max() > _LARGEST_FACTOR
            # What has another unit has no sum, and a gain or a shift is no parameter.
            or len({units.get(u.name, u.name) for u in members}) > 1
        ):
            continue
        along = weights * to
        sd = math.sqrt(max(0.0, float(along @ covariance @ along)))
        by_name = {u.name: float(w) for u, w in zip(unknowns, weights, strict=True) if w}
        values = np.array([u.value for u in unknowns])
        found.append((_product if units is None else _sum)(by_name, weights, values, sd))
    # An interval from nothing to anything determines a product as little as a parameter.
    return tuple(c for c in found if c.is_bounded)


def row_reduced(W: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[np.ndarray, list[int]]:
    """Row-reduce the null directions; pivots are late parameters, so that ratios read a/Ixx."""
    W, pivots = W.copy(), []
    for k in range(W.shape[0]):
        size = np.max(np.abs(W[k:]), axis=0)
        size[pivots] = 0.0
        # Half of the largest pivot is as stable as it needs to be, and leaves a choice of names.
        near = [i for i in range(W.shape[1]) if size[i] >= 0.5 * size.max()]
        # The pivot is what the others are divided by, so if possible it is one that has powers.
        proper = [i for i in near if unknowns[i].is_parameter and unknowns[i].logarithmic]
        pivot = (proper or near)[-1]
        row = k + int(np.argmax(np.abs(W[k:, pivot])))
        W[[k, row]] = W[[row, k]]
        W[k] /= W[k, pivot]
        for other in range(W.shape[0]):
            if other != k:
                W[other] -= W[other, pivot] * W[k]
        pivots.append(pivot)
    return W, pivots


def _rounded(weight: float, simple: bool) -> float:
    """A small fraction where the weight is one, else two digits; of a sum a fraction always."""
    quarter = round(weight * 4) / 4
    if abs(weight) < _ROUNDED and simple:
        return 0.0
    return quarter if simple or abs(weight - quarter) < _ROUNDED else round(weight, 2)


def _product(
    powers: dict[str, float], weights: np.ndarray, values: np.ndarray, sd: float
) -> Combination:
    """`sd`: of the logarithm."""
    part = weights != 0
    log = float(weights[part] @ np.log(np.abs(values[part])))
    value = math.exp(log) if abs(log) < _LARGEST else math.inf
    reach = math.exp(min(Z95 * sd, _LARGEST))

    def power(name: str, e: float) -> str:
        return name if e == 1 else f"{name}^{e:g}"

    over = " * ".join(power(n, e) for n, e in powers.items() if e > 0) or "1"
    under = [power(n, -e) for n, e in powers.items() if e < 0]
    below = under[0] if len(under) == 1 else f"({' * '.join(under)})"
    name = f"{over}/{below}" if under else over
    return Combination(name, powers, value, value * sd, value / reach, value * reach)


def _sum(
    factors: dict[str, float], weights: np.ndarray, values: np.ndarray, sd: float
) -> Combination:
    def term(name: str, factor: float, first: bool) -> str:
        sign = "-" if factor < 0 else "" if first else "+"
        size = "" if abs(factor) == 1 else f"{abs(factor):g} "
        return f"{sign}{'' if first else ' '}{size}{name}"

    value = float(weights @ values)
    name = " ".join(term(n, w, k == 0) for k, (n, w) in enumerate(factors.items()))
    ends = (value - Z95 * sd, value + Z95 * sd)
    return Combination(name, factors, value, sd, *ends, kind="sum")
