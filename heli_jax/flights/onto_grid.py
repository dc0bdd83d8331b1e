"""Resampling of signals on separate clocks to a `Flight` on one uniform grid.

The rows of a table are a topic too. Messages place a fault by line in a table, and by time in an
autopilot's log.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.as_logged import as_logged
from heli_jax.flights.flight import Flight, Source
from heli_jax.flights.grid import (
    LATEST,
    Grid,
    Uneven,
    clock_fault,
    rounding_of,
    uniform_grid,
)
from heli_jax.flights.holds import LOW_PASSED, Decision, decide, low_passed
from heli_jax.flights.log import ChannelLog, Topic, column, sample_count, shown, wrong
from heli_jax.flights.marks import infinite, repeats_removed
from heli_jax.flights.request import FEWEST, Key, Request, other_units
from heli_jax.flights.resample import (
    OWN,
    Timed,
    at_nearest,
    at_own_rate,
    goes_down,
    held_low_passed,
    held_mean,
    held_until_jumps,
    hold,
    in_gaps,
    interpolate,
    is_slower,
    longest_gap,
    own_clock,
    rate_notes,
    resampled,
    usual_step,
    with_lost,
)

MOST_UPSAMPLING = 100
"""Largest ratio of the requested rate to the log's; more is a slip and fills the memory."""
_ALIKE = 1e-3
"""Largest relative difference between two rates that count as equal."""
_SAME = 1e-6
"""Largest difference between two stamps that count as equal [steps]."""
_MOST_GAPS = 20
"""Largest ratio of grid instants to samples."""
_AN_INPUT = (
    "; an input needs a value at every sample: fill it in, or choose windows without that part"
)


# Clocks of a log's topics, and the signals on them.


@dataclass(frozen=True, eq=False)
class TopicClock:
    """Times of one topic inside the window.

    Attributes:
        name: name of the topic.
        seconds: (N,) [s] from the log's beginning.
        rows: rows of the topic at these times.
        topic: the topic itself.
    """

    name: str
    seconds: np.ndarray
    rows: slice
    topic: Topic

    @property
    def usual(self) -> float:
        """Median step [s]."""
        return float(np.median(np.diff(self.seconds)))

    @property
    def words(self) -> str:
        return f"{self.name} at about {1 / self.usual:.4g} Hz"

    def part(self, rows: slice) -> "TopicClock":
        """Return the clock at some of its own rows."""
        first = self.rows.start
        of_topic = slice(first + rows.start, first + rows.stop)
        return replace(self, seconds=self.seconds[rows], rows=of_topic)

    def grid(self) -> Grid | Uneven:
        """Return the uniform grid of the stamps, or `Uneven`."""
        rounding, table = rounding_of(self.seconds), self.topic.rows
        if table is not None:
            rounding = rounding_of(table.stamps[self.rows]) * table.scale
        return uniform_grid(self.seconds, rounding)

    def wrong(self, path: str, problem: str, i: int) -> InputError:
        """Return the error at the i-th time, with the line of a table or the topic's name."""
        places = (f"topic {shown(self.name)}",)
        if (rows := self.topic.rows) is not None:
            places = rows.table.place(self.rows.start + i), column(self.topic.clock)
        return wrong(path, f"{problem} at {self.seconds[i]:.6g} s", *places)


@dataclass(frozen=True, eq=False)
class ClockedSignal:
    """Samples (N,) in SI on the clock of a topic."""

    clock: TopicClock
    values: np.ndarray

    @property
    def timed(self) -> Timed:
        """Stamps and samples."""
        return Timed(self.clock.seconds, self.values)


def rows_in_window(
    path: str, elapsed: np.ndarray, window: tuple[float, float] | None, *place: str
) -> slice:
    """Return the rows of a clock (N,) [s] inside the window."""
    first, last = 0, elapsed.size
    where = ""
    if window is not None and elapsed.size > 1:
        # A tolerance keeps the bounds inclusive despite rounded stamps. It uses the median, because
        # gaps change the mean.
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
        raise wrong(log.path, "the times are not finite numbers, expected a clock", *place)
    # Stamps that go back outside the window do no harm.
    if window is not None and np.any(np.diff(elapsed) <= 0):
        inside = np.flatnonzero((elapsed >= window[0]) & (elapsed <= window[1]))
        rows = slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)
        rows_in_window(log.path, elapsed[rows], None, *place)
    else:
        rows = rows_in_window(log.path, elapsed, window, *place)
    clock = TopicClock(topic.name, elapsed[rows], rows, topic)
    if (found := clock_fault(clock.seconds)) is not None:
        row, fault = found
        problem = f"the time {fault} after {clock.seconds[max(row - 1, 0)]:.6g} s"
        raise wrong(
            log.path, f"{problem}, expected increasing times; choose another window", *place
        )
    return clock


