"""From a table of rows, one column of which is the time, to a `Flight`."""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import Finding, sentences
from heli_jax.flights.array_table import ArrayTable
from heli_jax.flights.as_logged import as_logged
from heli_jax.flights.clock_faults import require_increasing, unit_notes
from heli_jax.flights.derived import DerivedTable, marks_of_sources, why_missing
from heli_jax.flights.file_units import other_units
from heli_jax.flights.flight import Flight, Signal, Source
from heli_jax.flights.grid import (
    LATEST,
    SHORTEST_STEP,
    Grid,
    Uneven,
    rounding_of,
    uniform_grid,
    without_overflow,
)
from heli_jax.flights.holds import Decision
from heli_jax.flights.joined import joined_log
from heli_jax.flights.known_inputs import rows_of_known_inputs
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
from heli_jax.flights.read_channels import ClockedSignal, TopicClock
from heli_jax.flights.request import Request
from heli_jax.flights.resample import new_clock
from heli_jax.flights.row_clock import ROWS, contradicted_rate, counted
from heli_jax.flights.runs import clock_scale, with_runs
from heli_jax.flights.slower import Timed
from heli_jax.flights.stacked import NUMBER
from heli_jax.flights.table import Table, column, sample_count, wrong
from heli_jax.flights.table_view import first_of_copies, seen_once
from heli_jax.flights.time_units import require_likely


@dataclass(frozen=True, eq=False)
class LoadedTable:
    """A table with the columns (N,) that are asked for, and its clock."""

    table: Table
    numbers: Mapping[str, np.ndarray]
    clock: "_Clock"

    @property
    def first_time(self) -> float:
        """Of the first stamp [s], from which windows count."""
        return float(self.clock.stamps[0] * self.clock.scale)


def load_table(table: Table, request: Request) -> LoadedTable | ChannelLog:
    """The columns that are asked for, and the clock; as topics where rows hold one topic each.

    Raises:
        InputError: a column is missing or holds no numbers, or the time is none.
    """
    if request.time is None:
        problem = "no time is stated, expected the name of the column of time stamps"
        raise wrong(table.path, problem)
    file = _below(table)
    of_stack = isinstance(file, ArrayTable) and NUMBER in file.names
    if of_stack and request.time.name == ROWS and not request.options.runs:
        problem = f"its rows are of several runs, which {NUMBER!r} numbers"
        remedy = f"expected time: {{rate: HZ, runs: {NUMBER}}}, which makes a flight of each"
        raise wrong(table.path, f"{problem}; {remedy}")
    if request.time.name == ROWS:
        table = _over(table, counted(file))
    numbers = table.numbers(request.columns)
    if request.options.split:
        table, numbers = _with_runs(table, request, numbers)
    joined = joined_log(table, request, numbers)
    if joined is not None:
        return joined
    rows = first_of_copies(numbers[request.time.name], list(numbers.values()))
    if rows is not None:
        table = _over(table, seen_once(_below(table), rows))
        numbers = table.numbers(request.columns)
    return LoadedTable(table, numbers, _clock(table, request.time, numbers[request.time.name]))


def _with_runs(
    table: Table, request: Request, numbers: dict[str, np.ndarray]
) -> tuple[Table, dict[str, np.ndarray]]:
    """The table with its runs one after another, and its columns (N,)."""
    assert request.time is not None  # or `load_table` would have refused it
    clock, runs = request.time, request.options.runs
    parted = with_runs(_below(table), clock.name, numbers, clock_scale(table, clock), runs)
    if parted is _below(table):
        return table, numbers
    whole = _over(table, parted)
    return whole, whole.numbers(request.columns)


def _below(table: Table) -> Table:
    """The file's own columns."""
    return table.table if isinstance(table, DerivedTable) else table


def _over(table: Table, other: Table) -> Table:
    """Another view of the file's columns with those derived that a table has."""
    return DerivedTable(other, table.swashplate) if isinstance(table, DerivedTable) else other


def table_window_note(loaded: LoadedTable, request: Request) -> tuple[Finding, ...]:
    """A note where the window reaches beyond the table."""
    elapsed = loaded.clock.elapsed
    step = float(np.median(np.diff(elapsed))) if elapsed.size > 1 else 0.0
    return window_note(request.options.window, float(elapsed[-1]), step)


