"""A flight's samples on another clock."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.band_limited import PASSED, decimate, low_pass
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


@dataclass(frozen=True)
class Clock:
    """Where to sample: `times` (M,) [s], `dt` apart, and what to tell the reader of it."""

    times: np.ndarray
    dt: float
    notes: tuple[Finding, ...]


def longest_gap(seconds: np.ndarray) -> float:
    """The longest step [s] between stamps (N,) [s] that may be bridged."""
    # The larger of the two: in a slow log a few steps are longer than the time, and in a fast one
    # the time is many steps.
    return max(_GAP_STEPS * float(np.median(np.diff(seconds))), _GAP_SECONDS)


def new_clock(seconds: np.ndarray, rate: float) -> Clock:
    """A uniform clock of `rate` [Hz] from the first of the stamps (N,) [s] to the last."""
    usual = float(np.median(np.diff(seconds)))
    # The last sample is not lost to the rounding of its stamp.
    count = int(np.floor((seconds[-1] - seconds[0]) * rate + 1e-6)) + 1
    # Counted and multiplied, never added up: the sum of 1e6 rounded steps would drift.
    words = f"resampled to {rate:.6g} Hz from about {1 / usual:.6g} Hz"
    notes = [note("resampling.rate", words, value=1 / usual)]
    if rate * usual < _GOES_DOWN:
        passed = PASSED * rate
        words = f"low-pass filtered first: {passed:.3g} Hz and below pass, not held inputs"
        notes.append(note("resampling.low-passed", words, value=passed))
    return Clock(seconds[0] + np.arange(count) / rate, 1.0 / rate, tuple(notes))


def in_gaps(seconds: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Whether each of the times (M,) lies in a gap of the stamps (N,) that is not bridged."""
    behind = np.clip(np.searchsorted(seconds, times, side="right"), 1, seconds.size - 1)
    step = seconds[behind] - seconds[behind - 1]
    away = np.minimum(np.abs(times - seconds[behind - 1]), np.abs(times - seconds[behind]))
    # A step of exactly the limit passes whatever its rounding, and a time at a stamp has that
    # sample, however wide the gap beside it is.
    return (step > longest_gap(seconds) * (1 + 1e-9)) & (away > 1e-9)


