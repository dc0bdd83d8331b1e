"""Outputs with clocks of their own on the flight's grid: slower ones are missing between their
samples.

Straight lines between two samples of a slow sensor are no measurements: a fit that takes them for
such believes in twenty samples where there is one, and its intervals come out too narrow.
"""

from typing import NamedTuple

import numpy as np

from heli_jax.flights.resample import interpolate

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
