"""From the channels of an autopilot's log to a `Flight`: each signal from its own clock."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from heli_jax.flights.flight import Flight, Source
from heli_jax.flights.grid import LATEST, SHORTEST_STEP, Uneven, rounding_of, uniform_grid
from heli_jax.flights.holds import Decision, decide
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.request import Request
from heli_jax.flights.resample import hold, longest_gap, new_clock, resampled
from heli_jax.flights.table import shown, wrong

_FEWEST = 8
"""samples of a topic"""
_MOST_UPSAMPLING = 100
"""times the fastest topic's rate: more is a slip, and fills the memory with straight lines"""

_MOST_GAPS = 20
"""times the samples that there are"""

_Key = tuple[str, str]
"""a model's name, and `input` or `output`"""


@dataclass(frozen=True, eq=False)
class TopicClock:
    """The times (N,) [s] of one topic inside the window, from the log's beginning, and its rows."""

    topic: str
    seconds: np.ndarray
    rows: slice

    @property
    def usual(self) -> float:
        """The usual step [s]."""
        return float(np.median(np.diff(self.seconds)))

    @property
    def words(self) -> str:
        return f"{self.topic} at about {1 / self.usual:.4g} Hz"


@dataclass(frozen=True, eq=False)
class _Signal:
    """Samples (N,) in SI on a clock."""

    clock: TopicClock
    values: np.ndarray


def read_channels(log: ChannelLog, request: Request) -> Flight:
    """The flight of an autopilot's log.

    Topics of different clocks are resampled one by one to the rate that is asked for: inputs by
    their hold, outputs on straight lines.

    Args:
        log: what was opened.
        request: the signals, named by their channels, and the options.

    Raises:
        InputError: a channel is missing or holds no numbers, a clock is none, the window lies
            outside the log, a rate is needed or makes no sense.
    """
    if request.time is not None:
        problem = "its topics have clocks of their own, expected no time to be stated, got "
        raise wrong(log.path, problem + shown(request.time.name))
    options = request.options
    signals = _signals(log, request)
    # Before any resampling, which moves an input at more samples than the log shows it to.
    holds = _holds(request, signals)
    start, dt, samples, notes = _on_grid(log.path, options.rate, signals, holds)
    return Flight(
        dt=dt,
        inputs=request.of_kind("input", samples),
        outputs=request.of_kind("output", samples),
        t0=log.first_time + start,
        sd=request.noise(),
        known=request.known,
        hold_out=options.hold_out,
        name=options.name,
        source=Source(log.path, log.sha256, (*log.notes, *_missing(request, signals), *notes)),
        hold={key: decision.hold for key, decision in holds.items()},
        hold_reason={key: decision.reason for key, decision in holds.items() if decision.reason},
    )


def _signals(log: ChannelLog, request: Request) -> dict[_Key, _Signal]:
    """The signals in SI inside the window, each on the clock of its topic."""
    clocks: dict[str, TopicClock] = {}
    signals = {}
    for (key, kind), signal in request.signals.items():
        topic = log.topic_of(signal.name).name
        times, values = log.channel(signal.name)
        if topic not in clocks:
            elapsed = times - log.first_time
            clocks[topic] = topic_clock(log.path, topic, elapsed, request.options.window)
        clock = clocks[topic]
        with np.errstate(over="ignore"):  # what overflows is refused below
            values = signal.to_si(values[clock.rows])
        # An output may be missing here and there; a stick is somewhere all the time.
        bad = np.flatnonzero(np.isinf(values) if kind == "output" else ~np.isfinite(values))
        if bad.size:
            at = f"channel {shown(signal.name)}"
            problem = f"got {values[bad[0]]} at {clock.seconds[bad[0]]:.6g} s"
            raise wrong(log.path, f"{problem}, expected a finite number", at)
        signals[key, kind] = _Signal(clock, values)
    return signals


def topic_clock(
    path: str, topic: str, elapsed: np.ndarray, window: tuple[float, float] | None
) -> TopicClock:
    """The times of a topic inside the window, finite and increasing.

    Args:
        path: for the message.
        topic: its name.
        elapsed: its stamps (N,) [s] from the log's beginning.
        window: first and last [s].

    Raises:
        InputError: they are no clock, or too few.
    """
    place = f"topic {shown(topic)}"
    if elapsed.size and not np.all(np.abs(elapsed) <= LATEST):
        raise wrong(path, "got times that are no finite numbers, expected a clock", place)
    first, last = 0, elapsed.size
    if window is not None:
        # The bounds are inclusive whatever the rounding of the stamps.
        inside = np.flatnonzero((elapsed >= window[0] - 1e-9) & (elapsed <= window[1] + 1e-9))
        first, last = (int(inside[0]), int(inside[-1]) + 1) if inside.size else (0, 0)
    seconds = elapsed[first:last]
    if seconds.size < _FEWEST:
        where = "" if window is None else f" from {window[0]:g} s to {window[1]:g} s"
        span = f"; it goes from {elapsed[0]:.6g} s to {elapsed[-1]:.6g} s" if elapsed.size else ""
        problem = f"holds {seconds.size} samples{where}, expected at least {_FEWEST}{span}"
        raise wrong(path, problem, place)
    steps = np.diff(seconds)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        fault = "stands still" if steps[back[0]] == 0 else "runs backwards"
        problem = f"the time {fault} after {seconds[back[0]]:.6g} s, expected increasing times"
        raise wrong(path, f"{problem}; give a window without it", place)
    # The median and not the mean, which one long gap would lift above any limit.
    if np.median(steps) < SHORTEST_STEP:
        raise wrong(path, "its steps are shorter than 1 ns, expected a clock", place)
    return TopicClock(topic, seconds, slice(first, last))


