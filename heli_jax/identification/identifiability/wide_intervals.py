"""Directions whose 95 % interval reaches so far that it determines nothing: the rule of the factor.

A singular value may be far from zero and still leave a parameter anywhere between a tenth and ten
times its value. Everything is in relative coordinates.
"""

import math
from collections.abc import Mapping

import numpy as np

from heli_jax.identification.identifiability.combinations import unit_vector
from heli_jax.identification.identifiability.directions import directions
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown

TAKES_NO_PART = 1e-3
"""of a unit direction that is not determined: less leaves an unknown determined"""

_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches just as far as the factor"""


def _reaching_too_far(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[int]:
    """The unknowns whose 95 % interval reaches further than the factor."""
    # Values between bounds of both signs have no factor to go by: theirs is `weakly_held`.
    return [
        i
        for i, u in enumerate(unknowns)
        if (u.logarithmic or u.symmetric) and covariance[i, i] > _FAR**2
    ]


def too_wide(
    rows: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of full rank along which a 95 % interval still spans more than the factor.

    Args:
        rows: (any, q) the whitened sensitivity, with the rows of priors that count.
        covariance: (q, q) of the unknowns by these rows.
        unknowns: (q,) what the columns are.
    """
    if not _reaching_too_far(covariance, unknowns):
        return []
    # Not scaled by priors or intervals, as the rank is: here a unit is a factor of e for all.
    plain = directions(rows, np.ones(len(unknowns)))
    wide = [
        unit_vector(v) for s, v in zip(plain.singular, plain.right, strict=True) if s * _FAR < 1
    ]
    # Several directions can make one interval wide of which none is so by itself.
    return wide or [unit_vector(plain.right[-1])]


def single_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """For each unknown whose interval reaches too far the direction in which it does."""
    # How the others move with it, by their regression on it: the column of the covariance.
    return [
        unit_vector(covariance[:, i] / math.sqrt(covariance[i, i]))
        for i in _reaching_too_far(covariance, unknowns)
    ]


def reported_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """As `too_wide` has them, by the covariance of the intervals that are reported."""
    # Autocorrelated residuals have no rows of their own, only the covariance of the sandwich.
    if not _reaching_too_far(covariance, unknowns):
        return []
    # As in `too_wide`: if no single direction is too wide, the widest stands for their sum.
    values, vectors = np.linalg.eigh(covariance)
    return [unit_vector(v) for v in vectors[:, values > _FAR**2].T] or [unit_vector(vectors[:, -1])]


def weakly_held(
    without_weak: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of unknowns that may be zero and that weak priors alone hold.

    For those of one sign the factor of ten tells it; here it is an sd, without the weak priors,
    beyond the unknown's scale and ten times the one with them.

    Args:
        without_weak: (q, q) covariance without the weak priors of the nuisances.
        covariance: (q, q) with them.
        unknowns: (q,) what the columns are.
    """
    return [
        unit_vector(without_weak[:, i] / math.sqrt(without_weak[i, i]))
        for i, u in enumerate(unknowns)
        if not u.logarithmic and without_weak[i, i] > max(1.0, FACTOR**2 * covariance[i, i])
    ]


def further(directions: list[np.ndarray], null: list[np.ndarray]) -> list[np.ndarray]:
    """Of the directions those that are led by an unknown which the null ones do not touch."""
    # One that only leans on a null direction would say the same thing again in other words.
    added: list[np.ndarray] = []
    for v in directions:
        leads = int(np.argmax(np.abs(v)))
        if all(abs(w[leads]) <= TAKES_NO_PART for w in (*null, *added)):
            added.append(v)
    return added


def one_sided(
    covariance: np.ndarray, unknowns: tuple[Unknown, ...], names: tuple[str, ...]
) -> list[np.ndarray]:
    """For each of the unknowns that the likelihood does not bound its direction, without those
    that it does."""
    open_ = np.array([u.name in names for u in unknowns])
    return [
        unit_vector(np.where(open_, covariance[:, i] / np.sqrt(np.diag(covariance)), 0.0))
        for i in np.flatnonzero(open_)
    ]


def factor(u: Unknown, sd: float, limits: Mapping[str, tuple[float, float]]) -> float:
    """From the value to the further end of its interval; infinite where that holds zero."""
    if u.name not in limits:
        return math.exp(Z95 * sd)
    ratios = [end / u.value for end in limits[u.name]]
    return max(max(r, 1.0 / r) if r > 0 else math.inf for r in ratios)


def holds_zero(u: Unknown, sd: float, limits: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the interval of an unknown of either sign holds zero."""
    if u.name not in limits:
        return Z95 * sd >= u.distance
    low, high = limits[u.name]
    return low <= 0.0 <= high
