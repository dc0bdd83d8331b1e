"""Directions of the unknowns: what the data say along them, and what they are exchanged with."""

import math
from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.combinations import TAKES_PART
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown

_SHARPER = 3.0
"""weak priors hold a direction that is this many times as sharp with them: 8/9 of what is known"""

_DETERMINES = Z95 / math.log(FACTOR)
"""1 / sd in relative coordinates of a direction whose 95 % interval reaches just as far as the
factor: what leaves it wider is no way out"""


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
    nuisances: tuple[str, ...]
    """(k,) in words, as 'the bias of p'"""
    labels: tuple[str, ...]
    """(k,) as the fit names them, as 'flight 1/bias p'"""
    switched_off: dict[str, np.ndarray]
    """by the nuisance's switch, as 'fit.nuisance.bias', the sensitivity (any, q) without it"""


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
    S, spanned = R[:, k:], _span(R[:, :k], smallest)
    for _ in range(2):  # the second time takes off what rounding left the first time
        S = S - spanned @ (spanned.T @ S)
    return S


def _span(N: np.ndarray, smallest: float) -> np.ndarray:
    """Orthonormal columns that span those of N but for directions of no effect."""
    # Dependent columns leave directions of pure rounding in QR's Q; projecting those out too would
    # take some of the unknowns' effect away. Hence singular values, of columns of one size.
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    return left[:, singular > smallest * max(singular[0], 1e-300)]


class Directions(NamedTuple):
    """Orthogonal directions of the scaled unknowns, the best determined first."""

    singular: np.ndarray
    """(q,) 1 / sd along each"""
    right: np.ndarray
    """(q, q) a direction a row"""


def directions(sensitivity: np.ndarray, scale: np.ndarray) -> Directions:
    """Those of a whitened sensitivity (any, q), each unknown in units of its scale (q,)."""
    q = scale.size
    # With fewer rows than unknowns the decomposition would leave the null directions out.
    padded = np.vstack([sensitivity * scale, np.zeros((q, q))])
    # Each unknown in units of its scale: without that, what counts as the weakest direction would
    # hang on the units of parameters.
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    return Directions(singular, right)


def covariance_of(total: Directions, kept: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Covariance (q, q) of the unknowns along the directions that are kept.

    Args:
        total: the directions of the scaled unknowns.
        kept: (q,) which of them are determined.
        scale: (q,) in relative coordinates, as `directions` had it.
    """
    # Only along what is determined: with the rest every variance would be infinite, also those of
    # parameters that the data determine well.
    V = total.right[kept].T / total.singular[kept]
    return np.outer(scale, scale) * (V @ V.T)


class Exchange(NamedTuple):
    """Which nuisances a direction of the unknowns is exchanged with."""

    sensitivity: np.ndarray
    """(any, q) with the weak priors"""
    without_weak: WithoutWeakPriors | None
    least: float
    """singular value that counts as zero"""

    def moves(self, v: np.ndarray) -> np.ndarray:
        """(k,) whether each nuisance takes part; none where weak priors do not hold v."""
        if self.without_weak is None or not self.without_weak.nuisances:
            return np.zeros(0, bool)
        with_weak = np.linalg.norm(self.sensitivity @ v)
        without = np.linalg.norm(self.without_weak.sensitivity @ v)
        # In sds of their weak priors, so that a bias in rad and an offset of a stick compare.
        size = np.abs(self.without_weak.compensation @ v)
        # Sharp by the weak priors and by nothing else: then what moves is what they hold.
        if with_weak < max(self.least, _SHARPER * without):
            return np.zeros(size.size, bool)
        return size > TAKES_PART * max(size.max(), 1e-300)

    def labels(self, v: np.ndarray) -> tuple[str, ...]:
        """As the fit names the nuisances."""
        moves = self.moves(v)
        return (
            tuple(self.without_weak.labels[i] for i in np.flatnonzero(moves))
            if self.without_weak
            else ()
        )

    def words(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances that the directions are exchanged with, each once."""
        if self.without_weak is None:
            return ()
        words = self.without_weak.nuisances
        moving = [words[i] for v in rows for i in np.flatnonzero(self.moves(v))]
        return tuple(dict.fromkeys(moving))

    def switches(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances without which every direction would be determined."""
        if self.without_weak is None or not self.words(rows):
            return ()
        # Switched off one kind at a time; one that leaves a direction open is no way out of it.
        return tuple(
            name
            for name, other in self.without_weak.switched_off.items()
            if all(
                np.linalg.norm(other @ v)
                > max(
                    self.least,
                    _DETERMINES,
                    _SHARPER * np.linalg.norm(self.without_weak.sensitivity @ v),
                )
                for v in rows
            )
        )


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """(q, q) of a covariance; one that takes part in no determined direction has none."""
    sd = np.sqrt(np.diag(covariance))
    # An unknown that takes part in no determined direction has no variance in it.
    safe = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.clip(correlation, -1.0, 1.0)


def without_effect_of(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """The unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    # So little beside the largest is what rounding leaves of no effect.
    least = 1e-12 * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)