def signals_of(log: ChannelLog, request: Request) -> dict[Key, ClockedSignal]:
    """Return the signals in SI inside the window, each on the clock of its topic."""
    clocks: dict[str, TopicClock] = {}
    signals = {}
    for key, signal in request.signals.items():
        topic, channel = log.topic_of(signal.name), log.channel(signal.name)
        if topic.name not in clocks:
            clocks[topic.name] = topic_clock(log, topic, request.options.window)
        signals[key] = _in_si(log, request, key, channel.values, clocks[topic.name])
    return signals


def _in_si(
    log: ChannelLog, request: Request, key: Key, numbers: np.ndarray, clock: TopicClock
) -> ClockedSignal:
    signal, kind, numbers = request.signals[key], key[1], numbers[clock.rows]
    with np.errstate(over="ignore"):  # overflow is refused below
        values = signal.to_si(numbers)
    # An output may have missing samples.
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


def window_note(
    window: tuple[float, float] | None, times: Iterable[np.ndarray], begin: float
) -> tuple[Finding, ...]:
    """Return a note if the window exceeds the clocks (N,) of a log that begins at `begin` [s]."""
    # The flight ends with the clock that ends first.
    last = min((t for t in times if t.size > 1), key=lambda t: t[-1], default=None)
    if window is None or last is None:
        return ()
    end, step = float(last[-1]) - begin, float(np.median(np.diff(last)))
    if window[0] >= 0 and window[1] <= end + 1.001 * step:
        return ()
    words = f"the window from {window[0]:g} s to {window[1]:g} s was cut to the log"
    return (note("windows.cut", f"{words}, which ends at {end:.6g} s", value=end),)


# Signals on one grid.


def flight_of_signals(
    signals: Mapping[Key, ClockedSignal], request: Request, source: Source
) -> Flight:
    """Make a flight from signals with separate clocks.

    A table that is already a uniform grid of the requested rate keeps its samples. Otherwise,
    signals are resampled: inputs by their hold, outputs linearly if they are as fast as the rate. A
    slower output is missing (NaN) between its samples.
    """
    clocks, rate, path = clocks_of(signals.values()), request.options.rate, source.path
    grid = None
    if len(clocks) == 1 and (rate is None or clocks[0].topic.rows is not None):
        # Checked before the samples, because a wrong unit of time distorts their steps.
        grid = clocks[0].grid()
        if isinstance(grid, Uneven) and rate is None:
            raise _uneven(path, clocks[0], grid)
    logged = as_logged(request, {key: s.timed for key, s in signals.items()})
    values = {key: timed.values for key, timed in logged.signals.items()}
    # Before any resampling, which makes an input move at more samples than the log shows.
    holds = holds_of_inputs(request, values)
    outputs = request.of_kind("output", values)
    stated = {name: request.signals[name, "output"].repeats for name in outputs}
    once, repeated = repeats_removed(outputs, stated)
    values |= {(name, "output"): y for name, y in once.items()}
    signals = {key: replace(s, values=values[key]) for key, s in signals.items()}
    notes = [*other_units(request), *logged.notes, *repeated, *_missing(request, signals)]
    # If the rate differs from the log's grid by less than half a sample at the end, it is the same
    # grid. The samples then stay free of interpolation.
    start, end = float(clocks[0].seconds[0]), float(clocks[0].seconds[-1])
    if isinstance(grid, Grid) and (
        rate is None or abs(rate * grid.dt - 1.0) * clocks[0].seconds.size < 0.5
    ):
        dt = grid.dt if rate is None else 1.0 / rate
        made = OnGrid(values, holds, list(grid.notes))
    else:
        if rate is None:
            raise _several(path, clocks)
        if isinstance(grid, Grid):
            # The grid is more exact than its rounded stamps, by which held inputs would slip by a
            # sample.
            even = start + grid.dt * np.arange(clocks[0].seconds.size)
            clock = replace(clocks[0], seconds=even)
            signals = {key: replace(s, clock=clock) for key, s in signals.items()}
            notes += grid.notes
        times, of_rate = _times(path, signals, rate)
        notes += of_rate
        made = at_times(request, {key: s.timed for key, s in signals.items()}, holds, times)
        start, dt = float(times[0]), 1.0 / rate
        end = end if len(clocks) == 1 else float(times[-1])
    source = replace(
        source,
        notes=(*source.notes, *notes, *made.notes),
        facts={key: f.within(start, end) for key, f in logged.facts.items()},
    )
    return Flight(
        dt=dt,
        inputs=request.of_kind("input", made.samples),
        outputs=request.of_kind("output", made.samples),
        t0=source.first_time + start,
        sd=request.noise(),
        known=request.known,
        hold_out=request.options.hold_out,
        name=request.options.name,
        source=source,
        hold={key: decision.hold for key, decision in made.holds.items()},
        hold_reason={key: d.reason for key, d in made.holds.items() if d.reason},
    )


