"""A flight's samples on another clock.

Throughout, `seconds` (N,) [s] are stamps that increase, `values` (N,) the samples there, NaN where
one is missing, and `times` (M,) [s] those of a grid, evenly spaced. Results are (M,), in the
samples' unit, NaN where too much is missing. Holds take times from the first stamp on.
"""

import functools
from typing import Any, NamedTuple, cast

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.numerics.jumps import split

# What may be bridged: a few lost samples, or a moment in which a small helicopter's attitude is
# still near a straight line. What lies in a longer gap nobody knows.
_GAP_STEPS = 5.0
_GAP_SECONDS = 0.25
_GOES_DOWN = 0.9
"""new rate over old, below which something between the two Nyquist frequencies could fold"""
_CELLS = 16
"""parts of a grid step over which a held signal is averaged before it is low-passed: the mean takes
0.1 % off what is at 0.4 of the rate"""


def longest_gap(seconds: np.ndarray) -> float:
    """The longest step [s] between stamps (N,) [s] that may be bridged."""
    # The larger of the two: in a slow log a few steps are longer than the time, and in a fast one
    # the time is many steps.
    return max(_GAP_STEPS * float(np.median(np.diff(seconds))), _GAP_SECONDS)


def rate_notes(seconds: np.ndarray, rate: float) -> list[Finding]:
    """Notes on what becomes of samples at these stamps (N,) [s] at a rate [Hz]."""
    usual = float(np.median(np.diff(seconds)))
    words = f"resampled to {rate:.6g} Hz from about {1 / usual:.6g} Hz"
    notes = [note("resampling.rate", words, value=1 / usual)]
    if rate * usual < _GOES_DOWN:
        passed = PASSED * rate
        words = f"low-pass filtered first: {passed:.3g} Hz and below pass, not held inputs"
        notes.append(note("resampling.low-passed", words, value=passed))
    return notes


