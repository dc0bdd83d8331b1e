"""Directions of the unknowns in relative coordinates: rank, covariance, how far is too far, and
what stays the same along the directions that the data do not determine.

A singular value may be far from zero and still leave a parameter anywhere between a tenth and ten
times its value: an interval that reaches further than that factor determines nothing.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.identification.estimation.evaluation import NULL
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Combination, Unknown
from heli_jax.identification.unknowns.layout import FlightUnknown

TAKES_PART = 0.1
"""of a unit direction: less is not worth naming"""
TAKES_NO_PART = 1e-3
"""of a unit direction that is not determined: less leaves an unknown determined"""
_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches just as far as the factor"""
_SHARPER = 3.0
"""weak priors hold a direction that is this many times as sharp with them: 8/9 of what is known"""
_NO_EFFECT = 1e-12
"""norm of a column over the largest that rounding leaves of no effect"""


def unit_vector(v: np.ndarray) -> np.ndarray:
    """Return the vector with length one, its largest part positive."""
    v = v / np.linalg.norm(v)
    return v if v[np.argmax(np.abs(v))] > 0 else -v


def projected(J: np.ndarray, nuisances: np.ndarray, smallest: float | None = None) -> np.ndarray:
    """Return what rows say of the unknowns once the nuisances are free, as few rows (any, q).

    Args:
        J: (n, q) whitened Jacobian by the unknowns.
        nuisances: (n, k) that by the nuisances.
        smallest: the nuisances may be dependent: of their directions, with columns of equal size,
            those below this part of the largest have no effect of their own and are left out.
            Without it they have to be independent.
    """
    # By orthogonal factors, never by normal equations, which square the condition number: singular
    # values down to 1e-8 of the largest are looked at, and their squares are below rounding.
    q, k = J.shape[1], nuisances.shape[1]
    both = np.hstack([nuisances, J])
    both = np.vstack([both, np.zeros((max(q + k - both.shape[0], 0), q + k))])
    R = np.linalg.qr(both, mode="r")
    # With the nuisances first, the lower right corner is what they cannot explain.
    if smallest is None or k == 0:
        return R[k : k + q, k:]
    # Dependent columns leave directions of pure rounding in QR's Q; projecting those out too would
    # take some of the unknowns' effect away. Hence singular values, of columns of one size.
    S, N = R[:, k:], R[:, :k]
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    spanned = left[:, singular > smallest * max(singular[0], 1e-300)]
    for _ in range(2):  # the second time takes off what rounding left the first time
        S = S - spanned @ (spanned.T @ S)
    return S


class Directions(NamedTuple):
    """Rank and covariance of the unknowns by a whitened sensitivity."""

    singular: np.ndarray
    """(q,) 1 / sd along orthogonal directions, each unknown in units of its scale; largest first"""
    rank: int
    """how many of them are determined"""
    null: list[np.ndarray]
    """the others, as unit directions (q,) in relative coordinates"""
    covariance: np.ndarray
    """(q, q) in relative coordinates, along what is determined"""