def read_table(loaded: LoadedTable, request: Request) -> Flight:
    """The flight inside the window of `request`.

    Raises:
        InputError: one sentence on what is wrong with the table, the window or the rate.
    """
    table, clock, options = loaded.table, loaded.clock, request.options
    assert request.time is not None  # or `load_table` would have refused it
    # The window before anything else is asked of the samples: what lies outside of it may be as
    # wrong as it likes.
    with clock.hinting():
        rows, notes = _rows(table.path, clock.elapsed, options.window)
    rows, more = rows_of_known_inputs(request, loaded.numbers, clock.elapsed, rows)
    notes = (*notes, *more)
    signals = _to_si(table, request, loaded.numbers, rows)
    stamps = _Stamps(table, request.time.name, clock.elapsed[rows], rows.start)
    # Before the grid, whose rounding is a part of a step: steps of a wrong unit would make it
    # meaningless.
    _check_step(stamps)
    grid = uniform_grid(stamps.seconds, rounding_of(clock.stamps[rows]) * clock.scale)
    if isinstance(grid, Uneven) and options.rate is None:
        raise _uneven(stamps, grid)
    timed = {key: Timed(stamps.seconds, x) for key, x in signals.items()}
    logged = as_logged(request, timed, _of_sources(table, request, rows, stamps.seconds))
    signals = {key: timed.values for key, timed in logged.signals.items()}
    # Before any resampling, which moves an input at more samples than the log shows it to.
    holds = decided_holds(request, signals)
    signals, repeated = measured_once(request, logged.signals)
    with clock.hinting():
        dt, (samples, holds, more) = _on_grid(stamps, request, signals, grid, holds)
    timed = {key: Timed(stamps.seconds, x) for key, x in signals.items()}
    notes = (*table.notes, *clock.notes, *other_units(request), *notes)
    notes = (*notes, *logged.notes, *repeated, *sample_notes(request, timed), *more)
    source = Source(
        table.path,
        table.sha256,
        notes,
        cautions=clock.cautions,
        first_time=loaded.first_time,
    )
    source = logged.source(source, stamps.seconds[0], stamps.seconds[-1])
    t0 = float(clock.stamps[rows.start] * clock.scale)
    return flight_of(request, samples, dt, t0, holds, source)


def _of_sources(
    table: Table, request: Request, rows: slice, seconds: np.ndarray
) -> dict[Key, dict[str, Marked]]:
    """By signal and source the marks in these rows, at the rows' times (N,) [s]."""
    span = (rows.start, rows.stop - 1)
    sources = {}
    for key, signal in request.signals.items():
        by_source = marks_of_sources(table, signal.name, span)
        sources[key] = {
            n: marked._replace(places=seconds[marked.places - rows.start])
            for n, marked in by_source.items()
        }
    return sources


def clocked_table(loaded: LoadedTable, request: Request) -> dict[Key, ClockedSignal]:
    """The signals inside the window as those of one topic, in seconds from the first stamp.

    Raises:
        InputError: as `read_table`, but for what a uniform grid needs.
    """
    table, clock = loaded.table, loaded.clock
    assert request.time is not None  # or `load_table` would have refused it
    with clock.hinting():
        rows, _ = _rows(table.path, clock.elapsed, request.options.window)
    rows, _ = rows_of_known_inputs(request, loaded.numbers, clock.elapsed, rows)
    signals = _to_si(table, request, loaded.numbers, rows)
    stamps = _Stamps(table, request.time.name, clock.elapsed[rows], rows.start)
    _check_step(stamps)
    topic = TopicClock(Path(table.path).name, stamps.seconds, rows)
    marks = _of_sources(table, request, rows, stamps.seconds)
    return {key: ClockedSignal(topic, x, marks[key]) for key, x in signals.items()}


