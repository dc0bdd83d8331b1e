"""Delay of one log's clock behind another's, from a signal in both logs.

First, the lag with the largest correlation coefficient is found, over all lags with enough overlap.
Then least squares refines it to a part of a sample,

    a(t) = g b(t - lag) + c + d t + e(t),

where g, c and d allow for a scale, a bias and its drift.
"""

from typing import Any, NamedTuple

import numpy as np

from heli_jax.flights.resample import Timed, in_gaps, own_clock, resampled, usual_step

BAND = 0.2
"""Cutoff of the low-pass filter, relative to the slower signal's rate; cubic splines follow slower
motion."""
LEAST = 0.8
"""Smallest correlation of two signals of the same motion."""
_RIVAL = 2.0
"""Ratio of unexplained variances below which another lag is nearly as good as the best."""
_SHARE = 0.3
"""Smallest overlap, relative to the shorter signal."""
_FEWEST = 40
"""Fewest common samples."""
_REACH = 3.0
"""Largest distance of the lag from the best shift [steps]."""


class Lag(NamedTuple):
    """Correction of the second clock."""

    lag: float
    """Correction [s]."""
    correlation: float
    overlap: float
    """Overlap [s]."""


class NotAligned(ValueError):
    """Reason why no lag can be found."""


def lag_between(a: Timed, b: Timed) -> Lag:
    """Return the correction of the stamps of `b` that aligns its motion with that of `a`.

    Args:
        a: a signal on its clock.
        b: the other signal; its unit may differ.

    Raises:
        NotAligned: too short, too weakly correlated, opposite in sign, or ambiguous.
    """
    a, b = own_clock(a), own_clock(b)
    # Each counts from its own beginning: an epoch's digits would cost precision of the lag.
    first_a, first_b = float(a.seconds[0]), float(b.seconds[0])
    a, b = Timed(a.seconds - first_a, a.values), Timed(b.seconds - first_b, b.values)
    step = max(usual_step(a.seconds), usual_step(b.seconds))
    (at_a, even_a), (at_b, even_b) = _even(a, step), _even(b, step)
    shift, correlation = _coarse(even_a, even_b)
    # Sample k of a matches sample k - shift of b.
    lag = at_a - at_b + shift * step
    first, last = max(0, shift), min(even_a.size, even_b.size + shift)
    x, t = even_a[first:last], at_a + step * np.arange(first, last)
    lag = _refined(t, x, at_b, even_b, lag, step)
    return Lag(lag + first_a - first_b, correlation, (last - first - 1) * step)


def _even(signal: Timed, step: float) -> tuple[float, np.ndarray]:
    """Return first time and low-passed samples (N,) at even steps [s], NaN in gaps."""
    seconds, values = signal
    seen = np.isfinite(values)
    if seen.sum() < _FEWEST:
        raise NotAligned(f"{int(seen.sum())} samples, expected at least {_FEWEST}")
    seconds, values = seconds[seen], values[seen]
    count = int((seconds[-1] - seconds[0]) / step + 1e-6) + 1
    if count > 100 * seconds.size:
        raise NotAligned(f"{seconds.size} samples in {seconds[-1] - seconds[0]:.4g} s, mostly gaps")
    times = seconds[0] + step * np.arange(count)
    even = np.where(in_gaps(seconds, times), np.nan, resampled(seconds, values, times))
    return float(seconds[0]), _low_passed(even)


def _low_passed(x: np.ndarray) -> np.ndarray:
    """Low-pass even samples (N,) below `BAND` of their rate; NaN where they are NaN."""
    from scipy.signal import firwin

    taps = np.asarray(firwin(31, 2.0 * BAND, window="hamming"))
    seen = np.isfinite(x)
    middle = float(np.mean(x[seen]))
    # Weights of missing samples go to their neighbours, so that a gap's edge is not pulled to zero.
    known = np.convolve(seen.astype(float), taps, "same")
    sums = np.convolve(np.where(seen, x - middle, 0.0), taps, "same")
    return np.where(seen & (known > 0.5), middle + sums / np.where(known > 0.5, known, 1.0), np.nan)


