"""Vibration lines in a record."""

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