@dataclass(frozen=True, eq=False)
class _Clock:
    """Stamps (N,) in the log's unit, which is `scale` seconds, and the time since the first."""

    stamps: np.ndarray
    scale: float
    notes: tuple[Finding, ...] = ()
    """where the file or a name says another unit"""
    cautions: tuple[Finding, ...] = ()
    """what speaks against the times"""

    @contextlib.contextmanager
    def hinting(self) -> Iterator[None]:
        """What is said of the unit behind errors that a wrong one makes."""
        try:
            yield
        except InputError as e:
            if not self.notes:
                raise
            raise InputError("; ".join([str(e), *sentences(self.notes)])) from e

    @property
    def elapsed(self) -> np.ndarray:
        """(N,) [s], from 0; subtracted first, so that a calendar's digits do not cost any."""
        return (self.stamps - self.stamps[0]) * self.scale


@dataclass(frozen=True, eq=False)
class _Stamps:
    """The stamps (N,) that are used, in seconds from the log's first, and where they stand."""

    table: Table
    name: str
    """of their column"""
    seconds: np.ndarray
    first_row: int

    def wrong(self, problem: str, i: int) -> InputError:
        """The error for the i-th of these stamps, placed in the file's own rows."""
        place = self.table.place(self.first_row + i)
        return wrong(self.table.path, problem, place, column(self.name))


def _clock(table: Table, time: Signal, stamps: np.ndarray) -> _Clock:
    """The stamps, finite and increasing."""
    place = column(time.name)
    stated, scale = table.time_unit(time.name), clock_scale(table, time)
    # A type is unmistakable; only words may be meant for something else.
    is_sure = time.scale != 1.0 or (stated and not table.units.get(time.name))
    said = () if is_sure else unit_notes(time, stated)
    with np.errstate(over="ignore"):
        bad = np.flatnonzero(~(np.abs(stamps * scale) <= LATEST))  # NaN is bad too
    if bad.size:
        row = int(bad[0])
        problem = f"got {table.cell_text(time.name, row)}, expected a time"
        raise wrong(table.path, problem, table.place(row), place)
    stamps = without_overflow(stamps)
    require_increasing(table, time.name, stamps)
    step = float(np.median(np.diff(stamps))) * scale if stamps.size > 1 else math.inf
    cautions = contradicted_rate(table, time.name, 1.0 / step)
    if not stated and time.scale == 1.0:
        cautions += require_likely(table.path, time.name, time.unit, stamps, time.assumed)
    return _Clock(stamps, scale, said, cautions)


def _rows(
    path: str, elapsed: np.ndarray, window: tuple[float, float] | None
) -> tuple[slice, tuple[Finding, ...]]:
    """The rows inside the window, and a note where the window reaches beyond the log."""
    first, last = 0, elapsed.size
    notes: tuple[Finding, ...] = ()
    where = "the log"
    if window is not None and elapsed.size > 1:
        step = float(np.median(np.diff(elapsed)))  # the mean would count the gaps
        start, end = window
        where = f"the window from {start:g} s to {end:g} s"
        if end < 0 or start > elapsed[-1]:
            raise wrong(
                path,
                f"{where} lies outside the log, expected a part of 0 s to {elapsed[-1]:.6g} s",
            )
        notes = window_note(window, float(elapsed[-1]), step)
        # The bounds are inclusive whatever the rounding of the stamps.
        first = int(np.searchsorted(elapsed, start - 1e-3 * step, side="left"))
        last = int(np.searchsorted(elapsed, end + 1e-3 * step, side="right"))
    if last - first < FEWEST:
        count = max(last - first, 0)
        raise wrong(path, f"{where} holds {sample_count(count)}, expected at least {FEWEST}")
    return slice(first, last), notes


_Samples = dict[Key, np.ndarray]


def _to_si(
    table: Table, request: Request, numbers: Mapping[str, np.ndarray], rows: slice
) -> _Samples:
    """The signals (N,) inside the window in SI, by name and kind."""
    samples = {}
    for (key, kind), signal in request.signals.items():
        with np.errstate(over="ignore"):  # what overflows is refused below, with its line
            logged = numbers[signal.name][rows]
            values = signal.to_si(logged)
        # An output may be missing here and there; a stick is somewhere all the time.
        bad = infinite(values, logged) if kind == "output" else ~np.isfinite(values)
        bad = np.flatnonzero(bad)
        if bad.size:
            row = rows.start + int(bad[0])
            problem = f"got {table.cell_text(signal.name, row)}, expected a finite number"
            lacks = kind != "output" and bool(np.isnan(logged[bad[0]]))
            problem += why_missing(table, signal.name) or (_AN_INPUT if lacks else "")
            raise wrong(table.path, problem, table.place(row), column(signal.name))
        samples[key, kind] = values
    return samples