def holds_of_inputs(request: Request, values: Mapping[Key, np.ndarray]) -> dict[str, Decision]:
    """Decide the hold of each input: as stated, or by its own samples (N,)."""
    return {
        # A stated hold has no reason.
        key: decide(values[key, kind]) if signal.hold == "auto" else Decision(signal.hold, "")
        for (key, kind), signal in request.signals.items()
        if kind == "input"
    }


def _missing(request: Request, signals: Mapping[Key, ClockedSignal]) -> list[Finding]:
    """Return a note for every output with missing samples: how many, and where in the log."""
    notes = []
    for key, signal in signals.items():
        missing = np.isnan(signal.values)
        if not missing.any():
            continue
        count, seconds = int(missing.sum()), signal.clock.seconds[missing]
        runs = int(missing[0]) + int(np.count_nonzero(missing[1:] & ~missing[:-1]))
        words = f"{count} of {missing.size} samples of {shown(request.signals[key].name)} are"
        places = "one place" if runs == 1 else f"{runs} places"
        words += f" missing, in {places} from {seconds[0]:.6g} s to {seconds[-1]:.6g} s"
        notes.append(note("samples.missing", words, key[0], value=count))
    return notes


def clocks_of(signals: Iterable[ClockedSignal]) -> list[TopicClock]:
    """Return one clock for each topic, because signals of a topic share their stamps."""
    return list({s.clock.name: s.clock for s in signals}.values())


def fast_clocks(signals: Mapping[Key, ClockedSignal], rate: float) -> list[TopicClock]:
    """Return the clocks of inputs and of outputs not slower than `rate` [Hz].

    The flight needs their samples throughout; slower outputs are missing most of the time anyway.
    """
    needed = [s for (_, kind), s in signals.items() if kind == "input"]
    needed += [
        s for (_, kind), s in signals.items() if kind == "output" and not is_slower(s.timed, rate)
    ]
    return clocks_of(needed or signals.values())


def _times(
    path: str, signals: Mapping[Key, ClockedSignal], rate: float
) -> tuple[np.ndarray, list[Finding]]:
    """Return the times (M,) [s] of a grid of a rate [Hz], and notes on the resampling."""
    clocks, notes = fast_clocks(signals, rate), []
    for clock in clocks:
        found = rate_notes(clock.seconds, rate)
        notes += [n.of(clock.name) if clock.topic.rows is None else n for n in found]
        steps, most = np.diff(clock.seconds), longest_gap(clock.seconds)
        row = int(np.argmax(steps))
        # Rounding is tolerated for a step of exactly the limit.
        if steps[row] > most * (1 + 1e-9):
            problem = f"a gap of {steps[row]:.6g} s, expected at most {most:.3g} s; give a"
            problem += " window without it, or `gaps: split`; it ends"
            raise clock.wrong(path, problem, row + 1)
    outputs = (s.clock for (_, kind), s in signals.items() if kind == "output")
    alike = next((c for c in outputs if abs(rate * c.usual - 1.0) < _ALIKE), None)
    return common_times(path, clocks, rate, alike), notes


