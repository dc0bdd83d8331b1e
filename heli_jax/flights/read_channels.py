"""From the channels of an autopilot's log to a `Flight`: each signal from its own clock."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.as_logged import as_logged
from heli_jax.flights.derived import marks_of_sources, why_missing
from heli_jax.flights.file_units import other_units
from heli_jax.flights.flight import Flight, Source
from heli_jax.flights.grid import LATEST, SHORTEST_STEP, Uneven, rounding_of, uniform_grid
from heli_jax.flights.holds import Decision
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.marks import Marked, infinite
from heli_jax.flights.onto_grid import (
    FEWEST,
    MOST_UPSAMPLING,
    Key,
    OnGrid,
    at_times,
    decided_holds,
    even_expected,
    flight_of,
    long_gap,
    measured_once,
    sample_notes,
    window_note,
)
from heli_jax.flights.request import Request
from heli_jax.flights.resample import new_clock
from heli_jax.flights.slower import Timed, is_slower
from heli_jax.flights.table import sample_count, shown, wrong

_ALIKE = 1e-3
"""by which the rate of a grid and that of an output differ at most where both are one"""
_SAME = 1e-6
"""of a step, by which stamps differ at most that are one"""
_MOST_GAPS = 20
"""times the samples that there are"""


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
class ClockedSignal:
    """Samples (N,) in SI on the clock of a topic, and of a derived signal the marks that the
    channels had from which it is computed."""

    clock: TopicClock
    values: np.ndarray
    of_sources: Mapping[str, Marked] = field(default_factory=dict)

    @property
    def timed(self) -> Timed:
        """The stamps and the samples."""
        return Timed(self.clock.seconds, self.values)


def read_channels(log: ChannelLog, request: Request) -> Flight:
    """The flight of an autopilot's log.

    Topics of different clocks are resampled one by one to the rate that is asked for: inputs by
    their hold, outputs on straight lines where they are as fast as it; what is slower is missing
    between its samples.

    Args:
        log: what was opened.
        request: the signals, named by their channels, and the options.

    Raises:
        InputError: a channel is missing or holds no numbers, a clock is none, the window lies
            outside the log, a rate is needed or makes no sense.
    """
    notes = (*log.notes, *channel_window_note(log, request))
    source = Source(
        log.path, log.sha256, notes, log.firmware, log.parameters, cautions=log.cautions
    )
    return flight_of_signals(signals_of(log, request), request, source, log.first_time)


def channel_window_note(log: ChannelLog, request: Request) -> tuple[Finding, ...]:
    """A note where the window reaches beyond the topics that are asked for."""
    times = [log.topic_of(signal.name).times for signal in request.signals.values()]
    # The one that ends first is where the flight does.
    last = min((t for t in times if t.size > 1), key=lambda t: t[-1], default=None)
    if last is None:
        return ()
    step = float(np.median(np.diff(last)))
    return window_note(request.options.window, float(last[-1]) - log.first_time, step)


def flight_of_signals(
    signals: Mapping[Key, ClockedSignal], request: Request, source: Source, first_time: float
) -> Flight:
    """The flight of signals with clocks of their own.

    Args:
        signals: by key, in SI inside the window.
        request: what was asked for.
        source: where they came from, with notes on it so far.
        first_time: from which the clocks count [s], in the log's own count.

    Raises:
        InputError: a rate is needed or makes no sense, or a clock has a gap.
    """
    marks = {key: signal.of_sources for key, signal in signals.items()}
    logged = as_logged(request, {key: s.timed for key, s in signals.items()}, marks)
    values = {key: timed.values for key, timed in logged.signals.items()}
    # Before any resampling, which moves an input at more samples than the log shows it to.
    holds = decided_holds(request, values)
    timed = {key: Timed(signals[key].clock.seconds, x) for key, x in values.items()}
    values, repeated = measured_once(request, timed)
    signals = {key: replace(signal, values=values[key]) for key, signal in signals.items()}
    said = sample_notes(request, {key: signal.timed for key, signal in signals.items()})
    start, dt, (samples, holds, notes) = _on_grid(source.path, request, signals, holds)
    notes = (*source.notes, *other_units(request), *logged.notes, *repeated, *said, *notes)
    rates = {n: 1.0 / s.clock.usual for (n, kind), s in signals.items() if kind == "output"}
    source = replace(source, notes=notes, rates=rates, first_time=first_time)
    end = start + dt * (next(iter(samples.values())).size - 1)
    source = logged.source(source, start, end)
    return flight_of(request, samples, dt, first_time + start, holds, source)


def signals_of(log: ChannelLog, request: Request) -> dict[Key, ClockedSignal]:
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
            numbers = values[clock.rows]
            values = signal.to_si(numbers)
        # An output may be missing here and there; a stick is somewhere all the time.
        bad = infinite(values, numbers) if kind == "output" else ~np.isfinite(values)
        bad = np.flatnonzero(bad)
        if bad.size:
            at = f"channel {shown(signal.name)}"
            problem = f"got {values[bad[0]]} at {clock.seconds[bad[0]]:.6g} s"
            why = why_missing(log, signal.name)
            raise wrong(log.path, f"{problem}, expected a finite number{why}", at)
        span = tuple(times[clock.rows][[0, -1]])
        marks = {
            n: marked._replace(places=marked.places - log.first_time)
            for n, marked in marks_of_sources(log, signal.name, span).items()
        }
        signals[key, kind] = ClockedSignal(clock, values, marks)
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
    if seconds.size < FEWEST:
        where = "" if window is None else f" from {window[0]:g} s to {window[1]:g} s"
        span = f"; it goes from {elapsed[0]:.6g} s to {elapsed[-1]:.6g} s" if elapsed.size else ""
        problem = f"holds {sample_count(seconds.size)}{where}, expected at least {FEWEST}{span}"
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


def _on_grid(
    path: str,
    request: Request,
    signals: Mapping[Key, ClockedSignal],
    holds: Mapping[str, Decision],
) -> tuple[float, float, OnGrid]:
    """First time and step [s] of the grid, and the signals on it with notes on how they came
    there."""
    rate = request.options.rate
    clocks = clocks_of(signals.values())
    if rate is None:
        if len(clocks) > 1:
            slowest = min(1 / clock.usual for clock in clocks)
            words = ", ".join(clock.words for clock in clocks)
            problem = f"the signals have {len(clocks)} clocks ({words}), expected a rate to which"
            raise wrong(path, f"{problem} they are resampled, such as `rate: {slowest:.3g}`")
        dt, notes = _uniform(path, clocks[0])
        samples = {key: signal.values for key, signal in signals.items()}
        made = OnGrid(samples, dict(holds), list(notes))
        return float(clocks[0].seconds[0]), dt, made
    clocks = on_all_the_time(signals, rate)
    notes = [n.of(c.topic) for c in clocks for n in new_clock(c.seconds, rate).notes]
    _require_no_gaps(path, clocks)
    times = common_times(path, clocks, rate, _sampled_alike(signals, rate))
    timed = {key: signal.timed for key, signal in signals.items()}
    made = at_times(request, timed, holds, times)
    return float(times[0]), 1.0 / rate, made._replace(notes=[*notes, *made.notes])


def clocks_of(signals: Iterable[ClockedSignal]) -> list[TopicClock]:
    """One for each topic, since signals of the same topic share their stamps."""
    return list({s.clock.topic: s.clock for s in signals}.values())


def on_all_the_time(signals: Mapping[Key, ClockedSignal], rate: float) -> list[TopicClock]:
    """The clocks whose samples the flight needs throughout: of the inputs, and of outputs that are
    not slower than the `rate` [Hz]; what is slower is missing most of the time anyway."""
    needed = [s for (_, kind), s in signals.items() if kind == "input"]
    needed += [
        s for (_, kind), s in signals.items() if kind == "output" and not is_slower(s.timed, rate)
    ]
    return clocks_of(needed or signals.values())


def _uniform(path: str, clock: TopicClock) -> tuple[float, tuple[Finding, ...]]:
    """The step [s] of a single topic's clock, which is a uniform grid, and notes."""
    seconds = clock.seconds
    grid = uniform_grid(seconds - seconds[0], rounding_of(seconds))
    if isinstance(grid, Uneven):
        at = f"{seconds[grid.row]:.6g} s"
        if grid.drift is not None:
            problem = f"its times leave a uniform grid by {grid.drift:.2g} samples"
        else:
            problem = f"a step of {grid.step:.6g} s before {at}, usual are {grid.usual:.6g} s"
        problem += f", {even_expected(seconds, grid.usual)}"
        raise wrong(path, problem, f"topic {shown(clock.topic)}")
    return grid.dt, grid.notes


