"""From a log to a `Flight`: columns, units, window, clock."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import units
from heli_jax.errors import InputError
from heli_jax.flights.derived import DerivedTable, with_derived
from heli_jax.flights.flight import Flight, Signal, Source
from heli_jax.flights.grid import (
    LATEST,
    SHORTEST_STEP,
    Grid,
    Uneven,
    not_increasing,
    rounding_of,
    uniform_grid,
)
from heli_jax.flights.holds import Decision, decide
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.open_log import open_log
from heli_jax.flights.origins import with_origins, without_constants
from heli_jax.flights.read_channels import read_channels
from heli_jax.flights.request import ReadOptions, Request
from heli_jax.flights.resample import hold, longest_gap, new_clock, resampled
from heli_jax.flights.table import Table, column, shown, wrong

_FEWEST = 8
"""samples in a run"""
_MOST_UPSAMPLING = 100
"""times the log's rate: more is a slip, and fills the memory with straight lines"""
_DEFAULT = ReadOptions()


def read_flight(
    path: str | Path | ChannelLog | DerivedTable,
    *,
    time: str | Signal | None = None,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    options: ReadOptions = _DEFAULT,
    **keywords: Any,
) -> Flight:
    """Read one run from a log.

    Args:
        path: the log: a table, arrays or what an autopilot wrote (docs/logs.md); or one that is
            open, by `heli_jax.flights.derived.with_derived`.
        time: the column of time stamps, in seconds where only its name is given; None for an
            autopilot's log, whose topics have clocks of their own.
        inputs: the log's signals by the model's names; two inputs may share a column. What one
            does between samples is its `hold`; "auto" decides by how it moves in the log. One
            that the log lacks may be a `constant`.
        outputs: the same for what was measured.
        options: which part of the log, at which rate; all of it unless given.
        **keywords: fields of ReadOptions, in place of those of `options`: `rate` [Hz], `window`
            [s], `known` [SI], `hold_out`, `name`, `moving_inputs`, `number`.

    Raises:
        InputError: one sentence on what is wrong with the log or with the arguments.
        TypeError: a keyword that is no field of ReadOptions.
    """
    options = dataclasses.replace(options, **keywords)
    logged, constants = without_constants(inputs)
    # Checked before the log is opened, which may take minutes.
    name = str(path) if isinstance(path, str | Path) else path.path
    request = Request(name, time, logged, outputs, options)
    log = path
    if isinstance(log, str | Path):
        log = with_derived(open_log(log, options.number))
    if isinstance(log, ChannelLog):
        flight = read_channels(log, request)
    else:
        flight = _read_table(log, request)
    flight = with_origins(flight, inputs, outputs, constants)
    # Last, and for every kind of log alike: an input may move in the log and not within the window.
    if options.moving_inputs:
        require_moving_inputs(flight)
    return flight


def _read_table(table: Table, request: Request) -> Flight:
    """The flight of a table of rows, one column of which is the time."""
    options, path = request.options, table.path
    if request.time is None:
        raise wrong(path, "no time is stated, expected the name of the column of time stamps")
    numbers = table.numbers(request.columns)
    clock = _clock(table, request.time, numbers[request.time.name])
    # The window before anything else is asked of the samples: what lies outside of it may be as
    # wrong as it likes.
    rows, notes = _rows(path, clock.elapsed, options.window)
    signals = _to_si(table, request, numbers, rows)
    stamps = _Stamps(table, request.time.name, clock.elapsed[rows], rows.start)
    # Before the grid, whose rounding is a part of a step: steps of a wrong unit would make it
    # meaningless.
    _check_step(stamps)
    grid = uniform_grid(stamps.seconds, rounding_of(clock.stamps[rows]) * clock.scale)
    if isinstance(grid, Uneven) and options.rate is None:
        raise _uneven(stamps, grid)
    # Before any resampling, which moves an input at more samples than the log shows it to.
    holds = _holds(request, signals)
    dt, samples, more = _on_grid(stamps, options.rate, signals, grid, holds)
    return Flight(
        dt=dt,
        inputs=request.of_kind("input", samples),
        outputs=request.of_kind("output", samples),
        t0=float(clock.stamps[rows.start] * clock.scale),
        sd=request.noise(),
        known=request.known,
        hold_out=options.hold_out,
        name=options.name,
        source=Source(table.path, table.sha256, (*notes, *_missing(request, signals), *more)),
        hold={key: decision.hold for key, decision in holds.items()},
        hold_reason={key: decision.reason for key, decision in holds.items() if decision.reason},
    )


