"""Numbers of a log that stand for no value, such as -9999, and samples that are hardly any."""

import numpy as np

from heli_jax.flights.onto_grid import FEWEST
from heli_jax.flights.signal_facts import Counts, Strays

_NINES = tuple(
    sign * nines
    for nines in (999.0, 9999.0, 99999.0, 999999.0, 999.9, 9999.9, 99999.9, 999.99, 9999.99)
    for sign in (1.0, -1.0)
)
_MARKS = (
    *_NINES,
    *(2.0**bits - 1 for bits in (15, 16, 31, 32)),
    *(-(2.0**bits) for bits in (15, 31)),
    *(-7777.0, -8888.0, -88888.0),
    *(655.35, 327.67, -327.68),
)
"""numbers that loggers write where they have none: nines, eights, and the ends of integers"""
_SORTED = np.sort(_MARKS)
_SINGLE = 1e-6
"""of a mark, by which its number may miss it: single precision, and units that are converted"""
_ABSURD = 1e9
"""in the log's own numbers: larger ones are no measurement, such as 1e10 and 3.4e38"""
_MOST = 0.2
"""part of the samples that are absurd, at most: a counter may be as large for half of its time"""
_APART = 1.0
"""times the range of all other values, by which a mark lies outside of it"""
_ASIDE = 0.25
"""the same of a number that may be one, unless it has a sign that no other value has"""
_LEVELS = 4
"""distinct values that a signal has beside its marks, at least"""
_SPACING = 3.0
"""times the largest distance between neighbouring values, by which what may be a mark is off"""
_LONGEST = 3
"""samples in a row that no motion leads to, at most; one value that stays counts once"""
_STRAYS = 0.05
"""part of the samples that no motion leads to, at most"""
_MOTION = 50
"""samples from which the range of a motion is known"""
_FAR, _FARTHER = 5.0, 50.0
"""times the range of all other samples, from which on no motion leads there; the larger for inputs,
since a stick may be pushed out of noise for a moment, and for outputs of longer steps than"""
_QUICK = 0.04
"""s, between two samples of which a motion does not come and go"""
_SOME = 10_000
"""samples by which a long signal is looked over first"""


def at_marks(numbers: np.ndarray) -> np.ndarray:
    """Which of the numbers (N,) of a log stand for no value, far outside of all others."""
    with np.errstate(invalid="ignore"):
        absurd = np.abs(numbers) > _ABSURD
    known = _known(numbers)
    none = np.zeros(numbers.shape, bool)
    if not (absurd.any() or known.any()):
        return none
    size = np.count_nonzero(np.isfinite(numbers) | absurd)
    # Known marks at any share: of a slow sensor, most rows of a table hold nothing else.
    at = known | absurd if np.count_nonzero(absurd & ~known) <= _MOST * size else known
    rest = numbers[np.isfinite(numbers) & ~at]
    # Of a switch between a few values any of them may be one.
    if rest.size < FEWEST or np.unique(rest).size < _LEVELS:
        return none
    low, high = float(rest.min()), float(rest.max())
    away = _APART * (high - low)
    return at & ((numbers > high + away) | (numbers < low - away))


def _known(numbers: np.ndarray) -> np.ndarray:
    i = np.clip(np.searchsorted(_SORTED, numbers), 1, _SORTED.size - 1)
    at = np.zeros(numbers.shape, bool)
    for mark in (_SORTED[i - 1], _SORTED[i]):
        at |= np.abs(numbers - mark) <= _SINGLE * np.abs(mark)
    return at


def without_marks(numbers: np.ndarray) -> np.ndarray:
    """Numbers (N,) of a log, NaN where one stands for no value."""
    at = at_marks(numbers)
    return np.where(at, np.nan, numbers) if at.any() else numbers


def counted(numbers: np.ndarray, at: np.ndarray) -> Counts:
    """The marks in numbers (N,) of a log, and how many of each there are."""
    values, counts = np.unique(numbers[at], return_counts=True)
    return tuple((float(f"{v:.7g}"), int(n)) for v, n in zip(values, counts, strict=True))


def mark_words(marks: Counts, size: int | None = None) -> str:
    """`10 samples of -9999 and 1 of 1e+10, far outside of all others`.

    Args:
        marks: at least one.
        size: of all samples, theirs among them; a large share is said.
    """
    share = sum(n for _, n in marks) / max(size, 1) if size is not None else 0.0
    often = f" ({100 * share:.0f} % of all)" if share > _MOST else ""
    return f"{_listed(marks)}{often}, far outside of all others"


