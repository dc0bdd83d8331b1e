"""Tables of rows as logs of topics, once their clock is known.

A table usually is a log of one topic. In an outer join, as PlotJuggler, MAVExplorer and pandas
write it, each row holds the values of one topic and other cells are empty. Columns that are filled
in the same rows are then a topic, with the clock of these rows.
"""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.clock import (
    ROWS,
    clock_scale,
    columns_of,
    require_increasing,
    require_likely,
    unit_notes,
    with_runs,
)
from heli_jax.flights.derived import sources, with_derived
from heli_jax.flights.describe import LogInfo
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.arrays import SEGMENT, ArrayTable
from heli_jax.flights.grid import LATEST, without_overflow
from heli_jax.flights.log import (
    ChannelLog,
    Table,
    TableRows,
    Topic,
    as_floats,
    column,
    listed,
    shown,
    wrong,
)
from heli_jax.flights.request import Request
from heli_jax.flights.resample import SLOWER, usual_step

_SHARED = 0.1
"""Largest share of the smaller topic's rows that also hold the other one; stamps may coincide."""
_FEWEST = 8
"""Fewest rows of a topic."""
_NAMED = 2
"""Columns in the name of a topic."""


def load_table(table: Table, request: Request) -> ChannelLog:
    """Return the requested columns with their clock."""
    time, runs = request.time, request.options.runs
    if time is None:
        problem = "no time is stated, expected the name of the column of time stamps"
        raise wrong(table.path, problem)
    if isinstance(table, ArrayTable) and SEGMENT in table.names and time.name == ROWS and not runs:
        problem = f"its rows belong to several runs, numbered by {SEGMENT!r}"
        remedy = f"expected time: {{rate: HZ, runs: {SEGMENT}}}, which makes each run a flight"
        raise wrong(table.path, f"{problem}; {remedy}")
    names, known = [time.name, *([runs] if runs else [])], frozenset(table.names)
    for signal in request.signals.values():
        try:
            names += sources(signal.name, known, request.options.swashplate)
        except ValueError as e:
            raise wrong(table.path, str(e), column(signal.name)) from e
    numbers = columns_of(table, list(dict.fromkeys(names)))
    notices: tuple[Finding, ...] = ()
    if request.options.split:
        numbers, notices = with_runs(table, time.name, numbers, clock_scale(table, time), runs)
    log = with_derived(_with_clock(table, numbers, time), request.options.swashplate)
    stamps = numbers[time.name]
    # Stamps that are no clock are refused with their line.
    if stamps.size and np.isfinite(stamps).all() and np.all(np.diff(stamps) >= 0):
        columns = {s.name: log.channel(s.name).values for s in request.signals.values()}
        inputs = {s.name for (_, kind), s in request.signals.items() if kind == "input"}
        if is_joined(stamps * clock_scale(table, time), columns, inputs):
            return without_joins(replace(log, notes=(*log.notes, *notices)), joined=True)
    return replace(log, notes=(*log.notes, *notices, *_checked(table, time, stamps)))


@np.errstate(over="ignore", invalid="ignore")  # stamps that are no clock are refused later
def _with_clock(
    table: Table, numbers: Mapping[str, np.ndarray], time: Signal, name: str = ""
) -> ChannelLog:
    """Return the columns (N,) as one topic, whose times count from the first row."""
    scale, stamps = clock_scale(table, time), without_overflow(numbers[time.name])
    columns = {n: x for n, x in numbers.items() if n != time.name}
    stated = {n: table.units[n] for n in columns if table.units.get(n)}
    rows = TableRows(table, stamps, scale)
    # Subtracted first, so that the digits of a calendar date cost no precision.
    first = float(stamps[0]) if stamps.size else 0.0
    times = (stamps - first) * scale
    topic = Topic(name or Path(table.path).name, times, columns, stated, time.name, rows)
    return ChannelLog.of_table(table, (topic,), notes=table.notes, origin=first * scale)


def _checked(table: Table, time: Signal, stamps: np.ndarray) -> tuple[Finding, ...]:
    """Refuse stamps (N,) that are no clock; return notes on their unit."""
    stated = None if time.name == ROWS else table.time_unit(time.name)
    scale = clock_scale(table, time)
    # A type is unmistakable; words may mean something else.
    is_sure = time.scale != 1.0 or (stated and not table.units.get(time.name))
    notices = () if is_sure else unit_notes(time, stated)
    with np.errstate(over="ignore"):
        bad = np.flatnonzero(~(np.abs(stamps * scale) <= LATEST))  # NaN is bad too
    if bad.size:
        row = int(bad[0])
        problem = f"got {table.cell_text(time.name, row)}, expected a time"
        raise wrong(table.path, problem, table.place(row), column(time.name))
    stamps = without_overflow(stamps)
    require_increasing(table, time.name, stamps)
    if not stated and time.scale == 1.0:
        require_likely(table.path, time, stamps)
    return notices


# Without a request: the clock is guessed, and all columns are taken.


