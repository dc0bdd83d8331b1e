"""By how much one log's clock is behind another's, from a signal that both hold.

The lag where the correlation coefficient of the two is largest, over all lags that leave enough of
both; then to a part of a sample by least squares,

    a(t) = g b(t - lag) + c + d t + e(t),

where g, c and d allow for a scale, a bias and its drift. The standard deviation of the lag is that
of least squares with autocorrelated errors: the curvature of the sum of squares, which the shape of
the signal gives, and the spectrum of what is left (L. Ljung, System Identification, 1999, section
9.4; with white errors it is the Cramer-Rao bound of a delay).
"""

from typing import Any, NamedTuple

import numpy as np

from heli_jax.flights.resample import Timed, in_gaps, own_clock, resampled, usual_step

BAND = 0.2
"""of the slower signal's rate: what is faster is taken away, and cubics pass what is left"""
LEAST = 0.8
"""correlation below which two signals are not taken for the same motion"""
_RIVAL = 2.0
"""times the unexplained variance of the best lag, up to which another explains nearly as well"""
_SHARE = 0.3
"""of the shorter signal that the two overlap by, at least"""
_FEWEST = 40
"""common samples at least"""
_REACH = 3.0
"""steps from the best shift, within which the lag is"""


class Lag(NamedTuple):
    """Correction of the second clock, with its standard deviation."""

    lag: float
    """[s]"""
    sd: float
    """[s]"""
    correlation: float
    overlap: float
    """[s]"""


class NotAligned(ValueError):
    """Reason why no lag can be found."""


def lag_between(a: Timed, b: Timed) -> Lag:
    """Return the correction of the stamps of `b` that aligns its motion with that of `a`.

    Args:
        a: a signal on its clock; the unit may be another than that of `b`.

    Raises:
        NotAligned: too short, too weakly correlated, against one another, or ambiguous.
    """
    a, b = own_clock(a), own_clock(b)
    # Each from its own beginning: an epoch's digits would cost those of the lag.
    first_a, first_b = float(a.seconds[0]), float(b.seconds[0])
    a, b = Timed(a.seconds - first_a, a.values), Timed(b.seconds - first_b, b.values)
    step = max(usual_step(a.seconds), usual_step(b.seconds))
    (at_a, even_a), (at_b, even_b) = _even(a, step), _even(b, step)
    shift, correlation = _coarse(even_a, even_b)
    # Sample k of a is beside sample k - shift of b.
    lag = at_a - at_b + shift * step
    first, last = max(0, shift), min(even_a.size, even_b.size + shift)
    x, t = even_a[first:last], at_a + step * np.arange(first, last)
    lag, sd = _refined(t, x, at_b, even_b, lag, step)
    return Lag(lag + first_a - first_b, sd, correlation, (last - first - 1) * step)


def _even(signal: Timed, step: float) -> tuple[float, np.ndarray]:
    """First time and samples (N,) at even steps [s] of what is slow in a signal, NaN in gaps."""
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
    if np.isfinite(even).sum() < _FEWEST:
        raise NotAligned(f"{int(np.isfinite(even).sum())} samples, expected at least {_FEWEST}")
    return float(seconds[0]), _low_passed(even)


def _low_passed(x: np.ndarray) -> np.ndarray:
    """Low-pass even samples (N,) below `BAND` of their rate; NaN where they are NaN."""
    from scipy.signal import firwin

    taps = np.asarray(firwin(31, 2.0 * BAND, window="hamming"))
    seen = np.isfinite(x)
    middle = float(np.mean(x[seen]))
    # Weights of missing samples go to their neighbours, so that a gap's edge is not drawn to zero.
    known = np.convolve(seen.astype(float), taps, "same")
    sums = np.convolve(np.where(seen, x - middle, 0.0), taps, "same")
    return np.where(seen & (known > 0.5), middle + sums / np.where(known > 0.5, known, 1.0), np.nan)


def _coarse(a: np.ndarray, b: np.ndarray) -> tuple[int, float]:
    """The shift [steps] of b (M,) that correlates best with a (N,), and the coefficient.

    Raises:
        NotAligned: no shift does, or several do.
    """
    r = correlations(a, b)
    # As where sample k of a stands beside sample k - shift of b.
    shifts = np.arange(-(b.size - 1), a.size)
    best = int(np.argmax(r))
    if r[best] < LEAST:
        lowest = float(r.min())
        if lowest < -LEAST and -lowest > r[best]:
            raise NotAligned(
                f"the two move against one another (correlation {lowest:.2f}); expected the same "
                "sign, or `reverse: true`"
            )
        raise NotAligned(
            f"they are hardly correlated ( {r[best]:.2f} at the best lag), expected at least "
            f"{LEAST}"
        )
    rival = other_peak(r, best)
    if rival is not None and 1.0 - r[rival] ** 2 < _RIVAL * (1.0 - r[best] ** 2):
        raise NotAligned(
            f"{abs(int(shifts[best] - shifts[rival]))} samples apart two lags explain nearly the "
            f"same (correlations {r[best]:.4f} and {r[rival]:.4f}); expected a signal that does "
            "not repeat itself"
        )
    return int(shifts[best]), float(r[best])


