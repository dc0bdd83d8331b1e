"""Fewer samples a second, without folding what the new rate cannot hold onto what it can.

Two steps. Uneven samples become even ones of their own usual rate: the signal of least energy near
that rate's Nyquist frequency which goes through them, by least squares (as in Feichtinger and
Groechenig, 'Theory and practice of irregular sampling', 1994, with a penalty in place of a hard
limit of the band). These pass a low-pass filter, a sinc in a Kaiser window, evaluated at the new
times.

What a signal has near the old Nyquist frequency, as white noise has, cannot be told from what lost
samples hide, and a fit through every sample would multiply it. How closely the samples are followed
is therefore asked of the signal itself: some of them are hidden, and the closeness is taken that
predicts those best, from straight lines between neighbours (noise) to all that the others say (a
signal that ends below). Noise then passes as the low-pass filter lets it.

At 200 Hz with a fifth of a step of jitter and 5 % of the samples lost, what lies between 26 and
70 Hz of a signal without noise is below -74 dB at 50 Hz. Above 70 % of the old Nyquist frequency
lost samples cannot be made up for, and a part folds; even samples have no such limit.
"""

import functools
from typing import Any, cast

import numpy as np

PASSED, STOPPED = 0.4, 0.5
"""of the new rate: what is slower passes, what is faster is taken away"""
_REACH = 25
"""new steps on each side that the low-pass filter sees: 70 dB between the two"""
_BETA = 7.0
_TAPS = 32
"""samples that a sample between two others is a sum of"""
_TAPS_BETA = 8.0
_PENALTY = 0.1
"""for what lies in the upper seventh of the old band: a lost sample is what makes it small"""
_RIDGES = (1e-9, 1e-5, 1e-3, 3e-2, 1.0)
"""of the difference from straight lines: the smallest leaves them wherever samples say so"""
_HIDDEN, _TRIED = 17, 1 << 12
"""one sample of so many is hidden, of at most so many, to choose among them"""
_END, _END_RIDGE = 4, 1e-2
_BLOCK, _OVERLAP = 1 << 15, 256
_TABLE = 1 << 16
_AT_ONCE = 1 << 22
"""weights in memory"""