def _listed(marks: Counts) -> str:
    listed = [f"{n} of {v:.7g}" for v, n in marks[:3]]
    listed[0] = listed[0].replace(" of", " sample of" if marks[0][1] == 1 else " samples of", 1)
    more = f" and {len(marks) - 3} more such values" if len(marks) > 3 else ""
    return " and ".join(listed) + more


def strays(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[Strays, ...]:
    """Samples that may well be none and are not sure to be: marks that are not far outside of all
    others, and single samples to which no motion leads.

    Args:
        seconds: stamps (N,) [s].
        numbers: (N,), as the log has them, NaN where there is none or a mark stood.
        kind: `input` or `output`.
    """
    why = "which loggers write where they have no value"
    alone, far = _unreached(seconds, numbers, kind)
    off = f"which no motion leads to: more than {far:g} times the range of all others away"
    found = ((_suspected(numbers), why), (alone, off))
    return tuple(Strays(seconds[at], numbers[at], words) for at, words in found if at.any())


def stray_words(found: Strays) -> str:
    """`3 samples of -99, the first at 12.3 s, which ...`."""
    counts = counted(found.values, np.ones(found.values.shape, bool))
    listed = _listed(counts)
    if len(counts) > 3:
        low, high = found.values.min(), found.values.max()
        listed = f"{found.values.size} samples from {low:.4g} to {high:.4g}"
    at = "at" if found.times.size == 1 else "the first at"
    return f"{listed}, {at} {found.times[0]:.6g} s, {found.why}"


def _suspected(numbers: np.ndarray) -> np.ndarray:
    """Which of the numbers (N,) are marks repeated outside of all others, though not far."""
    known, none = _known(numbers), np.zeros(numbers.shape, bool)
    if not known.any():
        return none
    levels = np.unique(numbers[np.isfinite(numbers) & ~known])
    if levels.size < _LEVELS:
        return none
    low, high = float(levels[0]), float(levels[-1])
    spacing = _SPACING * float(np.diff(levels).max())
    # A sign that no other value has is enough; a counter goes through 999 without any step aside.
    above = max(high + spacing, 0.0 if high <= 0 else high + _ASIDE * (high - low))
    below = min(low - spacing, 0.0 if low >= 0 else low - _ASIDE * (high - low))
    at = known & ((numbers > above) | (numbers < below))
    for value in np.unique(numbers[at]):
        if np.count_nonzero(numbers == value) < 2:
            at &= numbers != value
    return at


def _unreached(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[np.ndarray, float]:
    """Which of the numbers (N,) stand alone, so far outside of all others that no motion leads
    there and back, and how many times their range that is."""
    seen, none = np.flatnonzero(np.isfinite(numbers)), np.zeros(numbers.shape, bool)
    x = numbers[seen]
    if x.size < _MOTION or _is_within(x):
        return none, _FAR
    # What a sensor holds until its next sample is one. A stick that stays was moved there.
    new = np.r_[True, x[1:] != x[:-1]] if kind == "output" else np.ones(x.size, bool)
    y, times = x[new], seconds[seen][new]
    if y.size < _MOTION:
        return none, _FAR
    quick = kind == "output" and float(np.median(np.diff(times))) <= _QUICK
    far = _FAR if quick else _FARTHER
    low, high = _range(y, far)
    out = _beyond(y, low, high, far)
    # Where it stays, or begins or ends, it moved; what is near to that is reached too.
    most = _LONGEST if quick or kind == "input" else 1
    while (moved := out & ~_alone(out, y, most)).any():
        low, high = min(low, y[moved].min()), max(high, y[moved].max())
        out = _beyond(y, low, high, far)
    at = out[np.cumsum(new) - 1]
    if np.unique(y[~out]).size >= FEWEST and np.count_nonzero(at) <= _STRAYS * x.size:
        none[seen[at]] = True
    return none, far


def _is_within(x: np.ndarray) -> bool:
    """Whether all samples (N,) are surely near to most: nearly always so, and soon told."""
    some = x[:: max(1, x.size // _SOME)]
    low, high = np.quantile(some, [2 * _STRAYS, 1 - 2 * _STRAYS])
    return bool(max(x.max() - high, low - x.min()) <= _FAR * (high - low))


def _beyond(y: np.ndarray, low: float, high: float, far: float) -> np.ndarray:
    away = far * (high - low)
    return (y > high + away) | (y < low - away)


def _range(y: np.ndarray, far: float) -> tuple[float, float]:
    """The range of samples (N,) that grows from its middle over all that are not too far off."""
    s, k = np.sort(y), int(_STRAYS * y.size)
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