def _uneven(path: str, clock: TopicClock, uneven: Uneven) -> InputError:
    """Return the error for stamps that are no uniform grid, with the remedy."""
    problem = f"a step of {uneven.step:.6g} s where {uneven.usual:.6g} s is usual"
    if uneven.drift is not None:
        problem = f"the times deviate from a uniform grid by {uneven.drift:.2g} samples"
    remedy = f"`rate: {1 / uneven.usual:.4g}` to resample, `gaps: split`, or a window without them"
    return clock.wrong(path, f"{problem}, expected a uniform grid; give {remedy};", uneven.row)


def _several(path: str, clocks: Sequence[TopicClock]) -> InputError:
    slowest = min(1 / clock.usual for clock in clocks)
    words = ", ".join(clock.words for clock in clocks)
    problem = f"the signals have {len(clocks)} clocks ({words}), expected a rate for resampling"
    return wrong(path, f"{problem}, such as `rate: {slowest:.3g}`")


def common_times(
    path: str, clocks: list[TopicClock], rate: float, on: TopicClock | None = None
) -> np.ndarray:
    """Return times (M,) [s] at the rate [Hz] at which all topics have samples before and after.

    Args:
        clocks: clocks of the topics, at least one; their times count from the log's beginning.
        rate: rate of the times [Hz].
        on: clock of the same rate, with a sample at which the times begin. Its samples then stay as
            they are. A mean of two neighbours has less noise, and that noise is not white.
    """
    # No extrapolation: a topic is unknown before its first sample and after its last.
    start = max(float(clock.seconds[0]) for clock in clocks)
    if on is not None:
        later = on.seconds[on.seconds >= start - _SAME * on.usual]
        start = max(start, float(later[0])) if later.size else start
    end = min(float(clock.seconds[-1]) for clock in clocks)
    count, usual = (end - start) * rate, min(clock.usual for clock in clocks)
    # Written so that NaN is refused too, here and below.
    if not count >= FEWEST - 1 - 1e-6:
        problem = f"a rate of {rate:g} Hz leaves fewer than {FEWEST} samples"
        raise wrong(path, f"{problem} of {max(count / rate, 0.0):.6g} s, expected more")
    # The product can overflow even if the rate is finite.
    if not (rate * usual <= MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for a log of about {1 / usual:.4g} Hz"
        # A thousandth of such a step is plausible for a flight.
        unit = "; is its time in ms (time.unit)?" if 1.0 <= usual <= 1e3 else ""
        raise wrong(path, f"{problem}, expected at most {MOST_UPSAMPLING} times as much{unit}")
    # Otherwise one wrong stamp at the end of a damaged log would fill the memory.
    most = _MOST_GAPS * max(clock.seconds.size * max(1.0, rate * clock.usual) for clock in clocks)
    if count > most:
        problem = f"the times cover {end - start:.6g} s, but samples cover less than 5 % of it"
        raise wrong(path, f"{problem}, expected a window without such gaps")
    # Multiplied, not summed: the sum of 1e6 rounded steps would drift.
    return start + np.arange(int(count + 1e-6) + 1) / rate


class OnGrid(NamedTuple):
    """Signals on a grid: samples (M,) by key, hold of each input, and notes."""

    samples: dict[Key, np.ndarray]
    holds: dict[str, Decision]
    notes: list[Finding]


def at_times(
    request: Request,
    signals: Mapping[Key, Timed],
    holds: Mapping[str, Decision],
    times: np.ndarray,
) -> OnGrid:
    """Return the signals on a grid.

    A held input is averaged from one instant to the next. A mixed one jumps at the instant nearest
    to its jump. Other inputs and the outputs are interpolated, or low-pass filtered if the rate
    decreases. Samples of outputs slower than the grid go to their nearest instants. If a low-passed
    output follows a held input within a sample, the input is low-passed too. It is then linear
    between samples.

    Args:
        signals: signals by key, SI, each on its own clock.
        holds: hold by input.
        times: times of the grid (M,) [s].
    """
    samples, notes, rate = {}, [], 1.0 / float(times[1] - times[0])
    # Linear inputs have their lines by interpolation.
    signals = {
        (n, kind): Timed(*with_lost(*s)) if kind == "input" and holds[n].hold != "linear" else s
        for (n, kind), s in signals.items()
    }
    alike = _alike(request, signals, holds, times)
    # Input and output need the same filter. If only the output is filtered, its ringing after jumps
    # would be attributed to the vehicle.
    low = {n: held_low_passed(*signals[n, "input"], times) for n in alike}
    for (key, kind), signal in signals.items():
        if kind == "input":
            if holds[key].hold == "mixed" and not goes_down(signal.seconds, times):
                samples[key, kind] = held_until_jumps(*signal, times)
            elif holds[key].hold != "zero-order":
                made = resampled(*signal, times)
                # A filter leaves out a short gap, but an input acts all the time.
                made = np.where(np.isnan(made), interpolate(*signal, times), made)
                samples[key, kind] = made
            elif key in alike:
                samples[key, kind] = low[key]
                outputs = ", ".join(alike[key])
                follow = "follow" if len(alike[key]) > 1 else "follows"
                words = (
                    f"{key} is also low-passed and taken as linear between samples, because "
                    f"{outputs} {follow} it within a sample and is low-passed"
                )
                notes.append(note(LOW_PASSED, words, key))
            else:
                # A low-pass filter would add ringing to a stick that jumps.
                samples[key, kind] = held_mean(*signal, times)
        elif is_slower(signal, rate):
            samples[key, kind] = at_nearest(signal, times)
            count = int(np.count_nonzero(np.isfinite(samples[key, kind])))
            words = (
                f"{shown(request.signals[key, kind].name)} at about "
                f"{1 / usual_step(own_clock(signal).seconds):.4g} Hz is slower than the grid of "
                f"{rate:.6g} Hz: its {count} samples are placed at the nearest instants, and the "
                "others are missing"
            )
            notes.append(note("resampling.slower", words, key, value=count))
        else:
            own = own_clock(signal)
            # `own` lacks the missing rows, so gaps are found here.
            gaps = in_gaps(own.seconds, times) if own is not signal else False
            jumps = [n for n in alike if request.options.follows.get((n, key))]
            if jumps:
                inputs = [(signals[n, "input"], low[n]) for n in jumps]
                made = _resampled_with(own, inputs, times)
            elif usual_step(own.seconds) * rate > OWN or goes_down(own.seconds, times):
                made = resampled(*own, times)
            else:
                made = at_own_rate(own, times)
            samples[key, kind] = np.where(gaps, np.nan, made)
    decided = {n: low_passed(alike[n]) if n in alike else d for n, d in holds.items()}
    # A low-passed signal has no jumps.
    decided |= {
        n: d._replace(hold="linear")
        for n, d in holds.items()
        if d.hold == "mixed" and goes_down(signals[n, "input"].seconds, times)
    }
    return OnGrid(samples, decided, notes)


def _alike(
    request: Request,
    signals: Mapping[Key, Timed],
    holds: Mapping[str, Decision],
    times: np.ndarray,
) -> dict[str, list[str]]:
    """Return the held inputs to be filtered, with the filtered outputs that follow them.

    An output follows an input if it responds within a sample of the grid (M,) [s].
    """
    alike: dict[str, list[str]] = {}
    for name, output in request.options.follows:
        held = name in holds and holds[name].hold == "zero-order"
        signal = signals.get((output, "output"))
        if held and signal is not None and goes_down(own_clock(signal).seconds, times):
            alike.setdefault(name, []).append(output)
    return alike


def _resampled_with(
    signal: Timed, inputs: Sequence[tuple[Timed, np.ndarray]], times: np.ndarray
) -> np.ndarray:
    """Low-pass an output (M,) that jumps with inputs.

    The jump is taken from the inputs, scaled by least squares, because it is known at all times.
    The output's samples alone would put it half a step early.

    Args:
        inputs: held inputs that the output follows without delay, each with the result of
            `held_low_passed`.
        times: (M,) [s].
    """
    seconds, values = signal
    held = np.array([hold(*u, np.maximum(seconds, u.seconds[0])) for u, _ in inputs])
    moves = np.diff(values)
    known = np.isfinite(moves)
    # The minimum-norm solution gives a gain of zero to an input that never jumps.
    gains = np.linalg.lstsq(np.diff(held)[:, known].T, moves[known], rcond=None)[0]
    jumping = gains @ np.array([low for _, low in inputs])
    return resampled(seconds, values - gains @ held, times) + jumping
