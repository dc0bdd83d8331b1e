"""Conversion of a log of any format to one table with a uniform clock: CSV or Parquet."""

import fnmatch
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heli_jax.errors import InputError, nearest
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.as_logged import without_marks_and_turns
from heli_jax.flights.derived import (
    DerivedLog,
    with_derived,
)
from heli_jax.flights.describe import describe_table
from heli_jax.flights.formats.arrays import ArrayTable, by_clocks
from heli_jax.flights.holds import decide
from heli_jax.flights.log import ChannelLog, listed, require_few_columns, shown, wrong
from heli_jax.flights.marks import at_marks, marks_note
from heli_jax.flights.onto_grid import TopicClock, common_times, topic_clock, window_note
from heli_jax.flights.open_log import open_log
from heli_jax.flights.preset import NamedBy
from heli_jax.flights.read_table import guessed_log, without_joins
from heli_jax.flights.request import require_rate_and_window
from heli_jax.flights.resample import hold, in_gaps, rate_notes, resampled
from heli_jax.flights.write import write_table

ENDINGS = (".csv", ".parquet")
TIME = "time"
"""Name of the first column, in seconds from the log's beginning."""
_SHARE = 0.5
"""Smallest duration of a topic, relative to the longest, in a conversion of all topics."""
_INTERPOLATED = 2.0
"""Ratio to a topic's rate above which a note says that most values are interpolated."""
_LONGEST = 3 * 10**8
"""Most cells: 2.4 GB."""


@dataclass(frozen=True)
class Selection:
    """Signals, rate and window to convert.

    Attributes:
        signals: names of channels and of derived ones; * matches anything. All channels if empty.
        rate: rate to resample to [Hz]; without it the samples stay as they are.
        window: first and last time [s] from the log's beginning.
        flight: number of the flight in a file that holds several, from 1.
        time: column of time stamps of a table; guessed if not given.
        time_unit: unit of these stamps; guessed if not given.
        time_rate: samples a second [Hz] of a table without times: of its rows, or of the counts in
            `time`.
        named: names of the columns from a preset, in place of `signals`; the values are then in SI.
    """

    signals: Sequence[str] = ()
    rate: float | None = None
    window: tuple[float, float] | None = None
    flight: int | None = None
    time: str | None = None
    time_unit: str | None = None
    time_rate: float | None = None
    named: NamedBy | None = None


@dataclass(frozen=True, eq=False)
class Converted:
    """Columns (M,) float64 by name, `time` [s] first, NaN if a sample is missing.

    `units` are those the log states. `notes` list what was assumed, resampled or is missing.
    """

    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    notes: tuple[Finding, ...]


def convert_log(path: str | Path, selection: Selection) -> Converted:
    """Convert the selected signals of a log to one clock.

    A signal that jumps and stays, such as a stick or a mode, is held between samples. Others are
    interpolated, or low-pass filtered if the rate decreases. Samples in a long gap are missing.

    Raises:
        InputError: the log cannot be read; a signal or a clock is missing; the signals have several
            clocks and no rate is given; or rate or window is invalid.
    """
    # Checked before the log is opened, which may take minutes.
    require_rate_and_window(str(path), selection.rate, selection.window)
    opened = open_log(path, selection.flight)
    # Done before the table changes its form, by which a preset may recognise it.
    named = None if selection.named is None else selection.named(opened)
    notes = [] if named is None else list(named.notes)
    stated = (selection.time, selection.time_unit, selection.time_rate)
    if isinstance(opened, ArrayTable) and stated == (None, None, None):
        opened = by_clocks(opened) or opened
    if not isinstance(opened, ChannelLog):
        opened = guessed_log(opened, describe_table(opened, *stated))
        # Without a rate, rows are copied as they are, with their empty cells.
        opened = opened if selection.rate is None else without_joins(opened)
    elif any(stated):
        raise wrong(
            opened.path, "its topics have clocks of their own, expected no time to be stated"
        )
    log = with_derived(opened)
    notes += log.notes
    if named is None:
        names = _names(log, selection.signals)
    else:
        names = list(dict.fromkeys(signal.name for signal in named.signals.values()))
    required = named is None and bool(selection.signals)
    clocks = _clocks(log, names, selection.window, required, notes)
    names = [name for name in names if log.topic_of(name).name in clocks]
    # Without a rate nothing is resampled: a copy at the log's own samples loses nothing.
    if selection.rate is None:
        columns = _as_logged(log, names, clocks, named is not None, notes)
    else:
        columns = _resampled(log, names, clocks, selection.rate, notes)
        for clock in clocks.values():
            notes += [n.of(clock.words) for n in rate_notes(clock.seconds, selection.rate)]
            # A table has a value in every row, but a fit treats slow outputs as missing in between.
            if selection.rate * clock.usual > _INTERPOLATED:
                words = f"{clock.words}: interpolated, so its noise is no longer white"
                notes.append(note("resampling.interpolated", words))
    units = {name: log.topic_of(name).units.get(name, "") for name in names}
    if named is not None:
        taken = {n: s for n, s in named.signals.items() if s.name in columns}
        units = {n: s.si for n, s in taken.items()}
        columns = {TIME: columns[TIME], **{n: s.to_si(columns[s.name]) for n, s in taken.items()}}
    notes += _missing(columns)
    return Converted(columns, {TIME: "s"} | units, tuple(notes))