def _holds(request: Request, signals: Mapping[_Key, _Signal]) -> dict[str, Decision]:
    """What each input does between samples: as stated, or by what its own samples show."""
    holds = {}
    for (key, kind), signal in request.signals.items():
        if kind == "input":
            stated = Decision(signal.hold, "")  # no reason: the log decided nothing
            holds[key] = decide(signals[key, kind].values) if signal.hold == "auto" else stated
    return holds


def _missing(request: Request, signals: Mapping[_Key, _Signal]) -> list[str]:
    """A note for every output with missing samples."""
    notes = []
    for key, signal in signals.items():
        count = int(np.isnan(signal.values).sum())
        if count:
            name = shown(request.signals[key].name)
            notes.append(f"{count} of {signal.values.size} samples of {name} are missing")
    return notes


def _on_grid(
    path: str,
    rate: float | None,
    signals: Mapping[_Key, _Signal],
    holds: Mapping[str, Decision],
) -> tuple[float, float, dict[_Key, np.ndarray], tuple[str, ...]]:
    """First time and step [s] of the grid, the samples (N,) on it, and notes on how they came
    there."""
    # One for each topic, since signals of the same topic share their stamps.
    clocks = list({s.clock.topic: s.clock for s in signals.values()}.values())
    if rate is None:
        if len(clocks) > 1:
            slowest = min(1 / clock.usual for clock in clocks)
            words = ", ".join(clock.words for clock in clocks)
            problem = f"the signals have {len(clocks)} clocks ({words}), expected a rate to which"
            raise wrong(path, f"{problem} they are resampled, such as `rate: {slowest:.3g}`")
        dt, notes = _uniform(path, clocks[0])
        samples = {key: signal.values for key, signal in signals.items()}
        return float(clocks[0].seconds[0]), dt, samples, notes
    notes = tuple(f"{c.topic}: {note}" for c in clocks for note in new_clock(c.seconds, rate).notes)
    _require_no_gaps(path, clocks)
    times = common_times(path, clocks, rate)
    samples = {}
    for (key, kind), signal in signals.items():
        # Steps stay steps: a low-pass filter would turn a stick that jumps into one that rings.
        stays = kind == "input" and holds[key].hold == "zero-order"
        method = hold if stays else resampled
        samples[key, kind] = method(signal.clock.seconds, signal.values, times)
    return float(times[0]), 1.0 / rate, samples, notes


def _uniform(path: str, clock: TopicClock) -> tuple[float, tuple[str, ...]]:
    """The step [s] of a single topic's clock, which is a uniform grid, and notes."""
    seconds = clock.seconds
    grid = uniform_grid(seconds - seconds[0], rounding_of(seconds))
    if isinstance(grid, Uneven):
        at = f"{seconds[grid.row]:.6g} s"
        if grid.drift is not None:
            problem = f"its times leave a uniform grid by {grid.drift:.2g} samples"
        else:
            problem = f"a step of {grid.step:.6g} s before {at}, usual are {grid.usual:.6g} s"
        # Where a gap is too long to be bridged, a rate would only lead to the next error.
        bridged = np.diff(seconds).max() <= longest_gap(seconds)
        remedy = f"`rate: {1 / grid.usual:.4g}` to resample, or " if bridged else ""
        problem += f", expected a uniform grid; give {remedy}a window without such steps"
        raise wrong(path, problem, f"topic {shown(clock.topic)}")
    return grid.dt, grid.notes


def _require_no_gaps(path: str, clocks: list[TopicClock]) -> None:
    for clock in clocks:
        steps, most = np.diff(clock.seconds), longest_gap(clock.seconds)
        row = int(np.argmax(steps))
        # A step of exactly the limit, but for its rounding, passes.
        if steps[row] > most * (1 + 1e-9):
            problem = f"a gap of {steps[row]:.6g} s at {clock.seconds[row]:.6g} s, expected none"
            problem += f" longer than {most:.3g} s; give a window without it"
            raise wrong(path, problem, f"topic {shown(clock.topic)}")


def common_times(path: str, clocks: list[TopicClock], rate: float) -> np.ndarray:
    """Times (M,) [s] at the rate [Hz] at which all topics have samples before and behind.

    Args:
        path: for the message.
        clocks: of the topics, at least one; their times count from the log's beginning.
        rate: of the times [Hz].

    Raises:
        InputError: there are too few, or absurdly many.
    """
    # Nothing is extrapolated: what a topic did before its first sample or behind its last nobody
    # knows.
    start = max(float(clock.seconds[0]) for clock in clocks)
    end = min(float(clock.seconds[-1]) for clock in clocks)
    fastest = min(clock.usual for clock in clocks)
    count = (end - start) * rate
    # Written so that a NaN is refused too, here and below.
    if not count >= _FEWEST - 1 - 1e-6:
        problem = f"the topics share {max(end - start, 0.0):.6g} s, at {rate:g} Hz fewer than"
        raise wrong(path, f"{problem} {_FEWEST} samples, expected more")
    if not (rate * fastest <= _MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for topics of at most {1 / fastest:.4g} Hz"
        raise wrong(path, f"{problem}, expected at most {_MOST_UPSAMPLING} times as much")
    # One wrong stamp at the end of a damaged log would otherwise fill the memory.
    most = _MOST_GAPS * max(clock.seconds.size * max(1.0, rate * clock.usual) for clock in clocks)
    if count > most:
        problem = f"the times go over {end - start:.6g} s, of which samples cover less than 5 %"
        raise wrong(path, f"{problem}, expected a window without such gaps")
    # Counted and multiplied, never added up: the sum of 1e6 rounded steps would drift.
    return start + np.arange(int(count + 1e-6) + 1) / rate
