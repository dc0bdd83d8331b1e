"""ArduPilot DataFlash logs, binary (.bin) and as text (.log), read with NumPy alone.

Source: the format of the messages FMT, FMTU, UNIT and MULT of ArduPilot's AP_Logger. Numbers and
names are those of pymavlink's DFReader, which is not used: a message that claims a length of zero
never lets it end, and it reads one message at a time.
"""

import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heli_jax.flights import progress
from heli_jax.flights.digest import Digest
from heli_jax.flights.log import ChannelLog, Topic, require_samples
from heli_jax.flights.table import wrong
from heli_jax.regular_file import read_regular

# The first message of a log is the format of formats: two bytes with which every message begins,
# and its number 0x80.
MAGIC = b"\xa3\x95\x80"
_LARGEST = 2 * 10**9
_HEAD = b"\xa3\x95"
_FMT = 0x80
# Bytes: three of the head, type and length, 4 of the name, 16 of the kinds and 64 of the columns.
_FMT_LENGTH = 89
_ROWS_AT_ONCE = 1 << 13
# How a field is stored, and what pymavlink multiplies it with.
FIELDS: dict[str, tuple[str, float | None]] = {
    "a": ("(32,)<i2", None), "b": ("<i1", None), "B": ("<u1", None), "g": ("<f2", None),
    "h": ("<i2", None), "H": ("<u2", None), "i": ("<i4", None), "I": ("<u4", None),
    "f": ("<f4", None), "n": ("S4", None), "N": ("S16", None), "Z": ("S64", None),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01),
    "L": ("<i4", 1e-7), "d": ("<f8", None), "M": ("<i1", None), "q": ("<i8", None),
    "Q": ("<u8", None),
}  # fmt: skip
_FEWEST_ROWS = 10
"""of a message, from which on a time that is out of order stands out"""
# New firmware counts microseconds, old firmware milliseconds.
_CLOCKS = {"TimeUS": 1e-6, "TimeMS": 1e-3}
_PREFIXES = {1.0: "", 1e-2: "c", 1e-3: "m", 1e-6: "u", 1e-9: "n"}
# Labels of ArduPilot that `heli_jax.units` does not know, in words that it does.
_LABELS = {"degheading": "deg", "deglatitude": "deg", "deglongitude": "deg", "satellites": "1"}


@dataclass(frozen=True)
class Format:
    """What a message FMT says of another: its fields' kinds, one letter each, and their names."""

    name: str
    kinds: str
    columns: tuple[str, ...]

    @property
    def dtype(self) -> np.dtype:
        """How the fields stand in the bytes."""
        return np.dtype([(c, FIELDS[k][0]) for c, k in zip(self.columns, self.kinds, strict=True)])

    @property
    def is_valid(self) -> bool:
        """Whether the fields are known, each with a name of its own."""
        return (
            len(self.kinds) == len(self.columns) == len(set(self.columns))
            and set(self.kinds) <= FIELDS.keys()
            and all(c.isprintable() and c for c in (*self.columns, self.name))
        )


def open_dataflash(path: Path) -> ChannelLog:
    """The flight of a binary DataFlash log.

    Raises:
        InputError: it is no DataFlash log, or holds no samples.
        OSError: it cannot be read.
    """
    data = read_regular(path, "a DataFlash log", _LARGEST)
    if not data.startswith(MAGIC):
        raise wrong(str(path), "is no DataFlash log, expected one that begins with a format")
    formats, starts, damaged = _walk(data)
    raw = np.frombuffer(data, np.uint8)
    rows = {}
    for number, places in starts.items():
        form = formats[number]
        dtype = form.dtype
        # Messages of one kind are of one length, so all of them are taken out of the bytes at once.
        # Each message's bytes become a row, whose columns are then the fields.
        rows[form.name] = _gathered(raw, np.frombuffer(places, np.int64) + 3, dtype)
    by_name = {form.name: form for form in formats.values()}
    names = {number: form.name for number, form in formats.items()}
    return make_log(str(path), data, rows, by_name, names, damaged)


