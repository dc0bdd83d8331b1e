"""Resampling of a flight's samples to another clock.

In all functions, `seconds` (N,) [s] are increasing stamps and `values` (N,) their samples, NaN if
missing. `times` (M,) [s] is an evenly spaced grid. Results are (M,), in the samples' unit, NaN
where too many samples are missing. Holds accept times from the first stamp on.
"""

import functools
from typing import Any, NamedTuple, cast

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.grid import JITTER_ALLOWED
from heli_jax.numerics.jumps import split

# A gap is bridged if it is a few lost samples, or so short that a small helicopter's attitude is
# still near a straight line.
_GAP_STEPS = 5.0
_GAP_SECONDS = 0.25
_GOES_DOWN = 0.9
"""Ratio of new to old rate below which frequencies between the Nyquist frequencies could fold."""
_CELLS = 16
"""Parts of a grid step over which a held signal is averaged before the low-pass filter. The mean
attenuates a signal at 0.4 of the rate by 0.1 %."""


def longest_gap(seconds: np.ndarray) -> float:
    """Return the longest step [s] between stamps (N,) [s] that is bridged."""
    # The larger of the two: in a slow log a few steps are longer than the fixed time, in a fast log
    # the fixed time is many steps.
    return max(_GAP_STEPS * float(np.median(np.diff(seconds))), _GAP_SECONDS)


def rate_notes(seconds: np.ndarray, rate: float) -> list[Finding]:
    """Return notes on the resampling of stamps (N,) [s] to a rate [Hz]."""
    usual = float(np.median(np.diff(seconds)))
    words = f"resampled to {rate:.6g} Hz from about {1 / usual:.6g} Hz"
    notes = [note("resampling.rate", words, value=1 / usual)]
    if lost := int(lost_samples(seconds).sum()):
        share = 100.0 * lost / (lost + seconds.size)
        words = f"{lost} samples are missing ({share:.2g} %), straight lines replace them"
        notes.append(note("resampling.lost", words, value=share))
    if rate * usual < _GOES_DOWN:
        passed = PASSED * rate
        words = (
            f"low-pass filtered first: {passed:.3g} Hz and below pass; held inputs are not filtered"
        )
        notes.append(note("resampling.low-passed", words, value=passed))
    return notes


