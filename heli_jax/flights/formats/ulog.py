"""PX4 ULog files (.ulg), read with NumPy alone.

Source: the ULog file format of the PX4 user guide. Numbers, names and the treatment of damage are
those of pyulog, which is not used: what a damaged file claims has to be bounded before it is read.
"""

import hashlib
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from heli_jax.finding import note
from heli_jax.flights import progress
from heli_jax.flights.log import ChannelLog, Topic, require_samples, wrong
from heli_jax.regular_file import read_regular

MAGIC = b"ULog\x01\x12\x35"
_SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_LARGEST = 2 * 10**9
_LONGEST_MESSAGE = 10_000
"""bytes, of a kind that is not known: what claims more is damage"""
_MOST_FIELDS = 5_000
_DEEPEST = 8
"""levels of types within types"""
_MOST_TOPICS = 5_000
_MOST_IN_ALL = 200_000
"""fields of all topics: logs have some thousand"""
_FAR = 86_400_000_000
"""us: a row whose stamp is a day from its topic's others is damage"""
_TYPES = {
    "int8_t": "<i1", "uint8_t": "<u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "<i1", "char": "<i1",
}  # fmt: skip
# At most five digits of a length: what claims more is damage, and would be laid out field by field.
_FIELD = re.compile(r"([A-Za-z_]\w*)(?:\[(\d{1,5})\])? ([A-Za-z_]\w*)")
# Kinds of messages by letter. Newer firmware may add others, which are passed over by their length.
_KNOWN = frozenset(b"BFIMPQARDLCSO")
_PARSED = frozenset(b"FIPAB")
_DATA, _FLAGS = b"DB"
_HEADER = 16
"""bytes before the first message"""


_COMMANDS = ("actuator_", "vehicle_torque_setpoint", "vehicle_thrust_setpoint")
"""topics whose `timestamp_sample` is that of the gyro's sample that they answer; commands act from
when they are published"""


class _Damaged(Exception):
    """A message does not hold what its kind has to."""


@dataclass
class _Subscription:
    """The messages of one topic's instance, and how their bytes are read."""

    name: str
    instance: int
    dtype: np.dtype
    longest: int
    """bytes of a message with the padding that may be left out"""
    data: bytearray = field(default_factory=bytearray)


@dataclass
class _Content:
    formats: dict[str, list[tuple[str, int, str]]] = field(default_factory=dict)
    subscriptions: dict[int, _Subscription] = field(default_factory=dict)
    closed: list[_Subscription] = field(default_factory=list)
    information: dict[str, str | int | float] = field(default_factory=dict)
    parameters: dict[str, str | int | float] = field(default_factory=dict)
    appended: list[int] = field(default_factory=list)
    n_fields: int = 0
    damaged: int = 0
    lost: int = 0
    """bytes of what is damaged"""
    mark: int = 0
    """the end of the logger's next mark, as far as it was looked for"""
    dropouts: int = 0
    dropped: int = 0
    """ms"""


def open_ulog(path: Path) -> ChannelLog:
    """The flight of a ULog file.

    A topic's times are `timestamp_sample`, of the sample itself, where there is one; otherwise
    `timestamp`, when it was published. So are those of commands, which act from then on: their
    `timestamp_sample` is that of the gyro's sample that they were computed from.
    """
    data = read_regular(path, "a ULog file", _LARGEST)
    if len(data) < 16 or not data.startswith(MAGIC):
        raise wrong(str(path), "is no ULog file, expected one that begins with its mark")
    content = _Content()
    _read_messages(str(path), data, content)
    topics = _topics(content)
    require_samples(str(path), topics)
    notes = []
    if content.damaged:
        share = 100 * content.lost / len(data)
        words = f"damaged messages skipped: {content.damaged}, {share:.2g} % of the file"
        notes.append(note("damage.skipped", words, value=content.damaged))
    if content.dropouts:
        lost = content.dropped * 1e-3
        words = f"times the logger dropped data: {content.dropouts}, {lost:.3g} s in all"
        notes.append(note("damage.dropouts", words, value=lost))
    information = content.information
    parts = (information.get("sys_name", ""), information.get("ver_hw", ""), _version(information))
    return ChannelLog(
        path=str(path),
        format="ulog",
        size=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
        topics=topics,
        firmware=" ".join(str(part) for part in parts if part),
        parameters=content.parameters,
        notes=tuple(notes),
        # Behind the mark stands when the logger began, in the count of the topics' own stamps [us].
        start=struct.unpack("<Q", data[8:16])[0] * 1e-6,
    )


def _version(information: dict[str, str | int | float]) -> str:
    release = information.get("ver_sw_release")
    if isinstance(release, int) and release >> 24 & 0xFF:
        return f"{release >> 24 & 0xFF}.{release >> 16 & 0xFF}.{release >> 8 & 0xFF}"
    return str(information.get("ver_sw", ""))[:12]


