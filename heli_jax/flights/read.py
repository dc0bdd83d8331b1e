"""From a log to a `Flight`: columns, units, window, clock."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heli_jax import units
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
from heli_jax.flights.open_log import open_table
from heli_jax.flights.request import Request
from heli_jax.flights.resample import hold, interpolate, longest_gap, new_clock
from heli_jax.flights.table import Table, column, shown, wrong

_FEWEST = 8
_MOST_UPSAMPLING = 100


def read_flight(
    path: str | Path,
    *,
    time: str | Signal,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    rate: float | None = None,
    window: tuple[float, float] | None = None,
    known: Mapping[str, float] | None = None,
    hold_out: bool = False,
    name: str = "",
    moving_inputs: bool = True,
) -> Flight:
    """Read one run from a log in CSV or Parquet.

    Args:
        path: the log, ending in .csv, .txt, .tsv or .parquet.
        time: the column of time stamps, in seconds where only its name is given.
        inputs: the log's signals by the model's names; two inputs may share a column. What one
            does between samples is its `hold`; "auto" decides by how it moves in the log.
        outputs: the same for what was measured.
        rate: resample to this rate [Hz]. Without it the stamps must be a uniform grid.
        window: first and last time to use [s], counted from the log's first sample.
        known: parameters that differ in this run, SI.
        hold_out: whether the run serves for validation alone.
        name: what to call the run.
        moving_inputs: whether a run in which no input ever moves is refused.

    Raises:
        InputError: one sentence on what is wrong with the log or with the arguments.
    """
    request = Request(str(path), time, inputs, outputs, rate, window, known or {})
    table = open_table(path)
    numbers = table.numbers(request.columns)
    clock = _clock(table, request.time, numbers[request.time.name])
    seconds = clock.elapsed
    rows, notes = _rows(table.path, seconds, window)
    signals = _to_si(table, request, numbers, rows)
    _check_step(table, request.time.name, seconds[rows], rows.start)
    grid = uniform_grid(seconds[rows], rounding_of(clock.stamps[rows]) * clock.scale)
    if isinstance(grid, Uneven) and rate is None:
        raise _uneven(table, request.time.name, seconds[rows], rows.start, grid)
    holds = _holds(request, signals)
    dt, samples, more = _on_grid(table, request, seconds, rows, signals, grid, holds)
    flight = Flight(
        dt=dt,
        inputs={key: samples[key, "input"] for key in inputs},
        outputs={key: samples[key, "output"] for key in outputs},
        t0=float(clock.stamps[rows.start] * clock.scale),
        sd=request.noise(),
        known=dict(request.known),
        hold_out=hold_out,
        name=name,
        source=Source(table.path, table.sha256, (*notes, *_missing(request, signals), *more)),
        hold={key: one.hold for key, one in holds.items()},
        hold_reason={key: one.reason for key, one in holds.items() if one.reason},
    )
    if moving_inputs:
        require_moving_inputs(flight)
    return flight


def require_moving_inputs(flight: Flight) -> None:
    """Refuse a flight in which no input moves: nothing can be learnt from it.

    Raises:
        InputError: naming the first input and the value it keeps.
    """
    path = flight.source.path if flight.source else flight.name or "flight"
    if any(values.min() != values.max() for values in flight.inputs.values()):
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


def _clock(table: Table, time: Signal, stamps: np.ndarray) -> _Clock:
    """The stamps, finite and increasing."""
    place = column(time.name)
    scale = units.factor(table.time_unit(time.name) or time.unit, "s")
    with np.errstate(over="ignore"):
        bad = np.flatnonzero(~(np.abs(stamps * scale) <= LATEST))  # NaN is bad too
    if bad.size:
        row = int(bad[0])
        found = f"got {table.found(time.name, row)}, expected a time"
        raise wrong(table.path, found, table.place(row), place)
    back = not_increasing(stamps)
    if back is not None:
        row, what = back
        after, now = table.found(time.name, row - 1), table.found(time.name, row)
        problem = f"the time {what}, got {now} after {after}, expected increasing times"
        raise wrong(table.path, problem, table.place(row), place)
    return _Clock(stamps, scale)


def _rows(
    path: str, elapsed: np.ndarray, window: tuple[float, float] | None
) -> tuple[slice, tuple[str, ...]]:
    """The rows inside the window, and a note where the window reaches beyond the log."""
    first, last, notes = 0, elapsed.size, ()
    where = "the log"
    if window is not None and elapsed.size > 1:
        step = float(np.median(np.diff(elapsed)))
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
        with np.errstate(over="ignore"):
            values = numbers[signal.name][rows] * units.factor(signal.unit, signal.si)
        # An output may be missing here and there; a stick is somewhere all the time.
        bad = np.flatnonzero(np.isinf(values) if kind == "output" else ~np.isfinite(values))
        if bad.size:
            row = rows.start + int(bad[0])
            found = f"got {table.found(signal.name, row)}, expected a finite number"
            raise wrong(table.path, found, table.place(row), column(signal.name))
        samples[key, kind] = values
    return samples


def _holds(request: Request, signals: _Samples) -> dict[str, Decision]:
    """What each input does between samples: as stated, or by what the log itself shows."""
    found = {}
    for (key, kind), signal in request.signals.items():
        if kind == "input":
            given = Decision(signal.hold, "")
            found[key] = decide(signals[key, kind]) if signal.hold == "auto" else given
    return found


def _missing(request: Request, signals: _Samples) -> list[str]:
    """A note for every output with missing samples."""
    found = []
    for (key, kind), values in signals.items():
        count = int(np.isnan(values).sum())
        if count:
            name = request.signals[key, kind].name
            found.append(f"{count} of {values.size} samples of {shown(name)} are missing")
    return found


def _check_step(table: Table, name: str, seconds: np.ndarray, start: int) -> None:
    """Refuse steps that no clock resolves: the time's unit is wrong."""
    usual = float(np.median(np.diff(seconds)))
    if usual < SHORTEST_STEP:
        problem = (
            f"the usual step is {usual:.3g} s, expected at least 1 ns; look at the time's unit"
        )
        raise wrong(table.path, problem, table.place(start), column(name))


