"""Lines of vibration in an autopilot's log that knows its rotor's speed."""

from typing import NamedTuple

import numpy as np

from heli_jax.flights.log import Channel, ChannelLog
from heli_jax.flights.marks import without_marks
from heli_jax.flights.preset import Preset, choose, fitting_presets, preset
from heli_jax.flights.vibration import SEGMENT, Line, lines

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
    """Of the rates and specific forces of a log; None where it has none, or no rotor speed."""
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