def _read_messages(path: str, data: bytes, content: _Content) -> None:
    """All messages, what was appended after a crash included."""
    at, end, report_at = _HEADER, len(data), _HEADER
    while at + 3 <= end:
        if at >= report_at:
            progress.advance(at)
            report_at = at + progress.STEP
        size, kind = data[at] | data[at + 1] << 8, data[at + 2]
        body, after = at + 3, at + 3 + size
        # The part before one that was appended ends with a message that was cut.
        limit = min((o for o in content.appended if at < o <= end), default=end)
        topic = _topic_of(data, at, content) if kind == _DATA else None
        if topic is not None and after <= limit:  # nearly all of them
            topic.data += data[body + 2 : body + 2 + topic.dtype.itemsize]
        elif after <= limit and _is_whole(path, data, at, limit, content):
            pass
        elif after <= limit and _begins(data, at, limit) and _begins(data, after, limit):
            # Its length is right: samples of an unknown topic, or another kind that was hit.
            if kind in _KNOWN:
                content.damaged += 1
                content.lost += after - at
        else:
            # Damage, so that its length is no way on; or cut off by the end of the file.
            content.damaged += 1
            after = min(_next_message(data, at, limit, content), limit)
            content.lost += after - at
            if after == end:
                return
        at = after


def _topic_of(data: bytes, at: int, content: _Content) -> _Subscription | None:
    """Whose samples the message D at a place holds; None where it is damaged."""
    size = data[at] | data[at + 1] << 8
    if size < 2 or at + 5 > len(data):
        return None
    topic = content.subscriptions.get(data[at + 3] | data[at + 4] << 8)
    # A message may leave out the padding at its end, so any length from that without it to that
    # with all of it is right. Any other is damage.
    if topic is None or not topic.dtype.itemsize <= size - 2 <= topic.longest:
        return None
    return topic


def _is_whole(path: str, data: bytes, at: int, end: int, content: _Content) -> bool:
    """Take in a message that is no D; False where it is damaged, or of a kind that is not known."""
    size, kind = data[at] | data[at + 1] << 8, data[at + 2]
    # Flags stand at the beginning alone.
    if kind not in _KNOWN or kind == _DATA or (kind == _FLAGS and at != _HEADER):
        return False
    try:
        _take(path, chr(kind), data[at + 3 : at + 3 + size], content)
    except (_Damaged, struct.error, IndexError):
        return False
    # Of other kinds any bytes may be one.
    return kind in _PARSED or _begins(data, at + 3 + size, end)


def _begins(data: bytes, at: int, end: int) -> bool:
    """True if a message may begin here, or the file ends."""
    if at + 3 > end:
        return at == end
    size, kind = data[at] | data[at + 1] << 8, data[at + 2]
    # A length of zero or a huge one is none of newer firmware.
    return kind in _KNOWN or bool(kind and 0 < size <= _LONGEST_MESSAGE)


def _next_message(data: bytes, at: int, end: int, content: _Content) -> int:
    """The next place with samples of a known topic and a message behind them, or behind the next
    mark that the logger writes from time to time; otherwise the end."""
    # The mark is itself a message, S, whose body it is; the next message begins right behind it.
    if content.mark < at:
        mark = data.find(_SYNC, at)
        content.mark = mark + len(_SYNC) if mark >= 0 else len(data)
    end = min(content.mark, end)
    place = at + 1
    while (place := data.find(b"D", place + 2, end) - 2) >= 0:
        size = data[place] | data[place + 1] << 8
        if _topic_of(data, place, content) and _begins(data, place + 3 + size, end):
            return place
        place += 1
    return end


def _take(path: str, kind: str, body: bytes, content: _Content) -> None:
    match kind:
        case "F":
            _take_format(body, content)
        case "I":
            key, value = _key_value(body)
            content.information[key] = value
        case "P":
            key, value = _key_value(body)
            # The first value stays: the logger writes a parameter again whenever somebody changes
            # it in flight.
            content.parameters.setdefault(key, value)
        case "A":
            _take_subscription(body, content)
        case "O":
            content.dropped += struct.unpack("<H", body[:2])[0]
            content.dropouts += 1
        case "B":
            flags = body[8:16]
            # A flag that is not known may mean that the data are laid out in another way, and the
            # format asks readers to refuse such a file. The one that is known says that data were
            # appended.
            if len(flags) < 8 or flags[0] & ~1 or any(flags[1:]):
                raise wrong(path, "is a ULog file of a kind that is not known, expected version 1")
            if flags[0] & 1 and len(body) >= 40:
                content.appended = [o for o in struct.unpack("<3Q", body[16:40]) if o]


