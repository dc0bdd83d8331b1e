"""Vibration lines in a record, and notches that remove them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

SEGMENT = 4.0
"""Length of a spectral segment [s]. The resolution is 0.25 Hz; a rotor keeps its speed for that
long."""
_STANDS_OUT = 20.0
"""Smallest ratio of a line to the median around it; noise exceeds it once in a million bins."""
_SURROUNDINGS = 15
"""Bins on either side over which the median is taken."""
SMALLEST = 0.01
"""Smallest share of the variance; a smaller line biases nothing."""
_SLOWEST = 4.0
"""Lowest frequency of a line [Hz]. Below are the vehicle's motion and the sticks, whose doublets
have lines too."""


class Line(NamedTuple):
    """A line of the spectrum."""

    hz: float
    share: float
    """Share of the variance."""


def lines(x: np.ndarray, dt: float) -> tuple[Line, ...]:
    """Return the vibration lines of a record, the strongest first.

    Args:
        x: samples (N,); missing ones (NaN) are interpolated.
        dt: time between samples [s].
    """
    from scipy.ndimage import median_filter

    n = min(x.size, max(64, round(SEGMENT / dt)))
    there = np.isfinite(x)
    if np.count_nonzero(there) < max(64, x.size // 2):
        return ()
    times = np.arange(x.size)
    x = _without_line(np.interp(times, times[there], x[there]))
    # Welch's spectrum. scipy.signal would add half a second to the start of every command.
    hz, window = np.fft.rfftfreq(n, dt), np.sin(np.pi * np.arange(n) / n) ** 2
    segments = np.lib.stride_tricks.sliding_window_view(x, n)[:: n - n // 2]
    spectra = np.abs(np.fft.rfft(_without_line(segments) * window)) ** 2
    power = 2.0 * dt / np.sum(window**2) * np.mean(spectra, axis=0)
    # Use the whole record, because motion slower than a segment is also part of the variance.
    total = float(np.var(x)) / float(hz[1])
    if not total > 0:
        return ()
    around = median_filter(power, 2 * _SURROUNDINGS + 1, mode="nearest")
    peak = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])
    peaks = np.flatnonzero(peak & (power[1:-1] > _STANDS_OUT * around[1:-1])) + 1
    result = []
    for i in peaks[hz[peaks] >= _SLOWEST]:
        # Two bins on either side: the width of a line in this window.
        part = slice(max(i - 2, 0), i + 3)
        share = float(np.sum(power[part] - around[part])) / total
        if share >= SMALLEST:
            result.append(Line(float(hz[i]), share))
    return tuple(sorted(result, key=lambda line: -line.share))


def _without_line(x: np.ndarray) -> np.ndarray:
    """Return signals (*, N) without their straight lines of least squares."""
    t = np.arange(x.shape[-1]) - 0.5 * (x.shape[-1] - 1)
    x = x - np.mean(x, axis=-1, keepdims=True)
    return x - (x @ t)[..., None] * t / (t @ t)


def folded(hz: float, rate: float) -> float:
    """Return the frequency [Hz] at which a frequency appears in samples taken at a rate [Hz]."""
    return abs(hz - rate * round(hz / rate))


def settling(frequencies: Sequence[float], q: float) -> float:
    """Return the settling time of notches to 5 % [s]."""
    # Their free response decays by exp(-omega t / (2 q)): to 1/20 in three time constants.
    return 3.0 * q / (np.pi * min(frequencies))


def slow_step(x: np.ndarray) -> int:
    """Return the usual step between samples (N,) of a sensor slower than the grid [grid steps].

    It is 1 if the sensor is not slower.
    """
    steps = np.diff(np.flatnonzero(np.isfinite(x)))
    return round(float(np.median(steps))) if steps.size else 1


def notched_slow(x: np.ndarray, dt: float, frequencies: Sequence[float], q: float) -> np.ndarray:
    """Apply notches to a sensor that is slower than the grid, at its own samples.

    Frequencies above its Nyquist frequency are left out: they are folded and remain.
    """
    step = slow_step(x)
    own = [hz for hz in frequencies if hz < 0.5 / (step * dt)]
    there = np.flatnonzero(np.isfinite(x))
    if step == 1 or (own and np.any(np.diff(there) % step)):
        return notched(x, dt, frequencies, q)
    made = np.array(x)
    if own:
        every = slice(int(there[0]), None, step)
        made[every] = notched(x[every], step * dt, own, q)
    return made


def notched(x: np.ndarray, dt: float, frequencies: Sequence[float], q: float) -> np.ndarray:
    """Remove frequencies from a record (N,) by causal notches that are settled at the first sample.

    After missing samples the notches start again, and their output is missing until they have
    settled.

    Args:
        x: samples (N,), NaN where one is missing.
        dt: time between samples [s].
        frequencies: centres of the notches [Hz], below half the rate.
        q: quality factor of the notches.
    """
    from scipy.signal import iirnotch, lfilter, lfilter_zi

    x = np.array(x)
    coefficients = [iirnotch(hz, q, 1.0 / dt) for hz in frequencies]
    unsettled = int(np.ceil(settling(frequencies, q) / dt))
    # Stretches of present samples: pairs of first and last + 1.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.isfinite(x), [False]])))
    for first, last in edges.reshape(-1, 2):
        for b, a in coefficients:
            part = x[first:last]
            x[first:last] = lfilter(b, a, part, zi=lfilter_zi(b, a) * part[0])[0]
        # At the record's beginning inputs and outputs have the same filter state.
        if first:
            x[first : min(first + unsettled, last)] = np.nan
    return x