def _uneven(table: Table, name: str, seconds: np.ndarray, start: int, uneven: Uneven) -> ValueError:
    """The error for stamps that are no uniform grid, with the remedy."""
    place = table.place(start + uneven.row)
    if uneven.drift is not None:
        problem = f"the times leave a uniform grid by {uneven.drift:.2g} samples"
    else:
        problem = f"a step of {uneven.step:.6g} s where {uneven.usual:.6g} s is usual"
    remedy = f"give `rate: {1 / uneven.usual:.4g}` to resample, or a window"
    if np.diff(seconds).max() > longest_gap(seconds):
        remedy = "give a window"
    wanted = f"expected a uniform grid; {remedy} without such steps"
    return wrong(table.path, f"{problem}, {wanted}", place, column(name))


def _on_grid(
    table: Table,
    request: Request,
    seconds: np.ndarray,
    rows: slice,
    signals: _Samples,
    grid: Grid | Uneven,
    holds: Mapping[str, Decision],
) -> tuple[float, _Samples, tuple[str, ...]]:
    """The time step, the signals on the uniform grid, and notes on how they came there."""
    stamps, rate = seconds[rows], request.rate
    notes: tuple[str, ...] = ()
    if isinstance(grid, Grid):
        if rate is None:
            return grid.dt, signals, grid.notes
        if abs(rate * grid.dt - 1.0) * stamps.size < 0.5:
            return 1.0 / rate, signals, grid.notes
        # The grid is better than its rounded stamps: held inputs would slip by a sample.
        stamps, notes = stamps[0] + grid.dt * np.arange(stamps.size), grid.notes
    assert rate is not None
    _check_rate(table, request.time.name, stamps, rows.start, rate)
    clock = new_clock(stamps, rate)
    samples = {}
    for (key, kind), x in signals.items():
        stays = kind == "input" and holds[key].hold == "zero-order"
        samples[key, kind] = (hold if stays else interpolate)(stamps, x, clock.times)
    return clock.dt, samples, notes + clock.notes


def _check_rate(table: Table, name: str, seconds: np.ndarray, start: int, rate: float) -> None:
    """Refuse gaps that nothing should bridge, and rates that make no sense for the log."""
    steps = np.diff(seconds)
    row, most = int(np.argmax(steps)), longest_gap(seconds)
    if steps[row] > most * (1 + 1e-9):
        raise wrong(
            table.path,
            f"found a gap of {steps[row]:.6g} s, {seconds[row]:.6g} s after the first sample,"
            f" expected none longer than {most:.3g} s; give a window without it",
            table.place(start + row + 1),
            column(name),
        )
    usual = float(np.median(steps))
    count = (seconds[-1] - seconds[0]) * rate
    if not count >= _FEWEST - 1 - 1e-6:
        problem = f"a rate of {rate:g} Hz leaves fewer than {_FEWEST} samples, expected more"
        raise wrong(table.path, problem)
    if not (rate * usual <= _MOST_UPSAMPLING and math.isfinite(count)):
        problem = f"a rate of {rate:g} Hz for a log of about {1 / usual:.4g} Hz"
        raise wrong(table.path, f"{problem}, expected at most {_MOST_UPSAMPLING} times as much")
