"""A log as channels, whatever the file's format: each topic of an autopilot has a clock of its own.

A table of rows becomes a log of one topic (`heli_jax/flights/read_table.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from heli_jax.errors import nearest
from heli_jax.finding import Finding
from heli_jax.flights.table import Table, shown, wrong

_APART = 1.0
"""s before and after the others' samples that a topic on their clock may have some"""


_PX4_COMMANDS = ("actuator_", "vehicle_torque_setpoint", "vehicle_thrust_setpoint")
"""topics of PX4; their `timestamp_sample` is that of the gyro's sample that they answer"""


def holds_commands(name: str) -> bool:
    """True for the name of a topic of PX4, or of a file made of one, that holds commands: they act
    from when they are published."""
    return any(topic in name for topic in _PX4_COMMANDS)


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
        cautions: what speaks against its times, which every fit repeats.
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
    cautions: tuple[Finding, ...] = ()
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
            problem = "its rows have an order and no times, so nothing can be fitted to them"
            raise wrong(self.path, problem, f"channel {shown(name)}")
        return Channel(topic.times, as_floats(topic.columns[name]))


def sharing_clocks(
    clocks: Mapping[str, np.ndarray], shared: tuple[float, float]
) -> tuple[str, ...]:
    """The columns of times of one topic that are on the other topics' clock, the nearest first."""
    first, last = shared
    within = {
        name: float(np.mean((times >= first - _APART) & (times <= last + _APART)))
        for name, times in clocks.items()
        if times.size
    }
    return tuple(sorted((n for n, part in within.items() if part > 0.5), key=lambda n: -within[n]))


def as_floats(values: np.ndarray) -> np.ndarray:
    """Samples (N,) of any type as float64."""
    # Damage can make a NaN of a kind that a conversion warns of; it stays NaN.
    with np.errstate(invalid="ignore"):
        return np.asarray(values, np.float64)


def require_samples(path: str, topics: Sequence[Topic]) -> None:
    """Refuse a log without any samples."""
    if not any(topic.times.size for topic in topics):
        raise wrong(path, "holds no samples, expected a flight")
