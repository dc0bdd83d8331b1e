"""A log whatever the file's format: a table of named columns, or channels on clocks of their own.

A table of rows becomes a log of one topic (`heli_jax/flights/read_table.py`).
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from heli_jax.errors import InputError, nearest
from heli_jax.finding import Finding
from heli_jax.regular_file import size_words

# Facts of a file.


def wrong(path: str, problem: str, *place: str) -> InputError:
    """The error for a file: `file, place, place: problem`, in one line whatever the names hold."""
    # A name from a file may hold line breaks or escape sequences, which a terminal would obey.
    within = ": ".join((*([", ".join(place)] if place else []), problem))
    text = f"{path}{', ' if place else ': '}{within}"
    return InputError(
        *(re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029]+", " ", t) for t in (text, within))
    )


def shown(text: str) -> str:
    """Text from a file, quoted, cut to 40 characters."""
    # Cut, since a damaged file may have a name as long as itself.
    return repr(text) if len(text) <= 40 else repr(text[:40]) + "..."


def listed(words: Iterable[str]) -> str:
    """The first six, and how many more there are."""
    each = list(words)
    more = f" and {len(each) - 6} more" if len(each) > 6 else ""
    return f"{', '.join(each[:6])}{more}"


def column(name: str) -> str:
    """`column 'phi'`, as a place."""
    return f"column {shown(name)}"


def sample_count(count: int) -> str:
    """`1 sample`, `2 samples`."""
    return "1 sample" if count == 1 else f"{count} samples"


MOST_COLUMNS = 10_000
"""of a log: more are none that anybody named"""


def require_few_columns(path: str, count: int, *place: str) -> None:
    """Refuse more columns than any log has."""
    if count > MOST_COLUMNS:
        raise wrong(path, f"expected at most {MOST_COLUMNS} columns, got {count}", *place)


_MOST_BYTES = 24 * 10**8
"""of all numbers of a file as float64: 3e8 of them"""
_MOST_SMALL = 250 * 10**6
_DENSEST = 200
"""bytes that one byte of a file may stand for, where they are more than `_MOST_SMALL`: a signal
that stands still packs by a thousand, numbers of sensors by less than ten"""


class Budget:
    """Memory that a file may take, asked before it is taken: a few bytes can claim any number of
    zeros."""

    def __init__(self, path: str, size: int) -> None:
        """Nothing is taken yet."""
        self._path, self._size, self._taken = path, size, 0
        self.most = min(_MOST_BYTES, max(_MOST_SMALL, _DENSEST * size))
        """bytes"""

    def take(self, count: int) -> None:
        """Count bytes that are to be filled."""
        self._taken += count
        self.require(self._taken)

    def take_numbers(self, count: int, stored: int = 0) -> None:
        """Count what numbers take as float64 beyond the bytes that were counted for them."""
        self.take(max(8 * count, stored) - stored)

    def require(self, count: int) -> None:
        """Refuse more bytes than the file may take at all."""
        if count <= self.most:
            return
        problem = f"its content takes {size_words(count)} of memory or more, expected at most"
        if self.most == _MOST_BYTES:
            remedy = f"{size_words(self.most)}: save fewer signals, or at a lower rate"
        else:
            of = f"from a file of {size_words(self._size)}"
            remedy = f"{size_words(self.most)} {of}: it is damaged, or no log"
        raise wrong(self._path, f"{problem} {remedy}")


_LONGEST_NAME = 1000
"""letters of a column's name: patterns that look at names take their square"""


def require_short_names(path: str, names: Sequence[str]) -> None:
    """Refuse a column's name that is no name."""
    longest = max(map(len, names), default=0)
    if longest > _LONGEST_NAME:
        problem = f"expected names of columns of at most {_LONGEST_NAME} letters, got {longest}"
        raise wrong(path, problem)


def require_columns(path: str, have: Sequence[str], needed: Sequence[str]) -> None:
    """Refuse a column that is missing or stands in the file twice."""
    for name in needed:
        count = have.count(name)
        # Which of the two is meant cannot be known, and pyarrow would return either.
        if count > 1:
            raise wrong(path, f"{count} columns have this name, expected one", column(name))
        if count == 0:
            # Cut, because the search for the nearest is quadratic in the length of a name.
            known = {n[:40] for n in have if n}
            raise wrong(path, f"no column {shown(name)}{nearest(name[:40], known)}")


# Tables.


@dataclass(frozen=True)
class Survey:
    """One column of a file: `values` (N,), NaN where empty, or None where it is text; `strays` says
    which cells are no numbers where most are."""

    name: str
    values: np.ndarray | None
    n_filled: int
    strays: str = ""