def _coarse(a: np.ndarray, b: np.ndarray) -> tuple[int, float]:
    """Return the shift [steps] of b (M,) that correlates best with a (N,), and the coefficient.

    Raises:
        NotAligned: no shift does, or several do.
    """
    r = correlations(a, b)
    # Sample k of a matches sample k - shift of b.
    shifts = np.arange(-(b.size - 1), a.size)
    best = int(np.argmax(r))
    if r[best] < LEAST:
        lowest = float(r.min())
        if lowest < -LEAST and -lowest > r[best]:
            raise NotAligned(
                f"the two have opposite signs (correlation {lowest:.2f}); expected the same sign, "
                "or `reverse: true`"
            )
        raise NotAligned(
            f"they are hardly correlated ({r[best]:.2f} at the best lag), expected at least {LEAST}"
        )
    rival = other_peak(r, best)
    if rival is not None and 1.0 - r[rival] ** 2 < _RIVAL * (1.0 - r[best] ** 2):
        raise NotAligned(
            f"two lags {abs(int(shifts[best] - shifts[rival]))} samples apart fit nearly equally "
            f"well (correlations {r[best]:.4f} and {r[rival]:.4f}); expected a signal that does "
            "not repeat itself"
        )
    return int(shifts[best]), float(r[best])


def other_peak(r: np.ndarray, best: int) -> int | None:
    """Return the highest maximum outside the peak of the best."""
    # Down both sides to the minima: everything on this peak is the same solution.
    left, right = best, best
    while left > 0 and r[left - 1] < r[left]:
        left -= 1
    while right < r.size - 1 and r[right + 1] < r[right]:
        right += 1
    others = np.where((np.arange(r.size) < left) | (np.arange(r.size) > right), r, -1.0)
    rival = int(np.argmax(others))
    return rival if others[rival] > 0 else None


def correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the correlation coefficient (N + M - 1,) of a (N,) and b (M,) at each shift.

    It is between -1 and 1, computed over the overlap, and zero if the overlap is too short.
    """
    from scipy.signal import correlate

    seen_a, seen_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    # The overall means are subtracted first: sums of squares of large numbers would lose a small
    # motion.
    x, y = np.nan_to_num(a - np.nanmean(a)), np.nan_to_num(b - np.nanmean(b))

    def sums(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray(correlate(u, v, "full", "fft"))

    n = np.round(sums(seen_a, seen_b))
    n = np.where(n > 0, n, 1.0)
    mean_a, mean_b = sums(x, seen_b) / n, sums(seen_a, y) / n
    var_a = sums(x**2, seen_b) / n - mean_a**2
    var_b = sums(seen_a, y**2) / n - mean_b**2
    size = np.sqrt(np.maximum(var_a, 0.0) * np.maximum(var_b, 0.0))
    shortest = max(_FEWEST, _SHARE * min(seen_a.sum(), seen_b.sum()))
    # If one of the two hardly moves within the overlap, correlation is by chance.
    enough = (n >= shortest) & (var_a > 0.05 * np.var(x)) & (var_b > 0.05 * np.var(y))
    if not enough.any():
        raise NotAligned("they are too short, or move too little, to be compared")
    return np.where(enough, (sums(x, y) / n - mean_a * mean_b) / np.where(size > 0, size, 1), 0.0)


def _refined(
    t: np.ndarray, x: np.ndarray, first: float, samples: np.ndarray, near: float, step: float
) -> float:
    """Return the least-squares lag [s].

    Args:
        t: times of x [s].
        x: the first signal (n,), NaN if missing.
        first: time [s] of the first of `samples`.
        samples: the second signal (M,), a `step` [s] apart, NaN if missing.
        near: a lag within a step or two of the solution.
        step: step of `samples` [s].
    """
    from scipy.interpolate import CubicSpline
    from scipy.optimize import minimize_scalar

    there = np.isfinite(samples)
    smooth = CubicSpline((first + step * np.arange(samples.size))[there], samples[there])

    def misfit(steps: float) -> float:
        """Return the mean square of x without the scaled other signal, a bias and its drift."""
        lag = near + steps * step
        i = np.floor((t - lag - first) / step + 1e-9).astype(np.int64)
        inside = (i >= 0) & (i < there.size - 1)
        i = np.clip(i, 0, there.size - 2)
        seen = inside & there[i] & there[i + 1] & np.isfinite(x)
        if seen.sum() < _FEWEST:
            raise NotAligned("they overlap by too little")
        at = t[seen] - lag
        columns = np.stack([smooth(at), np.ones(at.size), at - at.mean()], axis=1)
        gains = np.linalg.lstsq(columns, x[seen], rcond=None)[0]
        return float(np.mean((x[seen] - columns @ gains) ** 2))

    # Any: the stubs do not know the result.
    bounds, options = (-_REACH, _REACH), {"xatol": 1e-5}
    found: Any = minimize_scalar(misfit, bounds=bounds, method="bounded", options=options)
    if abs(found.x) > 0.999 * _REACH:
        raise NotAligned("the sum of squares has no minimum near the best lag")
    return near + float(found.x) * step
