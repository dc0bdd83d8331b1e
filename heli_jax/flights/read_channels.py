"""From signals on clocks of their own, as logs have them, to a `Flight` on one uniform grid.

The rows of a table are a topic too: its places in messages are lines, those of an autopilot's log
are times.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.as_logged import as_logged
from heli_jax.flights.flight import Flight, Source
from heli_jax.flights.grid import (
    LATEST,
    SHORTEST_STEP,
    Grid,
    Uneven,
    not_increasing,
    rounding_of,
    uniform_grid,
)
from heli_jax.flights.holds import Decision
from heli_jax.flights.log import ChannelLog, Topic
from heli_jax.flights.marks import infinite
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
from heli_jax.flights.request import Request, other_units
from heli_jax.flights.resample import Timed, is_slower, new_clock
from heli_jax.flights.table import column, sample_count, shown, wrong

_ALIKE = 1e-3
"""by which the rate of a grid and that of an output differ at most where both are one"""
_SAME = 1e-6
"""of a step, by which stamps differ at most that are one"""
_MOST_GAPS = 20
"""times the samples that there are"""
_AN_INPUT = "; an input acts all the time: fill it in, or take windows without that part"


@dataclass(frozen=True, eq=False)
class TopicClock:
    """The times of one topic inside the window.

    Attributes:
        name: of the topic.
        seconds: (N,) [s] from the log's beginning.
        rows: of the topic that they are.
        topic: itself.
    """

    name: str
    seconds: np.ndarray
    rows: slice
    topic: Topic

    @property
    def usual(self) -> float:
        """The usual step [s]."""
        return float(np.median(np.diff(self.seconds)))

    @property
    def words(self) -> str:
        return f"{self.name} at about {1 / self.usual:.4g} Hz"

    @property
    def rounding(self) -> float:
        """Rounding of the stamps [s]."""
        if self.topic.rows is None:
            return rounding_of(self.seconds)
        return rounding_of(self.topic.rows.stamps[self.rows]) * self.topic.rows.scale

    def part(self, rows: slice) -> "TopicClock":
        """Return the clock at some of its own rows."""
        first = self.rows.start
        of_topic = slice(first + rows.start, first + rows.stop)
        return replace(self, seconds=self.seconds[rows], rows=of_topic)

    def places(self, i: int) -> tuple[str, ...]:
        """Place of the i-th time: `line 12, column 't'`, or the topic of an autopilot's log."""
        if self.topic.rows is None:
            return (f"topic {shown(self.name)}",)
        return self.topic.rows.table.place(self.rows.start + i), column(self.topic.clock)

    def wrong(self, path: str, problem: str, i: int) -> InputError:
        """The error at the i-th of the times."""
        return wrong(path, f"{problem} at {self.seconds[i]:.6g} s", *self.places(i))


@dataclass(frozen=True, eq=False)
class ClockedSignal:
    """Samples (N,) in SI on the clock of a topic."""

    clock: TopicClock
    values: np.ndarray

    @property
    def timed(self) -> Timed:
        """The stamps and the samples."""
        return Timed(self.clock.seconds, self.values)


def rows_in_window(
    path: str, elapsed: np.ndarray, window: tuple[float, float] | None, *place: str
) -> slice:
    """The rows of a clock (N,) [s] inside the window."""
    first, last = 0, elapsed.size
    where = ""
    if window is not None and elapsed.size > 1:
        # The bounds are inclusive whatever the rounding of the stamps. The median and not the mean,
        # which would count the gaps.
        near = 1e-3 * float(np.median(np.diff(elapsed)))
        first = int(np.searchsorted(elapsed, window[0] - near, side="left"))
        last = int(np.searchsorted(elapsed, window[1] + near, side="right"))
        where = f" from {window[0]:g} s to {window[1]:g} s"
    if last - first < FEWEST:
        span = f"; it goes from {elapsed[0]:.6g} s to {elapsed[-1]:.6g} s" if elapsed.size else ""
        problem = f"holds {sample_count(max(last - first, 0))}{where}, expected at least {FEWEST}"
        raise wrong(path, f"{problem}{span}", *place)
    return slice(first, last)


