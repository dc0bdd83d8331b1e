"""Tables whose rows hold the values of one topic each, the other cells empty: an outer join.

PlotJuggler, MAVExplorer and pandas' outer merges write such. The columns that are filled in the
same rows are a topic, and their clock is that of these rows: an empty cell is no lost sample.
A join that was filled forward is told by its repeated values (`repeats.carried_on`).
"""

import fnmatch
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.clock import ROWS, clock_scale, counted, with_runs
from heli_jax.flights.describe import TimeInfo, describe_table
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.arrays import ArrayTable
from heli_jax.flights.grid import without_overflow
from heli_jax.flights.log import ChannelLog, Topic, as_floats
from heli_jax.flights.request import Request
from heli_jax.flights.resample import SLOWER, usual_step
from heli_jax.flights.table import Table, listed, shown, wrong

_SHARED = 0.1
"""of the rows of the smaller of two topics that hold the other too, at most: stamps may coincide"""
_FEWEST = 8
"""rows of a topic"""
_NAMED = 2
"""columns by which a topic is called"""


class RowGroup(NamedTuple):
    """Columns that are filled in the same rows (N,)."""

    names: tuple[str, ...]
    rows: np.ndarray


def row_groups(columns: Mapping[str, np.ndarray]) -> list[RowGroup]:
    """Columns (N,), NaN where a cell is empty, by the rows in which they are filled."""
    groups: dict[bytes, RowGroup] = {}
    for name, values in columns.items():
        rows = ~np.isnan(values)
        key = np.packbits(rows).tobytes()
        names = groups[key].names if key in groups else ()
        groups[key] = RowGroup((*names, name), rows)
    return list(groups.values())


def takes_turns(groups: Sequence[RowGroup]) -> bool:
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
    """True if the rows of a table are those of several topics.

    Args:
        seconds: of the rows (N,) [s].
        columns: that are asked for (N,), NaN where a cell is empty.
        needed: those of them that no sample may be missing of, such as inputs.
    """
    # Before a column's first value, and behind its last, there is nothing to fill forward with.
    inside = _all_begun(columns)
    seconds, columns = seconds[inside], {n: x[inside] for n, x in columns.items()}
    lacking = [name for name in needed if np.isnan(columns[name]).any()]
    if not lacking:
        return False
    groups = row_groups(columns)
    some = np.any([g.rows for g in groups], axis=0)
    # A row that holds nothing of what is asked for is one of another topic.
    if all(np.array_equal(~np.isnan(columns[name]), some) for name in lacking):
        return True
    step = usual_step(seconds)
    slower = any(usual_step(seconds[~np.isnan(columns[n])]) > SLOWER * step for n in lacking)
    return slower or takes_turns(groups)


def _all_begun(columns: Mapping[str, np.ndarray]) -> slice:
    """The rows from where all columns (N,) have begun to where the first one ends; all rows where
    there are hardly any."""
    seen = [np.flatnonzero(~np.isnan(x)) for x in columns.values()]
    seen = [rows for rows in seen if rows.size]
    begin = max((int(rows[0]) for rows in seen), default=0)
    end = min((int(rows[-1]) + 1 for rows in seen), default=0)
    return slice(begin, end) if end - begin >= _FEWEST else slice(None)


def joined_log(
    table: Table, request: Request, numbers: Mapping[str, np.ndarray]
) -> ChannelLog | None:
    """A table whose rows are those of several topics as a log of these; else None."""
    assert request.time is not None  # no table is read without
    stamps = numbers[request.time.name]
    # What is no clock is told by its line where rows are read.
    if not stamps.size or not np.isfinite(stamps).all() or np.any(np.diff(stamps) < 0):
        return None
    signals = {s.name: numbers[s.name] for s in request.signals.values()}
    inputs = {s.name for (_, kind), s in request.signals.items() if kind == "input"}
    scale = clock_scale(table, request.time)
    seconds = stamps * scale
    if not is_joined(seconds, signals, inputs):
        return None
    topics, said = topics_of(seconds, signals, table.units, request.time.name)
    return ChannelLog(
        table.path,
        table.format,
        table.size,
        table.sha256,
        topics,
        notes=(*table.notes, said),
        start=float(seconds[0]),
    )


def topics_of(
    seconds: np.ndarray,
    columns: Mapping[str, np.ndarray],
    units: Mapping[str, str],
    clock: str,
) -> tuple[tuple[Topic, ...], Finding]:
    """The topics of a joined table, each at its own rows, and a note on them.

    Args:
        seconds: of the rows (N,) [s].
        columns: (N,), NaN where a cell is empty.
        units: by column, where they are stated.
    """
    topics = []
    for group in row_groups(columns):
        own = {name: columns[name][group.rows] for name in group.names}
        stated = {name: units[name] for name in own if units.get(name)}
        topics.append(Topic(_called(group.names), seconds[group.rows], own, stated, clock))
    known = (t for t in topics if t.times.size > 1)
    rates = listed(f"{t.name} at about {1 / usual_step(t.times):.4g} Hz" for t in known)
    words = (
        f"its rows hold one topic each and leave other cells empty: each column is taken at the "
        f"rows that hold it ({rates})"
    )
    return tuple(topics), note("channels.joined", words, value=len(topics))


