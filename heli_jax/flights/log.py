"""Log of any file format: a table of named columns, or channels on separate clocks.

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
    """Return the error for a file: `file, place, place: problem`, in one line."""
    # Names from a file may hold line breaks or escape sequences, which a terminal would obey.
    within = ": ".join((*([", ".join(place)] if place else []), problem))
    text = f"{path}{', ' if place else ': '}{within}"
    return InputError(
        *(re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029]+", " ", t) for t in (text, within))
    )


def shown(text: str) -> str:
    """Return text from a file, quoted, cut to 40 characters."""
    # Cut, because a damaged file may have a name as long as the file.
    return repr(text) if len(text) <= 40 else repr(text[:40]) + "..."


def listed(words: Iterable[str]) -> str:
    """Return the first six words, and the number of the others."""
    each = list(words)
    more = f" and {len(each) - 6} more" if len(each) > 6 else ""
    return f"{', '.join(each[:6])}{more}"


def column(name: str) -> str:
    """Return `column 'phi'`, as a place."""
    return f"column {shown(name)}"


def sample_count(count: int) -> str:
    """Return `1 sample`, `2 samples`."""
    return "1 sample" if count == 1 else f"{count} samples"


MOST_COLUMNS = 10_000
"""Most columns of a log."""


def require_few_columns(path: str, count: int, *place: str) -> None:
    """Refuse more columns than any log has."""
    if count > MOST_COLUMNS:
        raise wrong(path, f"expected at most {MOST_COLUMNS} columns, got {count}", *place)


_MOST_BYTES = 24 * 10**8
"""Most bytes of all numbers of a file as float64: 3e8 numbers."""
_MOST_SMALL = 250 * 10**6
_DENSEST = 200
"""Largest memory per byte of a file, if it exceeds `_MOST_SMALL`. A constant signal packs by a
thousand, sensor data by less than ten."""


class Budget:
    """Memory that a file may use, checked before allocation: a few bytes can claim many zeros."""

    def __init__(self, path: str, size: int) -> None:
        """Start with no memory used."""
        self._path, self._size, self._taken = path, size, 0
        self.most = min(_MOST_BYTES, max(_MOST_SMALL, _DENSEST * size))
        """Most bytes."""

    def take(self, count: int) -> None:
        """Count bytes that will be filled."""
        self._taken += count
        self.require(self._taken)

    def take_numbers(self, count: int, stored: int = 0) -> None:
        """Count the memory of numbers as float64 beyond the bytes already counted for them."""
        self.take(max(8 * count, stored) - stored)

    def require(self, count: int) -> None:
        """Refuse more bytes than the file may use."""
        if count <= self.most:
            return
        problem = f"its content needs at least {size_words(count)} of memory"
        expected = f"at most {size_words(self.most)} from a file of {size_words(self._size)}"
        raise wrong(self._path, f"{problem}, expected {expected}: it is damaged or too large")


_LONGEST_NAME = 1000
"""Longest column name [characters]; the time of patterns on names grows with its square."""


def require_short_names(path: str, names: Sequence[str]) -> None:
    """Refuse a column name that is too long."""
    longest = max(map(len, names), default=0)
    if longest > _LONGEST_NAME:
        problem = f"expected names of columns of at most {_LONGEST_NAME} letters, got {longest}"
        raise wrong(path, problem)


def require_columns(path: str, have: Sequence[str], needed: Sequence[str]) -> None:
    """Refuse a column that is missing or occurs twice."""
    for name in needed:
        count = have.count(name)
        # It is unknown which of the two is meant, and pyarrow would return either.
        if count > 1:
            raise wrong(path, f"{count} columns have this name, expected one", column(name))
        if count == 0:
            # Cut, because the search for the nearest is quadratic in the length of a name.
            known = {n[:40] for n in have if n}
            raise wrong(path, f"no column {shown(name)}{nearest(name[:40], known)}")


# Tables.


@dataclass(frozen=True)
class Survey:
    """One column of a file: `values` (N,), NaN where empty, or None for text.

    `strays` lists the cells that are no numbers, if most are.
    """

    name: str
    values: np.ndarray | None
    n_filled: int
    strays: str = ""


class Table(Protocol):
    """Interface of table readers. Rows count from 0; places are for people."""

    # A protocol, not a base class: `open_log` chooses a reader by the file's ending, and a new
    # format is one more module there.

    path: str
    format: str
    size: int
    names: tuple[str, ...]
    notes: tuple[Finding, ...]
    """Assumptions and omissions when the file was opened."""
    units: Mapping[str, str]
    """Units by column, if the file states them."""

    @property
    def sha256(self) -> str:
        """SHA-256 of the whole file; waits for that of a large one."""
        ...

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return the columns as float64 (N,), NaN where a cell is empty."""
        ...

    def survey(self) -> list[Survey]:
        """Survey every column, in the file's order."""
        ...

    def place(self, row: int) -> str:
        """Return the place of a row: `line 12` of a text file, `row 3` (from 1) of another."""
        ...

    def cell_text(self, name: str, row: int) -> str:
        """Return the text of a cell."""
        ...

    def time_unit(self, name: str) -> str | None:
        """Return the unit of a column whose type is a time stamp, otherwise None."""
        ...


