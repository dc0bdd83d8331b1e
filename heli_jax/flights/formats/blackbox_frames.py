"""Blackbox format: the header, the fields of a frame, and the search for frames.

The header has lines `H name:value` that describe the frames. A decoder takes the bytes of the log
(B,) uint8 and the positions (M,) of M groups of fields. It returns the values, int32 (M, k), and
the positions (M,) after the groups. Unsigned numbers are kept as int32 with the same bits, which
halves the memory traffic. A position beyond the end reads the last byte, so the caller must compare
the positions with the size.

Source: the field encodings in 'Blackbox logging internals' of Cleanflight, data version 2.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from heli_jax.flights.log import shown, wrong

Decoded = tuple[np.ndarray, np.ndarray]

SIGNED_VB, UNSIGNED_VB, NEG_14BIT, TAG8_8SVB = 0, 1, 3, 6
TAG2_3S32, TAG8_4S16, NULL, TAG2_3SVARIABLE = 7, 8, 9, 10

LARGEST_GROUP = {TAG8_8SVB: 8, TAG2_3S32: 3, TAG8_4S16: 4, TAG2_3SVARIABLE: 3}
"""Number of fields that share a tag, by encoding. Other encodings have one field a group."""


def unsigned_vb(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Decode numbers of seven bits a byte, lowest first; the top bit means that one follows."""
    return _variable(data, at, _SEVEN_BITS)