def _called(names: Sequence[str]) -> str:
    few = ", ".join(shown(name) for name in names[:_NAMED])
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"rows of {few}{more}"


# A table of rows as a log of topics.


def without_joins(log: ChannelLog, notes: list[Finding]) -> ChannelLog:
    """The log with topics of their own where the rows of a table hold one topic each."""
    topics: list[Topic] = []
    for topic in log.topics:
        columns = {name: as_floats(values) for name, values in topic.columns.items()}
        if not takes_turns(row_groups(columns)):
            topics.append(topic)
            continue
        parts, said = topics_of(topic.times, columns, topic.units, topic.clock)
        notes.append(said)
        topics += parts
    return replace(log, topics=tuple(topics))


def in_runs(table: Table, clock: TimeInfo) -> Table:
    """A table whose runs follow one another, where its clock begins anew."""
    if clock.runs < 2:
        return table
    # As `describe_table` saw them.
    scale = clock_scale(
        table, Signal(clock.column, clock.unit, "s", scale=1.0 / (clock.counted or 1.0))
    )
    return with_runs(table, clock.column, table.numbers([clock.column]), scale)


def rate_note(clock: TimeInfo) -> Finding:
    """A note on a clock whose rate the file states."""
    what = "rows" if clock.column == ROWS else shown(clock.column)
    words = f"{what} are taken as samples at {clock.counted:g} Hz, as the file says: {clock.said}"
    return note("clock.rate-of-file", words, value=clock.counted)


def matching(names: Iterable[str], pattern: str) -> list[str]:
    # The brackets of gyroADC[0] are meant as they stand.
    literal = pattern.replace("[", "[[]")
    return [name for name in names if fnmatch.fnmatchcase(name, literal)]


def one_topic(
    table: Table,
    time: str | None,
    unit: str | None,
    rate: float | None,
    notes: list[Finding],
) -> ChannelLog:
    """A table as a log of one topic.

    Args:
        table: of rows, or of arrays, of which those of other lengths are left out.
        time: the clock, where it is named; else guessed.
        rate: samples a second [Hz] of a table without times.
        notes: to which what was assumed and left out is added.

    Raises:
        InputError: it has no clock, or two columns of one name.
    """
    info = describe_table(table, time, unit, rate)
    clock = info.time
    if clock is None or clock.problem:
        why = clock.problem if clock else "no column looks like a clock"
        remedy = "expected --time NAME, a column of increasing times"
        if not clock:
            remedy += ", or --time-rate HZ, samples a second"
        if clock:
            remedy += ", or a file without the rows that go back"
        if not clock and (texts := [c for c in info.columns if c.kind == "text"]):
            why += f" ({shown(texts[0].name)} is text{texts[0].strays and ': ' + texts[0].strays})"
        raise wrong(table.path, f"{why}, {remedy}")
    if clock.said:
        notes.append(rate_note(clock))
    elif clock.guessed:
        words = f"column {shown(clock.column)} is taken for a clock in {clock.unit}"
        notes.append(note("clock.guessed", words, clock.column))
    rows = next((c.count for c in info.columns if c.name == clock.column), info.n_rows)
    # Arrays may have lengths of their own; rows of a table with empty cells are of one length.
    whole = not isinstance(table, ArrayTable)
    numeric = [c for c in info.columns if c.kind == "number"]
    names = [c.name for c in numeric if whole or c.count == rows]
    others = [c.name for c in numeric if c.name not in names]
    if others:
        words = f"{listed(map(shown, others))}, not of {rows} samples as the clock"
        notes.append(note(LEFT_OUT, f"left out: {words}", *others))
    notes += table.notes
    if texts := [c for c in info.columns if c.kind == "text"]:
        words = listed(f"{shown(c.name)}{f' ({c.strays})' if c.strays else ''}" for c in texts)
        notes.append(note(LEFT_OUT, f"left out: text in {words}", *(c.name for c in texts)))
    twice = next((n for n in names if names.count(n) > 1), None)
    # The columns are keyed by name from here on, and one of the two would be lost without a word.
    if twice is not None:
        raise wrong(table.path, f"two columns are named {shown(twice)}, expected different names")
    if clock.runs > 1:
        table = in_runs(table, clock)
        notes += table.notes[-1:]
    names = list(dict.fromkeys([*names, clock.column]))
    numbers = (counted(table) if clock.column == ROWS else table).numbers(names)
    stamps = without_overflow(numbers.pop(clock.column))
    # By the clock's own measure of its length, which knows its unit.
    scale = clock.duration / float(stamps[-1] - stamps[0])
    topic = Topic("the table", (stamps - stamps[0]) * scale, numbers, {}, clock.column)
    return ChannelLog(table.path, table.format, table.size, table.sha256, (topic,))
