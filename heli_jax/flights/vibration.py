"""Lines of vibration in a record: which frequencies, how much of its variance, of what."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.flights.log import Channel, ChannelLog
from heli_jax.flights.marks import without_marks
from heli_jax.flights.preset import Preset, choose, fitting_presets, preset

SEGMENT = 4.0
"""s: lines of a quarter of a hertz, which a rotor's speed keeps to for so long"""
_STANDS_OUT = 20.0
"""times the median of its surroundings: noise does so once in a million bins"""
_SURROUNDINGS = 15
"""bins to either side of which the median is taken"""
SMALLEST = 0.01
"""share of the variance below which a line biases nothing"""
_SLOWEST = 4.0
"""Hz: below are the vehicle's own motion and the sticks', whose doublets have lines too"""
_HIGHEST = 12
"""harmonics of the rotor that are looked for"""
_HIGHEST_FOLDED = 4
"""those that are looked for where they fold to: of more, one would be near any line"""


class Line(NamedTuple):
    """A line of the spectrum."""

    hz: float
    share: float
    """of the variance"""
    harmonic: int = 0
    """of the rotor; zero where it is none"""
    of_hz: float = 0.0
    """the harmonic's own frequency: another one where it is aliased"""

    @property
    def aliased(self) -> bool:
        """True if the line is above half the rate and was folded down."""
        return self.harmonic > 0 and abs(self.of_hz - self.hz) > 0.1 * self.of_hz


def lines(
    x: np.ndarray, dt: float, rotor_hz: float | None = None, logged_hz: float | None = None
) -> tuple[Line, ...]:
    """The lines of a record, the strongest first.

    Args:
        x: samples (N,); NaN where one is missing, which are put on straight lines.
        dt: time between them [s].
        logged_hz: rate at which the log took it, where frequencies folded; 1/dt unless given.
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
    # Of the whole record: what is slower than a segment is part of the variance as well.
    total = float(np.var(x)) / float(hz[1])
    if not total > 0:
        return ()
    around = median_filter(power, 2 * _SURROUNDINGS + 1, mode="nearest")
    peak = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])
    peaks = np.flatnonzero(peak & (power[1:-1] > _STANDS_OUT * around[1:-1])) + 1
    rate = 1.0 / dt if logged_hz is None else logged_hz
    result = []
    for i in peaks[hz[peaks] >= _SLOWEST]:
        # Two bins to either side: as wide as the window makes a line.
        part = slice(max(i - 2, 0), i + 3)
        share = float(np.sum(power[part] - around[part])) / total
        if share >= SMALLEST:
            name = _harmonic(float(hz[i]), rate, rotor_hz, 1.5 * float(hz[1]))
            result.append(Line(float(hz[i]), share, *name))
    return tuple(sorted(result, key=lambda line: -line.share))


def line_words(line: Line, rotor_hz: float | None) -> str:
    """A line in words: `24.2 Hz has 12 % of its variance (1/rev of the rotor)`."""
    share = f"{line.hz:.3g} Hz has {100 * line.share:.2g} % of its variance"
    if line.aliased:
        return f"{share} ({line.harmonic}/rev of the rotor, {line.of_hz:.4g} Hz, aliased)"
    if line.harmonic:
        return f"{share} ({line.harmonic}/rev of the rotor)"
    return f"{share} ({'no harmonic of the rotor' if rotor_hz else 'of unknown origin'})"


def _harmonic(hz: float, rate: float, rotor_hz: float | None, width: float) -> tuple[int, float]:
    """Return the harmonic of the rotor that a line is, and this harmonic's frequency; zeros for
    none."""
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
    # Their free motion decays by exp(-omega t / (2 q)), by 1/20 in three time constants.
    return 3.0 * q / (np.pi * min(frequencies))


def slow_step(x: np.ndarray) -> int:
    """Return the usual step, in steps of the grid, between samples (N,) of a sensor that is
    slower than the grid; 1 if it is not slower."""
    steps = np.diff(np.flatnonzero(np.isfinite(x)))
    return round(float(np.median(steps))) if steps.size else 1


def notched_slow(x: np.ndarray, dt: float, frequencies: Sequence[float], q: float) -> np.ndarray:
    """As `notched`, of a sensor that is slower than the grid: by its own samples, and without the
    frequencies that it has no more; they are folded, and stay where they are.
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
    """A record (N,) without some frequencies: a causal notch for each, settled at the first sample.

    Behind missing samples the notches begin anew, and what they give until they have settled is
    missing as well.

    Args:
        x: samples (N,), NaN where one is missing.
        dt: time between them [s].
        frequencies: centres of the notches [Hz], below half the rate.
    """
    from scipy.signal import iirnotch, lfilter, lfilter_zi

    x = np.array(x)
    coefficients = [iirnotch(hz, q, 1.0 / dt) for hz in frequencies]
    unsettled = int(np.ceil(settling(frequencies, q) / dt))
    # Where samples begin and end to be there: pairs of first and last + 1.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.isfinite(x), [False]])))
    for first, last in edges.reshape(-1, 2):
        for b, a in coefficients:
            part = x[first:last]
            x[first:last] = lfilter(b, a, part, zi=lfilter_zi(b, a) * part[0])[0]
        # At the record's beginning inputs and outputs begin alike.
        if first:
            x[first : min(first + unsettled, last)] = np.nan
    return x


