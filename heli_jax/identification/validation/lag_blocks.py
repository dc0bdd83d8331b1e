"""How one signal is correlated with sums over past samples of another, and how surely.

The variance of such a correlation between two autocorrelated signals is Bartlett's: the sum over
all lags of the product of both autocorrelations (L. D. Haugh, J. Am. Stat. Assoc. 71, 1976).
"""

from collections.abc import Sequence

import numpy as np
import scipy.fft
import scipy.special
from jaxtyping import Float


def lag_blocks(longest: int) -> list[tuple[int, int]]:
    """Lags in samples, in groups that grow with the lag: what follows the response does so over a
    while, and few sums over many lags see it where each lag by itself would not.

    Args:
        longest: lag.
    """
    blocks, first = [], 1
    while first <= longest:
        last = max(first, int(first * 1.5))
        blocks.append((first, min(last, longest)))
        first = last + 1
    return blocks


def correlations_with_sums(
    u: Float[np.ndarray, " N"], e: Float[np.ndarray, " N"], blocks: Sequence[tuple[int, int]]
) -> list[tuple[float, float]]:
    """By block of lags p value and correlation of u with the sum of e over them.

    Args:
        u: NaN where it is missing, as of e.
        e: as long.
        blocks: first and last lag of each, in samples.
    """
    seen = np.isfinite(u) & np.isfinite(e)
    u, e = np.where(seen, u, 0.0), np.where(seen, e, 0.0)
    n, power = int(seen.sum()), float(np.sum(u**2))
    # Bartlett: autocorrelations beyond a few blocks are noise, and only add to the variance's own.
    lags = [min(4 * (last - first + 1) + 20, u.size - 1) for first, last in blocks]
    a = _autocorrelation(u, max(lags)) if power > 0 else u
    found = []
    for (first, last), most in zip(blocks, lags, strict=True):
        sums = np.concatenate([np.zeros(last), np.convolve(e, np.ones(last - first + 1), "valid")])
        past = sums[: u.size]  # at t the sum over t - last ... t - first
        size = float(np.sqrt(power * np.sum(past**2)))
        if size == 0:
            found.append((1.0, 0.0))
            continue
        correlation = float(u @ past) / size
        b = _autocorrelation(past, most)
        variance = max(float(1.0 + 2.0 * (a[1 : most + 1] @ b[1:])), 0.1) / n
        p = 2.0 * scipy.special.ndtr(-abs(correlation) / np.sqrt(variance))
        found.append((float(p), correlation))
    return found


def _autocorrelation(x: np.ndarray, lags: int) -> np.ndarray:
    # Padded by the lags alone: beyond them the end of the record may wrap round.
    size = scipy.fft.next_fast_len(x.size + lags, real=True)
    c = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: lags + 1]
    return c / c[0]
