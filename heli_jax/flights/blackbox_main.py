"""The frames of a blackbox log in their order, and which of them can be believed.

Those of the control loop are nearly all of a log. They stay packed as they were written, about as
large as the file, and a channel is computed when it is asked for: as 32 bits they take five times
the file.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from heli_jax.flights import blackbox_header as header
from heli_jax.flights.blackbox_columns import narrowed
from heli_jax.flights.blackbox_frames import Frames
from heli_jax.flights.blackbox_header import FrameLayout, Header
from heli_jax.flights.blackbox_predictors import Runs, add_predictions, constant, uses_motor

_LONGEST_JUMP = 10_000_000
"""us between frames, as firmware's own tools have it: what jumps further was misread"""


class MainColumns(Mapping[str, np.ndarray]):
    """Numbers (N,) of the control loop by name, in the fewest bits, each computed when it is asked
    for."""

    def __init__(self, frames: Frames, head: Header, runs: Runs, is_first: np.ndarray) -> None:
        self._first, self._differences = frames.packed["I"], frames.packed["P"]
        self._head, self._runs, self._is_first = head, runs, is_first
        self._place = {name: i for i, name in enumerate(head.layouts["I"].names)}
        self._kept: np.ndarray | None = None
        self._last: tuple[str, np.ndarray] = ("", np.zeros(0, np.int8))

    def __getitem__(self, name: str) -> np.ndarray:
        # Whoever describes a channel asks for it several times in turn.
        if self._last[0] != name:
            numbers = self._of_all_frames(self._place[name])
            kept = numbers if self._kept is None else numbers[self._kept]
            has_sign = self._head.layouts["I"].signed[self._place[name]]
            column = narrowed(kept if has_sign else kept.view(np.uint32))
            column.flags.writeable = False
            self._last = name, column
        return self._last[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)

    def __contains__(self, name: object) -> bool:  # Mapping's own computes the channel
        return name in self._place

    def stamps(self) -> np.ndarray:
        """Times (M,) uint32 [us] of all frames."""
        return self._of_all_frames(self._place["time"]).view(np.uint32)

    def keep(self, frames: np.ndarray) -> None:
        """Leave all frames out but these (N,), which may be believed."""
        self._kept = frames

    def _of_all_frames(self, i: int) -> np.ndarray:
        """The numbers (M,) int32 of the i-th field, those of frames in no run included."""
        numbers = np.empty(self._is_first.size, np.int32)
        numbers[self._is_first] = self._first.column(i)
        numbers[~self._is_first] = self._differences.column(i)
        # A motor that is told from itself, as no firmware writes, stays as it is.
        motor = self._place.get("motor[0]", i)
        told = np.zeros_like(numbers)
        if motor != i and uses_motor(i, self._head):
            told = self._of_all_frames(motor)
        add_predictions(numbers, i, self._runs, self._is_first, told, self._head)
        return numbers


@dataclass(frozen=True)
class MainFrames:
    """The frames of the control loop: `columns` of (N,) by name, `times` (N,) [us] from the
    firmware's start, `starts` (N,) [bytes]; `dropped` frames could not be computed or have
    impossible times."""

    columns: MainColumns
    times: np.ndarray
    starts: np.ndarray
    dropped: int


def main_frames(frames: Frames, head: Header) -> MainFrames:
    """The frames I and P with predictions added, in the order of the file.

    Args:
        frames: what was found.
        head: the flight's header.
    """
    # The finder keeps each kind apart. A difference needs the frame that stood before it in the
    # file, so the two kinds are merged by their positions.
    intra, inter = frames.starts["I"], frames.starts["P"]
    is_first = np.zeros(intra.size + inter.size, bool)
    is_first[np.searchsorted(inter, intra) + np.arange(intra.size)] = True
    starts = np.empty(is_first.size, intra.dtype)
    starts[is_first], starts[~is_first] = intra, inter
    runs = _runs(starts, is_first, np.asarray(frames.damage, np.int64))
    columns = MainColumns(frames, head, runs, is_first)
    keep, times = _plausible(columns.stamps(), runs, frames, starts)
    if keep is None:
        return MainFrames(columns, times, starts, 0)
    columns.keep(keep)
    return MainFrames(columns, times, starts[keep], starts.size - keep.size)