# Lines of vibration in an autopilot's log that knows its rotor's speed.

_TURNS = {"rpm": 1.0 / 60.0, "Hz": 1.0, "rad/s": 0.5 / np.pi}
"""turns per second of the units that presets have: pint takes a quarter of a second to load"""
_SIGNALS = (
    "roll_rate",
    "pitch_rate",
    "yaw_rate",
    "forward_force",
    "right_force",
    "down_force",
)
"""of a preset, in which a rotor shows"""
_RUNS = 0.5
"""part of the highest speed from which on the rotor is not just being started"""
_STEADY = 0.03
"""part by which the speed may differ from its median: lines of one that wanders are none"""
LEAST = 2.0 * SEGMENT
"""s of steady speed in a row"""


class SignalLines(NamedTuple):
    """The strongest lines of one channel."""

    signal: str
    """by the preset's name"""
    channel: str
    lines: tuple[Line, ...]


class RotorLines(NamedTuple):
    """Lines of vibration while the rotor's speed was steady; NaN and no signals where it never
    was for long enough."""

    channel: str
    """of the rotor's speed"""
    hz: float
    """turns per second, the mean"""
    start: float
    end: float
    """[s] from the log's beginning"""
    signals: tuple[SignalLines, ...]


def rotor_lines(log: ChannelLog) -> RotorLines | None:
    """Find the rotor's lines in the rates and specific forces of a log; None if it has none, or
    no rotor speed."""
    with np.errstate(all="ignore"):  # damage can make numbers that no sum holds
        for name in fitting_presets(log.format, log.names):
            by_preset = _by_preset(log, preset(name))
            if by_preset is not None:
                return by_preset
    return None


def _by_preset(log: ChannelLog, table: Preset) -> RotorLines | None:
    speed = choose(log, table.signals.get("rotor_speed", ()))
    if speed is None or speed.unit not in _TURNS:
        return None
    times, values = log.channel(speed.channel)
    hz = (without_marks(values) - speed.offset) * speed.scale * _TURNS[speed.unit]
    span = _steady(times, hz)
    if span is None:
        return RotorLines(speed.channel, np.nan, np.nan, np.nan, ())
    start, end = span
    rotor = float(np.nanmean(hz[(times >= start) & (times <= end)]))
    signals = []
    for signal in _SIGNALS:
        chosen = choose(log, table.signals.get(signal, ()))
        # One that is computed from others is none that a sensor shook in.
        if chosen is None or chosen.channel not in log.names:
            continue
        sampled = _evenly(log.channel(chosen.channel), start, end)
        if sampled is not None:
            signals.append(SignalLines(signal, chosen.channel, lines(*sampled, rotor)))
    if not signals:
        return None
    first = log.first_time
    return RotorLines(speed.channel, rotor, start - first, end - first, tuple(signals))


def _steady(times: np.ndarray, hz: np.ndarray) -> tuple[float, float] | None:
    """The longest time in which the rotor keeps its speed."""
    known = np.isfinite(hz) & np.isfinite(times)
    times, hz = times[known], hz[known]
    if not hz.size or not hz.max() > 0:
        return None
    usual = float(np.median(hz[hz >= _RUNS * hz.max()]))
    kept = np.concatenate([[False], np.abs(hz - usual) <= _STEADY * usual, [False]])
    parts = np.flatnonzero(np.diff(kept)).reshape(-1, 2)
    spans = [(float(times[first]), float(times[last - 1])) for first, last in parts]
    start, end = max(spans, key=lambda span: span[1] - span[0])
    return (start, end) if end - start >= LEAST else None


def _evenly(channel: Channel, start: float, end: float) -> tuple[np.ndarray, float] | None:
    """The samples (N,) of a time at even steps, and the step [s]; None where there are few."""
    values = without_marks(channel.values)
    inside = (channel.times >= start) & (channel.times <= end) & np.isfinite(values)
    times, values = channel.times[inside], values[inside]
    if times.size < 64 or np.any(np.diff(times) <= 0):
        return None
    step, length = float(np.median(np.diff(times))), float(times[-1] - times[0])
    # Mostly gaps, which straight lines would fill, or hardly begun.
    if length > 2 * step * times.size or length < 0.5 * (end - start):
        return None
    even = times[0] + step * np.arange(int(length / step))
    return np.interp(even, times, values), step
