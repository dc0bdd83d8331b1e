"""The numbers of a blackbox: what its frames hold plus what the firmware predicted.

An I frame stands alone; each P frame holds differences from what the frames before it let expect.
So a run is an I frame with the P frames up to the next, and runs do not depend on each other: the
k-th frames of all runs are computed at once.

All arithmetic is that of the firmware: 32 bits that overflow silently, division towards zero. A
field without a sign has the same bits.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from heli_jax.flights import blackbox_header as header
from heli_jax.flights.blackbox_columns import columns_of
from heli_jax.flights.blackbox_frames import Frames
from heli_jax.flights.blackbox_header import FrameLayout, Header

_PART = 1 << 15
"""frames that are computed at once, about: as numbers of 32 bits all of a log take five times it"""
_LONGEST_JUMP = 10_000_000
"""us between frames, as firmware's own tools have it: what jumps further was misread"""


@dataclass(frozen=True)
class MainFrames:
    """The frames of the control loop: `columns` F of (N,), in the fewest bits, `times` (N,) [us]
    from the firmware's start, `starts` (N,) [bytes]; `dropped` frames could not be computed or have
    impossible times."""

    columns: tuple[np.ndarray, ...]
    times: np.ndarray
    starts: np.ndarray
    dropped: int


def main_frames(frames: Frames, head: Header) -> MainFrames:
    """The frames I and P with predictions added, in the order of the file.

    Args:
        frames: what was found; their packed numbers are taken.
        head: the flight's header.
    """
    layout = head.layouts["I"]
    # The finder keeps each kind apart. A difference needs the frame that stood before it in the
    # file, so the two kinds are merged by their positions.
    starts = np.concatenate([frames.starts["I"], frames.starts["P"]])
    order = np.argsort(starts, kind="stable")
    starts, is_first = starts[order], (order < frames.starts["I"].size)
    del order  # of a long log each number a frame counts
    first, length = _runs(starts, is_first, np.asarray(frames.damage, np.int64))
    # In parts that begin with an I frame, which needs none before it.
    at = np.searchsorted(first, np.arange(_PART, starts.size, _PART)) - 1
    edges = np.unique(first[at]) if first.size else first
    pieces: list[list[np.ndarray]] = []
    stamps: list[np.ndarray] = []
    for begin, end in itertools.pairwise([0, *edges[edges > 0].tolist(), starts.size]):
        values = _part(frames, is_first[begin:end], len(layout.names))
        own = slice(*np.searchsorted(first, [begin, end]))
        _predict(values, first[own] - begin, length[own], head)
        stamps.append(np.ascontiguousarray(values[:, layout.names.index("time")]).view(np.uint32))
        pieces.append(columns_of(values, layout.signed))
    keep, times = _plausible(np.concatenate(stamps), first, length, frames, starts)
    del stamps
    columns = tuple(_joined(pieces, i) for i in range(len(layout.names)))
    if keep is None:
        return MainFrames(columns, times, starts, 0)
    dropped = starts.size - keep.size
    return MainFrames(tuple(column[keep] for column in columns), times, starts[keep], dropped)


def _part(frames: Frames, is_first: np.ndarray, width: int) -> np.ndarray:
    """The next frames (N, F) as written, of which some (N,) are I frames."""
    values = np.empty((is_first.size, width), np.int32)
    count = int(np.count_nonzero(is_first))
    values[is_first] = frames.packed["I"].take(count)
    values[~is_first] = frames.packed["P"].take(is_first.size - count)
    return values


def _joined(pieces: list[list[np.ndarray]], i: int) -> np.ndarray:
    """The i-th column of all parts, which are given away."""
    column = np.concatenate([piece[i] for piece in pieces])
    for piece in pieces:
        piece[i] = column[:0]
    return column


def _predict(values: np.ndarray, first: np.ndarray, length: np.ndarray, head: Header) -> None:
    """Add predictions to frames (N, F), by runs that begin at `first` (R,) with `length` (R,)."""
    _predict_first(values, first, head.layouts["I"], head)
    for k in range(1, int(length.max(initial=0))):
        rows = first[length > k] + k
        # An I frame counts as both frames before the first P frame.
        # The k-th frame of every run needs those before it alone, which the last turns have made
        # whole.
        before = values[rows - 1]
        earlier = values[rows - 2] if k > 1 else before
        values[rows] = _predicted(values[rows], before, earlier, head)


