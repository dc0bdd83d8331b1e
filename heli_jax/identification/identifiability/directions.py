"""Directions of the unknowns in relative coordinates: rank, covariance, and how far is too far.

A singular value may be far from zero and still leave a parameter anywhere between a tenth and ten
times its value: an interval that reaches further than that factor determines nothing.
"""

import math
from typing import NamedTuple

import numpy as np

from heli_jax.identification.estimation.evaluation import NULL
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown
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
    """Of length one, its largest part positive."""
    v = v / np.linalg.norm(v)
    return v if v[np.argmax(np.abs(v))] > 0 else -v


def projected(J: np.ndarray, nuisances: np.ndarray, smallest: float | None = None) -> np.ndarray:
    """What the rows say of the unknowns once the nuisances are free, as few rows (any, q).

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
    if both.shape[0] < q + k:
        both = np.vstack([both, np.zeros((q + k - both.shape[0], q + k))])
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
    """Orthogonal directions of the unknowns, each in units of its scale, the best determined
    first."""

    singular: np.ndarray
    """(q,) 1 / sd along each"""
    right: np.ndarray
    """(q, q) a direction a row"""
    scale: np.ndarray
    """(q,) of the unknowns, in relative coordinates"""
    null: float
    """part of the largest singular value up to which a direction is not determined"""

    @property
    def kept(self) -> np.ndarray:
        """(q,) which of them are determined."""
        return self.singular > self.null * max(self.singular[0], 1e-300)

    @property
    def not_determined(self) -> list[np.ndarray]:
        """The others, as unit directions (q,) in relative coordinates."""
        return [unit_vector(self.scale * v) for v in self.right[~self.kept]]

    @property
    def covariance(self) -> np.ndarray:
        """(q, q) of the unknowns along what is determined."""
        # With the rest every variance would be infinite, also those of parameters that the data
        # determine well.
        V = self.right[self.kept].T / self.singular[self.kept]
        return np.outer(self.scale, self.scale) * (V @ V.T)


def directions(rows: np.ndarray, scale: np.ndarray, null: float = NULL) -> Directions:
    """Those of a whitened sensitivity (any, q), each unknown in units of its scale (q,)."""
    # With fewer rows than unknowns the decomposition would leave the null directions out. Without
    # the scale, what counts as the weakest direction would hang on the units of parameters.
    padded = np.vstack([rows * scale, np.zeros((scale.size, scale.size))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    return Directions(singular, right, scale, null)


def without_effect(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """Return the unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    least = _NO_EFFECT * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)


def with_too_wide(
    null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Return the null directions, and those along which a 95 % interval spans more than the factor.

    Args:
        null: unit directions (q,) that are not determined anyhow.
        covariance: (q, q) of the unknowns in relative coordinates.
        unknowns: (q,) what these are.
    """
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
    """What is left of the data where the nuisances' weak priors are taken away.

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
        where weak priors do not hold it.

        Args:
            sensitivity: (any, q) with the weak priors.
        """
        held, free = (np.linalg.norm(rows @ v) for rows in (sensitivity, self.sensitivity))
        # Sharp by the weak priors and by nothing else: then what moves is what they hold.
        least = NULL * np.linalg.norm(sensitivity)
        if not self.nuisances or held < max(least, _SHARPER * free):
            return ()
        # In sds of their weak priors, so that a bias in rad and an offset of a stick compare.
        size = np.abs(self.compensation @ v)
        moves = size > TAKES_PART * max(size.max(), 1e-300)
        return tuple(n for n, m in zip(self.nuisances, moves, strict=True) if m)
