"""Samples of a log that no motion leads to, and numbers that nothing measures."""

from dataclasses import dataclass

import numpy as np

from heli_jax.flights.marks import counted, is_absurd, listed

_LEVELS, _FEW_LEVELS = 8, 3
"""distinct values of a signal beside its strays, at least; where they are so few, only what is
farther away is told"""
_LONGEST = 3
"""samples in a row that no motion leads to, at most; one value that stays counts once"""
_MOST = 0.05
"""part of the samples that no motion leads to, at most"""
_MOTION = 50
"""samples from which the range of a motion is known"""
_FAR, _FARTHER, _FARTHEST = 5.0, 20.0, 1e4
"""times the range of all other samples, from which on no motion leads there; the second for
inputs, since a stick may be pushed out of noise for a moment, and for outputs of longer steps than
`_QUICK`; the third for inputs of such steps"""
_QUICK = 0.04
"""s, between two samples of which a motion does not come and go"""
_SOME = 10_000
"""samples by which a long signal is looked over first"""


@dataclass(frozen=True, eq=False)
class Strays:
    """Samples that may stand for no value and are kept, since nobody knows: their times (K,) [s],
    their values (K,), as the log has them, and `why` they are odd."""

    times: np.ndarray
    values: np.ndarray
    why: str

    def within(self, begin: float, end: float) -> "Strays":
        """Those from `begin` to `end` [s], with times from `begin`."""
        at = (self.times >= begin) & (self.times <= end)
        return Strays(self.times[at] - begin, self.values[at], self.why)


def strays(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[Strays, ...]:
    """Samples that may well be none and are not sure to be: single ones to which no motion leads,
    and many that are larger than any measurement.

    Args:
        seconds: stamps (N,) [s].
        numbers: (N,), as the log has them, NaN where there is none or a mark stood.
        kind: `input` or `output`.
    """
    alone, far = _unreached(seconds, numbers, kind)
    off = f"which no motion leads to: more than {far:g} times the range of all others away"
    absurd, too_large = is_absurd(numbers), "larger than any measurement"
    alone &= ~absurd
    kinds = ((absurd, too_large), (alone, off))
    return tuple(Strays(seconds[at], numbers[at], words) for at, words in kinds if at.any())


def stray_words(strays: Strays) -> str:
    """`3 samples of -99, the first at 12.3 s, which ...`."""
    counts = counted(strays.values)
    words = listed(counts)
    if len(counts) > 3:
        low, high = strays.values.min(), strays.values.max()
        words = f"{strays.values.size} samples from {low:.4g} to {high:.4g}"
    at = "at" if strays.times.size == 1 else "the first at"
    return f"{words}, {at} {strays.times[0]:.6g} s, {strays.why}"


def _unreached(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[np.ndarray, float]:
    """Which of the numbers (N,) stand alone, so far outside of all others that no motion leads
    there and back, and how many times their range that is."""
    seen, none = np.flatnonzero(np.isfinite(numbers)), np.zeros(numbers.shape, bool)
    x = numbers[seen]
    if x.size < _MOTION or _is_within(x):
        return none, _FAR
    # What a sensor holds until its next sample is one. A stick that stays was moved there.
    new = np.r_[True, x[1:] != x[:-1]] if kind == "output" else np.ones(x.size, bool)
    coarse = np.count_nonzero(new) < _MOTION
    new |= coarse
    y, times = x[new], seconds[seen][new]
    quick = float(np.median(np.diff(times))) <= _QUICK
    close = quick and not coarse and kind == "output"
    far = _FAR if close else _FARTHER if quick or kind == "output" else _FARTHEST
    out, far = _lonely(y, far, _LONGEST if quick else 1)
    at = out[np.cumsum(new) - 1]
    if np.count_nonzero(at) <= _MOST * x.size:
        none[seen[at]] = True
    return none, far


def _lonely(y: np.ndarray, far: float, most: int) -> tuple[np.ndarray, float]:
    """Which of the samples (N,) lie `far` times the range of all others off, at `most` so many in a
    row; and how many times that is."""
    low, high = _range(y, far)
    out = _beyond(y, low, high, far)
    # Where it stays, or begins or ends, it moved; what is near to that is reached too.
    while (moved := out & ~_alone(out, y, most)).any():
        low, high = min(low, y[moved].min()), max(high, y[moved].max())
        out = _beyond(y, low, high, far)
    levels = np.unique(y[~out]).size
    if levels < _LEVELS:
        far = max(far, _FARTHER)
        out &= _beyond(y, low, high, far) & (levels >= _FEW_LEVELS)
    return out, far


def _is_within(x: np.ndarray) -> bool:
    """Whether all samples (N,) are surely near to most: nearly always so, and soon told."""
    some = x[:: max(1, x.size // _SOME)]
    low, high = np.quantile(some, [2 * _MOST, 1 - 2 * _MOST])
    return bool(max(x.max() - high, low - x.min()) <= _FAR * (high - low))


def _beyond(y: np.ndarray, low: float, high: float, far: float) -> np.ndarray:
    away = far * (high - low)
    return (y > high + away) | (y < low - away)


def _range(y: np.ndarray, far: float) -> tuple[float, float]:
    """The range of samples (N,) that grows from its middle over all that are not too far off."""
    s, k = np.sort(y), int(_MOST * y.size)
    lo, hi = k, y.size - 1 - k
    gaps = np.diff(s)
    while True:
        up = hi + _first(gaps[hi:] > far * (s[hi:-1] - s[lo]))
        down = lo - _first(gaps[:lo][::-1] > far * (s[up] - s[1 : lo + 1][::-1]))
        if (down, up) == (lo, hi):
            return float(s[lo]), float(s[hi])
        lo, hi = down, up


def _first(at: np.ndarray) -> int:
    return int(np.argmax(at)) if at.any() else at.size


def _alone(out: np.ndarray, y: np.ndarray, most: int) -> np.ndarray:
    """Which of the samples that are `out` (N,) stand between others, at most `most` in a row."""
    edges = np.flatnonzero(np.diff(np.r_[False, out, False].astype(int)))
    at = np.zeros(out.shape, bool)
    middle = float(np.median(y))
    for begin, end in edges.reshape(-1, 2):
        run = y[begin:end] > middle
        inside = begin > 0 and end < out.size
        at[begin:end] = inside and end - begin <= most and bool(run.all() or not run.any())
    return at