class Table(Protocol):
    """Interface of a reader of tables. Rows count from 0, places are for people."""

    # A protocol and no base class: a reader is chosen by the file's ending in `open_log` alone, and
    # the next format is one more module there.

    path: str
    format: str
    size: int
    names: tuple[str, ...]
    notes: tuple[Finding, ...]
    """what was assumed or left out when it was opened"""
    units: Mapping[str, str]
    """by column, where the file states one"""

    @property
    def sha256(self) -> str:
        """Fingerprint of the whole file; waits for that of a large one."""
        ...

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty."""
        ...

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        ...

    def place(self, row: int) -> str:
        """Place of a row: `line 12` of a text file, `row 3` (from 1) of another."""
        ...

    def cell_text(self, name: str, row: int) -> str:
        """Text of a cell."""
        ...

    def time_unit(self, name: str) -> str | None:
        """The unit of a column that holds stamps of a clock by its type, otherwise None."""
        ...


# Channels.


class Channel(NamedTuple):
    """One signal: `times` (N,) [s] and `values` (N,), both float64, NaN where one is missing."""

    times: np.ndarray
    values: np.ndarray


class TableRows(NamedTuple):
    """The rows of a table that are a topic, with their stamps (N,), `scale` seconds each."""

    table: Table
    stamps: np.ndarray
    scale: float


@dataclass(frozen=True, eq=False)
class Topic:
    """Channels that were written together.

    Attributes:
        name: what the autopilot calls them.
        times: of the samples (N,) float64 [s], from the log's `origin`.
        columns: the samples (N,) by the channel's full name, in the log's own type.
        units: by the channel's full name, where the log states one.
        clock: which field the times are, in words; empty where the rows have only an order.
        rows: of a table, by which errors name their line.
    """

    name: str
    times: np.ndarray
    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    clock: str = ""
    rows: TableRows | None = None


@dataclass(frozen=True, eq=False)
class ChannelLog:
    """One flight of a file of `size` [bytes].

    Attributes:
        topics: those that hold samples.
        firmware: which wrote it, in its own words.
        parameters: the firmware's settings, by name.
        notes: what was lost or assumed when it was read.
        flight: which flight of the file it is, from 1, and of how many.
        start: when the logger began [s], where the log says so.
        origin: from which times count [s], in the log's own count.
    """

    path: str
    format: str
    size: int
    sha256: str
    topics: tuple[Topic, ...]
    firmware: str = ""
    parameters: Mapping[str, str | int | float] = field(default_factory=dict)
    notes: tuple[Finding, ...] = ()
    flight: tuple[int, int] = (1, 1)
    start: float | None = None
    origin: float = 0.0

    @classmethod
    def of_table(cls, table: Table, topics: tuple[Topic, ...], **more: Any) -> "ChannelLog":
        """Return the log of topics that were made of a table; `more` are other fields."""
        return cls(table.path, table.format, table.size, table.sha256, topics, **more)

    @property
    def names(self) -> tuple[str, ...]:
        """The channels' full names, in the order of the log."""
        return tuple(name for topic in self.topics for name in topic.columns)

    @property
    def first_time(self) -> float:
        """The time [s] from which windows count: when the logger began, or the earliest sample."""
        clocks = [t.times for t in self.topics if t.clock and t.times.size]
        earliest = min((float(times[0]) for times in clocks), default=0.0)
        latest = max((float(times[-1]) for times in clocks), default=0.0)
        if self.start is not None and self.start <= latest:
            return self.start
        # What was published once, before the logger began, is older than the flight.
        longest = [times for times in clocks if times.size > 1]
        return min((float(times[0]) for times in longest), default=earliest)

    @property
    def begin(self) -> float:
        """The time from which windows count [s], in the log's own count."""
        return self.origin + self.first_time

    def topic_of(self, name: str) -> Topic:
        """The topic that holds a channel."""
        # A search and no index: a log has some hundred topics, and names are asked for a few times.
        for topic in self.topics:
            if name in topic.columns:
                return topic
        # Cut, because the search for the nearest is quadratic in the length of a name.
        known = {n[:60] for n in self.names}
        raise wrong(self.path, f"no channel {shown(name)}{nearest(name[:60], known)}")

    def channel(self, name: str) -> Channel:
        """Times and samples of one channel."""
        topic = self.topic_of(name)
        # `info` shows such rows; only who asks for times has to be told that there are none.
        if not topic.clock:
            problem = "its rows have no times, so nothing can be fitted"
            raise wrong(self.path, problem, f"channel {shown(name)}")
        return Channel(topic.times, as_floats(topic.columns[name]))


def as_floats(values: np.ndarray) -> np.ndarray:
    """Samples (N,) of any type as float64."""
    # Damage can make a NaN of a kind that a conversion warns of; it stays NaN.
    with np.errstate(invalid="ignore"):
        return np.asarray(values, np.float64)


def require_samples(path: str, topics: Sequence[Topic]) -> None:
    """Refuse a log without any samples."""
    if not any(topic.times.size for topic in topics):
        raise wrong(path, "holds no samples, expected a flight")
