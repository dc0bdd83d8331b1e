"""From a table of rows, one column of which is the time, to signals on its clock."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import Finding, note, sentences
from heli_jax.flights.clock import (
    ROWS,
    clock_scale,
    contradicted_rate,
    counted,
    require_increasing,
    unit_notes,
    with_runs,
)
from heli_jax.flights.derived import DerivedTable
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.arrays import SEGMENT, ArrayTable
from heli_jax.flights.grid import LATEST, rounding_of, without_overflow
from heli_jax.flights.joined import joined_log
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.onto_grid import FEWEST, Key, window_note
from heli_jax.flights.read_channels import (
    ClockedSignal,
    TopicClock,
    in_si,
    require_steps,
    rows_in_window,
)
from heli_jax.flights.request import Request
from heli_jax.flights.table import Table, column, shown, wrong
from heli_jax.flights.time_units import require_likely


@dataclass(frozen=True, eq=False)
class LoadedTable:
    """A table with the columns (N,) that are asked for, and its clock: `stamps` (N,) in the log's
    unit, which is `scale` seconds."""

    table: Table
    numbers: Mapping[str, np.ndarray]
    stamps: np.ndarray
    scale: float
    said: tuple[Finding, ...] = ()
    """where the file or a name says another unit of the clock"""
    cautions: tuple[Finding, ...] = ()
    """what speaks against the times"""

    @property
    def first_time(self) -> float:
        """Time of the first stamp [s], from which windows count."""
        return float(self.stamps[0] * self.scale)

    @property
    def elapsed(self) -> np.ndarray:
        """(N,) [s], from 0; subtracted first, so that a calendar's digits do not cost any."""
        return (self.stamps - self.stamps[0]) * self.scale

    @contextlib.contextmanager
    def hinting(self) -> Iterator[None]:
        """Add a hint about the unit to errors that a wrong unit causes."""
        try:
            yield
        except InputError as e:
            if not self.said:
                raise
            raise InputError("; ".join([str(e), *sentences(self.said)])) from e


def load_table(table: Table, request: Request) -> LoadedTable | ChannelLog:
    """The columns that are asked for, and the clock; as topics where rows hold one topic each.

    Raises:
        InputError: a column is missing or holds no numbers, or the time is none.
    """
    if request.time is None:
        problem = "no time is stated, expected the name of the column of time stamps"
        raise wrong(table.path, problem)
    file = _below(table)
    of_stack = isinstance(file, ArrayTable) and SEGMENT in file.names
    if of_stack and request.time.name == ROWS and not request.options.runs:
        problem = f"its rows are of several runs, which {SEGMENT!r} numbers"
        remedy = f"expected time: {{rate: HZ, runs: {SEGMENT}}}, which makes a flight of each"
        raise wrong(table.path, f"{problem}; {remedy}")
    if request.time.name == ROWS:
        table = _over(table, counted(file))
    numbers = table.numbers(request.columns)
    if request.options.split:
        table, numbers = _with_runs(table, request, numbers)
    joined = joined_log(table, request, numbers)
    if joined is not None:
        return joined
    return _with_clock(table, numbers, request.time)


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


def clocked_table(
    loaded: LoadedTable, request: Request
) -> tuple[dict[Key, ClockedSignal], tuple[Finding, ...]]:
    """The signals inside the window as those of one topic, in seconds from the first stamp, and
    notes.

    Raises:
        InputError: the window lies outside the table, or a cell is no finite number.
    """
    table, elapsed = loaded.table, loaded.elapsed
    assert request.time is not None  # or `load_table` would have refused it
    # The window before anything else is asked of the samples: what lies outside of it may be as
    # wrong as it likes.
    rows = rows_in_window(table.path, elapsed, request.options.window)
    rows, notes = _of_known_inputs(request, loaded.numbers, elapsed, rows)

    def places(i: int) -> tuple[str, ...]:
        assert request.time is not None
        return table.place(rows.start + i), column(request.time.name)

    seconds, stamps = elapsed[rows], loaded.stamps[rows]
    # Before the rounding is looked for, which steps of a wrong unit would make meaningless.
    require_steps(table.path, seconds, *places(0))
    begin, rounding = float(stamps[0] * loaded.scale), rounding_of(stamps) * loaded.scale
    topic = TopicClock(Path(table.path).name, seconds, rows, begin, rounding, places, of_table=True)
    signals = {}
    for (key, kind), signal in request.signals.items():

        def refuse(i: int, more: str) -> InputError:
            row, name = rows.start + i, signal.name  # noqa: B023
            problem = f"got {table.cell_text(name, row)}, expected a finite number"
            return wrong(table.path, problem + more, table.place(row), column(name))

        values = in_si(signal, kind, loaded.numbers[signal.name][rows], refuse)
        signals[key, kind] = ClockedSignal(topic, values)
    return signals, notes


def table_window_note(loaded: LoadedTable, request: Request) -> tuple[Finding, ...]:
    """A note where the window reaches beyond the table."""
    elapsed = loaded.elapsed
    step = float(np.median(np.diff(elapsed))) if elapsed.size > 1 else 0.0
    return window_note(request.options.window, float(elapsed[-1]), step)


def _of_known_inputs(
    request: Request, numbers: Mapping[str, np.ndarray], seconds: np.ndarray, rows: slice
) -> tuple[slice, tuple[Finding, ...]]:
    """The rows without those before an input's first value or behind its last, and a note of it.

    An input is somewhere all the time, and where it was before its first value nobody knows: a
    table whose cells are filled with the last value begins so, with the topic that came first.
    """
    first, stop, cut = rows.start, rows.stop, []
    inputs = (s.name for (_, kind), s in request.signals.items() if kind == "input")
    for name in dict.fromkeys(inputs):
        known = np.flatnonzero(~np.isnan(numbers[name][rows]))
        # Of a column without any value the first row is told.
        if not known.size or known[-1] - known[0] + 1 == rows.stop - rows.start:
            continue
        first = max(first, rows.start + int(known[0]))
        stop = min(stop, rows.start + int(known[-1]) + 1)
        cut.append(name)
    if not cut or stop - first < FEWEST:
        return rows, ()
    where = f"from {seconds[first]:.6g} s to {seconds[stop - 1]:.6g} s"
    count = (rows.stop - rows.start) - (stop - first)
    words = f"{', '.join(map(shown, cut))}: no value before or behind, {count} rows are left out"
    left_out = note("windows.inputs-known", f"the flight is {where}: {words}", *cut, value=count)
    return slice(first, stop), (left_out,)


def _with_clock(table: Table, numbers: Mapping[str, np.ndarray], time: Signal) -> LoadedTable:
    """The columns with their clock, whose stamps are finite and increase."""
    place, stamps = column(time.name), numbers[time.name]
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
    return LoadedTable(table, numbers, stamps, scale, said, cautions)