def decimate(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A signal at a lower rate.

    Args:
        seconds: stamps (N,) [s], increasing, with steps of at most a few usual ones.
        values: samples (N,), NaN where one is missing.
        times: (M,) [s], evenly spaced, M >= 2.

    Returns:
        (M,), in the samples' unit; NaN where more is missing than two new steps, or five old ones.
    """
    # A missing sample is taken out and not set to any value: the fit of even samples knows what to
    # do where none stands.
    known = np.isfinite(values)
    if np.count_nonzero(known) < 2:
        return np.full(times.size, np.nan)
    usual, step = float(np.median(np.diff(seconds))), float(times[1] - times[0])
    longest = max(2 * step, 5 * usual)
    seconds, values = seconds[known], values[known]
    even_step, even = even_samples(seconds, values, usual)
    filtered = low_pass(even, even_step, times - seconds[0], step)
    # The stamps on both sides of each time say how wide the gap is in which it lies. Where that is
    # too wide the fit has drawn a straight line, which is no measurement.
    behind = np.clip(np.searchsorted(seconds, times, side="right"), 1, seconds.size - 1)
    gap = seconds[behind] - seconds[behind - 1]
    inside = (times >= seconds[0] - usual) & (times <= seconds[-1] + usual)
    return np.where(inside & (gap <= longest), filtered, np.nan)


def even_samples(seconds: np.ndarray, values: np.ndarray, usual: float) -> tuple[float, np.ndarray]:
    """Samples (K,) at even steps [s] from the first stamp to behind the last, and the step.

    Args:
        seconds: stamps (N,) [s], increasing, N >= 2.
        values: samples (N,), all known.
        usual: the usual step [s].
    """
    span = float(seconds[-1] - seconds[0])
    # Bounded whatever the stamps: four even samples for each that there is.
    step = max(usual, span / (4 * seconds.size))
    # Even but for the rounding of the stamps: the samples are taken as they are, which is exact and
    # needs no fit.
    if np.ptp(np.diff(seconds)) < 1e-3 * step:
        return span / (seconds.size - 1), values
    at = (seconds - seconds[0]) / step
    count = int(np.ceil(at[-1])) + 1
    even = np.empty(count)
    # The last even sample lies behind the last stamp, where the slope goes on.
    slope = (values[-1] - values[-2]) / (at[-1] - at[-2])
    line = np.interp(np.arange(count), np.r_[at, at[-1] + 1], np.r_[values, values[-1] + slope])
    ridge = _best_ridge(at, values)
    for begin in range(0, count, _BLOCK):
        end = min(begin + _BLOCK, count)
        # A band of equations is solved for each block, so that its memory does not grow with the
        # log. What is near a block's end lacks its neighbours; the overlap is eight times as long
        # as the taps, is computed twice and kept once.
        first, last = max(begin - _OVERLAP, 0), min(end + _OVERLAP, count)
        # The small number keeps a stamp that lies on the block's last sample, whatever its
        # rounding.
        rows = slice(*np.searchsorted(at, [first, last - 1 + 1e-9]))
        block = _fitted(at[rows] - first, values[rows], line[first:last], ridge)
        even[begin:end] = block[begin - first : end - first]
    return step, even


def _best_ridge(at: np.ndarray, values: np.ndarray) -> float:
    """The one of `_RIDGES` that predicts hidden samples best.

    Args:
        at: where the samples stand (N,), in steps.
        values: the samples (N,).
    """
    # From the middle, where the machine is most likely at work; the ends are pulled to the line
    # whatever the ridge.
    first = max(0, (at.size - _TRIED) // 2)
    at, values = at[first : first + _TRIED], values[first : first + _TRIED]
    at = at - np.floor(at[0])
    hidden = np.zeros(at.size, bool)
    # Not every so-many-th: a periodic pattern would be blind to motion of that period.
    hidden[np.random.default_rng(0).permutation(at.size)[: at.size // _HIDDEN]] = True
    hidden[: 2 * _END] = hidden[-2 * _END :] = False
    if not hidden.any():
        return _RIDGES[-1]
    shown = ~hidden
    line = np.interp(np.arange(int(np.ceil(at[-1])) + 1), at[shown], values[shown])
    half = _TAPS // 2
    columns = np.floor(at[hidden]).astype(np.int64)[:, None] + 1 + np.arange(_TAPS) - half
    weights = _sinc(at[hidden][:, None] - columns)
    weights /= weights.sum(1, keepdims=True)
    errors = []
    for ridge in _RIDGES:
        even = _fitted(at[shown], values[shown], line, ridge)
        near = even[np.clip(columns, 0, even.size - 1)]
        errors.append(float(np.mean((np.sum(weights * near, axis=1) - values[hidden]) ** 2)))
    return _RIDGES[int(np.argmin(errors))]


def _fitted(at: np.ndarray, values: np.ndarray, line: np.ndarray, ridge: float) -> np.ndarray:
    """Even samples (K,) of the signal through `values` (N,) at `at` (N,) in steps.

    What is looked for is the difference from straight lines (K,), so that a gap is bridged by one.
    """
    from scipy.linalg import solveh_banded

    half = _TAPS // 2
    # Behind both ends the line goes on, for the taps that reach there.
    padded = np.pad(line, half, mode="reflect", reflect_type="odd")
    columns, weights, shared = _equations(np.ascontiguousarray(at).tobytes(), padded.size)
    missing = values - np.sum(weights * padded[columns], axis=1)
    right = np.bincount(columns.ravel(), (weights * missing[:, None]).ravel(), padded.size)
    energy = _penalty()
    middle = energy.size // 2
    band = shared.copy()
    # Within a gap a slow signal costs neither misfit nor penalty, and the matrix would be singular.
    # The ridge draws the difference from the line to zero.
    band[0] += ridge
    # At the ends samples stand on one side alone, and their noise would grow outward.
    band[0, : half + _END] += _END_RIDGE
    band[0, -half - _END :] += _END_RIDGE
    # The penalty is on the signal and not on its difference from the lines, so that of the lines
    # goes to the right-hand side.
    beyond = np.pad(padded, middle, mode="reflect", reflect_type="odd")
    right -= np.convolve(beyond, energy, mode="valid")
    # By Cholesky: the ridge has made the matrix positive definite, and the cost is linear in the
    # samples.
    correction = solveh_banded(band, right, lower=True)
    return (padded + correction)[half : half + line.size]


# The channels of a topic have one clock, and each tries several ridges: two sets of stamps, those
# that choose among them and all, serve them all.
@functools.lru_cache(maxsize=2)
def _equations(stamps: bytes, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which even samples each sample is a sum of (N, taps), with which weights (N, taps), and the
    diagonals (taps, size) of the equations of least squares, with the penalty.

    Args:
        stamps: where the samples stand (N,) in steps, float64.
        size: how many even samples there are, with those that the taps reach behind both ends.
    """
    at = np.frombuffer(stamps)
    columns = np.floor(at).astype(np.int64)[:, None] + 1 + np.arange(_TAPS)
    weights = _sinc(at[:, None] + _TAPS // 2 - columns)
    weights /= weights.sum(1, keepdims=True)  # a constant stays one, to the last digit
    # Diagonals from the middle down: LAPACK takes ten times as long for those above it.
    # A sample and another share a weight only within the taps, so the matrix is a band.
    band = np.zeros((_TAPS, size))
    for lag in range(_TAPS):
        products = weights[:, : _TAPS - lag] * weights[:, lag:]
        to = columns[:, : _TAPS - lag].ravel()
        band[lag] += np.bincount(to, products.ravel(), size)
    energy = _penalty()
    middle = energy.size // 2
    for lag in range(middle + 1):
        band[lag, : size - lag] += energy[middle + lag]
    for array in (columns, weights, band):
        array.setflags(write=False)
    return columns, weights, band


@functools.cache
def _penalty() -> np.ndarray:
    """The autocorrelation of the filter whose output's energy is held small."""
    from scipy.signal import firwin

    # Any: the stubs know neither windows with a parameter nor that this one returns one array.
    taps: Any = firwin(_TAPS - 1, 0.85, pass_zero=False, window=cast(Any, ("kaiser", 6.0)))
    high = _PENALTY * np.asarray(taps)
    high -= high.mean()  # straight lines, however steep, cost nothing
    return np.convolve(high, high[::-1])


def _sinc(x: np.ndarray) -> np.ndarray:
    """The weight of the sample x steps away, for a signal of the band of these steps."""
    half = _TAPS // 2
    window = np.i0(_TAPS_BETA * np.sqrt(np.clip(1 - (x / half) ** 2, 0, 1))) / np.i0(_TAPS_BETA)
    return np.sinc(x) * window


def low_pass(even: np.ndarray, step: float, times: np.ndarray, new_step: float) -> np.ndarray:
    """Even samples, low-passed, at the times of a slower grid (M,).

    Args:
        even: samples (K,), `step` [s] apart from 0 on; they go on as their mirror image.
        step: between them [s].
        times: (M,) [s].
        new_step: of the slower grid [s], whose Nyquist frequency nothing passes.
    """
    taps = 2 * int(np.ceil(_REACH * new_step / step)) + 2
    # As the mirror image through each end goes on: value and slope stay.
    padded = np.pad(even, taps, mode="reflect", reflect_type="odd")
    x, kernel = _kernel()
    filtered = np.empty(times.size)
    at_once = max(1, _AT_ONCE // taps)
    for begin in range(0, times.size, at_once):
        at = times[begin : begin + at_once] / step
        columns = np.floor(at).astype(np.int64)[:, None] + np.arange(-taps // 2 + 1, taps // 2 + 1)
        away = np.abs(at[:, None] - columns) * (step / (new_step * _REACH))
        weights = np.interp(away, x, kernel, right=0.0)
        samples = padded[np.clip(columns + taps, 0, padded.size - 1)]
        # Divided by the sum of the weights, so that a constant stays the same whatever part of the
        # kernel falls between samples.
        filtered[begin : begin + at_once] = np.sum(weights * samples, 1) / np.sum(weights, 1)
    return filtered


@functools.cache
def _kernel() -> tuple[np.ndarray, np.ndarray]:
    """The low-pass filter's kernel at distances from 0 to its reach, which is 1.

    Tabled and interpolated: the Bessel function of its window would else be computed anew for every
    weight.
    """
    x = np.linspace(0, 1, _TABLE)
    window = np.i0(_BETA * np.sqrt(1 - x**2)) / np.i0(_BETA)
    # The cutoff is midway between what passes and what is stopped; a sinc of cutoff f has twice f
    # in its argument, which is the sum of the two.
    return x, np.sinc((PASSED + STOPPED) * _REACH * x) * window