# Channels.


class Channel(NamedTuple):
    """One signal: `times` (N,) [s] and `values` (N,), both float64, NaN if missing."""

    times: np.ndarray
    values: np.ndarray


class TableRows(NamedTuple):
    """Rows of a table that form a topic, with their stamps (N,), `scale` seconds each."""

    table: Table
    stamps: np.ndarray
    scale: float


@dataclass(frozen=True, eq=False)
class Topic:
    """Channels that were written together.

    Attributes:
        name: the autopilot's name of the topic.
        times: times of the samples (N,) float64 [s], from the log's `origin`.
        columns: samples (N,) by the channel's full name, in the log's own type.
        units: units by the channel's full name, if the log states them.
        clock: field of the times, in words; empty if the rows have only an order.
        rows: rows of a table, by which errors name their line.
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
        topics: topics with samples.
        firmware: firmware that wrote the log, in its own words.
        parameters: the firmware's settings, by name.
        notes: losses and assumptions on reading.
        flight: number of the flight in the file, from 1, and the count of flights.
        start: time when the logger began [s], if the log states it.
        origin: zero of the times [s], in the log's own count.
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
        """Return the log of topics made from a table; `more` are other fields."""
        return cls(table.path, table.format, table.size, table.sha256, topics, **more)

    @property
    def names(self) -> tuple[str, ...]:
        """The channels' full names, in the order of the log."""
        return tuple(name for topic in self.topics for name in topic.columns)

    @property
    def first_time(self) -> float:
        """Zero of windows [s]: when the logger began, or the earliest sample."""
        clocks = [t.times for t in self.topics if t.clock and t.times.size]
        earliest = min((float(times[0]) for times in clocks), default=0.0)
        latest = max((float(times[-1]) for times in clocks), default=0.0)
        if self.start is not None and self.start <= latest:
            return self.start
        # A sample published once, before the logger began, is older than the flight.
        longest = [times for times in clocks if times.size > 1]
        return min((float(times[0]) for times in longest), default=earliest)

    @property
    def begin(self) -> float:
        """Zero of windows [s], in the log's own count."""
        return self.origin + self.first_time

    def topic_of(self, name: str) -> Topic:
        """Return the topic that holds a channel."""
        # A search needs no index: a log has some hundred topics, and names are looked up a few
        # times.
        for topic in self.topics:
            if name in topic.columns:
                return topic
        # Cut, because the search for the nearest is quadratic in the length of a name.
        known = {n[:60] for n in self.names}
        raise wrong(self.path, f"no channel {shown(name)}{nearest(name[:60], known)}")

    def channel(self, name: str) -> Channel:
        """Return times and samples of one channel."""
        topic = self.topic_of(name)
        # `info` shows such rows; only a request for times fails.
        if not topic.clock:
            problem = "its rows have no times, so nothing can be fitted"
            raise wrong(self.path, problem, f"channel {shown(name)}")
        return Channel(topic.times, as_floats(topic.columns[name]))


def as_floats(values: np.ndarray) -> np.ndarray:
    """Return samples (N,) of any type as float64."""
    # A damaged log may hold a NaN that warns on conversion; it stays NaN.
    with np.errstate(invalid="ignore"):
        return np.asarray(values, np.float64)


def require_samples(path: str, topics: Sequence[Topic]) -> None:
    """Refuse a log without samples."""
    if not any(topic.times.size for topic in topics):
        raise wrong(path, "holds no samples, expected a flight")