def in_gaps(seconds: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return a mask of the times (M,) that lie in a gap of the stamps (N,) that is not bridged."""
    behind = np.clip(np.searchsorted(seconds, times, side="right"), 1, seconds.size - 1)
    step = seconds[behind] - seconds[behind - 1]
    away = np.minimum(np.abs(times - seconds[behind - 1]), np.abs(times - seconds[behind]))
    # A step of exactly the limit passes whatever its rounding, and a time at a stamp has that
    # sample, however wide the gap beside it is.
    return (step > longest_gap(seconds) * (1 + 1e-9)) & (away > 1e-9)


def hold(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The value of the sample before each time: a stick stays until the next sample.

    For modes and counters, of which no mean makes sense; what acts on a vehicle takes `held_mean`.
    A time that misses a stamp by rounding alone counts as at the stamp.
    """
    tolerance = 1e-6 * float(np.median(np.diff(seconds)))
    return values[np.searchsorted(seconds, times + tolerance, side="right") - 1]


def held_until_jumps(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A signal that is held until it jumps, and else follows straight lines.

    A jump comes to the time nearest to its own, so that it remains one on the grid.
    """
    stairs, rest = split(values)
    nearest = times + 0.5 * (times[1] - times[0])
    return hold(seconds, stairs, nearest) + resampled(seconds, rest, times)


def held_mean(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The mean of a stepwise signal over each step of a grid, from its time to the next.

    What a vehicle makes of a step is its integral. The mean keeps it wherever the step falls; the
    value at the grid's time would be late by half a grid step on average, which a fit takes for
    the vehicle's lag.

    Args:
        seconds: stamps (N,) [s], increasing; each sample stays until the next.
        values: samples (N,), finite.
        times: (M,) [s], evenly spaced, M >= 2, none before the first stamp.

    Returns:
        (M,), in the samples' unit; the samples themselves, to the last bit, where no step falls
        between two times.
    """
    edges = np.append(times, 2 * times[-1] - times[-2])
    # A stamp that misses a time by rounding alone counts as at it.
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
    # Weighted first: the sum of huge values times seconds could overflow.
    mean = np.add.reduceat(pieces * (np.diff(bounds) / steps), first)
    return np.clip(mean, lowest, highest)


def held_low_passed(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A stepwise signal through the low-pass filter of `resampled`, at the times of a grid."""
    step = float(times[1] - times[0])
    cell = step / _CELLS
    count = int(np.ceil((max(seconds[-1], times[-1]) - seconds[0]) / cell)) + 1
    means = held_mean(seconds, values, seconds[0] + cell * np.arange(count))
    # A mean stands for the middle of its cell.
    return low_pass(means, cell, times - seconds[0] - 0.5 * cell, step)


def goes_down(seconds: np.ndarray, times: np.ndarray) -> bool:
    """True if `resampled` low-passes samples at these stamps (N,) [s] for these times (M,) [s]."""
    return bool(
        times.size >= 2 and np.median(np.diff(seconds)) < _GOES_DOWN * (times[1] - times[0])
    )


def resampled(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A signal that is no step: on straight lines, or low-passed where the rate goes down."""
    # Where the rate hardly goes down there is nothing to fold, and straight lines keep the samples
    # as they are.
    if not goes_down(seconds, times):
        return interpolate(seconds, values, times)
    return decimate(seconds, values, times)


def interpolate(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The straight line between neighbouring samples."""
    i = np.clip(np.searchsorted(seconds, times, side="right") - 1, 0, seconds.size - 2)
    part = np.clip((times - seconds[i]) / (seconds[i + 1] - seconds[i]), 0.0, 1.0)
    # A weighted mean: the difference of two huge values would overflow.
    between = values[i] * (1.0 - part) + values[i + 1] * part
    # A missing (NaN) neighbour costs nothing at the stamp itself.
    return np.where(part == 0.0, values[i], np.where(part == 1.0, values[i + 1], between))


# Outputs with clocks of their own on the flight's grid: slower ones are missing between their
# samples.
#
# Straight lines between two samples of a slow sensor are no measurements: a fit that takes them for
# such believes in twenty samples where there is one, and its intervals come out too narrow.

SLOWER = 1.5
"""grid steps; an output whose usual step is longer is slower than the grid. Up to here a straight
line makes at most three samples of two."""
_NEAR = 0.75
"""grid steps, to which a sample is moved along its slope"""
OWN = 1.1
"""grid steps; an output whose usual step is no longer has a sample for each instant"""


class Timed(NamedTuple):
    """A signal on its own clock: stamps (N,) [s], increasing, and samples (N,), NaN where one is
    missing."""

    seconds: np.ndarray
    values: np.ndarray


def usual_step(seconds: np.ndarray) -> float:
    """Return the usual step of stamps (N,) [s]; infinite for fewer than two."""
    return float(np.median(np.diff(seconds))) if seconds.size > 1 else float("inf")


def own_clock(signal: Timed) -> Timed:
    """Without missing samples where most are, as those of a slow sensor in a fast table are: the
    stamps then say how fast it was sampled."""
    seen = ~np.isnan(signal.values)
    # A few lost samples leave a clock as it is.
    if usual_step(signal.seconds[seen]) > SLOWER * usual_step(signal.seconds):
        return Timed(signal.seconds[seen], signal.values[seen])
    return signal


def is_slower(signal: Timed, rate: float) -> bool:
    """True if a signal was sampled clearly more slowly than `rate` [Hz]."""
    # 1e-6: a step of exactly the limit, but for its rounding, is none that is longer.
    return usual_step(own_clock(signal).seconds) * rate > SLOWER * (1 + 1e-6)


def at_nearest(signal: Timed, times: np.ndarray) -> np.ndarray:
    """Each sample at the one of the times (M,) nearest to its own; NaN between.

    It is moved there, by half a grid step at most, along the slope between its neighbours (second
    order, also where steps are uneven). So its value is right to that order, and its noise stays
    its own: the neighbours add 6 % of variance where the grid is hardly faster, and nothing to
    speak of where it is many times as fast.
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
    with np.errstate(over="ignore", invalid="ignore"):
        slope = np.zeros(seconds.size) if few else np.gradient(values, seconds, edge_order=2)
        moved = values + slope * away
    moved = np.where(np.isfinite(moved), moved, values)  # the slope of huge values is no number
    # Backwards by distance, so that of two at one instant the nearer is written last.
    order = np.argsort(-np.abs(away), kind="stable")
    order = order[inside[order]]
    samples[nearest[order]] = moved[order]
    return samples


def at_own_rate(signal: Timed, times: np.ndarray) -> np.ndarray:
    """A signal of the grid's own rate with other or uneven stamps: at each instant the sample
    nearest to it, moved there along the slope.

    A straight line between two samples is right to the same order, but averages their noise: white
    noise comes out with an autocorrelation of up to +0.5 at one sample, which passes for a
    disturbance.

    Args:
        times: (M,) [s], evenly spaced, M >= 2.

    Returns:
        (M,), in the samples' unit; NaN beside a missing sample. Where samples are far apart, on the
        straight line between them.
    """
    lines, seen = interpolate(signal.seconds, signal.values, times), ~np.isnan(signal.values)
    if np.count_nonzero(seen) < 3:
        return lines
    step = float(times[1] - times[0])
    with np.errstate(over="ignore", invalid="ignore"):
        slope = np.gradient(signal.values[seen], signal.seconds[seen], edge_order=2)
    whole = np.full(seen.size, np.nan)
    whole[seen] = slope
    after = np.clip(np.searchsorted(signal.seconds, times), 1, signal.seconds.size - 1)
    nearer = times - signal.seconds[after - 1] <= signal.seconds[after] - times
    nearest = np.where(nearer, after - 1, after)
    away = times - signal.seconds[nearest]
    # Of stamps that are multiples of the grid's step the rest is rounding.
    away = np.where(np.abs(away) > 1e-6 * step, away, 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        moved = signal.values[nearest] + whole[nearest] * away
    return np.where(np.isfinite(moved) & (np.abs(away) <= _NEAR * step), moved, lines)


# Fewer samples a second, without folding what the new rate cannot hold onto what it can.
#
# Two steps. Uneven samples become even ones of their own usual rate: the signal of least energy
# near that rate's Nyquist frequency which goes through them, by least squares (as in Feichtinger
# and Groechenig, 'Theory and practice of irregular sampling', 1994, with a penalty in place of a
# hard limit of the band). These pass a low-pass filter, a sinc in a Kaiser window, evaluated at the
# new times.
#
# What a signal has near the old Nyquist frequency, as white noise has, cannot be told from what
# lost samples hide, and a fit through every sample would multiply it. How closely the samples are
# followed is therefore asked of the signal itself: some of them are hidden, and the closeness is
# taken that predicts those best, from straight lines between neighbours (noise) to all that the
# others say (a signal that ends below). Noise then passes as the low-pass filter lets it.
#
# At 200 Hz with a fifth of a step of jitter and 5 % of the samples lost, what lies between 26 and
# 70 Hz of a signal without noise is below -74 dB at 50 Hz. Above 70 % of the old Nyquist frequency
# lost samples cannot be made up for, and a part folds; even samples have no such limit.

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
    """A signal at a lower rate."""
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
    """Samples (K,) at even steps [s] from the first stamp to behind the last, and the step."""
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
    """The one of `_RIDGES` that predicts hidden samples best."""
    # From the middle, where the vehicle is most likely at work; the ends are pulled to the line
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
    """Return the even samples that each sample is a sum of and their weights (N, taps), and the
    diagonals (taps, size) of the least-squares equations with the penalty.
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