def in_gaps(seconds: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return a mask of the times (M,) inside a gap of the stamps (N,) that is not bridged."""
    behind = np.clip(np.searchsorted(seconds, times, side="right"), 1, seconds.size - 1)
    step = seconds[behind] - seconds[behind - 1]
    away = np.minimum(np.abs(times - seconds[behind - 1]), np.abs(times - seconds[behind]))
    # A step of exactly the limit passes despite rounding. A time at a stamp has that sample,
    # however wide the gap beside it is.
    return (step > longest_gap(seconds) * (1 + 1e-9)) & (away > 1e-9)


def hold(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the value of the sample before each time (zero-order hold).

    For modes and counters, which have no meaningful mean; vehicle inputs use `held_mean`. A time
    that misses a stamp only by rounding counts as at the stamp.
    """
    tolerance = 1e-6 * float(np.median(np.diff(seconds)))
    return values[np.searchsorted(seconds, times + tolerance, side="right") - 1]


def held_until_jumps(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Resample a signal that is held until it jumps and otherwise follows straight lines.

    A jump moves to the nearest time, so that it remains a jump on the grid.
    """
    stairs, rest = split(values)
    nearest = times + 0.5 * (times[1] - times[0])
    return hold(seconds, stairs, nearest) + resampled(seconds, rest, times)


def held_mean(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the mean of a stepwise signal over each step of a grid, from its time to the next.

    The mean keeps the integral of the signal, to which a vehicle responds. The value at the grid's
    time would be late by half a step on average, which a fit attributes to lag.

    Args:
        seconds: stamps (N,) [s], increasing; each sample holds until the next.
        values: samples (N,), finite.
        times: (M,) [s], evenly spaced, M >= 2, none before the first stamp.

    Returns:
        (M,), in the samples' unit; bit-identical to the samples if no step is between two times.
    """
    edges = np.append(times, 2 * times[-1] - times[-2])
    # A stamp that misses a time only by rounding counts as at it.
    near = np.clip(np.searchsorted(edges, seconds), 1, edges.size - 1)
    nearest = np.where(seconds - edges[near - 1] < edges[near] - seconds, near - 1, near)
    at_edge = np.abs(seconds - edges[nearest]) <= 1e-6 * float(np.median(np.diff(seconds)))
    stamps = np.where(at_edge, edges[nearest], seconds)
    inside = stamps[(stamps >= edges[0]) & (stamps < edges[-1])]
    bounds = np.union1d(edges, inside)
    begins = bounds[:-1]
    pieces = values[np.maximum(np.searchsorted(stamps, begins, side="right") - 1, 0)]
    first = np.searchsorted(begins, times)
    lowest = np.minimum.reduceat(pieces, first)
    highest = np.maximum.reduceat(pieces, first)
    steps = np.diff(edges)[np.searchsorted(times, begins, side="right") - 1]
    # Weighted before the sum, because the sum of huge values times seconds could overflow.
    mean = np.add.reduceat(pieces * (np.diff(bounds) / steps), first)
    return np.clip(mean, lowest, highest)


def held_low_passed(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Low-pass a stepwise signal by the filter of `resampled`, at the times of a grid."""
    step = float(times[1] - times[0])
    cell = step / _CELLS
    count = int(np.ceil((max(seconds[-1], times[-1]) - seconds[0]) / cell)) + 1
    means = held_mean(seconds, values, seconds[0] + cell * np.arange(count))
    # A mean belongs to the middle of its cell.
    return low_pass(means, cell, times - seconds[0] - 0.5 * cell, step)


def with_lost(seconds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a stepwise signal with the samples that a regular clock lost, on straight lines.

    The line is the expected value: a step between two samples was equally likely at each lost one.
    The last value would make each such step late. Stamps of an irregular clock, such as those of a
    log of changes, are returned unchanged.
    """
    lost = lost_samples(seconds)
    if not lost.any():
        return seconds, values
    at = np.r_[0, np.cumsum(1 + lost)]
    each = np.arange(at[-1] + 1)
    return np.interp(each, at, seconds), np.interp(each, at, values)


def lost_samples(seconds: np.ndarray) -> np.ndarray:
    """Return the samples lost in each step (N - 1,) of a regular clock that a fit bridges."""
    steps = np.diff(seconds)
    usual = np.median(steps)
    # Half of the steps at least must show the clock.
    regular = np.median(np.abs(steps / usual - 1.0)) <= JITTER_ALLOWED
    bridged = regular & (steps <= longest_gap(seconds) * (1 + 1e-9))
    return np.where(bridged, np.rint(steps / usual) - 1, 0).clip(0).astype(np.int64)


def goes_down(seconds: np.ndarray, times: np.ndarray) -> bool:
    """True if `resampled` low-passes samples at these stamps (N,) [s] for these times (M,) [s]."""
    return bool(
        times.size >= 2 and np.median(np.diff(seconds)) < _GOES_DOWN * (times[1] - times[0])
    )


def resampled(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Resample a signal without steps: linearly, or low-passed if the rate decreases."""
    # If the rate hardly decreases, nothing folds, and interpolation keeps the samples as they are.
    if not goes_down(seconds, times):
        return interpolate(seconds, values, times)
    return decimate(seconds, values, times)


def interpolate(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolate linearly between neighbouring samples."""
    i = np.clip(np.searchsorted(seconds, times, side="right") - 1, 0, seconds.size - 2)
    part = np.clip((times - seconds[i]) / (seconds[i + 1] - seconds[i]), 0.0, 1.0)
    # A weighted mean, because the difference of two huge values would overflow.
    between = values[i] * (1.0 - part) + values[i + 1] * part
    # A missing (NaN) neighbour does not matter at the stamp itself.
    return np.where(part == 0.0, values[i], np.where(part == 1.0, values[i + 1], between))


# Outputs with separate clocks on the flight's grid: slower ones are missing between their samples.
#
# A line between two samples of a slow sensor is no measurement. A fit that uses it as one counts
# twenty samples instead of one, and its intervals are too narrow.

SLOWER = 1.5
"""Shortest usual step of an output that counts as slower than the grid [grid steps]. Below it,
interpolation makes at most three samples from two."""
OWN = 1.1
"""Largest usual step of an output with a sample at each instant [grid steps]."""


class Timed(NamedTuple):
    """Signal on its own clock: increasing stamps (N,) [s] and samples (N,), NaN if missing."""

    seconds: np.ndarray
    values: np.ndarray


def usual_step(seconds: np.ndarray) -> float:
    """Return the usual step of stamps (N,) [s]; infinite for fewer than two."""
    return float(np.median(np.diff(seconds))) if seconds.size > 1 else float("inf")


def own_clock(signal: Timed) -> Timed:
    """Return the signal without missing samples if most are missing, else unchanged.

    A slow sensor in a fast table has mostly missing samples; the remaining stamps show its rate.
    """
    seen = ~np.isnan(signal.values)
    # A few lost samples do not change the clock.
    if usual_step(signal.seconds[seen]) > SLOWER * usual_step(signal.seconds):
        return Timed(signal.seconds[seen], signal.values[seen])
    return signal


def is_slower(signal: Timed, rate: float) -> bool:
    """True if a signal was sampled clearly more slowly than `rate` [Hz]."""
    # 1e-6: a step of exactly the limit does not count as longer because of rounding.
    return usual_step(own_clock(signal).seconds) * rate > SLOWER * (1 + 1e-6)


def at_nearest(signal: Timed, times: np.ndarray) -> np.ndarray:
    """Move each sample to the nearest of the times (M,); NaN between.

    The sample moves by at most half a grid step along the slope between its neighbours. This is
    second order, also for uneven steps. Its noise stays nearly its own: the neighbours add 6 % of
    variance at most, and little on a much faster grid.
    """
    seen = ~np.isnan(signal.values)
    seconds, values = signal.seconds[seen], signal.values[seen]
    samples, step = np.full(times.size, np.nan), float(times[1] - times[0])
    nearest = np.rint((seconds - times[0]) / step).astype(np.int64)
    inside = (nearest >= 0) & (nearest < times.size)
    if not inside.any():
        return samples
    few = seconds.size < 3
    away = times[np.clip(nearest, 0, times.size - 1)] - seconds
    # For stamps at multiples of the grid's step, the remainder is rounding.
    away = np.where(np.abs(away) > 1e-6 * step, away, 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        slope = np.zeros(seconds.size) if few else np.gradient(values, seconds, edge_order=2)
        moved = values + slope * away
    moved = np.where(np.isfinite(moved), moved, values)  # the slope of huge values can overflow
    # In descending distance, so that the nearer of two samples at one instant is written last.
    order = np.argsort(-np.abs(away), kind="stable")
    order = order[inside[order]]
    samples[nearest[order]] = moved[order]
    return samples


def at_own_rate(signal: Timed, times: np.ndarray) -> np.ndarray:
    """Return the samples at their nearest instants (M,), and straight lines at other instants.

    This is for signals with the grid's rate but different or uneven stamps. Linear interpolation
    alone would give white noise an autocorrelation of up to +0.5, which looks like a disturbance.
    """
    placed = at_nearest(signal, times)
    return np.where(np.isnan(placed), interpolate(*signal, times), placed)


# Fewer samples a second without aliasing.
#
# There are two steps. First, least squares makes even samples at the usual rate. The result is the
# signal through the samples with the least energy near the Nyquist frequency. This follows
# Feichtinger and Groechenig, 'Theory and practice of irregular sampling', 1994, with a penalty
# instead of a hard band limit. Second, a low-pass filter, a sinc in a Kaiser window, is evaluated
# at the new times.
#
# White noise has energy near the old Nyquist frequency, which cannot be separated from lost
# samples. A fit through every sample would amplify it. The ridge, which sets how closely samples
# are followed, is therefore chosen by cross-validation. It ranges from straight lines between
# neighbours (noise) to a fit of all samples (a band-limited signal). Noise then passes according to
# the low-pass filter.
#
# Measured at 200 Hz with jitter of a fifth of a step and 5 % of the samples lost: a noise-free
# signal between 26 and 70 Hz is below -74 dB at 50 Hz. Above 70 % of the old Nyquist frequency,
# lost samples cannot be restored and a part folds. Even samples have no such limit.

PASSED, STOPPED = 0.4, 0.5
"""Edges of the pass band and the stop band, relative to the new rate."""
_REACH = 25
"""Reach of the low-pass filter on each side [new steps]: 70 dB between the two edges."""
_BETA = 7.0
_TAPS = 32
"""Even samples that contribute to one sample between them."""
_TAPS_BETA = 8.0
_PENALTY = 0.1
"""Weight of the energy in the upper seventh of the old band; it acts where samples are lost."""
_RIDGES = (1e-9, 1e-5, 1e-3, 3e-2, 1.0)
"""Candidate ridges on the difference from straight lines; the smallest follows the samples most
closely."""
_HIDDEN, _TRIED = 17, 1 << 12
"""One sample in `_HIDDEN`, of at most `_TRIED`, is hidden to choose the ridge."""
_END, _END_RIDGE = 4, 1e-2
_BLOCK, _OVERLAP = 1 << 15, 256
_TABLE = 1 << 16
_AT_ONCE = 1 << 22
"""Largest number of weights in memory."""


def decimate(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Resample a signal to a lower rate."""
    # A missing sample is removed, not replaced: the fit of even samples handles gaps.
    known = np.isfinite(values)
    if np.count_nonzero(known) < 2:
        return np.full(times.size, np.nan)
    usual, step = float(np.median(np.diff(seconds))), float(times[1] - times[0])
    longest = max(2 * step, 5 * usual)
    seconds, values = seconds[known], values[known]
    even_step, even = even_samples(seconds, values, usual)
    filtered = low_pass(even, even_step, times - seconds[0], step)
    # The stamps on both sides of a time give the width of its gap. In a wide gap the fit is a
    # straight line, which is no measurement.
    behind = np.clip(np.searchsorted(seconds, times, side="right"), 1, seconds.size - 1)
    gap = seconds[behind] - seconds[behind - 1]
    inside = (times >= seconds[0] - usual) & (times <= seconds[-1] + usual)
    return np.where(inside & (gap <= longest), filtered, np.nan)


def even_samples(seconds: np.ndarray, values: np.ndarray, usual: float) -> tuple[float, np.ndarray]:
    """Return an even step [s], and samples (K,) from the first stamp to beyond the last."""
    span = float(seconds[-1] - seconds[0])
    # Bounds the memory: at most four even samples for each sample.
    step = max(usual, span / (4 * seconds.size))
    # The stamps are even except for rounding. The samples are then exact without a fit.
    if np.ptp(np.diff(seconds)) < 1e-3 * step:
        return span / (seconds.size - 1), values
    at = (seconds - seconds[0]) / step
    count = int(np.ceil(at[-1])) + 1
    even = np.empty(count)
    # The last even sample is after the last stamp; the slope continues there.
    slope = (values[-1] - values[-2]) / (at[-1] - at[-2])
    line = np.interp(np.arange(count), np.r_[at, at[-1] + 1], np.r_[values, values[-1] + slope])
    ridge = _best_ridge(at, values)
    for begin in range(0, count, _BLOCK):
        end = min(begin + _BLOCK, count)
        # Block by block, so that the memory does not grow with the log. Samples near a block's end
        # lack neighbours; the overlap is eight times the taps, computed twice and kept once.
        first, last = max(begin - _OVERLAP, 0), min(end + _OVERLAP, count)
        # The small number keeps a stamp at the block's last sample despite rounding.
        rows = slice(*np.searchsorted(at, [first, last - 1 + 1e-9]))
        block = _fitted(at[rows] - first, values[rows], line[first:last], ridge)
        even[begin:end] = block[begin - first : end - first]
    return step, even


def _best_ridge(at: np.ndarray, values: np.ndarray) -> float:
    """Return the one of `_RIDGES` that predicts hidden samples best."""
    # From the middle, where the vehicle is most likely active; the ends are pulled to the line by
    # any ridge.
    first = max(0, (at.size - _TRIED) // 2)
    at, values = at[first : first + _TRIED], values[first : first + _TRIED]
    at = at - np.floor(at[0])
    hidden = np.zeros(at.size, bool)
    # Random, because a periodic pattern would miss motion of that period.
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
    """Return even samples (K,) of the signal through `values` (N,) at `at` (N,) [steps].

    The unknown is the difference from straight lines (K,), so that a gap is bridged by a line.
    """
    from scipy.linalg import solveh_banded

    half, energy = _TAPS // 2, _penalty()
    # The line continues beyond both ends for the taps that reach there.
    padded = np.pad(line, half, mode="reflect", reflect_type="odd")
    sums, shared = _equations(np.ascontiguousarray(at).tobytes(), padded.size)
    # The penalty applies to the signal, not to its difference from the lines. The part of the lines
    # moves to the right-hand side.
    beyond = np.pad(padded, energy.size // 2, mode="reflect", reflect_type="odd")
    right = sums.T @ (values - sums @ padded) - np.convolve(beyond, energy, mode="valid")
    # In a gap a slow signal has neither misfit nor penalty, and the matrix would be singular. The
    # ridge pulls the difference from the line to zero.
    ridges = np.full(padded.size, ridge)
    # The ends have samples on one side only, and their noise would grow outward.
    ridges[: half + _END] += _END_RIDGE
    ridges[-half - _END :] += _END_RIDGE
    # Cholesky works because the ridge makes the matrix positive definite; the cost is linear in the
    # samples.
    correction = solveh_banded(np.vstack([shared[0] + ridges, shared[1:]]), right, lower=True)
    return (padded + correction)[half : half + line.size]


# Channels of a topic share a clock, and each tries several ridges. Two entries are enough: the
# stamps for the choice of the ridge, and all stamps.
@functools.lru_cache(maxsize=2)
def _equations(stamps: bytes, size: int) -> tuple[Any, np.ndarray]:
    """Return the sums of even samples that make the samples (N, size), and the band.

    The band (taps, size) has the lower diagonals of the least-squares equations with the penalty.
    """
    from scipy.sparse import csr_array, diags_array

    at = np.frombuffer(stamps)
    columns = np.floor(at).astype(np.int64)[:, None] + 1 + np.arange(_TAPS)
    weights = _sinc(at[:, None] + _TAPS // 2 - columns)
    weights /= weights.sum(1, keepdims=True)  # a constant stays exact
    pointers = _TAPS * np.arange(at.size + 1)
    sums = csr_array((weights.ravel(), columns.ravel(), pointers), shape=(at.size, size))
    energy, middle = _penalty(), _penalty().size // 2
    offsets: Any = np.arange(-middle, middle + 1)  # the stubs take a single one
    shared = sums.T @ sums + diags_array(energy, offsets=offsets, shape=(size, size))
    # Two samples share a weight only within the taps, so the matrix is a band.
    band = [np.r_[shared.diagonal(-lag), np.zeros(lag)] for lag in range(_TAPS)]
    return sums, np.array(band)


@functools.cache
def _penalty() -> np.ndarray:
    """Return the autocorrelation of the filter whose output energy is penalised."""
    from scipy.signal import firwin

    # Any: the stubs know neither windows with a parameter nor the single array that is returned.
    taps: Any = firwin(_TAPS - 1, 0.85, pass_zero=False, window=cast(Any, ("kaiser", 6.0)))
    high = _PENALTY * np.asarray(taps)
    high -= high.mean()  # straight lines, however steep, have no penalty
    return np.convolve(high, high[::-1])


def _sinc(x: np.ndarray) -> np.ndarray:
    """Return the weight of a sample x steps away, for a signal limited to the band of the steps."""
    half = _TAPS // 2
    window = np.i0(_TAPS_BETA * np.sqrt(np.clip(1 - (x / half) ** 2, 0, 1))) / np.i0(_TAPS_BETA)
    return np.sinc(x) * window


def low_pass(even: np.ndarray, step: float, times: np.ndarray, new_step: float) -> np.ndarray:
    """Low-pass even samples, at the times of a slower grid (M,).

    Args:
        even: samples (K,), `step` [s] apart from 0 on; they continue as their mirror image.
        step: step of `even` [s].
        times: (M,) [s].
        new_step: step of the slower grid [s]; its Nyquist frequency is stopped.
    """
    taps = 2 * int(np.ceil(_REACH * new_step / step)) + 2
    # Odd reflection at each end keeps value and slope.
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
        # Divided by the sum of the weights, so that a constant stays exact wherever the kernel is
        # sampled.
        filtered[begin : begin + at_once] = np.sum(weights * samples, 1) / np.sum(weights, 1)
    return filtered


@functools.cache
def _kernel() -> tuple[np.ndarray, np.ndarray]:
    """Return the low-pass filter's kernel at distances from 0 to its reach, which is 1.

    It is tabulated, because the Bessel function of the window would otherwise be computed for every
    weight.
    """
    x = np.linspace(0, 1, _TABLE)
    window = np.i0(_BETA * np.sqrt(1 - x**2)) / np.i0(_BETA)
    # The cutoff is midway between the pass and the stop edge. A sinc of cutoff f has 2 f in its
    # argument, the sum of the two edges.
    return x, np.sinc((PASSED + STOPPED) * _REACH * x) * window
