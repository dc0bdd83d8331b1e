"""Covariance of output-error estimates when the residuals have a memory.

Source: Klein and Morelli, Aircraft System Identification (2006), section 5.3; the lag window is
Bartlett's, with which no variance can come out negative (Newey and West, 1987).
"""

import numpy as np

from heli_jax.identification.evaluation import Evaluation
from heli_jax.identification.layout import Data, Layout

LONGEST = 20.0
"""lags of the residual's autocovariance that are used [s], at most a fifth of the record"""


def inflation(
    layout: Layout, data: Data, e: Evaluation, along: np.ndarray | None = None
) -> np.ndarray:
    """How much wider than white noise says the standard deviations (q,) of all unknowns are, or
    (k,) of the combinations `along` (k, q) of them.

    With M = J'J the covariance is M^-1 (sum over i, k of J_i R(i - k) J_k') M^-1, where R is the
    windowed autocovariance of the residuals; M^-1 would hold if they were white. Several outputs
    of a flight enter with their cross-covariances.
    """
    J, r = np.asarray(e.J, np.float64), np.asarray(e.r, np.float64)
    norms = np.linalg.norm(J, axis=0)
    J = J / np.where(norms > 0, norms, 1.0)
    at, meat = 0, np.zeros((J.shape[1], J.shape[1]))
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        n = next(iter(flight.outputs.values())).shape[0]
        size = n * len(outputs)
        blocks = J[at : at + size].reshape(len(outputs), n, -1)
        lags = max(1, min(int(LONGEST / float(flight.dt)), n // 5))
        meat += _memory(blocks, r[at : at + size].reshape(len(outputs), n), lags)
        at += size
    rest = J[at:]
    meat += rest.T @ rest
    inverse = np.linalg.pinv(J, rcond=1e-10)
    white = inverse @ inverse.T
    coloured = white @ meat @ white
    along = np.eye(norms.size) if along is None else along
    along = along / np.where(norms > 0, norms, 1.0)
    by_white = np.sum(along @ white * along, axis=1)
    ratio = np.sum(along @ coloured * along, axis=1) / np.where(by_white > 0, by_white, 1.0)
    return np.sqrt(np.maximum(ratio, 0.0))


def _memory(J: np.ndarray, r: np.ndarray, lags: int) -> np.ndarray:
    """Sum over outputs a, b and lags of the windowed R_ab(l) times sum_k J_a[k + l] J_b[k]'.

    J is (outputs, N, q), r (outputs, N).
    """
    _, n, q = J.shape
    size = 1 << (n + lags).bit_length()
    spectra = np.fft.rfft(J, size, axis=1)
    residual = np.fft.rfft(r, size, axis=1)
    window = 1.0 - np.arange(lags + 1) / (lags + 1)
    both = np.concatenate([window, np.zeros(size - 2 * lags - 1), window[:0:-1]])
    total = np.zeros((q, q))
    for a in range(J.shape[0]):
        for b in range(J.shape[0]):
            R = np.fft.irfft(residual[a] * np.conj(residual[b]), size) / n * both
            for i in range(q):
                cross = np.fft.irfft(spectra[a, :, i, None] * np.conj(spectra[b]), size, axis=0)
                total[i] += R @ cross
    return 0.5 * (total + total.T)
