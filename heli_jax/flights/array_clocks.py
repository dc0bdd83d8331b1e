"""Arrays that have clocks of their own by where they stand in a file: `log.imu.t` is the time of
`log.imu.gx` and `log.rc.t` that of `log.rc.aileron`."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.clock_guess import TIME_NAMES
from heli_jax.flights.formats.arrays import ArrayTable
from heli_jax.flights.log import ChannelLog, Topic, sharing_clocks
from heli_jax.flights.row_clock import contradicted_rate
from heli_jax.flights.table import Table, listed, sample_count, shown
from heli_jax.flights.time_units import SECONDS, likely_unit, split_unit

_LEVEL = re.compile(r"[./]")


class _Clock(NamedTuple):
    """An array of times: its name, the group that it stands in, and its samples."""

    name: str
    group: tuple[str, ...]
    size: int


def by_clocks(table: ArrayTable) -> ChannelLog | None:
    """Arrays as topics, each with the times of its group or of the nearest above that has some of
    its length; None where all have one clock.
    """
    arrays = {s.name: s.values for s in table.survey() if s.values is not None}
    clocks = [c for name, x in arrays.items() if (c := _clock(name, x)) is not None]
    seconds = {c.name: _seconds(table, c.name, arrays[c.name]) for c in clocks}
    matched = {n: _clock_of(n, x.size, clocks, seconds) for n, x in arrays.items()}
    of_clock: dict[str, list[str]] = {}
    for name, clock in matched.items():
        if clock is not None and name not in {c.name for c in clocks}:
            of_clock.setdefault(clock.name, []).append(name)
    if len(of_clock) < 2:
        return None
    topics = tuple(_topic(table, arrays, c, seconds[c], names) for c, names in of_clock.items())
    without = [n for n, clock in matched.items() if clock is None and arrays[n].size > 1]
    notes = (*table.notes, *_left_out(without, arrays))
    steps = [float(np.median(np.diff(t.times))) for t in topics]
    cautions = [
        caution
        for t, step in zip(topics, steps, strict=True)
        for caution in contradicted_rate(table, t.clock, 1.0 / step)
    ]
    return ChannelLog(
        table.path,
        table.format,
        table.size,
        table.sha256,
        topics,
        notes=notes,
        cautions=tuple(cautions),
    )


def clock_notes(table: Table) -> tuple[Finding, ...]:
    """That arrays have clocks of their own, where they have."""
    log = by_clocks(table) if isinstance(table, ArrayTable) else None
    if log is None:
        return ()
    topics = listed(f"{shown(t.name)} of {len(t.columns)}" for t in log.topics)
    words = f"arrays have clocks of their own, read where no time is stated: {topics}"
    return (note("clock.of-arrays", words, value=len(log.topics)),)


def _clock(name: str, values: np.ndarray) -> _Clock | None:
    *group, leaf = _LEVEL.split(name)
    words = words_in(split_unit(leaf)[0])
    increases = values.size > 1 and bool(np.all(values[1:] > values[:-1]))
    if not words or not TIME_NAMES & {words[0], words[-1]} or not increases:
        return None
    return _Clock(name, tuple(group), values.size)


def _clock_of(
    name: str, size: int, clocks: Sequence[_Clock], seconds: Mapping[str, np.ndarray]
) -> _Clock | None:
    """The clock of an array; None where its group has none of its length, or several of which not
    one alone shares the other groups' time."""
    group = tuple(_LEVEL.split(name)[:-1])
    for depth in range(len(group), -1, -1):
        near = [c for c in clocks if c.group == group[:depth] and c.size == size]
        others = [c for c in clocks if c.group != group[:depth]]
        if len(near) > 1 and others:
            # GPS time of week beside the board's time.
            times = seconds[max(others, key=lambda c: c.size).name]
            shared = (float(times[0]), float(times[-1]))
            on_it = sharing_clocks({c.name: seconds[c.name] for c in near}, shared)
            near = [c for c in near if c.name in on_it]
        if near:
            return near[0] if len(near) == 1 else None
    return None


def _seconds(table: ArrayTable, clock: str, stamps: np.ndarray) -> np.ndarray:
    unit = table.time_unit(clock) or split_unit(clock)[1] or likely_unit(stamps)
    with np.errstate(over="ignore"):  # of a damaged file
        return stamps * SECONDS[unit]


def _topic(
    table: ArrayTable,
    arrays: Mapping[str, np.ndarray],
    clock: str,
    times: np.ndarray,
    names: Sequence[str],
) -> Topic:
    units = {n: table.units.get(n, "") for n in names}
    return Topic(clock, times, {n: arrays[n] for n in names}, units, clock)


def _left_out(names: Sequence[str], arrays: Mapping[str, np.ndarray]) -> tuple[Finding, ...]:
    if not names:
        return ()
    each = listed(f"{shown(n)} ({sample_count(arrays[n].size)})" for n in names)
    words = "no time of their length, or several, stand in their groups"
    return (note(LEFT_OUT, f"left out, since {words}: {each}", *names),)
