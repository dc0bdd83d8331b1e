"""How one signal is correlated with sums over past samples of another, and how surely.

The variance of such a correlation between two autocorrelated signals is Bartlett's: the sum over
all lags of the product of both autocorrelations (L. D. Haugh, J. Am. Stat. Assoc. 71, 1976).
"""

import numpy as np
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


def correlation_with_sums(
    u: Float[np.ndarray, " N"], e: Float[np.ndarray, " N"], block: tuple[int, int]
) -> tuple[float, float]:
    """p value and correlation of u with the sum of e over the lags of a block.

    Args:
        u: NaN where it is missing, as of e.
        e: as long.
        block: first and last lag, in samples.
    """
    first, last = block
    seen = np.isfinite(u) & np.isfinite(e)
    u, e = np.where(seen, u, 0.0), np.where(seen, e, 0.0)
    sums = np.concatenate([np.zeros(last), np.convolve(e, np.ones(last - first + 1), "valid")])
    past = sums[: u.size]  # at t the sum over t - last ... t - first
    n = int(seen.sum())
    size = float(np.sqrt(np.sum(u**2) * np.sum(past**2)))
    if size == 0:
        return 1.0, 0.0
    correlation = float(u @ past) / size
    # Bartlett: autocorrelations beyond a few blocks are noise, and only add to the variance's own.
    lags = min(4 * (last - first + 1) + 20, u.size - 1)
    a, b = _autocorrelation(u, lags), _autocorrelation(past, lags)
    variance = max(float(1.0 + 2.0 * (a[1:] @ b[1:])), 0.1) / n
    p = 2.0 * scipy.special.ndtr(-abs(correlation) / np.sqrt(variance))
    return float(p), correlation


def _autocorrelation(x: np.ndarray, lags: int) -> np.ndarray:
    size = 1 << (2 * x.size - 1).bit_length()
    c = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: lags + 1]
    return c / c[0]
