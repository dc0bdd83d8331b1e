"""How one signal is correlated with sums over past samples of another, and how surely.

The variance of such a correlation between two autocorrelated signals is Bartlett's: the sum over
all lags of the product of both autocorrelations (L. D. Haugh, J. Am. Stat. Assoc. 71, 1976).
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.special
from jaxtyping import Float

_NOTHING = 1e-7
"""of the root of what a sum's power is at least where its terms are unrelated, below which it is
rounding"""


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


class Correlated(NamedTuple):
    """By column and block of lags."""

    p_value: Float[np.ndarray, "p b"]
    correlation: Float[np.ndarray, "p b"]


def correlations_with_sums(
    u: Float[np.ndarray, " N"], e: Float[np.ndarray, "N p"], blocks: Sequence[tuple[int, int]]
) -> Correlated:
    """Of u with the sums of each column of e over each block of lags.

    Args:
        u: NaN where it is missing.
        e: likewise, in whole rows.
        blocks: first and last lag of each, in samples.
    """
    seen = np.isfinite(u) & np.isfinite(e).all(axis=1)
    u, e = np.where(seen, u, 0.0), np.where(seen[:, None], e, 0.0)
    n, power, N = int(seen.sum()), float(np.sum(u**2)), u.size
    # Bartlett: autocorrelations beyond a few blocks are noise, and only add to the variance's own.
    most = [min(4 * (last - first + 1) + 20, N - 1) for first, last in blocks]
    signals = _Signals(u, e, most, blocks)
    correlated = Correlated(*np.zeros((2, e.shape[1], len(blocks))))
    correlated.p_value[:] = 1.0
    if not power > 0:
        return correlated
    for b, (block, lags) in enumerate(zip(blocks, most, strict=True)):
        own = signals.of_sums(block, lags)
        size = np.sqrt(power * np.maximum(own[0], 0.0))
        moves = size > _NOTHING * np.sqrt(power * signals.own[0] * (block[1] - block[0] + 1))
        over = np.where(moves, 1.0 / np.where(moves, size, 1.0), 0.0)
        correlation = signals.with_sums(block) * over
        autocorrelation = own[1:] / np.where(moves, own[0], 1.0)
        variance = 1.0 + 2.0 * (signals.of_u[1 : lags + 1] @ autocorrelation)
        sd = np.sqrt(np.maximum(variance, 0.1) / n)
        p_value = 2.0 * scipy.special.ndtr(-np.abs(correlation) / sd)
        correlated.p_value[:, b] = np.where(moves, p_value, 1.0)
        correlated.correlation[:, b] = correlation
    return correlated


class _Signals:
    """Products of signals over lags, and of sums over blocks of lags without making these sums.

    What sums over the whole signal, with zeros before and behind it, have for products follows from
    those of the signal; of what is wanted, sums that lie in the record as a whole, both ends are
    taken off.
    """

    def __init__(
        self, u: np.ndarray, e: np.ndarray, most: Sequence[int], blocks: Sequence[tuple[int, int]]
    ) -> None:
        """Of u (N,) and e (N, p), without a missing value."""
        self.u, N = u, u.size
        reach = [lags + last - first + 1 for lags, (first, last) in zip(most, blocks, strict=True)]
        lags = max(*reach, *(last + 1 for _, last in blocks), 1)
        # Padded by the lags alone: beyond them the end of the record may wrap round.
        size = scipy.fft.next_fast_len(N + lags, real=True)
        U, E = np.fft.rfft(u, size), np.fft.rfft(e.T, size)
        of_u = np.fft.irfft(np.abs(U) ** 2, size)
        self.of_u = of_u / (of_u[0] if of_u[0] > 0 else 1.0)
        self.own = np.fft.irfft(np.abs(E) ** 2, size)[:, : lags + 1].T
        self.crossed = np.fft.irfft(U * np.conj(E), size)[:, : lags + 1].T
        self.sums = np.concatenate([np.zeros((1, e.shape[1])), np.cumsum(e, axis=0)])

    def with_sums(self, block: tuple[int, int]) -> Float[np.ndarray, " p"]:
        """Of u with the sums over a block, from the first whole one on."""
        first, last = block
        early = self.u[first:last] @ self.sums[1 : last - first + 1]
        return np.sum(self.crossed[first : last + 1], axis=0) - early

    def of_sums(self, block: tuple[int, int], lags: int) -> Float[np.ndarray, "k p"]:
        """Of the sums over a block, with themselves at lags 0 ... `lags`."""
        (first, last), N, c = block, self.u.size, self.sums
        width, whole = last - first + 1, N - last
        if lags >= whole:
            past = c[width : width + max(whole, 0)] - c[: max(whole, 0)]
            made = np.zeros((lags + 1, c.shape[1]))
            for k in range(min(lags + 1, len(past))):
                made[k] = np.sum(past[: len(past) - k] * past[k:], axis=0)
            return made
        made = _weights(width, lags) @ self.own[: lags + width]

        def at(begin: int, end: int) -> np.ndarray:
            """The sums that begin at these samples, some of which may be none of the record."""
            s = np.arange(begin, end)
            return c[np.minimum(s + width, N)] - c[np.maximum(s, 0)]

        # Those that begin before the record, each with itself and all that follow it.
        if width > 1:
            head = at(1 - width, lags)
            made -= np.einsum("ip,kip->kp", head[: width - 1], _windows(head, lags + 1))
        # Those that end behind it, each with itself and all before it.
        tail = at(whole - lags, N)
        return made - np.einsum("ip,kip->kp", tail[lags:], _windows(tail, lags + 1)[::-1])


def _windows(v: Float[np.ndarray, "N p"], count: int) -> Float[np.ndarray, "k n p"]:
    """Views (N - count + 1, p) that begin at the first samples."""
    step, column = v.strides
    shape = (count, len(v) - count + 1, v.shape[1])
    return np.ndarray(shape, v.dtype, v, strides=(step, step, column))


@functools.lru_cache(maxsize=64)
def _weights(width: int, lags: int) -> Float[np.ndarray, "k d"]:
    """What makes the autocorrelation of sums over so many samples, up to so many lags, of that of
    the samples."""
    made = np.zeros((lags + 1, lags + width))
    for d in range(1 - width, width):
        at = np.abs(np.arange(lags + 1) + d)
        np.add.at(made, (np.arange(lags + 1), at), float(width - abs(d)))
    return made
