"""Vibration lines in a record: their frequency, share of the variance and origin."""

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
_HIGHEST = 12
"""Highest harmonic of the rotor in the search."""
_HIGHEST_FOLDED = 4
"""Highest harmonic in the search for aliases; with more, one would be near any line."""


class Line(NamedTuple):
    """A line of the spectrum."""

    hz: float
    share: float
    """Share of the variance."""
    harmonic: int = 0
    """Harmonic of the rotor; zero if it is none."""
    of_hz: float = 0.0
    """The harmonic's own frequency, which differs if it is aliased."""

    @property
    def aliased(self) -> bool:
        """True if the line is above half the rate and was folded down."""
        return self.harmonic > 0 and abs(self.of_hz - self.hz) > 0.1 * self.of_hz


def lines(
    x: np.ndarray, dt: float, rotor_hz: float | None = None, logged_hz: float | None = None
) -> tuple[Line, ...]:
    """Return the vibration lines of a record, the strongest first.

    Args:
        x: samples (N,); missing ones (NaN) are interpolated.
        dt: time between samples [s].
        rotor_hz: speed of the rotor [Hz], if known.
        logged_hz: rate of the log, where frequencies folded; 1/dt by default.
    """
    from scipy.ndimage import median_filter
    from scipy.signal import detrend, welch

    n = min(x.size, max(64, round(SEGMENT / dt)))
    there = np.isfinite(x)
    if np.count_nonzero(there) < max(64, x.size // 2):
        return ()
    times = np.arange(x.size)
    x = detrend(np.interp(times, times[there], x[there]))
    hz, power = welch(x, 1.0 / dt, nperseg=n, detrend="linear")
    # Use the whole record, because motion slower than a segment is also part of the variance.
    total = float(np.var(x)) / float(hz[1])
    if not total > 0:
        return ()
    around = median_filter(power, 2 * _SURROUNDINGS + 1, mode="nearest")
    peak = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])
    peaks = np.flatnonzero(peak & (power[1:-1] > _STANDS_OUT * around[1:-1])) + 1
    rate = 1.0 / dt if logged_hz is None else logged_hz
    result = []
    for i in peaks[hz[peaks] >= _SLOWEST]:
        # Two bins on either side: the width of a line in this window.
        part = slice(max(i - 2, 0), i + 3)
        share = float(np.sum(power[part] - around[part])) / total
        if share >= SMALLEST:
            name = _harmonic(float(hz[i]), rate, rotor_hz, 1.5 * float(hz[1]))
            result.append(Line(float(hz[i]), share, *name))
    return tuple(sorted(result, key=lambda line: -line.share))


def line_words(line: Line, rotor_hz: float | None) -> str:
    """Describe a line: `24.2 Hz has 12 % of its variance (1/rev of the rotor)`."""
    share = f"{line.hz:.3g} Hz has {100 * line.share:.2g} % of its variance"
    if line.aliased:
        return f"{share} ({line.harmonic}/rev of the rotor, {line.of_hz:.4g} Hz, aliased)"
    if line.harmonic:
        return f"{share} ({line.harmonic}/rev of the rotor)"
    return f"{share} ({'no harmonic of the rotor' if rotor_hz else 'of unknown origin'})"


def _harmonic(hz: float, rate: float, rotor_hz: float | None, width: float) -> tuple[int, float]:
    """Return the rotor's harmonic at a line, and its frequency; zeros for none."""
    if rotor_hz is None:
        return 0, 0.0
    for k in range(1, _HIGHEST + 1):
        own = k * rotor_hz
        # A governor keeps the speed to a percent or two.
        there = own < 0.5 * rate or k <= _HIGHEST_FOLDED
        if there and abs(folded(own, rate) - hz) <= width + 0.01 * own:
            return k, own
    return 0, 0.0


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