def hold(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The value of the sample before each time: a stick stays until the next sample.

    For modes and counters, of which no mean makes sense; what acts on a machine takes `held_mean`.
    A time that misses a stamp by rounding alone counts as at the stamp.

    Args:
        seconds: stamps (N,) [s], increasing.
        values: samples (N,).
        times: (M,) [s], none before the first stamp.

    Returns:
        (M,), in the samples' unit.
    """
    tolerance = 1e-6 * float(np.median(np.diff(seconds)))
    return values[np.searchsorted(seconds, times + tolerance, side="right") - 1]


def held_until_jumps(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A signal that is held until it jumps, and else follows straight lines.

    A jump comes to the time nearest to its own, so that it remains one on the grid.

    Args:
        seconds: stamps (N,) [s], increasing.
        values: samples (N,), finite.
        times: (M,) [s], evenly spaced, none before the first stamp.

    Returns:
        (M,), in the samples' unit.
    """
    stairs, rest = split(values)
    nearest = times + 0.5 * (times[1] - times[0])
    return hold(seconds, stairs, nearest) + resampled(seconds, rest, times)


def held_mean(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The mean of a stepwise signal over each step of a grid, from its time to the next.

    What a machine makes of a step is its integral. The mean keeps it wherever the step falls; the
    value at the grid's time would be late by half a grid step on average, which a fit takes for
    the machine's lag.

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
    """A stepwise signal through the low-pass filter of `resampled`, at the times of a grid.

    Args:
        seconds: stamps (N,) [s], increasing; each sample stays until the next.
        values: samples (N,), finite.
        times: (M,) [s], evenly spaced, M >= 2, none before the first stamp.

    Returns:
        (M,), in the samples' unit.
    """
    step = float(times[1] - times[0])
    cell = step / _CELLS
    count = int(np.ceil((max(seconds[-1], times[-1]) - seconds[0]) / cell)) + 1
    means = held_mean(seconds, values, seconds[0] + cell * np.arange(count))
    # A mean stands for the middle of its cell.
    return low_pass(means, cell, times - seconds[0] - 0.5 * cell, step)


def goes_down(seconds: np.ndarray, times: np.ndarray) -> bool:
    """Whether `resampled` low-passes samples at these stamps (N,) [s] for these times (M,) [s]."""
    return bool(
        times.size >= 2 and np.median(np.diff(seconds)) < _GOES_DOWN * (times[1] - times[0])
    )


def resampled(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A signal that is no step: on straight lines, or low-pass filtered where the rate goes down.

    Args:
        seconds: stamps (N,) [s], increasing.
        values: samples (N,), NaN where one is missing.
        times: (M,) [s], evenly spaced.

    Returns:
        (M,), in the samples' unit; NaN where too much is missing.
    """
    # Where the rate hardly goes down there is nothing to fold, and straight lines keep the samples
    # as they are.
    if not goes_down(seconds, times):
        return interpolate(seconds, values, times)
    return decimate(seconds, values, times)


def interpolate(seconds: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The straight line between neighbouring samples.

    Args:
        seconds: stamps (N,) [s], increasing.
        values: samples (N,), NaN where one is missing.
        times: (M,) [s]; beyond the last stamp its value holds.

    Returns:
        (M,), in the samples' unit; NaN beside a missing sample.
    """
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


class Placed(NamedTuple):
    """A slow signal on a fast grid."""

    samples: np.ndarray
    """(M,), NaN where there is none"""
    moved: float
    """[s] by how much a sample was moved at most"""
    left_out: int
    """samples to whose instant another was nearer"""


def usual_step(seconds: np.ndarray) -> float:
    """Of stamps (N,) [s]; infinite where there are fewer than two."""
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
    """Whether a signal was sampled clearly more slowly than `rate` [Hz]."""
    # 1e-6: a step of exactly the limit, but for its rounding, is none that is longer.
    return usual_step(own_clock(signal).seconds) * rate > SLOWER * (1 + 1e-6)


def at_nearest(signal: Timed, times: np.ndarray) -> Placed:
    """Each sample at the instant nearest to its own, and nothing between.

    It is moved there, by half a grid step at most, along the slope between its neighbours (second
    order, also where steps are uneven). So its value is right to that order, and its noise stays
    its own: the neighbours add 6 % of variance where the grid is hardly faster, and nothing to
    speak of where it is many times as fast.

    Args:
        times: (M,) [s], evenly spaced, M >= 2.
    """
    seen = ~np.isnan(signal.values)
    seconds, values = signal.seconds[seen], signal.values[seen]
    samples, step = np.full(times.size, np.nan), float(times[1] - times[0])
    nearest = np.rint((seconds - times[0]) / step).astype(np.int64)
    inside = (nearest >= 0) & (nearest < times.size)
    if not inside.any():
        return Placed(samples, 0.0, 0)
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
    # Of stamps that are multiples of the grid's step the rest is rounding.
    largest = float(np.abs(away[inside]).max())
    left_out = int(inside.sum()) - int(np.count_nonzero(~np.isnan(samples)))
    return Placed(samples, largest if largest > 1e-6 * step else 0.0, left_out)


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


def slower_words(name: str, placed: Placed, signal: Timed, rate: float) -> str:
    """What was done to a slow output, in a sentence.

    Args:
        placed: what `at_nearest` made of it.
        rate: of the grid [Hz].
    """
    there = int(np.count_nonzero(~np.isnan(placed.samples)))
    words = (
        f"{name} at about {1 / usual_step(own_clock(signal).seconds):.4g} Hz is slower than the "
        f"grid of {rate:.6g} Hz: {there} samples at the instants nearest to their own"
    )
    if placed.moved:
        words += f", moved there by up to {1e3 * placed.moved:.2g} ms along the slope"
    if placed.left_out:
        words += f", {placed.left_out} left out that fell on the instant of another"
    return f"{words}; between them it is missing"
