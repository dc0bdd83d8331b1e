"""Where the frames of a blackbox log begin and end.

Frames have no length: each ends where the next begins, and which that is shows only once its fields
are decoded. To do that frame by frame is a hundred times too slow in Python. So every byte that
might begin a frame is taken for one, all are decoded at once with NumPy, and a walk from end to
beginning keeps those that are frames. What is no frame where one should be is damage; the walk goes
on at the next byte from which a frame leads to the beginning of another.
"""

from dataclasses import dataclass, field

import numpy as np

from heli_jax.flights.blackbox_fields import FrameLayout, Rows, decode

MAIN = "IP"
"""letters of the control loop's frames"""
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
    """The frames of one flight, by kind in the order of the file.

    `rows` (M, F) int32 by letter are the numbers as written, before any prediction, those of the
    control loop (I and P, nearly all) packed in `packed`; `starts` (M,) where each frame begins
    [bytes]. `damage` (D,) are the places where something was no frame,
    `resumes` where the firmware says that it went on after a pause, `end` says that it closed the
    log.
    """

    rows: dict[str, np.ndarray]
    packed: dict[str, Rows]
    starts: dict[str, np.ndarray]
    damage: list[int] = field(default_factory=list)
    resumes: list[int] = field(default_factory=list)
    end: bool = False


def find_frames(data: bytes, start: int, layouts: dict[str, FrameLayout]) -> Frames:
    """All frames of a flight.

    Args:
        start: where its frames begin.
    """
    return _Walk(data, start, layouts).run()


@dataclass(frozen=True)
class _Candidates:
    """Bytes (M,) that may begin a frame, where it would end, and its numbers (M, F)."""

    starts: np.ndarray
    ends: np.ndarray
    values: np.ndarray


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
        """Where the next candidate behind `at` begins."""
        i = int(np.searchsorted(self.starts, at, side="right"))
        return int(self.starts[i]) if i < self.starts.size else otherwise

    def visited(self) -> np.ndarray:
        """Where those begin that were followed."""
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
        self.frames = Frames({}, {}, {})
        self.kept = {letter: Rows(len(layout.names)) for letter, layout in layouts.items()}
        self.starts: dict[str, list[np.ndarray]] = {letter: [] for letter in layouts}
        self.in_damage = False

    def run(self) -> Frames:
        while self.at < self.size and not self.frames.end:
            self._walk_piece(self.at, min(self.at + self.piece, self.size))
        for letter, rows in self.kept.items():
            if letter in MAIN:
                self.frames.packed[letter] = rows
            else:
                self.frames.rows[letter] = rows.frames()
            self.frames.starts[letter] = np.concatenate(
                [np.zeros(0, np.uint32), *self.starts[letter]]
            )
            self.starts[letter].clear()
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
            i = np.flatnonzero(is_frame[each.starts - first])
            self.kept[letter].append(each.values[i])
            # A file has less than 2^32 bytes.
            self.starts[letter].append(each.starts[i].astype(np.uint32))

    def _candidates(self, letter: str, first: int, last: int) -> _Candidates:
        starts = first + np.flatnonzero(self.bytes[first:last] == ord(letter))
        values, ends = decode(self.bytes, starts + 1, self.layouts[letter].encodings)
        # A frame leads to another, or to the end of the file.
        whole = (ends <= self.size) & (ends - starts <= LONGEST_FRAME)
        # A single byte is a letter by chance often enough. That another letter stands just where
        # the frame would end is what makes it likely to be one.
        follows = self.is_letter[self.bytes.take(ends, mode="clip")]
        i = np.flatnonzero(whole & (follows | (ends == self.size)))
        return _Candidates(starts[i], ends[i], values[i])

    def _note_damage(self) -> None:
        rest = self.data[self.at : self.at + LONGEST_FRAME]
        # Erased memory behind the last frame is no loss.
        blank = not rest.strip(b"\xff") or not rest.strip(b"\0")
        if not self.in_damage and not blank:
            self.frames.damage.append(self.at)
        self.in_damage = True

    def _event_end(self, at: int) -> int:
        """Where the event at `at` ends; 0 where it is none."""
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