def _names(log: DerivedLog, patterns: Sequence[str]) -> list[str]:
    """Return the requested channels in the order of the patterns, or else all but the clocks."""
    if not patterns:
        names = [
            name
            for topic in log.topics
            for name in topic.columns
            # ULog and DataFlash name a channel by topic and field, other formats by field alone.
            # The clock is left out under either name, because it becomes the column `time`.
            if topic.clock and name not in (topic.clock, f"{topic.name}.{topic.clock}")
        ]
        if not names:
            raise wrong(
                log.path, "its rows have an order and no times, expected a log with a clock"
            )
    else:
        names = []
        for pattern in patterns:
            # The brackets of gyroADC[0] are literal.
            matches = fnmatch.filter(log.names, pattern.replace("[", "[[]"))
            if not matches and log.is_derived(pattern):
                matches = [pattern]
            if not matches:
                known = {n[:60] for n in log.names}
                problem = f"no channel {shown(pattern)}{nearest(pattern[:60], known)}"
                raise wrong(log.path, problem)
            names += matches
    names = list(dict.fromkeys(names))
    # After the patterns, several of which may match the same channel.
    require_few_columns(log.path, len(names))
    if TIME in names:
        problem = f"{TIME!r} is the name of the written clock, expected other signals"
        raise wrong(log.path, problem)
    return names


def _clocks(
    log: ChannelLog,
    names: Sequence[str],
    window: tuple[float, float] | None,
    required: bool,
    notes: list[Finding],
) -> dict[str, TopicClock]:
    """Return the clocks of the topics that hold the channels, by the topics' names.

    A topic without a clock is an error if its channels are required, otherwise a note.
    """
    clocks, problems = {}, []
    for topic in dict.fromkeys(log.topic_of(name) for name in names):
        log.channel(next(iter(topic.columns)))  # refuses rows without times
        try:
            clocks[topic.name] = topic_clock(log, topic, window)
        except InputError as e:
            # A requested signal that is not available is an error. A request for all signals takes
            # those available.
            if required:
                raise
            problems.append(e)
            notes.append(note(LEFT_OUT, f"left out: {e.within}", topic.name))
    if not clocks:
        raise problems[0]
    taken = [clock.topic.times for clock in clocks.values()]
    notes += window_note(window, [max(taken, key=lambda times: times[-1])], log.first_time)
    # Events within a moment would leave no time that all topics share.
    spans = {name: float(clock.seconds[-1] - clock.seconds[0]) for name, clock in clocks.items()}
    for name, span in spans.items():
        # A topic requested by name may be short.
        if not required and span < _SHARE * max(spans.values()):
            del clocks[name]
            words = f"left out: topic {shown(name)}, which covers {span:.3g} s"
            notes.append(note(LEFT_OUT, words, name, value=span))
    return clocks