def _runs(starts: np.ndarray, is_first: np.ndarray, damage: np.ndarray) -> Runs:
    """The runs of frames; P frames behind damage are in none."""
    first = np.flatnonzero(is_first)
    end = np.append(first[1:], starts.size)
    # The first frame behind each place of damage: the difference that was lost is missing in all
    # that follow.
    behind = np.searchsorted(starts, damage)
    for place in np.unique(behind):
        run = int(np.searchsorted(first, place, side="right")) - 1
        # An I frame right behind the damage needs nothing from before it.
        if run >= 0 and first[run] < place:
            end[run] = min(end[run], place)
    return Runs(first, end - first)


def _plausible(
    stamps: np.ndarray, runs: Runs, frames: Frames, starts: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """The frames whose times go on from the last one's, None where all do, and these times
    [us]."""
    resumed = set(np.searchsorted(starts, np.asarray(frames.resumes, np.int64)).tolist())
    inside = _inside(runs, stamps.size)
    rows = None if inside.all() else np.flatnonzero(inside)
    kept = stamps if rows is None else stamps[rows]
    # Modulo 2^32, so that the turn of the counter is a small step like any other, and a step back
    # is a huge one.
    steps = np.diff(kept)
    # Nearly always nothing is wrong, and the runs need not be looked at one by one.
    if kept.size and not resumed and np.all(steps < _LONGEST_JUMP):
        in_turn = np.empty(kept.size, np.int64)
        in_turn[0] = 0
        np.cumsum(steps, out=in_turn[1:])
        in_turn += int(kept[0])
        return rows, in_turn
    keep: list[np.ndarray] = []
    times: list[np.ndarray] = []
    now: int | None = None
    rejected: int | None = None
    for begin, count in zip(runs.begin.tolist(), runs.length.tolist(), strict=True):
        stamp = int(stamps[begin])
        # The firmware's counter starts again at zero after 71 minutes.
        base = stamp if now is None else now + ((stamp - now) & 0xFFFFFFFF)
        # After a pause that the firmware announces the time may jump by any amount. Without one a
        # jump means that the stamp was misread.
        if not (now is None or begin in resumed or _goes_on(now, stamp)):
            # Two I frames that agree with each other outvote what stood before them.
            if rejected is None or not _goes_on(rejected, stamp):
                rejected = stamp
                continue
            base = now + ((stamp - now + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
            while times and times[-1][-1] >= base:
                keep.pop()
                times.pop()
        rejected = None
        steps = np.diff(stamps[begin : begin + count]).astype(np.int64)
        # The False behind the end stops the search in a run without any jump. Of one with a jump
        # the frames in front of it are kept.
        whole = int(np.argmin(np.append(steps < _LONGEST_JUMP, False))) + 1
        keep.append(np.arange(begin, begin + whole))
        times.append(base + np.concatenate([[0], np.cumsum(steps[: whole - 1])]))
        now = int(times[-1][-1])
    if not keep:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(keep), np.concatenate(times)


def _inside(runs: Runs, count: int) -> np.ndarray:
    """Whether each of `count` frames is in a run."""
    edges = np.zeros(count + 1, np.int8)
    edges[runs.begin] += 1
    np.subtract.at(edges, runs.begin + runs.length, 1)
    return np.cumsum(edges[:-1], dtype=np.int8) > 0


def _goes_on(before: int, stamp: int) -> bool:
    return ((stamp - before) & 0xFFFFFFFF) < _LONGEST_JUMP


def other_frames(
    frames: Frames, letter: str, head: Header, main: MainFrames, home: np.ndarray | None
) -> np.ndarray:
    """Frames S, G or H (M, F) int64: settings that change, positions, and where home is.

    Args:
        frames: what was found.
        letter: the kind.
        head: the flight's header.
        main: the frames of the control loop, of which the last one's time may be a prediction.
        home: by G frame, the home position (M, 2) in the log's unit; None where it has none.
    """
    layout, values = head.layouts[letter], frames.rows[letter].astype(np.int64)
    coordinate = 0
    last = np.searchsorted(main.starts, frames.starts[letter]) - 1
    for column, predictor in enumerate(layout.predictors):
        if predictor == header.HOME:
            if home is not None:
                values[:, column] += home[:, min(coordinate, 1)]
            coordinate += 1
        # The time is a difference from the last main frame in the file, which is why those are
        # computed before all others.
        elif predictor == header.LAST_TIME and main.times.size:
            values[:, column] += main.times[np.maximum(last, 0)]
        else:
            values[:, column] += constant(predictor, head)
    return _wrapped(values, layout)


def _wrapped(values: np.ndarray, layout: FrameLayout) -> np.ndarray:
    """As numbers of 32 bits, with a sign or without."""
    half = np.where(layout.signed, 1 << 31, 0)
    return ((values + half) & 0xFFFFFFFF) - half