def topic_clock(log: ChannelLog, topic: Topic, window: tuple[float, float] | None) -> TopicClock:
    """Return the times of a topic inside the window [s], finite and increasing."""
    place = () if topic.rows else (f"topic {shown(topic.name)}",)
    elapsed = topic.times - log.first_time
    if elapsed.size and not np.all(np.abs(elapsed) <= LATEST):
        raise wrong(log.path, "got times that are no finite numbers, expected a clock", *place)
    # What lies outside of the window may be as wrong as it likes: stamps that go back there do no
    # harm.
    if window is not None and np.any(np.diff(elapsed) <= 0):
        inside = np.flatnonzero((elapsed >= window[0]) & (elapsed <= window[1]))
        rows = slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)
        rows_in_window(log.path, elapsed[rows], None, *place)
    else:
        rows = rows_in_window(log.path, elapsed, window, *place)
    clock = TopicClock(topic.name, elapsed[rows], rows, topic)
    back = not_increasing(clock.seconds)
    if back is not None:
        row, fault = back
        problem = (
            f"the time {fault} after {clock.seconds[row - 1]:.6g} s, expected increasing times"
        )
        raise wrong(log.path, f"{problem}; give a window without it", *place)
    # The median and not the mean, which one long gap would lift above any limit.
    if clock.usual < SHORTEST_STEP:
        problem = "the usual step is shorter than 1 ns, expected a clock; look at the time's unit"
        raise wrong(log.path, problem, *clock.places(0))
    return clock


def signals_of(
    log: ChannelLog, request: Request
) -> tuple[dict[Key, ClockedSignal], tuple[Finding, ...]]:
    """Return the signals in SI inside the window, each on the clock of its topic, and notes."""
    clocks: dict[str, TopicClock] = {}
    numbers: dict[Key, np.ndarray] = {}
    topics: dict[str, list[Key]] = {}
    for key, signal in request.signals.items():
        topic = log.topic_of(signal.name)
        numbers[key] = log.channel(signal.name).values
        if topic.name not in clocks:
            clocks[topic.name] = topic_clock(log, topic, request.options.window)
        topics.setdefault(topic.name, []).append(key)
    notes: tuple[Finding, ...] = ()
    for name, keys in topics.items():
        inputs = {request.signals[k].name: numbers[k] for k in keys if k[1] == "input"}
        clocks[name], said = _of_known_inputs(clocks[name], inputs)
        notes += said
    of_key = {key: clocks[name] for name, keys in topics.items() for key in keys}
    signals = {key: _in_si(log, request, key, numbers[key], of_key[key]) for key in request.signals}
    return signals, notes


def _in_si(
    log: ChannelLog, request: Request, key: Key, numbers: np.ndarray, clock: TopicClock
) -> ClockedSignal:
    signal, kind, numbers = request.signals[key], key[1], numbers[clock.rows]
    with np.errstate(over="ignore"):  # what overflows is refused below
        values = signal.to_si(numbers)
    # An output may be missing here and there.
    bad = infinite(values, numbers) if kind == "output" else ~np.isfinite(values)
    if not bad.any():
        return ClockedSignal(clock, values)
    i = int(np.argmax(bad))
    more = _AN_INPUT if kind == "input" and np.isnan(numbers[i]) else ""
    if clock.topic.rows is None:
        problem = f"got {numbers[i]} at {clock.seconds[i]:.6g} s, expected a finite number{more}"
        raise wrong(log.path, problem, f"channel {shown(signal.name)}")
    table, row = clock.topic.rows.table, clock.rows.start + i
    is_derived = signal.name not in table.names
    cell = f"{numbers[i]:g}" if is_derived else table.cell_text(signal.name, row)
    problem = f"got {cell}, expected a finite number{more}"
    raise wrong(log.path, problem, table.place(row), column(signal.name))


def _of_known_inputs(
    clock: TopicClock, inputs: Mapping[str, np.ndarray]
) -> tuple[TopicClock, tuple[Finding, ...]]:
    """Leave out the rows before an input's first value or behind its last, with a note.

    An input is somewhere all the time, and where it was before its first value nobody knows: a
    table whose cells are filled with the last value begins so, with the topic that came first.
    """
    count = clock.seconds.size
    first, stop, cut = 0, count, []
    for name, numbers in inputs.items():
        known = np.flatnonzero(~np.isnan(numbers[clock.rows]))
        # Of a column without any value the first row is told.
        if known.size and known[-1] - known[0] + 1 < count:
            first, stop = max(first, int(known[0])), min(stop, int(known[-1]) + 1)
            cut.append(name)
    if not cut or stop - first < FEWEST:
        return clock, ()
    where = f"from {clock.seconds[first]:.6g} s to {clock.seconds[stop - 1]:.6g} s"
    left = count - (stop - first)
    words = f"{', '.join(map(shown, cut))}: no value before or behind, {left} rows are left out"
    said = note("windows.inputs-known", f"the flight is {where}: {words}", *cut, value=left)
    return clock.part(slice(first, stop)), (said,)