def _require_no_gaps(path: str, clocks: list[TopicClock]) -> None:
    for clock in clocks:
        gap = long_gap(clock.seconds)
        if gap is not None:
            problem = f"a gap of {gap.step:.6g} s at {clock.seconds[gap.row]:.6g} s, expected none"
            problem += f" longer than {gap.most:.3g} s; give a window without it, or"
            problem += " `gaps: split`"
            raise wrong(path, problem, f"topic {shown(clock.topic)}")


def _sampled_alike(signals: Mapping[Key, ClockedSignal], rate: float) -> TopicClock | None:
    """The clock of an output that was sampled at the grid's own rate [Hz], if there is one."""
    outputs = (s.clock for (_, kind), s in signals.items() if kind == "output")
    return next((c for c in outputs if abs(rate * c.usual - 1.0) < _ALIKE), None)


def common_times(
    path: str, clocks: list[TopicClock], rate: float, on: TopicClock | None = None
) -> np.ndarray:
    """Times (M,) [s] at the rate [Hz] at which all topics have samples before and behind.

    Args:
        path: for the message.
        clocks: of the topics, at least one; their times count from the log's beginning.
        rate: of the times [Hz].
        on: a clock at a sample of which they begin: one of that rate. Samples that fall on the grid
            stay as they are; a mean of two neighbours has less noise, and that is not white.

    Raises:
        InputError: there are too few, or absurdly many.
    """
    # Nothing is extrapolated: what a topic did before its first sample or behind its last nobody
    # knows.
    start = max(float(clock.seconds[0]) for clock in clocks)
    if on is not None:
        later = on.seconds[on.seconds >= start - _SAME * on.usual]
        start = max(start, float(later[0])) if later.size else start
    end = min(float(clock.seconds[-1]) for clock in clocks)
    fastest = min(clock.usual for clock in clocks)
    count = (end - start) * rate
    # Written so that a NaN is refused too, here and below.
    if not count >= FEWEST - 1 - 1e-6:
        problem = f"the topics share {max(end - start, 0.0):.6g} s, at {rate:g} Hz fewer than"
        raise wrong(path, f"{problem} {FEWEST} samples, expected more")
    if not (rate * fastest <= MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for topics of at most {1 / fastest:.4g} Hz"
        raise wrong(path, f"{problem}, expected at most {MOST_UPSAMPLING} times as much")
    # One wrong stamp at the end of a damaged log would otherwise fill the memory.
    most = _MOST_GAPS * max(clock.seconds.size * max(1.0, rate * clock.usual) for clock in clocks)
    if count > most:
        problem = f"the times go over {end - start:.6g} s, of which samples cover less than 5 %"
        raise wrong(path, f"{problem}, expected a window without such gaps")
    # Counted and multiplied, never added up: the sum of 1e6 rounded steps would drift.
    return start + np.arange(int(count + 1e-6) + 1) / rate
