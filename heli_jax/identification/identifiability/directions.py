"""Directions of the unknowns in relative coordinates: rank, covariance, null directions, and the
combinations of parameters that do not change along them.

A null direction has a singular value below rounding, or makes a 95 % interval that reaches further
than a factor of ten.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.identification.estimation.evaluation import NULL
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Combination, Unknown
from heli_jax.identification.unknowns.layout import FlightUnknown

TAKES_PART = 0.01
"""component of a unit null direction from which on an unknown takes part in it"""
_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches as far as the factor"""
_SHARPER = 100.0
"""sensitivity with known nuisances over that with free ones from which on a direction is
exchangeable with nuisances"""
_NO_EFFECT = 1e-12
"""norm of a column without effect, over the largest"""


def unit_vector(v: np.ndarray) -> np.ndarray:
    """Return the vector with length one, its largest part positive."""
    v = v / np.linalg.norm(v)
    return v if v[np.argmax(np.abs(v))] > 0 else -v


def projected(J: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """Return whitened rows (any, q) of the information on the unknowns with the nuisances free.

    Args:
        J: (n, q) whitened Jacobian by the unknowns.
        nuisances: (n, k) that by the nuisances, which may be dependent.
    """
    # Orthogonal factors, no normal equations: singular values down to 1e-8 of the largest count,
    # and their squares are below rounding.
    k = nuisances.shape[1]
    R = np.linalg.qr(np.hstack([nuisances, J]), mode="r")
    N, S = R[:, :k], R[:, k:]
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    spanned = left[:, singular > NULL * max(singular.max(initial=0.0), 1e-300)]
    for _ in range(2):  # the second time takes off the rounding of the first
        S = S - spanned @ (spanned.T @ S)
    return np.linalg.qr(S, mode="r")


class Directions(NamedTuple):
    """Rank and covariance of the unknowns by a whitened sensitivity."""

    singular: np.ndarray
    """(q,) 1 / sd along orthogonal directions, each unknown in units of its scale; largest first"""
    rank: int
    null: list[np.ndarray]
    """null directions, as unit vectors (q,) in relative coordinates"""
    covariance: np.ndarray
    """(q, q) in relative coordinates, without the null directions"""


def directions(rows: np.ndarray, scale: np.ndarray) -> Directions:
    """Return rank and covariance by rows (any, q), of unknowns of a size (q,)."""
    # Rows of zeros: the decomposition has all q directions.
    padded = np.vstack([rows * scale, np.zeros((scale.size, scale.size))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    kept = singular > NULL * max(singular[0], 1e-300)
    V = scale[:, None] * right[kept].T / singular[kept]
    null = [unit_vector(scale * v) for v in right[~kept]]
    return Directions(singular, int(kept.sum()), null, V @ V.T)


def without_effect(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """Return the unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    least = _NO_EFFECT * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)


def with_wide_intervals(
    null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Return the null directions, and those of unknowns whose 95 % interval by the covariance
    (q, q) spans more than the factor."""
    # Values between bounds of both signs have no factor.
    far = [
        i
        for i, u in enumerate(unknowns)
        if (u.logarithmic or u.symmetric) and covariance[i, i] > _FAR**2
    ]
    # The widest first. Its column is the regression of the others on it.
    far.sort(key=lambda i: -covariance[i, i])
    return with_new_directions(null, [covariance[:, i] for i in far])


def with_new_directions(null: list[np.ndarray], others: list[np.ndarray]) -> list[np.ndarray]:
    """Return the null directions, and those others whose largest component is in none of them."""
    for v in map(unit_vector, others):
        if all(abs(w[np.argmax(np.abs(v))]) <= TAKES_PART for w in null):
            null = [*null, v]
    return null


class Nuisances(NamedTuple):
    """Initial states, biases and input offsets, which may be exchangeable with parameters."""

    fixed: np.ndarray
    """(any, q) sensitivity to the unknowns with the nuisances known"""
    compensation: np.ndarray
    """(k, q) change of the nuisances, in sds of their weak priors, that compensates a unit of each
    unknown"""
    names: tuple[FlightUnknown, ...]
    """(k,)"""

    def exchanged(self, v: np.ndarray, sensitivity: np.ndarray) -> tuple[FlightUnknown, ...]:
        """Return the nuisances that are exchangeable with a direction v (q,) of the unknowns; none
        if it is no sharper with the nuisances known than by the given sensitivity (any, q)."""
        known, free = (np.linalg.norm(rows @ v) for rows in (self.fixed, sensitivity))
        if not self.names or known < max(NULL * np.linalg.norm(self.fixed), _SHARPER * free):
            return ()
        size = np.abs(self.compensation @ v)
        moves = size > 0.1 * max(size.max(), 1e-300)
        return tuple(n for n, m in zip(self.names, moves, strict=True) if m)


# Products of powers, such as a/Ixx, and sums, such as La + Lb, that do not change along the null
# directions at one point; `equivalents` tests them far from it.

_ROUNDED = 0.02
"""distance of a power or factor from a multiple of a quarter that is noise"""
_LARGEST_FACTOR = 4.0
"""of a parameter in a sum"""
_LARGEST = 700.0
"""log of the largest value: exp overflows at 709"""


def combinations(
    null: Sequence[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    units: Mapping[str, str | None] | None = None,
) -> tuple[Combination, ...]:
    """Return the products of powers that do not change along the null directions (q,), or with
    `units` the sums of parameters of one unit; with sds by a covariance (q, q)."""
    # From a relative coordinate to log |value|, or for sums to the value.
    to = np.array([u.per_log for u in unknowns])
    if units is not None:
        to = to * [u.value if u.logarithmic else 0.0 for u in unknowns]
    moved = [v * to for v in null]
    if not moved or not all(np.linalg.norm(v) > 0 for v in moved):
        return ()
    W, pivots = row_reduced(np.array([unit_vector(v) for v in moved]), unknowns)
    found = []
    for i in range(W.shape[1]):
        if i in pivots or not np.any(abs(W[:, i]) >= (0.1 if units is None else _ROUNDED)):
            continue
        # W has the identity in the pivots' columns: unknown i less W[:, i] times the pivots is
        # constant along the null directions.
        weights = np.zeros(W.shape[1])
        weights[i] = 1.0
        weights[pivots] = -W[:, i]
        weights = np.array([_rounded(w, units is not None) for w in weights])
        members = [unknowns[k] for k in np.flatnonzero(weights)]
        if not all(u.logarithmic for u in members):
            continue
        if units is None:
            # a/Ixx rather than Ixx/a
            weights = -weights if weights[pivots].sum() < 0 else weights
        elif (
            len(members) < 2
            or np.abs(weights).max() > _LARGEST_FACTOR
            or len({units.get(u.name, u.name) for u in members}) > 1
        ):
            continue
        by_name = {u.name: float(w) for u, w in zip(unknowns, weights, strict=True) if w}
        values = {u.name: u.value for u in members}
        made = _product if units is None else _sum
        along = weights * to
        sd = math.sqrt(max(0.0, float(along @ covariance @ along)))
        found.append(made(by_name, values, sd))
    return tuple(c for c in found if c.is_bounded)


def row_reduced(W: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[np.ndarray, list[int]]:
    """Row-reduce the null directions; pivots are late parameters, so that ratios read a/Ixx."""
    W, pivots = W.copy(), []
    for k in range(W.shape[0]):
        size = np.max(np.abs(W[k:]), axis=0)
        size[pivots] = 0.0
        # Half of the largest pivot is stable enough.
        near = [i for i in range(W.shape[1]) if size[i] >= 0.5 * size.max()]
        # The pivot is in the denominator.
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
    """Return the nearest quarter if the weight is near it or of a sum, else two digits."""
    quarter = round(weight * 4) / 4
    if abs(weight) < _ROUNDED and simple:
        return 0.0
    return quarter if simple or abs(weight - quarter) < _ROUNDED else round(weight, 2)


def _product(powers: dict[str, float], values: dict[str, float], sd: float) -> Combination:
    """Return a product of powers; `sd` is that of its logarithm."""
    log = sum(e * math.log(abs(values[n])) for n, e in powers.items())
    value = math.exp(log) if abs(log) < _LARGEST else math.inf
    factor = math.exp(min(Z95 * sd, _LARGEST))

    def power(name: str, e: float) -> str:
        return name if e == 1 else f"{name}^{e:g}"

    over = " * ".join(power(n, e) for n, e in powers.items() if e > 0) or "1"
    under = [power(n, -e) for n, e in powers.items() if e < 0]
    below = under[0] if len(under) == 1 else f"({' * '.join(under)})"
    name = f"{over}/{below}" if under else over
    return Combination(name, powers, value, value * sd, value / factor, value * factor)


def _sum(factors: dict[str, float], values: dict[str, float], sd: float) -> Combination:
    def term(name: str, factor: float) -> str:
        size = "" if abs(factor) == 1 else f"{abs(factor):g} "
        return f"{'-' if factor < 0 else '+'} {size}{name}"

    value = sum(w * values[n] for n, w in factors.items())
    name = " ".join(term(n, w) for n, w in factors.items())
    name = name.removeprefix("+ ") if name.startswith("+") else name.replace("- ", "-", 1)
    ends = (value - Z95 * sd, value + Z95 * sd)
    return Combination(name, factors, value, sd, *ends, kind="sum")