def channel_window_note(log: ChannelLog, request: Request) -> tuple[Finding, ...]:
    """Return a note where the window reaches beyond the topics that are asked for."""
    times = [log.topic_of(signal.name).times for signal in request.signals.values()]
    # The one that ends first is where the flight does.
    last = min((t for t in times if t.size > 1), key=lambda t: t[-1], default=None)
    if last is None:
        return ()
    step = float(np.median(np.diff(last)))
    return window_note(request.options.window, float(last[-1]) - log.first_time, step)


def flight_of_signals(
    signals: Mapping[Key, ClockedSignal], request: Request, source: Source
) -> Flight:
    """The flight of signals with clocks of their own.

    Topics of different clocks are resampled one by one to the rate that is asked for: inputs by
    their hold, outputs on straight lines where they are as fast as it; what is slower is missing
    between its samples.
    """
    clocks, rate = clocks_of(signals.values()), request.options.rate
    is_one = len(clocks) == 1 and (rate is None or clocks[0].topic.rows is not None)
    if is_one:
        # Before the samples are looked at: a wrong unit makes anything of their steps.
        grid = uniform_grid(clocks[0].seconds, clocks[0].rounding)
        if isinstance(grid, Uneven) and rate is None:
            raise _uneven(source.path, clocks[0], grid)
    logged = as_logged(request, {key: s.timed for key, s in signals.items()})
    values = {key: timed.values for key, timed in logged.signals.items()}
    # Before any resampling, which moves an input at more samples than the log shows it to.
    holds = decided_holds(request, values)
    values, repeated = measured_once(request, logged.signals)
    timed = {key: Timed(signals[key].clock.seconds, x) for key, x in values.items()}
    said = sample_notes(request, timed)
    if is_one:
        start, end = float(clocks[0].seconds[0]), float(clocks[0].seconds[-1])
        dt, (samples, holds, notes) = _of_one_clock(
            source.path, request, clocks[0], grid, timed, holds
        )
    else:
        signals = {key: replace(signal, values=values[key]) for key, signal in signals.items()}
        start, dt, (samples, holds, notes) = _of_several(source.path, request, signals, holds)
        end = start + dt * (next(iter(samples.values())).size - 1)
    notes = (*source.notes, *other_units(request), *logged.notes, *repeated, *said, *notes)
    rates = {n: 1.0 / s.clock.usual for (n, kind), s in signals.items() if kind == "output"}
    source = replace(source, notes=notes, rates=rates)
    return flight_of(
        request, samples, dt, source.first_time + start, holds, logged.source(source, start, end)
    )


def clocks_of(signals: Iterable[ClockedSignal]) -> list[TopicClock]:
    """One for each topic, since signals of the same topic share their stamps."""
    return list({s.clock.name: s.clock for s in signals}.values())


def on_all_the_time(signals: Mapping[Key, ClockedSignal], rate: float) -> list[TopicClock]:
    """The clocks whose samples the flight needs throughout: of the inputs, and of outputs that are
    not slower than the `rate` [Hz]; what is slower is missing most of the time anyway."""
    needed = [s for (_, kind), s in signals.items() if kind == "input"]
    needed += [
        s for (_, kind), s in signals.items() if kind == "output" and not is_slower(s.timed, rate)
    ]
    return clocks_of(needed or signals.values())


def _of_one_clock(
    path: str,
    request: Request,
    clock: TopicClock,
    grid: Grid | Uneven,
    signals: Mapping[Key, Timed],
    holds: Mapping[str, Decision],
) -> tuple[float, OnGrid]:
    """The time step, and the signals on the uniform grid with notes on how they came there."""
    seconds, rate = clock.seconds, request.options.rate
    notes: tuple[Finding, ...] = ()
    if isinstance(grid, Grid):
        # A rate that leaves the log's own grid by less than half a sample at its end is that grid:
        # the samples stay as they are, unblurred by interpolation.
        if rate is None or abs(rate * grid.dt - 1.0) * seconds.size < 0.5:
            samples = {key: signal.values for key, signal in signals.items()}
            dt = grid.dt if rate is None else 1.0 / rate
            return dt, OnGrid(samples, dict(holds), list(grid.notes))
        # The grid is better than its rounded stamps: held inputs would slip by a sample.
        seconds, notes = seconds[0] + grid.dt * np.arange(seconds.size), grid.notes
        clock = replace(clock, seconds=seconds)
    assert rate is not None  # uneven stamps without one are refused
    _require_no_gap(path, clock)
    _require_rate(path, rate, clock.usual, (seconds[-1] - seconds[0]) * rate)
    new = new_clock(seconds, rate)
    timed = {key: Timed(seconds, signal.values) for key, signal in signals.items()}
    made = at_times(request, timed, holds, new.times)
    return new.dt, made._replace(notes=[*notes, *new.notes, *made.notes])