def directions(rows: np.ndarray, scale: np.ndarray, smallest: float = NULL) -> Directions:
    """Return what rows (any, q) determine of unknowns of a size (q,).

    Args:
        smallest: part of the largest singular value up to which nothing is determined.
    """
    # With fewer rows than unknowns the decomposition would leave the null directions out. Without
    # the scale, what counts as the weakest direction would hang on the units of parameters.
    padded = np.vstack([rows * scale, np.zeros((scale.size, scale.size))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    kept = singular > smallest * max(singular[0], 1e-300)
    # With the rest every variance would be infinite, also those of parameters that the data
    # determine well.
    V = scale[:, None] * right[kept].T / singular[kept]
    null = [unit_vector(scale * v) for v in right[~kept]]
    return Directions(singular, int(kept.sum()), null, V @ V.T)


def without_effect(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """Return the unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    least = _NO_EFFECT * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)


def with_too_wide(
    null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Return the null directions, and those along which a 95 % interval by the covariance (q, q)
    spans more than the factor."""
    # Values between bounds of both signs have no factor to go by.
    far = [
        i
        for i, u in enumerate(unknowns)
        if (u.logarithmic or u.symmetric) and covariance[i, i] > _FAR**2
    ]
    if far and not null:
        # Not scaled by priors or intervals, as the rank is: here a unit is a factor of e for all.
        values, vectors = np.linalg.eigh(covariance)
        # Several directions can make one interval wide of which none is so by itself.
        wide = vectors[:, values > _FAR**2].T
        null = [unit_vector(v) for v in (wide if len(wide) else vectors[:, -1:].T)]
    # How the others move with one, by their regression on it: the column of the covariance.
    return with_further(null, [covariance[:, i] for i in far])


def with_further(null: list[np.ndarray], others: list[np.ndarray]) -> list[np.ndarray]:
    """Return the null directions, and those others that are led by an unknown which none of them
    touches."""
    # One that only leans on a null direction would say the same thing again in other words.
    for v in map(unit_vector, others):
        if all(abs(w[np.argmax(np.abs(v))]) <= TAKES_NO_PART for w in null):
            null = [*null, v]
    return null


class WithoutWeakPriors(NamedTuple):
    """Information of the data without the nuisances' weak priors.

    Initial states, biases and input offsets carry priors of ten times the signal, so that one that
    no output shows does no harm. What only these hold up of a parameter the data do not determine.
    """

    sensitivity: np.ndarray
    """(any, q) with the nuisances free: no prior of any kind"""
    compensation: np.ndarray
    """(k, q) by how much the nuisances move, in sds of their weak priors, to make up for a unit of
    each unknown"""
    nuisances: tuple[FlightUnknown, ...]
    """(k,)"""

    def exchanged(self, v: np.ndarray, sensitivity: np.ndarray) -> tuple[FlightUnknown, ...]:
        """Return the nuisances that a direction v (q,) of the unknowns is exchanged with; none
        where weak priors, which the given sensitivity (any, q) has, do not hold it."""
        held, free = (np.linalg.norm(rows @ v) for rows in (sensitivity, self.sensitivity))
        # Sharp by the weak priors and by nothing else: then what moves is what they hold.
        least = NULL * np.linalg.norm(sensitivity)
        if not self.nuisances or held < max(least, _SHARPER * free):
            return ()
        # In sds of their weak priors, so that a bias in rad and an offset of a stick compare.
        size = np.abs(self.compensation @ v)
        moves = size > TAKES_PART * max(size.max(), 1e-300)
        return tuple(n for n, m in zip(self.nuisances, moves, strict=True) if m)


# Products of powers, such as a/Ixx, and sums, such as La + Lb, that the data may determine where
# the parameters are not: by the slopes at one point, which `equivalents` tests far from it.

_ROUNDED = 0.02
"""of a power or factor that is a quarter or nothing: what the record's noise leaves of a/Ixx is
a/Ixx^0.99"""
_LARGEST_FACTOR = 4.0
"""of a parameter in a sum that is worth naming"""
_LARGEST = 700.0
"""log of the largest value: exp overflows at 709"""

type Spread = Callable[[np.ndarray], tuple[float, float]]
"""of a weighted sum (q,) of relative coordinates: standard deviation, and how many of these a 95 %
interval reaches to either side"""


def combinations(
    null: Sequence[np.ndarray],
    spread: Spread,
    unknowns: tuple[Unknown, ...],
    units: Mapping[str, str | None] | None = None,
) -> tuple[Combination, ...]:
    """Return the products of powers that do not change along the null directions (q,); with `units`
    the sums of parameters of one unit."""
    # From a relative coordinate to log |value|, whose powers these are, or to the value itself.
    to = np.array([u.per_log for u in unknowns])
    if units is not None:
        to = to * [u.value if u.logarithmic else 0.0 for u in unknowns]
    moved = [v * to for v in null]
    if not moved or not all(np.linalg.norm(v) > 0 for v in moved):
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
        by_name = {u.name: float(w) for u, w in zip(unknowns, weights, strict=True) if w}
        values = {u.name: u.value for u in members}
        made = _product if units is None else _sum
        found.append(made(by_name, values, *spread(weights * to)))
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
    """Return a small fraction where the weight is one, else two digits; of a sum a fraction."""
    quarter = round(weight * 4) / 4
    if abs(weight) < _ROUNDED and simple:
        return 0.0
    return quarter if simple or abs(weight - quarter) < _ROUNDED else round(weight, 2)


def _product(
    powers: dict[str, float], values: dict[str, float], sd: float, reach: float
) -> Combination:
    """Return a product of powers; `sd` is that of its logarithm."""
    log = sum(e * math.log(abs(values[n])) for n, e in powers.items())
    value = math.exp(log) if abs(log) < _LARGEST else math.inf
    factor = math.exp(min(reach * sd, _LARGEST))

    def power(name: str, e: float) -> str:
        return name if e == 1 else f"{name}^{e:g}"

    over = " * ".join(power(n, e) for n, e in powers.items() if e > 0) or "1"
    under = [power(n, -e) for n, e in powers.items() if e < 0]
    below = under[0] if len(under) == 1 else f"({' * '.join(under)})"
    name = f"{over}/{below}" if under else over
    return Combination(name, powers, value, value * sd, value / factor, value * factor)


def _sum(
    factors: dict[str, float], values: dict[str, float], sd: float, reach: float
) -> Combination:
    def term(name: str, factor: float) -> str:
        size = "" if abs(factor) == 1 else f"{abs(factor):g} "
        return f"{'-' if factor < 0 else '+'} {size}{name}"

    value = sum(w * values[n] for n, w in factors.items())
    name = " ".join(term(n, w) for n, w in factors.items())
    # The first sign stands without a space, a plus not at all.
    name = name.removeprefix("+ ") if name.startswith("+") else name.replace("- ", "-", 1)
    ends = (value - reach * sd, value + reach * sd)
    return Combination(name, factors, value, sd, *ends, kind="sum")