def require_moving_inputs(flight: Flight) -> None:
    """Refuse a flight in which no input moves: nothing can be learnt from it.

    Raises:
        InputError: naming the first input and the value it keeps.
    """
    path = flight.source.path if flight.source else flight.name or "flight"
    if not flight.inputs or any(x.min() != x.max() for x in flight.inputs.values()):
        return
    name, values = next(iter(flight.inputs.items()))
    others = " as do the others" if len(flight.inputs) > 1 else ""
    raise wrong(
        path,
        f"stays at {values[0]:.6g} (SI) for all of {flight.duration:.6g} s{others}, so nothing"
        " can be learnt from it; expected an input that moves",
        f"input {name!r}",
    )


@dataclass(frozen=True, eq=False)
class _Clock:
    """Stamps (N,) in the log's unit, which is `scale` seconds, and the time since the first."""

    stamps: np.ndarray
    scale: float

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
    # A column of time stamps says by its type what its ticks are, whatever the user thinks.
    scale = units.factor(table.time_unit(time.name) or time.unit, "s")
    with np.errstate(over="ignore"):
        bad = np.flatnonzero(~(np.abs(stamps * scale) <= LATEST))  # NaN is bad too
    if bad.size:
        row = int(bad[0])
        problem = f"got {table.cell_text(time.name, row)}, expected a time"
        raise wrong(table.path, problem, table.place(row), place)
    back = not_increasing(stamps)
    if back is not None:
        row, fault = back
        after, now = table.cell_text(time.name, row - 1), table.cell_text(time.name, row)
        problem = f"the time {fault}, got {now} after {after}, expected increasing times"
        raise wrong(table.path, problem, table.place(row), place)
    return _Clock(stamps, scale)


def _rows(
    path: str, elapsed: np.ndarray, window: tuple[float, float] | None
) -> tuple[slice, tuple[str, ...]]:
    """The rows inside the window, and a note where the window reaches beyond the log."""
    first, last, notes = 0, elapsed.size, ()
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
        if start < 0 or end > elapsed[-1] + step:
            notes = (f"{where} was cut to the log, which ends at {elapsed[-1]:.6g} s",)
        # The bounds are inclusive whatever the rounding of the stamps.
        first = int(np.searchsorted(elapsed, start - 1e-3 * step, side="left"))
        last = int(np.searchsorted(elapsed, end + 1e-3 * step, side="right"))
    if last - first < _FEWEST:
        count = max(last - first, 0)
        raise wrong(path, f"{where} holds {count} samples, expected at least {_FEWEST}")
    return slice(first, last), notes


_Samples = dict[tuple[str, str], np.ndarray]


def _to_si(
    table: Table, request: Request, numbers: Mapping[str, np.ndarray], rows: slice
) -> _Samples:
    """The signals (N,) inside the window in SI, by name and kind."""
    samples = {}
    for (key, kind), signal in request.signals.items():
        with np.errstate(over="ignore"):  # what overflows is refused below, with its line
            values = signal.to_si(numbers[signal.name][rows])
        # An output may be missing here and there; a stick is somewhere all the time.
        bad = np.flatnonzero(np.isinf(values) if kind == "output" else ~np.isfinite(values))
        if bad.size:
            row = rows.start + int(bad[0])
            problem = f"got {table.cell_text(signal.name, row)}, expected a finite number"
            raise wrong(table.path, problem, table.place(row), column(signal.name))
        samples[key, kind] = values
    return samples