def _take_format(body: bytes, content: _Content) -> None:
    name, _, fields = body.decode("utf-8", "ignore").partition(":")
    parsed = []
    for text in filter(None, fields.split(";")):
        match = _FIELD.fullmatch(text)
        if not match:
            raise _Damaged
        parsed.append((match[1], int(match[2] or 1), match[3]))
    # Nothing could be laid out of such a type, however often it stands in another.
    if not parsed:
        raise _Damaged
    content.formats[name] = parsed


def _key_value(body: bytes) -> tuple[str, str | int | float]:
    kind, _, key = body[1 : 1 + body[0]].decode("utf-8", "ignore").partition(" ")
    raw = body[1 + body[0] :]
    if kind.startswith("char["):
        return key, raw.decode("utf-8", "ignore").rstrip("\0")
    if kind not in _TYPES or len(raw) != np.dtype(_TYPES[kind]).itemsize or not key:
        raise _Damaged
    return key, np.frombuffer(raw, _TYPES[kind])[0].item()


def _take_subscription(body: bytes, content: _Content) -> None:
    instance, number = struct.unpack("<BH", body[:3])
    name = body[3:].decode("utf-8", "ignore")
    fields: list[tuple[str, str]] = []
    if len(content.subscriptions) + len(content.closed) >= _MOST_TOPICS:
        raise _Damaged
    if content.n_fields >= _MOST_IN_ALL:
        raise _Damaged
    _flatten("", name, content, fields, 0)
    # With all padding, before what stands at the end is taken off: firmware writes it or not.
    longest = sum(np.dtype(kind).itemsize for _, kind in fields)
    while fields and fields[-1][0].startswith("_padding"):
        fields.pop()
    names = [field_name for field_name, _ in fields]
    # The rows become a structured array, whose fields need names of their own.
    if "timestamp" not in names or len(set(names)) < len(names):
        raise _Damaged
    content.n_fields += len(fields)
    before = content.subscriptions.get(number)
    if before is not None:
        # A number that is given anew is another topic's from here on; what was gathered under it
        # stays.
        content.closed.append(before)
    content.subscriptions[number] = _Subscription(name, instance, np.dtype(fields), longest)


def _flatten(
    prefix: str, kind: str, content: _Content, fields: list[tuple[str, str]], depth: int
) -> None:
    """The fields of a type, those of types within it as `outer.inner` and `outer[0].inner`."""
    if kind not in content.formats or depth > _DEEPEST:
        raise _Damaged
    for inner, count, name in content.formats[kind]:
        for i in range(count):
            if len(fields) >= _MOST_FIELDS:
                raise _Damaged
            full = f"{prefix}{name}[{i}]" if count > 1 else prefix + name
            if inner in _TYPES:
                fields.append((full, _TYPES[inner]))
            else:
                _flatten(f"{full}.", inner, content, fields, depth + 1)


def _topics(content: _Content) -> tuple[Topic, ...]:
    whole = [s for s in (*content.closed, *content.subscriptions.values()) if s.data]
    whole.sort(key=lambda s: (s.name, s.instance))
    merged: dict[tuple[str, int], list[np.ndarray]] = {}
    for s in whole:
        rows = np.frombuffer(s.data, s.dtype)
        stamps = rows["timestamp"].astype(np.float64)
        middle = (stamps.size - 1) // 2
        near = np.abs(stamps - np.partition(stamps, middle)[middle]) <= _FAR
        content.damaged += int(np.count_nonzero(~near))
        merged.setdefault((s.name, s.instance), []).append(rows if near.all() else rows[near])
    topics = []
    for (name, instance), parts in merged.items():
        rows = parts[0]
        # A topic may be subscribed to more than once; its rows then follow each other.
        if len(parts) > 1 and all(p.dtype == rows.dtype for p in parts):
            rows = np.concatenate(parts)
        several = sum(other == name for other, _ in merged) > 1
        shown = f"{name}[{instance}]" if several or instance else name
        clock = _clock(name, rows)
        columns = {f"{shown}.{n}": rows[n] for n in rows.dtype.names or () if "_padding" not in n}
        units = {f"{shown}.{n}": "us" for n in ("timestamp", "timestamp_sample")}
        units = {n: unit for n, unit in units.items() if n in columns}
        topics.append(Topic(shown, rows[clock] * 1e-6, columns, units, clock))
    return tuple(topics)


def _clock(name: str, rows: np.ndarray) -> str:
    names = rows.dtype.names or ()
    if "timestamp_sample" in names and not any(topic in name for topic in _COMMANDS):
        stamps = rows["timestamp_sample"]
        # Some modules leave the field at zero, or publish one sample twice.
        if stamps.dtype.kind == "u" and stamps[0] > 0 and np.all(stamps[1:] > stamps[:-1]):
            return "timestamp_sample"
    return "timestamp"