def _of_several(
    path: str,
    request: Request,
    signals: Mapping[Key, ClockedSignal],
    holds: Mapping[str, Decision],
) -> tuple[float, float, OnGrid]:
    """First time and step [s] of the grid, and the signals on it with notes on how they came
    there."""
    rate = request.options.rate
    if rate is None:
        clocks = clocks_of(signals.values())
        slowest = min(1 / clock.usual for clock in clocks)
        words = ", ".join(clock.words for clock in clocks)
        problem = f"the signals have {len(clocks)} clocks ({words}), expected a rate to which"
        raise wrong(path, f"{problem} they are resampled, such as `rate: {slowest:.3g}`")
    clocks = on_all_the_time(signals, rate)
    notes = [n.of(c.name) for c in clocks for n in new_clock(c.seconds, rate).notes]
    for clock in clocks:
        _require_no_gap(path, clock)
    outputs = (s.clock for (_, kind), s in signals.items() if kind == "output")
    alike = next((c for c in outputs if abs(rate * c.usual - 1.0) < _ALIKE), None)
    times = common_times(path, clocks, rate, alike)
    timed = {key: signal.timed for key, signal in signals.items()}
    made = at_times(request, timed, holds, times)
    return float(times[0]), 1.0 / rate, made._replace(notes=[*notes, *made.notes])


def _uneven(path: str, clock: TopicClock, uneven: Uneven) -> InputError:
    """The error for stamps that are no uniform grid, with the remedy."""
    if uneven.drift is not None:
        problem = f"the times leave a uniform grid by {uneven.drift:.2g} samples"
    else:
        problem = f"a step of {uneven.step:.6g} s where {uneven.usual:.6g} s is usual"
    problem += f", {even_expected(clock.seconds, uneven.usual)};"
    return clock.wrong(path, problem, uneven.row)


def _require_no_gap(path: str, clock: TopicClock) -> None:
    gap = long_gap(clock.seconds)
    if gap is not None:
        problem = f"a gap of {gap.step:.6g} s, expected none longer than {gap.most:.3g} s; give a"
        problem += " window without it, or `gaps: split`; it ends"
        raise clock.wrong(path, problem, gap.row + 1)


def _require_rate(path: str, rate: float, usual: float, count: float) -> None:
    """Refuse rates [Hz] that make no sense for a log of a usual step [s]: of `count` samples."""
    # Written so that a NaN is refused too, here and below.
    if not count >= FEWEST - 1 - 1e-6:
        problem = f"a rate of {rate:g} Hz leaves fewer than {FEWEST} samples"
        raise wrong(path, f"{problem} of {max(count / rate, 0.0):.6g} s, expected more")
    # The product can overflow where the rate alone is finite.
    if not (rate * usual <= MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for a log of about {1 / usual:.4g} Hz"
        # A thousandth of such a step is one of a flight.
        unit = "; is its time in ms (time.unit)?" if 1.0 <= usual <= 1e3 else ""
        raise wrong(path, f"{problem}, expected at most {MOST_UPSAMPLING} times as much{unit}")


def common_times(
    path: str, clocks: list[TopicClock], rate: float, on: TopicClock | None = None
) -> np.ndarray:
    """Times (M,) [s] at the rate [Hz] at which all topics have samples before and behind.

    Args:
        clocks: of the topics, at least one; their times count from the log's beginning.
        rate: of the times [Hz].
        on: a clock at a sample of which they begin: one of that rate. Samples that fall on the grid
            stay as they are; a mean of two neighbours has less noise, and that is not white.
    """
    # Nothing is extrapolated: what a topic did before its first sample or behind its last nobody
    # knows.
    start = max(float(clock.seconds[0]) for clock in clocks)
    if on is not None:
        later = on.seconds[on.seconds >= start - _SAME * on.usual]
        start = max(start, float(later[0])) if later.size else start
    end = min(float(clock.seconds[-1]) for clock in clocks)
    count = (end - start) * rate
    _require_rate(path, rate, min(clock.usual for clock in clocks), count)
    # One wrong stamp at the end of a damaged log would otherwise fill the memory.
    most = _MOST_GAPS * max(clock.seconds.size * max(1.0, rate * clock.usual) for clock in clocks)
    if count > most:
        problem = f"the times go over {end - start:.6g} s, of which samples cover less than 5 %"
        raise wrong(path, f"{problem}, expected a window without such gaps")
    # Counted and multiplied, never added up: the sum of 1e6 rounded steps would drift.
    return start + np.arange(int(count + 1e-6) + 1) / rate