def _holds(request: Request, signals: _Samples) -> dict[str, Decision]:
    """What each input does between samples: as stated, or by what the log itself shows."""
    holds = {}
    for (key, kind), signal in request.signals.items():
        if kind == "input":
            stated = Decision(signal.hold, "")  # no reason: the log decided nothing
            holds[key] = decide(signals[key, kind]) if signal.hold == "auto" else stated
    return holds


def _missing(request: Request, signals: _Samples) -> list[str]:
    """A note for every output with missing samples."""
    notes = []
    for (key, kind), values in signals.items():
        count = int(np.isnan(values).sum())
        if count:
            name = request.signals[key, kind].name
            notes.append(f"{count} of {values.size} samples of {shown(name)} are missing")
    return notes


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
    remedy = f"give `rate: {1 / uneven.usual:.4g}` to resample, or a window"
    # Where a gap is too long to be bridged, a rate would only lead to the next error.
    if np.diff(stamps.seconds).max() > longest_gap(stamps.seconds):
        remedy = "give a window"
    expected = f"expected a uniform grid; {remedy} without such steps"
    return stamps.wrong(f"{problem}, {expected}", uneven.row)


def _on_grid(
    stamps: _Stamps,
    rate: float | None,
    signals: _Samples,
    grid: Grid | Uneven,
    holds: Mapping[str, Decision],
) -> tuple[float, _Samples, tuple[str, ...]]:
    """The time step, the signals on the uniform grid, and notes on how they came there."""
    seconds = stamps.seconds
    notes: tuple[str, ...] = ()
    if isinstance(grid, Grid):
        if rate is None:
            return grid.dt, signals, grid.notes
        # A rate that leaves the log's own grid by less than half a sample at its end is that grid:
        # the samples stay as they are, unblurred by interpolation.
        if abs(rate * grid.dt - 1.0) * seconds.size < 0.5:
            return 1.0 / rate, signals, grid.notes
        # The grid is better than its rounded stamps: held inputs would slip by a sample.
        seconds, notes = seconds[0] + grid.dt * np.arange(seconds.size), grid.notes
        stamps = dataclasses.replace(stamps, seconds=seconds)
    assert rate is not None  # `read_flight` refuses uneven stamps without one
    _check_rate(stamps, rate)
    clock = new_clock(seconds, rate)
    samples = {}
    for (key, kind), x in signals.items():
        stays = kind == "input" and holds[key].hold == "zero-order"
        samples[key, kind] = (hold if stays else resampled)(seconds, x, clock.times)
    return clock.dt, samples, notes + clock.notes


def _check_rate(stamps: _Stamps, rate: float) -> None:
    """Refuse gaps that nothing should bridge, and rates that make no sense for the log."""
    seconds, path = stamps.seconds, stamps.table.path
    steps = np.diff(seconds)
    row, most = int(np.argmax(steps)), longest_gap(seconds)
    if steps[row] > most * (1 + 1e-9):  # a step of exactly the limit, but for its rounding, passes
        raise stamps.wrong(
            f"a gap of {steps[row]:.6g} s, {seconds[row]:.6g} s after the first sample,"
            f" expected none longer than {most:.3g} s; give a window without it",
            row + 1,
        )
    usual = float(np.median(steps))
    count = (seconds[-1] - seconds[0]) * rate
    if not count >= _FEWEST - 1 - 1e-6:
        problem = f"a rate of {rate:g} Hz leaves fewer than {_FEWEST} samples, expected more"
        raise wrong(path, problem)
    # The product can overflow where the rate alone is finite.
    if not (rate * usual <= _MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for a log of about {1 / usual:.4g} Hz"
        raise wrong(path, f"{problem}, expected at most {_MOST_UPSAMPLING} times as much")