def _missing(columns: Mapping[str, np.ndarray]) -> list[Finding]:
    """Return a note on the missing samples."""
    counts = {name: int(np.isnan(values).sum()) for name, values in columns.items()}
    counts = {name: count for name, count in counts.items() if count}
    if not counts:
        return []
    each = listed(f"{shown(name)} ({count})" for name, count in counts.items())
    words = f"samples are missing, of {columns[TIME].size}: {each}"
    return [note("samples.missing", words, *counts, value=max(counts.values()))]


def _as_logged(
    log: ChannelLog,
    names: Sequence[str],
    clocks: Mapping[str, TopicClock],
    converted: bool,
    notes: list[Finding],
) -> dict[str, np.ndarray]:
    """Return the samples as they are, which requires a single clock.

    Marks become missing if the numbers are `converted` to another unit, in which they would not be
    recognised.
    """
    if len(clocks) > 1:
        few = ", ".join(clock.words for clock in list(clocks.values())[:4])
        more = ", ..." if len(clocks) > 4 else ""
        problem = (
            f"the signals have {len(clocks)} clocks ({few}{more}), expected --rate for resampling"
        )
        raise wrong(log.path, f"{problem}, or signals of one topic")
    (clock,) = clocks.values()
    columns = {TIME: clock.seconds}
    for name in names:
        values = _finite(log.channel(name).values[clock.rows])
        if (at := at_marks(values)).any():
            done = "taken as missing" if converted else "kept; with --rate they are missing"
            notes.append(marks_note(shown(name), values, at, done, name))
        columns[name] = np.where(at, np.nan, values) if converted else values
    return columns


def _resampled(
    log: ChannelLog,
    names: Sequence[str],
    clocks: Mapping[str, TopicClock],
    rate: float,
    notes: list[Finding],
) -> dict[str, np.ndarray]:
    # Counted before any signal is resampled, so that a wrong rate is refused before it fills the
    # memory.
    times = common_times(log.path, list(clocks.values()), rate)
    if times.size * len(names) > _LONGEST:
        problem = f"{len(names)} signals at {rate:g} Hz are {times.size * len(names)} numbers"
        raise wrong(log.path, f"{problem}, expected at most {_LONGEST}; take fewer signals")
    columns = {TIME: times}
    gaps = {name: in_gaps(clock.seconds, times) for name, clock in clocks.items()}
    for name in names:
        topic = log.topic_of(name).name
        clock = clocks[topic]
        logged = _finite(log.channel(name).values[clock.rows])
        values, notices = without_marks_and_turns(shown(name), logged)
        notes += notices
        # The hold is decided from valid samples only, because a move to or from NaN is none.
        known = values[~np.isnan(values)]
        stays = not known.size or decide(known).hold == "zero-order"
        new = (hold if stays else resampled)(clock.seconds, values, times)
        # A hold and a straight line continue through any gap, so their values there are removed.
        columns[name] = np.where(gaps[topic], np.nan, new)
    return columns


def _finite(values: np.ndarray) -> np.ndarray:
    """Return the values with infinite ones as missing; no filter can process them."""
    return np.where(np.isfinite(values), values, np.nan)


def require_output(out: Path, log: str | Path) -> None:
    """Refuse a name with an unknown ending, and a file that exists."""
    if out.suffix.lower() not in ENDINGS:
        raise InputError(f"{out}: expected a name ending in {', '.join(ENDINGS)}")
    # Compared by file, not by name: a link or another spelling of the path would also overwrite the
    # log.
    if out.exists() and Path(log).exists() and os.path.samefile(out, log):
        raise InputError(f"{out}: is the log itself, expected another name")
    if os.path.lexists(out):  # a broken link is in the way too
        raise InputError(f"{out}: exists already, expected a new name")


def write_converted(out: Path, converted: Converted) -> None:
    """Write the columns; a missing sample is an empty cell.

    Raises:
        OSError: the place cannot be written to.
    """
    # Missing cells are nulls: CSV would show a NaN as the word nan.
    columns = {n: np.ma.masked_invalid(x) for n, x in converted.columns.items()}
    write_table(out, columns, converted.units)