def _gathered(raw: np.ndarray, at: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The rows (N,) whose bytes begin at `at` (N,)."""
    rows = np.empty((at.size, dtype.itemsize), np.uint8)
    within = np.arange(dtype.itemsize)
    # A block at a time: an index of eight bytes for each byte takes more than the log.
    for i in range(0, at.size, _ROWS_AT_ONCE):
        rows[i : i + _ROWS_AT_ONCE] = raw[at[i : i + _ROWS_AT_ONCE, None] + within]
    return rows.view(dtype)[:, 0]


def _walk(data: bytes) -> tuple[dict[int, Format], dict[int, array.array], int]:
    """The formats by number, where the messages of each begin, and how often there was neither."""
    # The format of formats is stated here, since without it the first message could not be read,
    # which states it again.
    formats = {_FMT: Format("FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))}
    lengths = {_FMT: _FMT_LENGTH}
    starts: dict[int, array.array] = {}
    at, damaged, size, report_at = 0, 0, len(data), 0
    while at + 3 <= size:
        if at >= report_at:
            progress.advance(at)
            report_at = at + progress.STEP
        number = data[at + 2]
        length = lengths.get(number, 0)
        if data[at] != 0xA3 or data[at + 1] != 0x95 or not length:
            # Blocks that were never written stand at the end, and are no loss.
            blank = not data[at : at + 256].strip(b"\0") or not data[at : at + 256].strip(b"\xff")
            damaged += not blank
            at = data.find(_HEAD, at + 1)
            # On to a message that is known: one call a byte would take minutes where none is.
            while at >= 0 and (at + 2 >= size or data[at + 2] not in lengths):
                at = data.find(_HEAD, at + 1)
            if at < 0:
                break
            continue
        # The power goes off before the last block is written: a log seldom ends with a whole
        # message.
        if at + length > size:
            damaged += 1
            break
        if number == _FMT and not _take_format(data[at + 3 : at + length], formats, lengths):
            damaged += 1
        # Positions alone are gathered in this loop, and the numbers are read by NumPy afterwards: a
        # log has millions of messages.
        places = starts.get(number)
        if places is None:
            places = starts[number] = array.array("q")
        places.append(at)
        at += length
    return formats, starts, damaged


def _take_format(body: bytes, formats: dict[int, Format], lengths: dict[int, int]) -> bool:
    number, length = body[0], body[1]
    name, kinds, columns = (_text(part) for part in (body[2:6], body[6:22], body[22:86]))
    form = Format(name, kinds, tuple(columns.split(",")) if columns else ())
    # The length is stated beside the kinds that give it. That both agree tells a format from bytes
    # that look like one.
    if not form.is_valid or length != form.dtype.itemsize + 3:
        return False
    # A log has one format a number: another is damage that looks like a message.
    if number in formats:
        return formats[number] == form
    # The rows are kept by name, so the same name under a second number would take the place of the
    # first.
    if name in {f.name for f in formats.values()}:
        return False
    formats[number], lengths[number] = form, length
    return True


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace")


def make_log(
    path: str,
    data: bytes,
    rows: dict[str, np.ndarray],
    formats: dict[str, Format],
    numbers: dict[int, str],
    damaged: int,
    scaled: bool = False,
) -> ChannelLog:
    """The log that messages make.

    Args:
        path: of the file.
        data: its bytes.
        rows: the messages' fields (N,) by the message's name, structured.
        formats: what was said of each message.
        numbers: the names of messages by number.
        damaged: how many places were no message.
        scaled: whether fields hold numbers that were multiplied already, as text does.

    Raises:
        InputError: no message holds a number.
    """
    units = _units(rows, formats, numbers)
    topics = []
    for name, table in rows.items():
        # These messages describe the log and are no samples: what they say is in units, parameters
        # and firmware.
        if name not in ("FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG"):
            of_message, lost = _topics(formats[name], table, units.get(name, {}), scaled)
            topics += of_message
            damaged += lost
    require_samples(path, topics)
    return ChannelLog(
        path=path,
        format="dataflash",
        size=len(data),
        sha256=Digest(data).hex(),
        topics=tuple(topics),
        firmware=_firmware(rows),
        parameters=_parameters(rows),
        notes=(f"{damaged} damaged place{'' if damaged == 1 else 's'} skipped",) if damaged else (),
    )


def _topics(
    form: Format, table: np.ndarray, units: dict[str, str], scaled: bool
) -> tuple[list[Topic], int]:
    """A message's topics, one for each instance where the log says which field counts them, and
    how many messages are damaged by their times."""
    tables = _by_instance(form, table, units)
    kept = {name: _in_order(form, rows) for name, rows in tables.items()}
    lost = sum(tables[name].size - rows.size for name, rows in kept.items())
    return [_topic(name, form, rows, units, scaled) for name, rows in kept.items()], lost


def _by_instance(form: Format, table: np.ndarray, units: dict[str, str]) -> dict[str, np.ndarray]:
    instance = next((c for c, unit in units.items() if unit == "#"), None)
    # In text a count is read as any number is.
    if instance is None or not _are_counts(table[instance]):
        return {form.name: table}
    counts = np.unique(table[instance]).astype(np.int64)
    # A machine with one sensor has instance 0 alone; a name without an index is what its user
    # expects.
    if len(counts) == 1 and not counts[0]:
        return {form.name: table}
    return {f"{form.name}[{i}]": table[table[instance] == i] for i in counts}


def _in_order(form: Format, table: np.ndarray) -> np.ndarray:
    """The rows without single ones whose time lies outside of those around them, as where a log was
    cut off in a message: where the others are in order, and these are few."""
    clock = _clock(form)
    if not clock or table.size < _FEWEST_ROWS:
        return table
    times = table[clock].astype(np.float64)
    back = np.flatnonzero(np.diff(times) < 0) + 1
    if not 0 < back.size <= max(1, table.size // 1000):
        return table
    # A row before which the times go back is the wrong one, or the one before it is: whichever
    # leaves the others in order.
    wrong_rows = [
        row if row + 1 == table.size or times[row + 1] >= times[row - 1] else row - 1
        for row in back
    ]
    kept = np.delete(table, wrong_rows)
    return kept if np.all(np.diff(kept[clock].astype(np.float64)) >= 0) else table


def _clock(form: Format) -> str:
    """The field with the time; some firmware puts it behind the instance."""
    return next((c for c in form.columns if c in _CLOCKS), "")


def _are_counts(values: np.ndarray) -> bool:
    if values.dtype.kind in "iu":
        return True
    whole = values.dtype.kind == "f" and np.isfinite(values) & (np.abs(values) < 256.0)
    return bool(np.all(whole)) and bool(np.all(values == np.rint(values)))


def _topic(
    name: str, form: Format, table: np.ndarray, units: dict[str, str], scaled: bool
) -> Topic:
    columns, named = {}, {}
    for column, kind in zip(form.columns, form.kinds, strict=True):
        values, factor = table[column], FIELDS[kind][1]
        # Text is no signal: a mode that is written as its name cannot be an input or an output.
        if values.dtype.kind == "S":
            continue
        if factor is not None and not scaled:
            # 718 / 100 is the number nearest to 7.18, 718 * 0.01 is not.
            values = values / round(1.0 / factor) if factor < 1.0 else values * factor
        parts = {f"[{i}]": values[:, i] for i in range(values.shape[1])} if values.ndim > 1 else {}
        for end, part in (parts or {"": values}).items():
            columns[f"{name}.{column}{end}"] = part
            if units.get(column, "#") != "#":
                named[f"{name}.{column}{end}"] = units[column]
    clock = _clock(form)
    # Without a clock the rows have their order alone, which `clock` says by being empty.
    times = table[clock] * _CLOCKS[clock] if clock else np.arange(len(table), dtype=np.float64)
    return Topic(name, times, columns, named, clock)


def _units(
    rows: dict[str, np.ndarray], formats: dict[str, Format], numbers: dict[int, str]
) -> dict[str, dict[str, str]]:
    """The units of each message's fields, by its name; `#` is that of a count of instances."""
    if "FMTU" not in rows or not {"FmtType", "UnitIds"} <= set(rows["FMTU"].dtype.names or ()):
        return {}
    labels = _pairs(rows.get("UNIT"), "Id", "Label")
    factors = _pairs(rows.get("MULT"), "Id", "Mult")
    units: dict[str, dict[str, str]] = {}
    # A unit is told in three messages: FMTU has a letter for each field of a format, UNIT says
    # which unit the letter is, MULT what the field's number has to be multiplied with.
    for row in rows["FMTU"]:
        name = numbers.get(int(row["FmtType"]), "")
        if name not in rows:
            continue
        marks = _text(bytes(row["UnitIds"]))
        scales = _text(bytes(row["MultIds"])) if "MultIds" in row.dtype.names else ""
        units[name] = {}
        # By the letters of the format, since text has whole numbers as any other.
        for i, (column, kind) in enumerate(
            zip(formats[name].columns[: len(marks)], formats[name].kinds, strict=False)
        ):
            scale = factors.get(scales[i : i + 1], 1.0)
            unit = _unit(marks[i], labels, scale, kind)
            if unit:
                units[name][column] = unit
    return units


def _unit(mark: str, labels: dict[str, object], scale: object, kind: str) -> str:
    if mark == "#":
        return "#"
    label = labels.get(mark)
    if not isinstance(label, str) or not label or mark in "-?":
        return ""
    label = _LABELS.get(label, label)
    # Whole numbers may count thousandths; floats, and fields that are multiplied when they are
    # read, hold the unit itself.
    prefix = _PREFIXES.get(float(scale) if isinstance(scale, int | float) else 1.0, "")
    stored, factor = FIELDS[kind]
    is_count = np.dtype(stored).kind in "iu" and factor is None
    return prefix + label if is_count and label in ("s", "m", "V", "A", "Hz") else label


def _pairs(table: np.ndarray | None, key: str, value: str) -> dict[str, object]:
    """A column by another; of text both without what stands behind the end, ids as letters."""
    if table is None or not {key, value} <= set(table.dtype.names or ()):
        return {}
    pairs = {}
    for row in table:
        entry = row[value]
        # Ids are letters that are stored as signed bytes, and a damaged one may be negative. In
        # text they stand as numbers.
        if isinstance(row[key], bytes):
            mark = _text(row[key])
        elif np.isfinite(row[key]):
            mark = chr(int(row[key]) & 0xFF)
        else:
            continue
        pairs[mark] = _text(entry) if isinstance(entry, bytes) else float(entry)
    return pairs


def _parameters(rows: dict[str, np.ndarray]) -> dict[str, str | int | float]:
    return {
        name: value
        for name, value in _pairs(rows.get("PARM"), "Name", "Value").items()
        if isinstance(value, float)
    }


def _firmware(rows: dict[str, np.ndarray]) -> str:
    """The first message that names an ArduPilot."""
    messages = rows.get("MSG")
    if messages is None or "Message" not in (messages.dtype.names or ()):
        return ""
    # The firmware names itself when it begins to log; messages of the flight may quote anything.
    texts = [_text(text) for text in messages["Message"][:50]]
    return next((t for t in texts if t.startswith(("Ardu", "APM:", "Blimp", "Rover"))), "")
