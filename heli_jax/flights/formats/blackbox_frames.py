"""Blackbox format: header, fields of a frame, and the places of frames.

The header is lines of `H name:value` that say how the frames are written. Every decoder takes the
bytes of the log (B,) uint8 and the positions (M,) where M groups of fields begin, and returns their
values, int32 (M, k), and the positions (M,) behind them. Numbers without a sign are the same bits:
half the memory, which is what decoding waits for. A position beyond the end reads the last byte:
the caller compares the positions behind with the size.

Source: the field encodings as documented in 'Blackbox logging internals' of Cleanflight, data
version 2.
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
"""fields that share a tag, by encoding; those of the others stand alone"""


def unsigned_vb(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Numbers of seven bits a byte, the lowest first; the top bit says that more follow."""
    return _variable(data, at, _SEVEN_BITS)


def signed_vb(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Zigzag: 0, -1, 1, -2, ... stand as 0, 1, 2, 3, ..."""
    return _variable(data, at, _ZIGZAG)


def _variable(data: np.ndarray, at: np.ndarray, of_one_byte: np.ndarray) -> Decoded:
    """Numbers of a variable length; `of_one_byte` are those of a single byte, by the byte."""
    first = data.take(at, mode="clip")
    # Most end with their first byte, since what is logged are small differences from a prediction:
    # a table has these, and only the numbers that go on are looked at again.
    values = of_one_byte.take(first)
    # The sum makes a new array: the caller still needs the positions at which the groups begin.
    after = at + 1
    long = np.flatnonzero(first & 128)
    if long.size:
        numbers, after[long] = _long_numbers(data, at[long])
        values[long] = _unfolded(numbers) if of_one_byte is _ZIGZAG else numbers.view(np.int32)
    return values[:, None], after


def _long_numbers(data: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (M,) uint32 of two bytes and more, and the positions behind them."""
    values, at = _bytes(data, at) & 127, at + 1
    more = np.arange(at.size)
    for shift in (7, 14, 21, 28):
        byte = _bytes(data, at[more])
        # Five groups of seven bits are 35, of which a number of the firmware has the lowest 32: the
        # others are shifted out.
        values[more] |= (byte & 127) << shift
        at[more] += 1
        more = more[(byte & 128) != 0]
        if not more.size:
            break
    # 32 bits end with the fifth byte: a number that goes on is damage, which the firmware's own
    # tools read as zero.
    values[more] = 0
    return values, at


def _unfolded(numbers: np.ndarray) -> np.ndarray:
    return ((numbers >> 1) ^ -(numbers & 1)).view(np.int32)


_SEVEN_BITS = (np.arange(256, dtype=np.uint32) & 127).view(np.int32)
_ZIGZAG = _unfolded(np.arange(256, dtype=np.uint32) & 127)


def negative_14_bit(data: np.ndarray, at: np.ndarray) -> Decoded:
    """The negative of a number of 14 bits, as a falling battery voltage is kept."""
    values, at = unsigned_vb(data, at)
    return -_signed(values.view(np.uint32), 14), at


def tag8_8svb(data: np.ndarray, at: np.ndarray, count: int) -> Decoded:
    """A byte says which of up to eight fields are not zero; these follow. One alone has no tag."""
    # The tag would take more room than it saves, so the firmware leaves it out.
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
    """Four fields of 0, 4, 8 or 16 bits in a row of nibbles, as two bits each of a byte say."""
    tag, start = _bytes(data, at), at + 1
    values = np.zeros((at.size, 4), np.int32)
    nibble = np.zeros(at.size, np.int64)
    for k in range(4):
        size = (tag >> (2 * k)) & 3
        # Code 0 is missing: such a field takes no bits, and its value stays zero.
        for code, bits in ((1, 4), (2, 8), (3, 16)):
            i = np.flatnonzero(size == code)
            if not i.size:
                continue
            # A field may begin in the middle of a byte: three bytes always hold it.
            first = start[i] + (nibble[i] >> 1)
            three = _joined(data, first, 3)
            shift = (24 - 4 * (nibble[i] & 1) - bits).astype(np.uint32)
            values[i, k] = _signed(three >> shift, bits)
            nibble[i] += bits // 4
    # The next field begins with a whole byte: half a byte that is left over stays empty.
    return values, start + ((nibble + 1) >> 1)


# Bits and shifts of the three fields, by the two bits on top of the first byte; a word is as many
# bytes long as the code says, plus one.
_TAG2_3S32 = (((2, 4), (2, 2), (2, 0)), ((4, 8), (4, 4), (4, 0)), ((6, 16), (6, 8), (6, 0)))
_TAG2_3SVARIABLE = (((2, 4), (2, 2), (2, 0)), ((5, 9), (5, 4), (4, 0)), ((8, 14), (7, 7), (7, 0)))


def tag2_3s32(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Three fields of 2, 4 or 6 bits each, or of whole bytes, as two bits of the first say."""
    return _three(data, at, _TAG2_3S32)


def tag2_3svariable(data: np.ndarray, at: np.ndarray) -> Decoded:
    """Three fields of 2, 2, 2 or 5, 5, 4 or 8, 7, 7 bits, or of whole bytes."""
    return _three(data, at, _TAG2_3SVARIABLE)


def _three(
    data: np.ndarray, at: np.ndarray, layouts: tuple[tuple[tuple[int, int], ...], ...]
) -> Decoded:
    lead = _bytes(data, at)
    values = np.zeros((at.size, 3), np.int32)
    kind = lead >> 6
    # Of kind 3 only the first byte is sure; the lengths that stand in it are added field by field.
    after = at + 1 + np.where(kind < 3, kind, 0).astype(np.int64)
    for code, layout in enumerate(layouts):
        i = np.flatnonzero(kind == code)
        if i.size:
            word = _joined(data, at[i], code + 1)
            for k, (bits, shift) in enumerate(layout):
                values[i, k] = _signed(word >> shift, bits)
    # The positions are moved on in place: where a field begins depends on how long those before it
    # are.
    _whole_bytes(data, lead, values, after, np.flatnonzero(kind == 3))
    return values, after


def _whole_bytes(
    data: np.ndarray, lead: np.ndarray, values: np.ndarray, after: np.ndarray, i: np.ndarray
) -> None:
    """Fields of one to four bytes each, the lowest first, into `values` and `after` at rows `i`."""
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
    # Clipped, because most positions are guesses that may lie beyond the end of the file. Four
    # bytes wide, because shifted bytes of uint8 would overflow.
    return data.take(at, mode="clip").astype(np.uint32)


def _joined(data: np.ndarray, at: np.ndarray, count: int) -> np.ndarray:
    """`count` bytes as one number, the highest first."""
    number = _bytes(data, at)
    for n in range(1, count):
        number = (number << 8) | _bytes(data, at + n)
    return number


def _signed(number: np.ndarray, bits: int) -> np.ndarray:
    """The lowest `bits` bits as two's complement."""
    # Half the range is added before the mask and taken off behind it. That needs no branch, so that
    # it does for whole arrays what a comparison does for one number.
    half = 1 << (bits - 1)
    return (((number + half) & ((1 << bits) - 1)) - half).view(np.int32)


def _nothing(data: np.ndarray, at: np.ndarray) -> Decoded:
    # Such a field takes no byte of the frame: its prediction is its value.
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
    """All fields (M, F) of frames of one kind whose fields begin at `at` (M,)."""
    values = np.empty((at.size, len(encodings)), np.int32)
    field = 0
    while field < len(encodings):
        encoding = encodings[field]
        # Neighbours of one encoding share a tag, up to as many as it has room for.
        end = field + 1
        while (
            end < len(encodings)
            and encodings[end] == encoding
            and end - field < LARGEST_GROUP.get(encoding, 1)
        ):
            end += 1
        # The only group whose layout depends on how many fields are in it. The others always hold
        # as many as there is room for, and what is too many is left out.
        if encoding == TAG8_8SVB:
            numbers, at = tag8_8svb(data, at, end - field)
        else:
            numbers, at = _ALONE[encoding](data, at)
        values[:, field:end] = numbers[:, : end - field]
        field = end
    return values, at


MARK = b"H Product:Blackbox flight data recorder by Nicholas Sherlock"
"""with which every flight of a file begins"""

PREVIOUS, STRAIGHT_LINE, AVERAGE, MIN_THROTTLE, MOTOR_0, INCREMENT = 1, 2, 3, 4, 5, 6
FIFTEEN_HUNDRED, VBAT_REFERENCE, MIN_MOTOR = 8, 9, 11
_LAST_PREDICTOR = MIN_MOTOR
_MOST_FIELDS = 256
"""of a frame: ten times what firmware writes in its largest"""
_LONGEST_HEADER = 1 << 20
_MOST_ITERATIONS = 1 << 16
"""between two I frames: firmware writes one in 32 ms"""


@dataclass(frozen=True)
class FrameLayout:
    """The fields of one kind of frame; each tuple is (F,), in the order of the bytes."""

    names: tuple[str, ...]
    signed: tuple[bool, ...]
    predictors: tuple[int, ...]
    encodings: tuple[int, ...]


@dataclass(frozen=True)
class Header:
    """Header: `settings` by name, `layouts` by the frames' letter.

    `start` is where the frames begin [bytes from the flight's first].
    """

    settings: dict[str, str]
    layouts: dict[str, FrameLayout]
    start: int

    def integer(self, name: str, default: int) -> int:
        """A setting of one number, or the first of several, as firmware of any age writes it."""
        match = re.match(r"\s*(-?\d{1,10})\b", self.settings.get(name, ""))
        return int(match[1]) if match else default

    @property
    def intervals(self) -> tuple[int, int, int]:
        """Iterations between I frames, and of how many iterations how many are logged."""
        between = self.integer("I interval", 1)
        match = re.fullmatch(r"(\d{1,5})(?:/(\d{1,5}))?", self.settings.get("P interval", "1/1"))
        # Old firmware writes a share, 1/2; new firmware a divisor alone, 2.
        part, whole = (1, 1) if not match else (int(match[1]), int(match[2] or 0))
        if match and not match[2]:
            part, whole = 1, part
        # Bounded, because the iterations between I frames are laid out as an array by whoever
        # predicts them, and the header of a damaged file may claim any number.
        return min(max(between, 1), _MOST_ITERATIONS), part, max(whole, 1)


def read_header(path: str, data: bytes) -> Header:
    """The header at the beginning of `data`, which is one flight of the file `path`."""
    settings, at = {}, 0
    while data.startswith(b"H ", at):
        end = data.find(b"\n", at, at + _LONGEST_HEADER)
        if end < 0 or end > _LONGEST_HEADER:
            raise wrong(path, "the header is cut off, expected frames behind it")
        # In Latin-1 every byte is a letter: the name of a craft in another encoding must not refuse
        # the flight.
        name, _, value = data[at + 2 : end].decode("latin-1").partition(":")
        settings[name.strip()] = value.strip()
        at = end + 1
    version = settings.get("Data version", "")
    # Other versions pack the same encodings in another way, and would be read as wrong numbers
    # without any error.
    if version != "2":
        raise wrong(path, f"data version {shown(version)}, expected 2", "blackbox header")
    layouts = {
        letter: _layout(path, settings, letter) for letter in "ISGH" if _has(settings, letter)
    }
    # Neither serves alone: P frames are differences from I frames, and of these there is one in
    # 32 ms.
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
    """The fields of one kind of frame; P frames have the names and signs of I frames, `named`."""
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
    # One field of unknown length makes all that stands behind it unreadable, so the flight is
    # refused before any frame is decoded.
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


# Frames have no length: each ends where the next begins, and which that is shows only once its
# fields are decoded. To do that frame by frame is a hundred times too slow in Python. So every
# byte that might begin a frame is taken for one, all are decoded at once with NumPy, and a walk
# from end to beginning keeps those that are frames. What is no frame where one should be is
# damage; the walk goes on at the next byte from which a frame leads to the beginning of another.

LONGEST_FRAME = 256
"""bytes, as firmware's own tools have it: what goes on for longer is damage"""
_CELLS_AT_ONCE = 1 << 25
"""numbers of 32 bits that a piece may hold, were each of its bytes a frame"""
_LONGEST_PIECE = 1 << 20
"""bytes: what is shorter costs more in calls of NumPy than in decoding"""
_EVENT = ord("E")
_END_OF_LOG = b"End of log\0"

# Numbers in an event, by its type: v is one of variable length. Types 50 to 52 are Rotorflight's.
_EVENTS = {0: "v", 14: "vv", 15: "v", 30: "vv", 50: "v", 51: "v", 52: "v"}
_ADJUSTMENT, _RESUME, _CUSTOM, _END = 13, 14, (100, 101), 255


@dataclass
class Frames:
    """The frames of one flight, by the letter of their kind in the order of the file.

    `rows` (M, F) int32 are the numbers as written, before any prediction; `starts` (M,) where each
    frame begins [bytes]. `damage` (D,) are the places where something was no frame, `resumes` where
    the firmware says that it went on after a pause, `end` says that it closed the log.
    """

    rows: dict[str, np.ndarray]
    starts: dict[str, np.ndarray]
    damage: list[int] = field(default_factory=list)
    resumes: list[int] = field(default_factory=list)
    end: bool = False


def find_frames(data: bytes, start: int, layouts: dict[str, FrameLayout]) -> Frames:
    """All frames of a flight."""
    return _Walk(data, start, layouts).run()


@dataclass(frozen=True)
class _Candidates:
    """Bytes (M,) that may begin a frame, where it would end, and its numbers (M, F)."""

    starts: np.ndarray
    ends: np.ndarray
    values: np.ndarray

    def at(self, rows: np.ndarray) -> "_Candidates":
        return _Candidates(self.starts[rows], self.ends[rows], self.values[rows])


class _Chain:
    """Candidates of a piece, each with the one that begins where it ends.

    Most lead to their neighbour. So the walk goes from one place where that is not so to the next,
    and not from frame to frame, which took Python half of the time.
    """

    def __init__(self, starts: np.ndarray, ends: np.ndarray) -> None:
        order = np.argsort(starts, kind="stable")
        self.starts, self.ends = starts[order], ends[order]
        self.following = np.searchsorted(self.starts, self.ends)
        self.is_last = (
            self.starts.take(self.following, mode="clip") != self.ends
            if starts.size
            else np.zeros(0, bool)
        )
        neighbour = ~self.is_last & (self.following == 1 + np.arange(starts.size))
        self.breaks = np.flatnonzero(~neighbour)
        self.ranges: list[tuple[int, int]] = []

    def follow(self, at: int) -> int:
        """The end of the last of the frames that follow on one another from `at`; 0 where none
        begins there."""
        i = int(np.searchsorted(self.starts, at))
        if i == self.starts.size or self.starts[i] != at:
            return 0
        while True:
            last = int(self.breaks[np.searchsorted(self.breaks, i)])
            self.ranges.append((i, last + 1))
            if self.is_last[last]:
                return int(self.ends[last])
            i = int(self.following[last])

    def next_behind(self, at: int, otherwise: int) -> int:
        """Return the place of the next candidate behind `at`."""
        i = int(np.searchsorted(self.starts, at, side="right"))
        return int(self.starts[i]) if i < self.starts.size else otherwise

    def visited(self) -> np.ndarray:
        """Places of the candidates that were followed."""
        edges = np.zeros(self.starts.size + 1, np.int64)
        for first, end in self.ranges:
            edges[first] += 1
            edges[end] -= 1
        return self.starts[np.cumsum(edges[:-1]) > 0]


class _Walk:
    def __init__(self, data: bytes, start: int, layouts: dict[str, FrameLayout]) -> None:
        self.data, self.at, self.layouts = data, start, layouts
        self.size = len(data)
        self.bytes = np.frombuffer(data, np.uint8)
        self.is_letter = np.zeros(256, bool)
        self.is_letter[[*map(ord, layouts), _EVENT]] = True
        # A piece is as long as the numbers of all its candidates fit in memory: any byte may be
        # one, each with as many numbers as the widest frame has fields.
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
        """Walk from `self.at` to the first frame that begins at `last` or behind it."""
        candidates = {letter: self._candidates(letter, first, last) for letter in self.layouts}
        # One chain serves all kinds of frames, since a byte is the letter of one kind at most.
        chain = _Chain(
            np.concatenate([each.starts for each in candidates.values()]),
            np.concatenate([each.ends for each in candidates.values()]),
        )
        while self.at < last and not self.frames.end:
            end = chain.follow(self.at)
            # Events are decoded one by one on the way: they are rare, and each type has another
            # form.
            if not end and self.data[self.at] == _EVENT:
                end = self._event_end(self.at)
            if end:
                self.at, self.in_damage = end, False
                continue
            self._note_damage()
            # On at the next candidate and not at the next letter: a letter that stands in numbers
            # by chance seldom leads to another one.
            self.at = chain.next_behind(self.at, last)
        # A letter within another frame's numbers is a candidate too. Only those that the walk came
        # upon from the end of a frame are frames.
        is_frame = np.zeros(last - first, bool)
        is_frame[chain.visited() - first] = True
        for letter, each in candidates.items():
            self.kept[letter].append(each.at(np.flatnonzero(is_frame[each.starts - first])))

    def _candidates(self, letter: str, first: int, last: int) -> _Candidates:
        starts = first + np.flatnonzero(self.bytes[first:last] == ord(letter))
        values, ends = decode(self.bytes, starts + 1, self.layouts[letter].encodings)
        # A frame leads to another, or to the end of the file.
        whole = (ends <= self.size) & (ends - starts <= LONGEST_FRAME)
        # A single byte is a letter by chance often enough. That another letter stands just where
        # the frame would end is what makes it likely to be one.
        follows = self.is_letter[self.bytes.take(ends, mode="clip")]
        found = _Candidates(starts, ends, values)
        return found.at(np.flatnonzero(whole & (follows | (ends == self.size))))

    def _note_damage(self) -> None:
        rest = self.data[self.at : self.at + LONGEST_FRAME]
        # Erased memory behind the last frame is no loss.
        blank = not rest.strip(b"\xff") or not rest.strip(b"\0")
        if not self.in_damage and not blank:
            self.frames.damage.append(self.at)
        self.in_damage = True

    def _event_end(self, at: int) -> int:
        """Return the end of the event at `at`; 0 if there is none."""
        kind = self.data[at + 1] if at + 1 < len(self.data) else -1
        # The type alone is one byte, which damage makes by chance. The words behind it do not come
        # about so, and the end of a log is believed only with them.
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
            # A float of four bytes where the top bit of the function says so, else a number.
            return at + 5 if self.data[at] >= 128 else self._skip_numbers(at + 1, 1)
        if kind in _CUSTOM and at < len(self.data):
            return at + 1 + self.data[at]
        if kind in _EVENTS:
            return self._skip_numbers(at, len(_EVENTS[kind]))
        return 0

    def _skip_numbers(self, at: int, count: int) -> int:
        for _ in range(count):
            # At most five bytes, as a number of 32 bits has, or damage could claim the rest of the
            # file.
            length = next((n for n, b in enumerate(self.data[at : at + 5], 1) if b < 128), 5)
            at += length
        return at