def _runs(
    starts: np.ndarray, is_first: np.ndarray, damage: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First frames (R,) and lengths (R,) of the runs; P frames behind damage are in none."""
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
    return first, end - first


def _predict_first(values: np.ndarray, rows: np.ndarray, layout: FrameLayout, head: Header) -> None:
    # Nothing stands before an I frame, so of the predictors only constants and the motors' own can
    # be meant in it.
    for column, predictor in enumerate(layout.predictors):
        constant = _constant(predictor, head)
        if constant:
            values[rows, column] += np.int64(constant).astype(np.int32)
    # Behind the constants: the first motor is itself a difference from one, and has to be whole
    # before the others are made of it.
    _add_motor(values, rows, layout.predictors, layout)


def _constant(predictor: int, head: Header) -> int:
    match predictor:
        case header.MIN_THROTTLE:
            return head.integer("minthrottle", 1150)
        case header.FIFTEEN_HUNDRED:
            return 1500
        case header.VBAT_REFERENCE:
            return head.integer("vbatref", 4095)
        case header.MIN_MOTOR:
            return head.integer("motorOutput", 0)
    return 0


def _add_motor(
    values: np.ndarray, rows: np.ndarray, predictors: tuple[int, ...], layout: FrameLayout
) -> None:
    """Add the first motor of the same frame, from which the others differ little."""
    columns = [i for i, p in enumerate(predictors) if p == header.MOTOR_0]
    if columns and "motor[0]" in layout.names:
        motor = values[rows, layout.names.index("motor[0]")]
        values[np.ix_(rows, columns)] += motor[:, None]


def _predicted(
    rows: np.ndarray, before: np.ndarray, earlier: np.ndarray, head: Header
) -> np.ndarray:
    """Values (R, F) of P frames from their differences and the two frames before each."""
    layout = head.layouts["P"]
    predictors = np.asarray(layout.predictors)
    previous = np.flatnonzero(predictors == header.PREVIOUS)
    line = np.flatnonzero(predictors == header.STRAIGHT_LINE)
    mean = np.flatnonzero(predictors == header.AVERAGE)
    rows[:, previous] += before[:, previous]
    rows[:, line] += 2 * before[:, line] - earlier[:, line]
    both = _as_numbers(before, layout, mean) + _as_numbers(earlier, layout, mean)
    # Division in C goes towards zero, NumPy's towards minus infinity: odd negative sums would be
    # off by one, and each frame would hand the error on to the next.
    rows[:, mean] += (np.sign(both) * (np.abs(both) // 2)).astype(np.int32)
    for column in np.flatnonzero(predictors == header.INCREMENT):
        iteration = before[:, column].view(np.uint32).astype(np.int64)
        rows[:, column] += _next_iteration(iteration, head).astype(np.int32)
    for column, predictor in enumerate(layout.predictors):
        constant = _constant(predictor, head)
        if constant:
            rows[:, column] += np.int64(constant).astype(np.int32)
    _add_motor(rows, np.arange(len(rows)), layout.predictors, layout)
    return rows


def _as_numbers(values: np.ndarray, layout: FrameLayout, columns: np.ndarray) -> np.ndarray:
    """Some columns (R, K) as int64, in which those without a sign are positive."""
    numbers = values[:, columns].astype(np.int64)
    positive = ~np.asarray(layout.signed)[columns]
    numbers[:, positive] &= 0xFFFFFFFF
    return numbers


def _next_iteration(before: np.ndarray, head: Header) -> np.ndarray:
    """The first iteration behind each of `before` (R,) that the firmware logs."""
    between, part, whole = head.intervals
    # The condition is the one by which the firmware leaves iterations out. The count is not in the
    # frame, so it has to be made up in the same way.
    phase = np.arange(between)
    logged = (phase + part - 1) % whole < part
    logged[0] = True  # an I frame
    # From each phase, the steps to the next that is logged: at most to the next I frame.
    ahead = np.flatnonzero(np.append(logged, True))
    steps = ahead[np.searchsorted(ahead, phase, side="right")] - phase
    return before + steps[before % between]


def _wrapped(values: np.ndarray, layout: FrameLayout) -> np.ndarray:
    """As numbers of 32 bits, with a sign or without."""
    half = np.where(layout.signed, 1 << 31, 0)
    return ((values + half) & 0xFFFFFFFF) - half


def _plausible(
    stamps: np.ndarray, first: np.ndarray, length: np.ndarray, frames: Frames, starts: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """The frames whose times go on from the last one's, None where all do, and these times
    [us]."""
    resumed = set(np.searchsorted(starts, np.asarray(frames.resumes, np.int64)).tolist())
    inside = _inside(first, length, stamps.size)
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
    for begin, count in zip(first.tolist(), length.tolist(), strict=True):
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


def _inside(first: np.ndarray, length: np.ndarray, count: int) -> np.ndarray:
    """Whether each of `count` frames is in a run."""
    edges = np.zeros(count + 1, np.int8)
    edges[first] += 1
    np.subtract.at(edges, first + length, 1)
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
            values[:, column] += _constant(predictor, head)
    return _wrapped(values, layout)