_AN_INPUT = "; an input acts all the time: fill it in, or take windows without that part"


def _check_step(stamps: _Stamps) -> None:
    """Refuse steps that no clock resolves: the time's unit is wrong."""
    usual = float(np.median(np.diff(stamps.seconds)))
    if usual < SHORTEST_STEP:
        problem = f"the usual step is {usual:.3g} s, expected at least 1 ns"
        raise stamps.wrong(f"{problem}; look at the time's unit", 0)


def _uneven(stamps: _Stamps, uneven: Uneven) -> InputError:
    """The error for stamps that are no uniform grid, with the remedy."""
    if uneven.drift is not None:
        problem = f"the times leave a uniform grid by {uneven.drift:.2g} samples"
    else:
        problem = f"a step of {uneven.step:.6g} s where {uneven.usual:.6g} s is usual"
    expected = even_expected(stamps.seconds, uneven.usual)
    return stamps.wrong(f"{problem}, {expected}", uneven.row)


def _on_grid(
    stamps: _Stamps,
    request: Request,
    signals: _Samples,
    grid: Grid | Uneven,
    holds: Mapping[str, Decision],
) -> tuple[float, OnGrid]:
    """The time step, and the signals on the uniform grid with notes on how they came there."""
    seconds, rate = stamps.seconds, request.options.rate
    notes: tuple[Finding, ...] = ()
    if isinstance(grid, Grid):
        if rate is None:
            return grid.dt, OnGrid(signals, dict(holds), list(grid.notes))
        # A rate that leaves the log's own grid by less than half a sample at its end is that grid:
        # the samples stay as they are, unblurred by interpolation.
        if abs(rate * grid.dt - 1.0) * seconds.size < 0.5:
            return 1.0 / rate, OnGrid(signals, dict(holds), list(grid.notes))
        # The grid is better than its rounded stamps: held inputs would slip by a sample.
        seconds, notes = seconds[0] + grid.dt * np.arange(seconds.size), grid.notes
        stamps = dataclasses.replace(stamps, seconds=seconds)
    assert rate is not None  # `read_flight` refuses uneven stamps without one
    _check_rate(stamps, rate)
    clock = new_clock(seconds, rate)
    timed = {key: Timed(seconds, x) for key, x in signals.items()}
    made = at_times(request, timed, holds, clock.times)
    return clock.dt, made._replace(notes=[*notes, *clock.notes, *made.notes])


def _check_rate(stamps: _Stamps, rate: float) -> None:
    """Refuse gaps that nothing should bridge, and rates that make no sense for the log."""
    seconds, path = stamps.seconds, stamps.table.path
    gap = long_gap(seconds)
    if gap is not None:
        raise stamps.wrong(
            f"a gap of {gap.step:.6g} s, {seconds[gap.row]:.6g} s after the first sample,"
            f" expected none longer than {gap.most:.3g} s; give a window without it,"
            " or `gaps: split`",
            gap.row + 1,
        )
    usual = float(np.median(np.diff(seconds)))
    count = (seconds[-1] - seconds[0]) * rate
    if not count >= FEWEST - 1 - 1e-6:
        problem = f"a rate of {rate:g} Hz leaves fewer than {FEWEST} samples, expected more"
        raise wrong(path, problem)
    # The product can overflow where the rate alone is finite.
    if not (rate * usual <= MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for a log of about {1 / usual:.4g} Hz"
        # A thousandth of such a step is one of a flight.
        unit = "; is its time in ms (time.unit)?" if 1.0 <= usual <= 1e3 else ""
        raise wrong(path, f"{problem}, expected at most {MOST_UPSAMPLING} times as much{unit}")
