"""Reader of ArduPilot DataFlash logs, binary (.bin) and text (.log), with NumPy alone.

Source: the messages FMT, FMTU, UNIT and MULT of ArduPilot's AP_Logger. Numbers and names follow
pymavlink's DFReader. pymavlink's reader is not used: a message with length zero makes it loop
forever, and it reads one message at a time.
"""

import array
import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from heli_jax.finding import note
from heli_jax.flights import progress
from heli_jax.flights.log import ChannelLog, Topic, require_samples, wrong
from heli_jax.regular_file import read_regular

# A log begins with the format of formats: two bytes that begin every message, and its number 0x80.
MAGIC = b"\xa3\x95\x80"
_LARGEST, _LARGEST_TEXT = 2 * 10**9, 10**9
_HEAD = b"\xa3\x95"
_FMT = 0x80
# Bytes: 3 of the head, type and length, 4 of the name, 16 of the kinds and 64 of the columns.
_FMT_LENGTH = 89
_ROWS_AT_ONCE = 1 << 13
# NumPy type of each kind of field, and the factor that pymavlink multiplies it by.
FIELDS: dict[str, tuple[str, float | None]] = {
    "a": ("(32,)<i2", None), "b": ("<i1", None), "B": ("<u1", None), "g": ("<f2", None),
    "h": ("<i2", None), "H": ("<u2", None), "i": ("<i4", None), "I": ("<u4", None),
    "f": ("<f4", None), "n": ("S4", None), "N": ("S16", None), "Z": ("S64", None),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01),
    "L": ("<i4", 1e-7), "d": ("<f8", None), "M": ("<i1", None), "q": ("<i8", None),
    "Q": ("<u8", None),
}  # fmt: skip
_APART = 1.0
"""Margin before and after the board's time within which a message's time may lie [s]."""
# New firmware counts microseconds, old firmware milliseconds. In old firmware's GPS message, TimeMS
# is the time of the week and T the board's time.
_CLOCKS = {"TimeUS": 1e-6, "TimeMS": 1e-3, "T": 1e-3}
# These messages describe the log (units, parameters, firmware) and hold no samples.
_OF_LOG = ("FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG")
_PREFIXES = {1.0: "", 1e-2: "c", 1e-3: "m", 1e-6: "u", 1e-9: "n"}
# Labels of ArduPilot that `heli_jax.units` does not know, and their equivalents.
_LABELS = {"degheading": "deg", "deglatitude": "deg", "deglongitude": "deg", "satellites": "1"}


@dataclass(frozen=True)
class Format:
    """Format of a message: its name, the kinds of its fields (one letter each) and their names."""

    name: str
    kinds: str
    columns: tuple[str, ...]

    @property
    def dtype(self) -> np.dtype:
        """NumPy type of the fields in the bytes."""
        return np.dtype([(c, FIELDS[k][0]) for c, k in zip(self.columns, self.kinds, strict=True)])

    @property
    def is_valid(self) -> bool:
        """True if all fields are known and have different names."""
        return (
            len(self.kinds) == len(self.columns) == len(set(self.columns))
            and set(self.kinds) <= FIELDS.keys()
            and all(c.isprintable() and c for c in (*self.columns, self.name))
        )


class Part(NamedTuple):
    """Messages that are read by one description.

    Attributes:
        form: the description.
        number: number of the message.
        since: position of the description, in the count of `at`.
        at: positions of the messages in the file (N,), increasing; a list while they are collected.
        rows: their fields (N,), structured; for a text log a list of cells at first.
    """

    form: Format
    number: int
    since: int
    at: Any
    rows: Any


class _Messages(NamedTuple):
    """Messages of one name in the file's order, by one description or several.

    Attributes:
        name: name of the topic.
        at: positions of the messages in the file (M,).
        columns: their fields (M,), scaled.
        clocks: fields that may be the time.
        units: units by field.
    """

    name: str
    at: np.ndarray
    columns: Mapping[str, np.ndarray]
    clocks: tuple[str, ...] = ()
    units: Mapping[str, str] = MappingProxyType({})

    def seconds(self, clock: str) -> np.ndarray:
        """Return the times (M,) [s] of a clock."""
        return self.columns[clock] * _CLOCKS[clock]

    def rows(self, kept: np.ndarray) -> "_Messages":
        """Return the messages of a mask or of row numbers."""
        columns = {name: values[kept] for name, values in self.columns.items()}
        return self._replace(at=self.at[kept], columns=columns)


