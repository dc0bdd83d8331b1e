"""A flight's samples on another clock."""

from dataclasses import dataclass

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.band_limited import PASSED, decimate, low_pass
from heli_jax.flights.clock_steps import step_notes
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
    notes += step_notes(seconds, rate, longest_gap(seconds))
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