def signed_vb(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Decode zigzag numbers: 0, -1, 1, -2, ... are stored as 0, 1, 2, 3, ..."""
    return _variable(data, at, _ZIGZAG)


def _variable(data: np.ndarray, at: np.ndarray, of_one_byte: np.ndarray) -> Decoded:
    """Decode numbers of variable length; `of_one_byte` holds the value of each single byte."""
    first = data.take(at, mode="clip")
    # Most numbers are small differences from a prediction and end with their first byte. A table
    # decodes these, so only longer numbers need a second pass.
    values = of_one_byte.take(first)
    # The sum makes a new array, because the caller still needs the original positions.
    after = at + 1
    long = np.flatnonzero(first & 128)
    if long.size:
        numbers, after[long] = _long_numbers(data, at[long])
        values[long] = _unfolded(numbers) if of_one_byte is _ZIGZAG else numbers.view(np.int32)
    return values[:, None], after


def _long_numbers(data: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers (M,) uint32 of two and more bytes, and the positions after them."""
    values, at = _bytes(data, at) & 127, at + 1
    more = np.arange(at.size)
    for shift in (7, 14, 21, 28):
        byte = _bytes(data, at[more])
        # Five groups have 35 bits and a number of the firmware has 32. The shift drops the top
        # bits.
        values[more] |= (byte & 127) << shift
        at[more] += 1
        more = more[(byte & 128) != 0]
        if not more.size:
            break
    # 32 bits end with the fifth byte, so a longer number is damage. The firmware's own tools read
    # it as zero.
    values[more] = 0
    return values, at


def _unfolded(numbers: np.ndarray) -> np.ndarray:
    return ((numbers >> 1) ^ -(numbers & 1)).view(np.int32)


_SEVEN_BITS = (np.arange(256, dtype=np.uint32) & 127).view(np.int32)
_ZIGZAG = _unfolded(np.arange(256, dtype=np.uint32) & 127)


def negative_14_bit(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Decode 14-bit numbers that are stored negated, such as a falling battery voltage."""
    values, at = unsigned_vb(data, at)
    return -_signed(values.view(np.uint32), 14), at


def tag8_8svb(data: np.ndarray, at: np.ndarray, count: int) -> Decoded:
    """Decode up to eight fields; a tag byte marks the nonzero ones. A single field has no tag."""
    # The firmware omits the tag of a single field, where it would cost more than it saves.
    if count == 1:
        return signed_vb(data, at)
    tag, at = _bytes(data, at), at + 1
    values = np.zeros((at.size, count), np.int32)
    for k in range(count):
        present = np.flatnonzero((tag >> k) & 1)
        if present.size:
            numbers, after = signed_vb(data, at[present])
            values[present, k], at[present] = numbers[:, 0], after
    return values, at


def tag8_4s16(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Decode four fields of 0, 4, 8 or 16 bits; a leading byte has a 2-bit size code for each."""
    tag, start = _bytes(data, at), at + 1
    values = np.zeros((at.size, 4), np.int32)
    nibble = np.zeros(at.size, np.int64)
    for k in range(4):
        size = (tag >> (2 * k)) & 3
        # Code 0 is not in the list: the field takes no bits and its value stays zero.
        for code, bits in ((1, 4), (2, 8), (3, 16)):
            i = np.flatnonzero(size == code)
            if not i.size:
                continue
            # A field may begin in the middle of a byte. Three bytes always contain it.
            first = start[i] + (nibble[i] >> 1)
            three = _joined(data, first, 3)
            shift = (24 - 4 * (nibble[i] & 1) - bits).astype(np.uint32)
            values[i, k] = _signed(three >> shift, bits)
            nibble[i] += bits // 4
    # The next group begins at a whole byte, so a remaining half byte is skipped.
    return values, start + ((nibble + 1) >> 1)


# Bits and shifts of the three fields, by the top two bits of the first byte. The word has one byte
# more than that code.
_TAG2_3S32 = (((2, 4), (2, 2), (2, 0)), ((4, 8), (4, 4), (4, 0)), ((6, 16), (6, 8), (6, 0)))
_TAG2_3SVARIABLE = (((2, 4), (2, 2), (2, 0)), ((5, 9), (5, 4), (4, 0)), ((8, 14), (7, 7), (7, 0)))


def tag2_3s32(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Decode three fields of 2, 4 or 6 bits or whole bytes, by the top two bits of the first."""
    return _three(data, at, _TAG2_3S32)


def tag2_3svariable(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Decode three fields of 2, 2, 2 or 5, 5, 4 or 8, 7, 7 bits, or of whole bytes."""
    return _three(data, at, _TAG2_3SVARIABLE)


def _three(
    data: np.ndarray, at: np.ndarray, layouts: tuple[tuple[tuple[int, int], ...], ...]
) -> Decoded:
    lead = _bytes(data, at)
    values = np.zeros((at.size, 3), np.int32)
    kind = lead >> 6
    # For kind 3 only the first byte is certain; the field lengths in it are added one by one.
    after = at + 1 + np.where(kind < 3, kind, 0).astype(np.int64)
    for code, layout in enumerate(layouts):
        i = np.flatnonzero(kind == code)
        if i.size:
            word = _joined(data, at[i], code + 1)
            for k, (bits, shift) in enumerate(layout):
                values[i, k] = _signed(word >> shift, bits)
    # The positions are advanced in place, because each field begins where the previous one ends.
    _whole_bytes(data, lead, values, after, np.flatnonzero(kind == 3))
    return values, after


def _whole_bytes(
    data: np.ndarray, lead: np.ndarray, values: np.ndarray, after: np.ndarray, i: np.ndarray
) -> None:
    """Decode fields of one to four bytes, lowest first, into rows `i` of `values` and `after`."""
    for k in range(3):
        size = (lead[i] >> (2 * k)) & 3
        for code in range(4):
            j = i[size == code]
            if j.size:
                number = np.zeros(j.size, np.uint32)
                for n in range(code + 1):
                    number |= _bytes(data, after[j] + n) << (8 * n)
                values[j, k] = _signed(number, 8 * (code + 1))
                after[j] += code + 1


def _bytes(data: np.ndarray, at: np.ndarray) -> np.ndarray:
    # Positions are clipped, because most are guesses that may lie beyond the end of the file. Four
    # bytes wide, because shifted uint8 values would overflow.
    return data.take(at, mode="clip").astype(np.uint32)


def _joined(data: np.ndarray, at: np.ndarray, count: int) -> np.ndarray:
    """Return `count` bytes as one number, the highest first."""
    number = _bytes(data, at)
    for n in range(1, count):
        number = (number << 8) | _bytes(data, at + n)
    return number


def _signed(number: np.ndarray, bits: int) -> np.ndarray:
    """Return the lowest `bits` bits as two's complement."""
    # Adding half the range before the mask and subtracting it afterwards needs no branch, so it
    # works on whole arrays.
    half = 1 << (bits - 1)
    return (((number + half) & ((1 << bits) - 1)) - half).view(np.int32)


def _nothing(data: np.ndarray, at: np.ndarray) -> Decoded:
    # The field takes no byte of the frame: its value is the prediction.
    return np.zeros((at.size, 1), np.int32), at


_ALONE: dict[int, Callable[[np.ndarray, np.ndarray], Decoded]] = {
    SIGNED_VB: signed_vb,
    UNSIGNED_VB: unsigned_vb,
    NEG_14BIT: negative_14_bit,
    TAG2_3S32: tag2_3s32,
    TAG8_4S16: tag8_4s16,
    NULL: _nothing,
    TAG2_3SVARIABLE: tag2_3svariable,
}

KNOWN = frozenset((*_ALONE, TAG8_8SVB))


def decode(data: np.ndarray, at: np.ndarray, encodings: tuple[int, ...]) -> Decoded:
    """Decode all fields (M, F) of frames of one kind whose fields begin at `at` (M,)."""
    values = np.empty((at.size, len(encodings)), np.int32)
    field = 0
    while field < len(encodings):
        encoding = encodings[field]
        # Neighbouring fields of one encoding share a tag, up to the size of its group.
        end = field + 1
        while (
            end < len(encodings)
            and encodings[end] == encoding
            and end - field < LARGEST_GROUP.get(encoding, 1)
        ):
            end += 1
        # Only this group's layout depends on the number of fields in it. The others always hold a
        # full group, and surplus fields are dropped.
        if encoding == TAG8_8SVB:
            numbers, at = tag8_8svb(data, at, end - field)
        else:
            numbers, at = _ALONE[encoding](data, at)
        values[:, field:end] = numbers[:, : end - field]
        field = end
    return values, at


MARK = b"H Product:Blackbox flight data recorder by Nicholas Sherlock"
"""First bytes of every flight in a file."""

PREVIOUS, STRAIGHT_LINE, AVERAGE, MIN_THROTTLE, MOTOR_0, INCREMENT = 1, 2, 3, 4, 5, 6
FIFTEEN_HUNDRED, VBAT_REFERENCE, MIN_MOTOR = 8, 9, 11
_LAST_PREDICTOR = MIN_MOTOR
_MOST_FIELDS = 256
"""Largest number of fields in a frame, ten times that of the largest frame firmware writes."""
_LONGEST_HEADER = 1 << 20
_MOST_ITERATIONS = 1 << 16
"""Most iterations between two I frames; firmware writes one in 32 ms."""


@dataclass(frozen=True)
class FrameLayout:
    """Fields of one kind of frame; each tuple is (F,), in the order of the bytes."""

    names: tuple[str, ...]
    signed: tuple[bool, ...]
    predictors: tuple[int, ...]
    encodings: tuple[int, ...]


@dataclass(frozen=True)
class Header:
    """Header of a flight.

    `settings` are by name, `layouts` by the frames' letter. `start` is the position of the first
    frame [bytes from the beginning of the flight].
    """

    settings: dict[str, str]
    layouts: dict[str, FrameLayout]
    start: int

    def integer(self, name: str, default: int) -> int:
        """Return a setting as an integer: its only number or the first of several."""
        match = re.match(r"\s*(-?\d{1,10})\b", self.settings.get(name, ""))
        return int(match[1]) if match else default

    @property
    def intervals(self) -> tuple[int, int, int]:
        """Iterations between I frames, and the logged share as two numbers: part, whole."""
        between = self.integer("I interval", 1)
        match = re.fullmatch(r"(\d{1,5})(?:/(\d{1,5}))?", self.settings.get("P interval", "1/1"))
        # Old firmware writes a fraction, 1/2; new firmware writes only the divisor, 2.
        part, whole = (1, 1) if not match else (int(match[1]), int(match[2] or 0))
        if match and not match[2]:
            part, whole = 1, part
        # Bounded, because the prediction allocates an array of the iterations between I frames, and
        # a damaged header may contain any number.
        return min(max(between, 1), _MOST_ITERATIONS), part, max(whole, 1)


def read_header(path: str, data: bytes) -> Header:
    """Read the header at the beginning of `data`, which is one flight of the file `path`."""
    settings, at = {}, 0
    while data.startswith(b"H ", at):
        end = data.find(b"\n", at, at + _LONGEST_HEADER)
        if end < 0 or end > _LONGEST_HEADER:
            raise wrong(path, "the header is cut off, expected frames behind it")
        # Latin-1 decodes any byte, so a craft name in another encoding does not refuse the flight.
        name, _, value = data[at + 2 : end].decode("latin-1").partition(":")
        settings[name.strip()] = value.strip()
        at = end + 1
    version = settings.get("Data version", "")
    # Other versions pack the same encodings differently and would give wrong numbers without an
    # error.
    if version != "2":
        raise wrong(path, f"data version {shown(version)}, expected 2", "blackbox header")
    layouts = {
        letter: _layout(path, settings, letter) for letter in "ISGH" if _has(settings, letter)
    }
    # Both kinds are needed: P frames are differences from I frames, and I frames come only every 32
    # ms.
    if "I" not in layouts or "Field P predictor" not in settings:
        raise wrong(path, "no fields of I and P frames, expected both", "blackbox header")
    layouts["P"] = _layout(path, settings, "P", layouts["I"])
    if "time" not in layouts["I"].names:
        raise wrong(path, "no field 'time' in the I frames, expected one", "blackbox header")
    return Header(settings, layouts, at)


def _has(settings: dict[str, str], letter: str) -> bool:
    return f"Field {letter} name" in settings


def _layout(
    path: str, settings: dict[str, str], letter: str, named: FrameLayout | None = None
) -> FrameLayout:
    """Return the fields of one kind of frame; P frames take names and signs from `named`."""
    if named is None:
        names = tuple(settings[f"Field {letter} name"].split(","))
        if len(names) > _MOST_FIELDS or len(set(names)) < len(names) or "" in names:
            problem = (
                f"expected at most {_MOST_FIELDS} different names, got {shown(','.join(names))}"
            )
            raise wrong(path, problem, "blackbox header", f"Field {letter} name")
        signed = _listed_numbers(path, settings, f"Field {letter} signed", len(names))
    else:
        names, signed = named.names, named.signed
    predictors = _listed_numbers(path, settings, f"Field {letter} predictor", len(names))
    encodings = _listed_numbers(path, settings, f"Field {letter} encoding", len(names))
    # A field of unknown length makes everything after it unreadable, so the flight is refused
    # before any frame is decoded.
    for kind, numbers, known in (
        ("predictor", predictors, range(_LAST_PREDICTOR + 1)),
        ("encoding", encodings, KNOWN),
    ):
        unknown = next((n for n in numbers if n not in known), None)
        if unknown is not None:
            problem = f"{kind} {unknown} cannot be read, expected one of {sorted(known)}"
            raise wrong(path, problem, "blackbox header", f"Field {letter} {kind}")
    return FrameLayout(names, tuple(map(bool, signed)), tuple(predictors), tuple(encodings))


def _listed_numbers(path: str, settings: dict[str, str], name: str, count: int) -> tuple[int, ...]:
    text = settings.get(name, "")
    if not re.fullmatch(r"\d{1,3}(,\d{1,3})*", text) or text.count(",") + 1 != count:
        problem = f"expected {count} numbers with commas between them, got {shown(text)}"
        raise wrong(path, problem, "blackbox header", name)
    return tuple(int(number) for number in text.split(","))


# Frames have no length: each ends where the next begins, and that is known only after its fields
# are decoded. Decoding frame by frame is a hundred times too slow in Python. Therefore every byte
# that might begin a frame is treated as one, and NumPy decodes all of them at once. A walk from
# each frame's end to the next one's beginning keeps the real frames. If none follows, the log is
# damaged, and the walk goes on at the next candidate.

LONGEST_FRAME = 256
"""Longest frame [bytes], as in the firmware's own tools; a longer one is damage."""
_CELLS_AT_ONCE = 1 << 25
"""Largest number of 32-bit cells in a piece if each of its bytes were a frame."""
_LONGEST_PIECE = 1 << 20
"""Longest piece [bytes]; in a shorter one, calls of NumPy cost more than decoding."""
_EVENT = ord("E")
_END_OF_LOG = b"End of log\0"

# Fields of an event by its type; each v is one number of variable length. Types 50 to 52 are
# Rotorflight's.
_EVENTS = {0: "v", 14: "vv", 15: "v", 30: "vv", 50: "v", 51: "v", 52: "v"}
_ADJUSTMENT, _RESUME, _CUSTOM, _END = 13, 14, (100, 101), 255


@dataclass
class Frames:
    """Frames of one flight, by the letter of their kind, in the order of the file.

    `rows` (M, F) int32 are the numbers as written, before prediction; `starts` (M,) are the frames'
    positions [bytes]. `damage` (D,) are the positions without a valid frame, `resumes` those where
    the firmware continued after a pause. `end` is True if the firmware closed the log.
    """

    rows: dict[str, np.ndarray]
    starts: dict[str, np.ndarray]
    damage: list[int] = field(default_factory=list)
    resumes: list[int] = field(default_factory=list)
    end: bool = False


def find_frames(data: bytes, start: int, layouts: dict[str, FrameLayout]) -> Frames:
    """Find all frames of a flight."""
    return _Walk(data, start, layouts).run()


@dataclass(frozen=True)
class _Candidates:
    """Bytes (M,) that may begin a frame, where it would end, and its numbers (M, F)."""

    starts: np.ndarray
    ends: np.ndarray
    values: np.ndarray

    def at(self, rows: np.ndarray) -> "_Candidates":
        return _Candidates(self.starts[rows], self.ends[rows], self.values[rows])


class _Walk:
    def __init__(self, data: bytes, start: int, layouts: dict[str, FrameLayout]) -> None:
        self.data, self.at, self.layouts = data, start, layouts
        self.size = len(data)
        self.bytes = np.frombuffer(data, np.uint8)
        self.is_letter = np.zeros(256, bool)
        self.is_letter[[*map(ord, layouts), _EVENT]] = True
        # A piece is so long that the numbers of all candidates fit in memory. Any byte may be a
        # candidate, with as many numbers as the widest frame.
        widest = max(len(layout.names) for layout in layouts.values())
        self.piece = max(1024, min(_LONGEST_PIECE, _CELLS_AT_ONCE // widest))
        self.frames = Frames({}, {})
        self.kept: dict[str, list[_Candidates]] = {letter: [] for letter in layouts}
        self.in_damage = False

    def run(self) -> Frames:
        while self.at < self.size and not self.frames.end:
            self._walk_piece(self.at, min(self.at + self.piece, self.size))
        for letter, pieces in self.kept.items():
            none = np.zeros((0, len(self.layouts[letter].names)), np.int32)
            self.frames.rows[letter] = np.concatenate([none, *(p.values for p in pieces)])
            starts = [p.starts for p in pieces]
            self.frames.starts[letter] = np.concatenate([np.zeros(0, np.int64), *starts])
            pieces.clear()
        return self.frames

    def _walk_piece(self, first: int, last: int) -> None:
        """Walk from `self.at` to the first frame that begins at `last` or after it."""
        candidates = {letter: self._candidates(letter, first, last) for letter in self.layouts}
        # One table serves all kinds of frames, because a byte is the letter of at most one kind.
        starts = np.concatenate([each.starts for each in candidates.values()])
        ends = np.concatenate([each.ends for each in candidates.values()])
        end_of = dict(zip(starts.tolist(), ends.tolist(), strict=True))
        starts.sort()
        # A letter within another frame's numbers is a candidate too. Only candidates reached from
        # the end of a frame are frames.
        is_frame = np.zeros(last - first, bool)
        while self.at < last and not self.frames.end:
            end = end_of.get(self.at, 0)
            if end:
                is_frame[self.at - first] = True
            # Events are decoded one by one: they are rare, and each type has its own form.
            elif self.data[self.at] == _EVENT:
                end = self._event_end(self.at)
            if end:
                self.at, self.in_damage = end, False
                continue
            self._note_damage()
            # Continue at the next candidate, not the next letter: a letter within numbers seldom
            # leads to another one.
            following = int(np.searchsorted(starts, self.at, side="right"))
            self.at = int(starts[following]) if following < starts.size else last
        for letter, each in candidates.items():
            self.kept[letter].append(each.at(np.flatnonzero(is_frame[each.starts - first])))

    def _candidates(self, letter: str, first: int, last: int) -> _Candidates:
        starts = first + np.flatnonzero(self.bytes[first:last] == ord(letter))
        values, ends = decode(self.bytes, starts + 1, self.layouts[letter].encodings)
        # A frame leads to another one or to the end of the file.
        whole = (ends <= self.size) & (ends - starts <= LONGEST_FRAME)
        # A byte is often a letter by chance. A second letter at the frame's end makes a real frame
        # likely.
        follows = self.is_letter[self.bytes.take(ends, mode="clip")]
        found = _Candidates(starts, ends, values)
        return found.at(np.flatnonzero(whole & (follows | (ends == self.size))))

    def _note_damage(self) -> None:
        rest = self.data[self.at : self.at + LONGEST_FRAME]
        # Erased memory after the last frame is no loss.
        blank = not rest.strip(b"\xff") or not rest.strip(b"\0")
        if not self.in_damage and not blank:
            self.frames.damage.append(self.at)
        self.in_damage = True

    def _event_end(self, at: int) -> int:
        """Return the end of the event at `at`; 0 if there is none."""
        kind = self.data[at + 1] if at + 1 < len(self.data) else -1
        # Damage produces the one-byte type by chance, but not the words after it. The end of a log
        # needs both.
        if kind == _END:
            self.frames.end = self.data.startswith(_END_OF_LOG, at + 2)
            return at + 2 + len(_END_OF_LOG) if self.frames.end else 0
        end = self._numbers_end(at + 2, kind)
        if not end or end > len(self.data):
            return 0
        if end < len(self.data) and not self.is_letter[self.data[end]]:
            return 0
        if kind == _RESUME:
            self.frames.resumes.append(at)
        return end

    def _numbers_end(self, at: int, kind: int) -> int:
        if kind == _ADJUSTMENT and at < len(self.data):
            # A float of four bytes if the function's top bit is set, else a number.
            return at + 5 if self.data[at] >= 128 else self._skip_numbers(at + 1, 1)
        if kind in _CUSTOM and at < len(self.data):
            return at + 1 + self.data[at]
        if kind in _EVENTS:
            return self._skip_numbers(at, len(_EVENTS[kind]))
        return 0

    def _skip_numbers(self, at: int, count: int) -> int:
        for _ in range(count):
            # A 32-bit number has at most five bytes; without this limit, damage could claim the
            # rest of the file.
            length = next((n for n, b in enumerate(self.data[at : at + 5], 1) if b < 128), 5)
            at += length
        return at