def open_dataflash(path: Path) -> ChannelLog:
    """Read a binary DataFlash log."""
    data = read_regular(path, "a DataFlash log", _LARGEST)
    if not data.startswith(MAGIC):
        raise wrong(str(path), "is no DataFlash log, expected one that begins with a format")
    described, damaged = _walk(data)
    raw = np.frombuffer(data, np.uint8)
    parts = []
    for part in described:
        # Messages of one description have the same length, so their bytes are gathered at once into
        # rows.
        at = np.frombuffer(part.at, np.int64)
        parts.append(part._replace(at=at, rows=_gathered(raw, at + 3, part.form.dtype)))
    return make_log(str(path), data, parts, damaged)


def _gathered(raw: np.ndarray, at: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Return the rows (N,) whose bytes begin at `at` (N,)."""
    rows = np.empty((at.size, dtype.itemsize), np.uint8)
    within = np.arange(dtype.itemsize)
    # Block by block, because an index of eight bytes for each byte takes more memory than the log.
    for i in range(0, at.size, _ROWS_AT_ONCE):
        rows[i : i + _ROWS_AT_ONCE] = raw[at[i : i + _ROWS_AT_ONCE, None] + within]
    return rows.view(dtype)[:, 0]


def _walk(data: bytes) -> tuple[list[Part], int]:
    """Return the descriptions that have messages, and the number of damaged places."""
    # The format of formats is stated here, because the first message, which describes it, cannot be
    # read without it.
    of_formats = Format("FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))
    described = [Part(of_formats, _FMT, 0, array.array("q"), None)]
    forms = {_FMT: of_formats}
    lengths = {_FMT: _FMT_LENGTH}
    starts = {_FMT: described[0].at}
    at, damaged, size, report_at = 0, 0, len(data), 0
    while at + 3 <= size:
        if at >= report_at:
            progress.advance(at)
            report_at = at + progress.STEP
        number = data[at + 2]
        length = lengths.get(number, 0)
        if data[at] != 0xA3 or data[at + 1] != 0x95 or not length:
            # Blocks that were never written are at the end and are no loss.
            blank = not data[at : at + 256].strip(b"\0") or not data[at : at + 256].strip(b"\xff")
            damaged += not blank
            at = data.find(_HEAD, at + 1)
            # Skip to the next known message. One call per byte would take minutes in a file without
            # any.
            while at >= 0 and (at + 2 >= size or data[at + 2] not in lengths):
                at = data.find(_HEAD, at + 1)
            if at < 0:
                break
            continue
        # A log rarely ends with a whole message, because the power goes off before the last block
        # is written.
        if at + length > size:
            damaged += 1
            break
        # The loop gathers only positions, because a log has millions of messages. NumPy reads the
        # numbers later.
        starts[number].append(at)
        if number == _FMT:
            taken = _format(data[at + 3 : at + length])
            damaged += taken is None
            # Every boot describes its messages again. New firmware may change a description, which
            # then holds for the messages after it.
            if taken is not None and forms.get(taken[0]) != taken[1]:
                new = Part(taken[1], taken[0], at, array.array("q"), None)
                described.append(new)
                forms[new.number], starts[new.number] = new.form, new.at
                lengths[new.number] = new.form.dtype.itemsize + 3
        at += length
    return [part for part in described if part.at], damaged


def _format(body: bytes) -> tuple[int, Format] | None:
    """Return the number and the format in a message FMT; None if it is damaged."""
    number, length = body[0], body[1]
    name, kinds, columns = (_text(part) for part in (body[2:6], body[6:22], body[22:86]))
    form = Format(name, kinds, tuple(columns.split(",")) if columns else ())
    # The length is redundant with the kinds. Agreement of both separates a format from bytes that
    # look like one.
    if not form.is_valid or length != form.dtype.itemsize + 3:
        return None
    # The format of formats is the same in every log.
    if (number == _FMT) != (name == "FMT") or (number == _FMT and length != _FMT_LENGTH):
        return None
    return number, form


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace")


def make_log(
    path: str, data: bytes, parts: Sequence[Part], damaged: int, scaled: bool = False
) -> ChannelLog:
    """Return the log that consists of these messages."""
    of_name: dict[str, list[Part]] = {}
    for part in parts:
        of_name.setdefault(part.form.name, []).append(part)
    alone = {name: _joined(name, of_name.get(name, ()), scaled) for name in _OF_LOG}
    units = _units(parts, alone)
    topics_of = [
        each
        for name, of_one in of_name.items()
        if name not in _OF_LOG
        for each in _topics_of(name, of_one, units, scaled)
    ]
    # The board's clock is that of the most frequent message with exactly one time that is not GPS
    # time.
    certain = [m for m in topics_of if len(m.clocks) == 1 and "Week" not in m.columns]
    board = None
    if certain:
        most = max(certain, key=lambda m: m.at.size)
        board = most.seconds(most.clocks[0])
    topics = []
    for messages in topics_of:
        clock = _clock(messages, board)
        topics += [_topic(each, clock) for each in _by_instance(messages)]
    require_samples(path, topics)
    notes = []
    if damaged:
        words = f"{damaged} damaged place{'' if damaged == 1 else 's'} skipped"
        notes.append(note("damage.skipped", words, value=damaged))
    # The firmware logs its name first; later messages may quote any text.
    texts = map(_text, alone["MSG"].columns.get("Message", np.array([], "S1"))[:50])
    settings = _pairs(alone["PARM"].columns, "Name", "Value")
    return ChannelLog(
        path=path,
        format="dataflash",
        size=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
        topics=tuple(topics),
        firmware=next((t for t in texts if t.startswith(("Ardu", "APM:", "Blimp", "Rover"))), ""),
        parameters={name: value for name, value in settings.items() if isinstance(value, float)},
        notes=tuple(notes),
    )


def _topics_of(
    name: str, parts: Sequence[Part], units: Mapping[int, dict[str, str]], scaled: bool
) -> Iterator[_Messages]:
    """Group messages of a name into topics: one, unless a description changes clock or unit."""
    groups: list[tuple[list[Part], dict[str, str]]] = []
    for part in parts:
        stated = units.get(id(part), {})
        for group, known in groups:
            same = _clocks(group[0].form) == _clocks(part.form)
            if same and all(known.get(c, u) == u for c, u in stated.items()):
                group.append(part)
                known |= stated
                break
        else:
            groups.append(([part], dict(stated)))
    for i, (group, stated) in enumerate(groups):
        messages = _joined(f"{name}#{i + 1}" if i else name, group, scaled)
        yield messages._replace(clocks=_clocks(group[0].form), units=stated)


def _joined(name: str, parts: Sequence[Part], scaled: bool) -> _Messages:
    """Join messages by the fields of all their descriptions; missing numbers are NaN."""

    def values(part: Part, field: str) -> np.ndarray:
        kind = dict(zip(part.form.columns, part.form.kinds, strict=True)).get(field)
        if kind is None:
            return np.full(part.at.size, np.nan)
        stored = part.rows[field]
        return stored if scaled else _multiplied(stored, FIELDS[kind][1])

    at = np.concatenate([np.zeros(0, np.int64), *(p.at for p in parts)])
    order, columns = np.argsort(at, kind="stable"), {}
    for field in dict.fromkeys(c for p in parts for c in p.form.columns):
        have = [values(part, field) for part in parts]
        # Text and numbers, or arrays and numbers, cannot be joined.
        if len({(x.ndim, x.dtype.kind == "S") for x in have}) == 1:
            columns[field] = have[0] if len(have) == 1 else np.concatenate(have)[order]
    return _Messages(name, at[order], columns)


def _multiplied(values: np.ndarray, factor: float | None) -> np.ndarray:
    if factor is None:
        return values
    # 718 / 100 is the float nearest to 7.18, 718 * 0.01 is not.
    return values / round(1.0 / factor) if factor < 1.0 else values * factor


def _by_instance(messages: _Messages) -> list[_Messages]:
    """Split the messages by instance if the log marks a field that counts instances."""
    instance = next((c for c, unit in messages.units.items() if unit == "#"), None)
    if instance is None or instance not in messages.columns:
        return [messages]
    numbers = messages.columns[instance]
    # A text log stores the count as a float.
    whole = numbers.dtype.kind in "iu" or (
        numbers.dtype.kind == "f"
        and np.all(np.isfinite(numbers) & (np.abs(numbers) < 256.0))
        and np.all(numbers == np.rint(numbers))
    )
    counts = np.unique(numbers).astype(np.int64) if whole else ()
    # A user with a single sensor expects a name without an index.
    if not len(counts) or (len(counts) == 1 and not counts[0]):
        return [messages]
    name = messages.name
    return [messages.rows(numbers == i)._replace(name=f"{name}[{i}]") for i in counts]


def _clocks(form: Format) -> tuple[str, ...]:
    """Return the fields that may be the time; some firmware puts it after the instance."""
    named = zip(form.columns, form.kinds, strict=True)
    return tuple(c for c, kind in named if c in _CLOCKS and (kind in "IQ" or c != "T"))


def _clock(messages: _Messages, board: np.ndarray | None) -> str:
    """Return the field with the board's time [s]; empty if there is none.

    Between GPS.TimeMS, which may be a time of week, and GPS.T it is the one within the other
    messages' times.
    """
    clocks = messages.clocks
    if board is None or (len(clocks) < 2 and "Week" not in messages.columns):
        return next(iter(clocks), "")
    first, last = float(np.nanmin(board)), float(np.nanmax(board))
    for clock in clocks:
        times = messages.seconds(clock)
        if np.mean((times >= first - _APART) & (times <= last + _APART)) > 0.5:
            return clock
    return ""


def _topic(messages: _Messages, clock: str) -> Topic:
    columns, units, name = {}, {}, messages.name
    for column, values in messages.columns.items():
        # Text is no signal: a mode that is written as its name cannot be an input or an output.
        if values.dtype.kind == "S":
            continue
        parts = {f"[{i}]": values[:, i] for i in range(values.shape[1])} if values.ndim > 1 else {}
        for end, part in (parts or {"": values}).items():
            columns[f"{name}.{column}{end}"] = part
            if messages.units.get(column, "#") != "#":
                units[f"{name}.{column}{end}"] = messages.units[column]
    # Without a clock only the order of the rows is known; `clock` is empty then.
    times = messages.seconds(clock) if clock else np.arange(messages.at.size, dtype=np.float64)
    return Topic(name, times, columns, units, clock)


def _units(parts: Sequence[Part], alone: Mapping[str, _Messages]) -> dict[int, dict[str, str]]:
    """Return the units of fields, by the id of the part; `#` marks a count of instances."""
    stated = alone["FMTU"].columns
    if not {"FmtType", "UnitIds"} <= set(stated):
        return {}
    labels = _pairs(alone["UNIT"].columns, "Id", "Label")
    factors = _pairs(alone["MULT"].columns, "Id", "Mult")
    units: dict[int, dict[str, str]] = {}
    # Three messages give a unit: FMTU has a letter for each field, UNIT the unit of each letter,
    # and MULT the factor of the field's number.
    ids = zip(stated["FmtType"], stated["UnitIds"], alone["FMTU"].at, strict=True)
    for row, (number, unit_ids, at) in enumerate(ids):
        of_number = [p for p in parts if p.number == int(number)]
        # Use the description that is valid at this position.
        part = next((p for p in reversed(of_number) if p.since <= at), next(iter(of_number), None))
        if part is None:
            continue
        marks = _text(bytes(unit_ids))
        scales = _text(bytes(stated["MultIds"][row])) if "MultIds" in stated else ""
        found = units[id(part)] = {}
        # The letters come from the format, because a text log stores every number as a float.
        for i, (column, kind) in enumerate(
            zip(part.form.columns[: len(marks)], part.form.kinds, strict=False)
        ):
            scale = factors.get(scales[i : i + 1], 1.0)
            unit = _unit(marks[i], labels, scale, kind)
            if unit:
                found[column] = unit
    return units


def _unit(mark: str, labels: dict[str, object], scale: object, kind: str) -> str:
    if mark == "#":
        return "#"
    label = labels.get(mark)
    if not isinstance(label, str) or not label or mark in "-?":
        return ""
    label = _LABELS.get(label, label)
    # Integers may count thousandths. Floats, and fields that are multiplied on reading, hold the
    # unit itself.
    prefix = _PREFIXES.get(float(scale) if isinstance(scale, int | float) else 1.0, "")
    stored, factor = FIELDS[kind]
    is_count = np.dtype(stored).kind in "iu" and factor is None
    return prefix + label if is_count and label in ("s", "m", "V", "A", "Hz") else label


def _pairs(columns: Mapping[str, np.ndarray], key: str, value: str) -> dict[str, object]:
    """Return one column by another; text is cut at its end, ids become letters."""
    if not {key, value} <= set(columns):
        return {}
    pairs = {}
    for mark, entry in zip(columns[key], columns[value], strict=True):
        # Ids are letters stored as signed bytes, so a damaged one may be negative. A text log
        # stores them as numbers.
        if isinstance(mark, bytes):
            letter = _text(mark)
        elif np.isfinite(mark):
            letter = chr(int(mark) & 0xFF)
        else:
            continue
        pairs[letter] = _text(entry) if isinstance(entry, bytes) else float(entry)
    return pairs


_FMT_PARTS = 5
"""Cells of a format before the names of the columns, the word FMT included."""
# Kinds of fields that hold text, of 4, 16 and 64 characters.
_TEXTS = "nNZ"


def is_dataflash_text(head: bytes) -> bool:
    """True if the first bytes of a file contain a message format."""
    return any(line.startswith(b"FMT,") for line in head.splitlines())


def open_dataflash_text(path: Path) -> ChannelLog:
    """Read a DataFlash log in text."""
    data = read_regular(path, "a DataFlash log in text", _LARGEST_TEXT)
    formats: dict[str, Part] = {}
    described: list[Part] = []
    damaged = 0
    # A last line without its end is cut off, and its numbers may be too.
    whole = data[: data.rfind(b"\n") + 1]
    damaged += len(whole) < len(data)
    # Bytes that are not UTF-8 damage only their line, not the log.
    for at, line in enumerate(io.TextIOWrapper(io.BytesIO(whole), "utf-8", "replace")):
        name, _, rest = line.rstrip("\n").partition(",")
        name = name.strip()
        if name == "FMT":
            taken = _format_of_line(rest)
            damaged += taken is None
            # New firmware may describe its messages differently after a boot.
            if taken is not None and (
                taken[1].name not in formats or formats[taken[1].name].form != taken[1]
            ):
                described.append(Part(taken[1], taken[0], at, [], []))
                formats[taken[1].name] = described[-1]
        elif name in formats:
            form, _, _, places, rows = formats[name]
            # The last cell may be a message that contains commas.
            row = [cell.strip() for cell in rest.split(",", len(form.columns) - 1)]
            if len(row) == len(form.columns):
                places.append(at)
                rows.append(row)
            else:
                damaged += 1
        # Lines of the firmware and the board come before the first format.
        elif line.strip() and formats:
            damaged += 1
    if not formats:
        raise wrong(str(path), "is no DataFlash log, expected lines of FMT that name its columns")
    parts = []
    for form, number, since, places, rows in described:
        table, good = _columns(form, rows)
        damaged += len(rows) - table.size
        if table.size:
            parts.append(Part(form, number, since, np.array(places)[good], table))
    return make_log(str(path), data, parts, damaged, scaled=True)


def _format_of_line(rest: str) -> tuple[int, Format] | None:
    """Return the number and the format in a line FMT; None if it is damaged."""
    cells = [cell.strip() for cell in rest.split(",")]
    if len(cells) < _FMT_PARTS or not cells[0].isdigit():
        return None
    # A line is FMT, type, length, name, kinds, columns. The length is that of the binary message
    # and is not used.
    form = Format(cells[2], cells[3], tuple(cells[_FMT_PARTS - 1 :]))
    # The text form of arrays is not known.
    if not form.is_valid or "a" in form.kinds:
        return None
    # Cut, because a damaged cell may hold thousands of digits, which Python refuses to convert.
    return int(cells[0][:9]), form


def _columns(form: Format, lines: list[list[str]]) -> tuple[np.ndarray, list[int]]:
    """Return the lines of one message as a structured array, and the indices of the valid ones."""
    good, parsed = [], []
    for i, row in enumerate(lines):
        try:
            parsed.append(
                tuple(
                    cell.encode() if kind in _TEXTS else float(cell)
                    for kind, cell in zip(form.kinds, row, strict=True)
                )
            )
            good.append(i)
        # The whole row is left out: its other cells are doubtful too.
        except ValueError:
            continue
    # A number in text may have decimals whatever its kind: the text log holds the value, not
    # hundredths.
    kinds = [FIELDS[kind][0] if kind in _TEXTS else "<f8" for kind in form.kinds]
    # A mode is written as its name: a column without any number is text.
    dtype = np.dtype(list(zip(form.columns, kinds, strict=True)))
    return np.array(parsed, dtype), good