def other_peak(r: np.ndarray, best: int) -> int | None:
    """The highest maximum outside the hill of the best."""
    # Down both sides to where it turns: what is on the hill is the same solution.
    left, right = best, best
    while left > 0 and r[left - 1] < r[left]:
        left -= 1
    while right < r.size - 1 and r[right + 1] < r[right]:
        right += 1
    others = np.where((np.arange(r.size) < left) | (np.arange(r.size) > right), r, -1.0)
    rival = int(np.argmax(others))
    return rival if others[rival] > 0 else None


def correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation coefficient (N + M - 1,) of a (N,) and b (M,) over what overlaps at each shift,
    -1 < 0 < 1; zero where that is too short."""
    from scipy.signal import correlate

    seen_a, seen_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    # By the means of the whole: sums of squares of large numbers would lose the small motion.
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
    # Where one of the two hardly moves within the overlap anything correlates by chance.
    enough = (n >= shortest) & (var_a > 0.05 * np.var(x)) & (var_b > 0.05 * np.var(y))
    if not enough.any():
        raise NotAligned("they are too short or too still to be compared")
    return np.where(enough, (sums(x, y) / n - mean_a * mean_b) / np.where(size > 0, size, 1), 0.0)


def _refined(
    t: np.ndarray, x: np.ndarray, first: float, samples: np.ndarray, near: float, step: float
) -> tuple[float, float]:
    """The lag of least squares, and its standard deviation, both [s].

    Args:
        t: times of x [s].
        x: the first signal (n,), NaN where it is missing, and so are others.
        first: time [s] of the first of the second signal's `samples` (M,), a `step` [s] apart.
        near: a lag within a step or two of it.
    """
    from scipy.interpolate import CubicSpline
    from scipy.optimize import least_squares

    there = np.isfinite(samples)
    smooth = CubicSpline((first + step * np.arange(samples.size))[there], samples[there])

    def linearised(lag: float) -> np.ndarray:
        """Return what the model leaves of x, and its derivative by the lag (2, n); zero where one
        of the two signals is missing. Scale, bias and drift are taken out of both."""
        i = np.floor((t - lag - first) / step + 1e-9).astype(np.int64)
        inside = (i >= 0) & (i < there.size - 1)
        i = np.clip(i, 0, there.size - 2)
        seen = inside & there[i] & there[i + 1] & np.isfinite(x)
        if seen.sum() < _FEWEST:
            raise NotAligned("they overlap by too little")
        at = t[seen] - lag
        others = np.stack([smooth(at), np.ones(at.size), at - at.mean()], axis=1)
        both = np.stack([x[seen], smooth(at, 1)], axis=1)
        gains = np.linalg.lstsq(others, both, rcond=None)[0]
        left, slope = (both - others @ gains).T
        whole = np.zeros((2, t.size))
        # The model falls as the lag grows.
        whole[:, seen] = left, gains[0, 0] * slope
        return whole

    # Counted in steps from the near one: an epoch's digits would cost those of the lag. Any: the
    # stubs know no function here.
    jacobian: Any = lambda z: step * linearised(near + z[0] * step)[1][:, None]  # noqa: E731
    found = least_squares(
        lambda z: linearised(near + z[0] * step)[0],
        [0.0],
        jac=jacobian,
        bounds=([-_REACH], [_REACH]),
    )
    lag = near + float(found.x[0]) * step
    left, slope = linearised(lag)
    curvature = float(slope @ slope)
    if abs(found.x[0]) > 0.999 * _REACH or not curvature > 0:
        raise NotAligned("the sum of squares has no minimum near the best lag")
    return lag, float(np.sqrt(t.size * _long_run(slope * left)) / curvature)


def _long_run(v: np.ndarray) -> float:
    """Variance of the sum of v (n,) over n: the sum of its autocovariances under Parzen's window,
    whose length its correlation time asks for (Andrews, 1991)."""
    n = v.size
    size = 1 << (2 * n - 1).bit_length()
    c = np.fft.irfft(np.abs(np.fft.rfft(v, size)) ** 2, size)[:n] / n
    if not c[0] > 0:
        return 0.0
    rho = c[1 : max(n // 5, 2)] / c[0]
    time = max(1.0, (1.0 + 2.0 * float(np.sum(rho**2))) / (1.0 + 2.0 * rho.size / n))
    length = min(max(6.0 * time * (n / time) ** 0.2, 2.0), 0.5 * n)
    lags = np.minimum(np.arange(n) / length, 1.0)
    window = np.where(lags < 0.5, 1 - 6 * lags**2 * (1 - lags), 2 * (1 - lags) ** 3)
    # Few windows fit into a short record, and what least squares fits is missing in the rest.
    return max(float(c[0] + 2.0 * np.sum(window[1:] * c[1:])), 0.1 * float(c[0]))
