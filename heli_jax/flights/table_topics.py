"""A table of rows as a log of topics."""

import fnmatch
from collections.abc import Iterable
from dataclasses import replace

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.clock import ROWS, clock_scale, counted, with_runs
from heli_jax.flights.describe import TimeInfo, describe_table
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.arrays import ArrayTable
from heli_jax.flights.grid import without_overflow
from heli_jax.flights.joined import row_groups, takes_turns, topics_of
from heli_jax.flights.log import ChannelLog, Topic, as_floats
from heli_jax.flights.table import Table, listed, shown, wrong


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