def guessed_log(table: Table, info: LogInfo) -> ChannelLog:
    """Return all columns of numbers as one topic; the notes list assumptions and omissions.

    Args:
        info: description of the table, whose clock is taken.
    """
    clock, notes = info.time, []
    if clock is None or clock.problem:
        why = clock.problem if clock else "no column of numbers looks like a clock"
        remedy = "expected --time NAME, a column of increasing times, or --time-rate HZ"
        raise wrong(table.path, f"{why}, {remedy}")
    if clock.guessed:
        words = f"column {shown(clock.column)} is taken as the clock in {clock.unit}"
        notes.append(note("clock.guessed", words, clock.column))
    rows = next((c.count for c in info.columns if c.name == clock.column), info.n_rows)
    # Arrays may have different lengths; rows of a table with empty cells have one length.
    whole = not isinstance(table, ArrayTable)
    # Columns that share a name cannot be selected.
    names = [
        c.name
        for c in info.columns
        if c.kind == "number" and (whole or c.count == rows) and table.names.count(c.name) == 1
    ]
    if left := [c for c in info.columns if c.name not in names]:
        each = listed(f"{shown(c.name)}{c.strays and f' ({c.strays})'}" for c in left)
        words = f"left out, no {rows} numbers of one name: {each}"
        notes.append(note(LEFT_OUT, words, *(c.name for c in left)))
    numbers = columns_of(table, list(dict.fromkeys([*names, clock.column])))
    if clock.runs > 1:
        scale = clock_scale(table, clock.signal)
        numbers, notices = with_runs(table, clock.column, numbers, scale)
        notes += notices
    log = _with_clock(table, numbers, clock.signal, "the table")
    return replace(log, notes=(*notes, *log.notes))


# Rows that hold the values of one topic each.


class RowGroup(NamedTuple):
    """Columns that are filled in the same rows (N,)."""

    names: tuple[str, ...]
    rows: np.ndarray


def row_groups(columns: Mapping[str, np.ndarray]) -> list[RowGroup]:
    """Group columns (N,), NaN where a cell is empty, by the rows in which they are filled."""
    groups: dict[bytes, RowGroup] = {}
    for name, values in columns.items():
        rows = ~np.isnan(values)
        key = np.packbits(rows).tobytes()
        names = groups[key].names if key in groups else ()
        groups[key] = RowGroup((*names, name), rows)
    return list(groups.values())


def rows_alternate(groups: Sequence[RowGroup]) -> bool:
    """True if two of the groups hardly share a row."""
    counts = [int(np.count_nonzero(g.rows)) for g in groups]
    some = [(g.rows, n) for g, n in zip(groups, counts, strict=True) if n >= _FEWEST]
    return any(
        np.count_nonzero(a & b) <= _SHARED * min(m, n)
        for (a, m), (b, n) in itertools.combinations(some, 2)
    )


def is_joined(
    seconds: np.ndarray, columns: Mapping[str, np.ndarray], needed: Collection[str]
) -> bool:
    """True if the rows of a table, at `seconds` (N,), belong to several topics.

    Args:
        seconds: times of the rows (N,) [s].
        columns: requested columns (N,), NaN where a cell is empty.
        needed: columns that must not miss samples, such as inputs.
    """
    # Before a column's first value and after its last, there is no value to fill from.
    seen = [rows for x in columns.values() if (rows := np.flatnonzero(~np.isnan(x))).size]
    begin = max((int(rows[0]) for rows in seen), default=0)
    end = min((int(rows[-1]) + 1 for rows in seen), default=0)
    inside = slice(begin, end) if end - begin >= _FEWEST else slice(None)
    seconds, columns = seconds[inside], {n: x[inside] for n, x in columns.items()}
    lacking = [name for name in needed if np.isnan(columns[name]).any()]
    if not lacking:
        return False
    groups = row_groups(columns)
    some = np.any([g.rows for g in groups], axis=0)
    # A row without any requested value belongs to another topic.
    if all(np.array_equal(~np.isnan(columns[name]), some) for name in lacking):
        return True
    step = usual_step(seconds)
    slower = any(usual_step(seconds[~np.isnan(columns[n])]) > SLOWER * step for n in lacking)
    return slower or rows_alternate(groups)


def without_joins(log: ChannelLog, joined: bool = False) -> ChannelLog:
    """Return the log with separate topics if the rows of a table hold one topic each.

    Args:
        joined: True if they are known to do so.
    """
    topics: list[Topic] = []
    notes = []
    for topic in log.topics:
        columns = {name: as_floats(values) for name, values in topic.columns.items()}
        groups = row_groups(columns)
        if not joined and not rows_alternate(groups):
            topics.append(topic)
            continue
        parts = []
        for group in groups:
            own = {name: columns[name][group.rows] for name in group.names}
            units = {name: topic.units[name] for name in own if name in topic.units}
            few = ", ".join(map(shown, group.names[:_NAMED]))
            more = f" and {len(own) - _NAMED} more" if len(own) > _NAMED else ""
            called = f"rows of {few}{more}"
            parts.append(Topic(called, topic.times[group.rows], own, units, topic.clock))
        known = (t for t in parts if t.times.size > 1)
        rates = listed(f"{t.name} at about {1 / usual_step(t.times):.4g} Hz" for t in known)
        words = (
            f"each row holds one topic and leaves other cells empty: each column is read at "
            f"its own rows ({rates})"
        )
        notes.append(note("channels.joined", words, value=len(parts)))
        topics += parts
    start = log.first_time if notes else log.start
    return replace(log, topics=tuple(topics), notes=(*log.notes, *notes), start=start)
