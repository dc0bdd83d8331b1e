"""Directions of the unknowns: what the data say along them, and what they are exchanged with."""

from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.combinations import TAKES_PART

_HELD = 3.0
"""weak priors hold a direction that is this many times as sharp with them: 8/9 of what is known"""


class Held(NamedTuple):
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
    """by the nuisance's switch, as 'nuisance.bias', the sensitivity (any, q) without it"""


def projected(J: np.ndarray, nuisances: np.ndarray, smallest: float | None = None) -> np.ndarray:
    """What J (n, q) says once the nuisance columns (n, k) are free, as few rows (any, q).

    By orthogonal factors, never by normal equations: singular values keep their full precision.

    Args:
        smallest: the nuisances may be dependent: of their directions, with columns of equal size,
            those below this part of the largest have no effect of their own and are left out.
            Without it they have to be independent.
    """
    q, k = J.shape[1], nuisances.shape[1]
    both = np.hstack([nuisances, J])
    if both.shape[0] < q + k:
        both = np.vstack([both, np.zeros((q + k - both.shape[0], q + k))])
    R = np.linalg.qr(both, mode="r")
    if smallest is None or k == 0:
        return R[k : k + q, k:]
    N, S = R[:, :k], R[:, k:]
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    shown = left[:, singular > smallest * max(singular[0], 1e-300)]
    for _ in range(2):  # the second time takes off what rounding left the first time
        S = S - shown @ (shown.T @ S)
    return S


class Directions(NamedTuple):
    singular: np.ndarray
    right: np.ndarray


def directions(sensitivity: np.ndarray, scale: np.ndarray) -> Directions:
    q = scale.size
    padded = np.vstack([sensitivity * scale, np.zeros((q, q))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    return Directions(singular, right)


def covariance_of(total: Directions, kept: np.ndarray, scale: np.ndarray) -> np.ndarray:
    V = total.right[kept].T / total.singular[kept]
    return np.outer(scale, scale) * (V @ V.T)


class Exchange(NamedTuple):
    """Which nuisances a direction of the unknowns is exchanged with."""

    sensitivity: np.ndarray
    held: Held | None
    least: float
    """singular value that counts as zero"""

    def moves(self, v: np.ndarray) -> np.ndarray:
        """(k,) whether each nuisance takes part; none where weak priors do not hold v."""
        if self.held is None or not self.held.nuisances:
            return np.zeros(0, bool)
        with_weak = np.linalg.norm(self.sensitivity @ v)
        without = np.linalg.norm(self.held.sensitivity @ v)
        size = np.abs(self.held.compensation @ v)
        if with_weak < max(self.least, _HELD * without):
            return np.zeros(size.size, bool)
        return size > TAKES_PART * max(size.max(), 1e-300)

    def labels(self, v: np.ndarray) -> tuple[str, ...]:
        """As the fit names the nuisances."""
        moves = self.moves(v)
        return tuple(self.held.labels[i] for i in np.flatnonzero(moves)) if self.held else ()

    def words(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances that the directions are exchanged with, each once."""
        if self.held is None:
            return ()
        found = [self.held.nuisances[i] for v in rows for i in np.flatnonzero(self.moves(v))]
        return tuple(dict.fromkeys(found))

    def switches(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances without which every direction would be determined."""
        if self.held is None or not self.words(rows):
            return ()
        return tuple(
            name
            for name, other in self.held.switched_off.items()
            if all(
                np.linalg.norm(other @ v)
                > max(self.least, _HELD * np.linalg.norm(self.held.sensitivity @ v))
                for v in rows
            )
        )
