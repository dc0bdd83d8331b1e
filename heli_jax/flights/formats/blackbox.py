"""Blackbox logs of Rotorflight, Betaflight and Cleanflight (.bbl, .bfl, .TXT).

Source of the format: 'Blackbox logging internals' of Cleanflight; Rotorflight's events are from its
firmware. The channels keep the firmware's own numbers and names.
"""

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights import progress
from heli_jax.flights.formats import blackbox_frames as frames_of
from heli_jax.flights.formats.blackbox_frames import (
    MARK,
    FrameLayout,
    Frames,
    Header,
    find_frames,
    read_header,
)
from heli_jax.flights.log import ChannelLog, Topic, wrong
from heli_jax.regular_file import read_regular

_LARGEST = 4 * 10**8
"""Largest file [bytes]; reading takes about ten times as much memory."""
_MOST_FLIGHTS = 1000
_DEGREES_PER_SECOND = "0x3f800000"
"""gyro_scale of firmware whose gyro counts are degrees per second: the float 1.0."""


@dataclass(frozen=True)
class MainFrames:
    """Frames of the control loop.

    `columns` are (N,) by name, `times` (N,) [us] from the firmware's start, `starts` (N,) [bytes].
    `dropped` frames could not be computed or have impossible times.
    """

    columns: Mapping[str, np.ndarray]
    times: np.ndarray
    starts: np.ndarray
    dropped: int


def open_blackbox(path: Path) -> tuple[ChannelLog, ...]:
    """Read the flights of a blackbox file, without those that have no frame."""
    data = read_regular(path, "a blackbox log", _LARGEST)
    starts = [match.start() for match in re.finditer(re.escape(MARK), data)]
    if not starts:
        raise wrong(str(path), "is no blackbox log, expected one that begins with its header")
    if len(starts) > _MOST_FLIGHTS:
        raise wrong(str(path), f"expected at most {_MOST_FLIGHTS} flights, got {len(starts)}")
    # Hash the whole file, so that it equals the output of sha256sum for the user's file.
    sha256, size = hashlib.sha256(data).hexdigest(), len(data)
    flights: list[ChannelLog] = []
    problems: list[InputError] = []
    for i, (start, end) in enumerate(pairwise([*starts, size])):
        progress.advance(start)
        try:
            log = _flight(str(path), data[start:end], sha256, size, (i + 1, len(starts)))
        except InputError as e:
            # An unreadable flight must not affect the others of the file. Its problem is reported
            # only if no flight is readable.
            problems.append(e)
            continue
        if log is not None:
            flights.append(log)
    if not flights:
        raise problems[0] if problems else wrong(str(path), "holds no frames, expected a flight")
    return tuple(flights)


def _flight(
    path: str, data: bytes, sha256: str, size: int, flight: tuple[int, int]
) -> ChannelLog | None:
    """Read one flight from its bytes; None if it has no frame."""
    head = read_header(path, data)
    frames = find_frames(data, head.start, head.layouts)
    main = main_frames(frames, head)
    if not main.times.size:
        return None
    # P frames have the names and signs of I frames, so one layout fits all rows.
    layout = head.layouts["I"]
    units = _units(layout, head)
    topics = [Topic("main", main.times * 1e-6, main.columns, units, "time")]
    if (slow := _slow(frames, head, main)) is not None:
        topics.append(slow)
    return ChannelLog(
        path=path,
        format="blackbox",
        size=size,
        sha256=sha256,
        topics=tuple(topics),
        firmware=head.settings.get("Firmware revision", head.settings.get("Firmware type", "")),
        # The lines named Field describe the packing of the bytes and are no settings of the
        # vehicle.
        parameters={k: v for k, v in head.settings.items() if not k.startswith("Field ")},
        notes=_losses(frames, main),
        flight=flight,
    )


def _units(layout: FrameLayout, head: Header) -> dict[str, str]:
    """Return the units that are certain for any version of the firmware."""
    # Other fields stay counts without a unit. A unit that is right only for some firmware would be
    # copied into a configuration and scale a fit wrongly.
    units = {"time": "us", "headspeed": "rpm", "tailspeed": "rpm"}
    if head.settings.get("gyro_scale", "").lower() == _DEGREES_PER_SECOND:
        gyros = [n for n in layout.names if n.startswith(("gyroADC[", "gyroRAW[", "gyroUnfilt["))]
        units |= dict.fromkeys(gyros, "deg/s")
    return {name: unit for name, unit in units.items() if name in layout.names}


def _slow(frames: Frames, head: Header, main: MainFrames) -> Topic | None:
    """Return the settings that change in flight (S frames) as a topic; None if there are none."""
    if "S" not in head.layouts or not frames.starts["S"].size:
        return None
    layout = head.layouts["S"]
    values = frames.rows["S"] + np.array([constant(p, head) for p in layout.predictors], np.int64)
    # S frames are between main frames and have the time of the previous one.
    last = np.maximum(np.searchsorted(main.starts, frames.starts["S"]) - 1, 0)
    # A field may be in several kinds of frames, but a channel name belongs to one topic.
    columns = {
        f"slow.{name}" if name in main.columns else name: _signed(values[:, i], has_sign)
        for i, (name, has_sign) in enumerate(zip(layout.names, layout.signed, strict=True))
    }
    return Topic("slow", main.times[last] * 1e-6, columns, {}, "time of the main frame before")


def _signed(values: np.ndarray, has_sign: bool) -> np.ndarray:
    """Return the lowest 32 bits of numbers (N,), with or without a sign."""
    return values.astype(np.int64).astype(np.uint32).view(np.int32 if has_sign else np.uint32)


def _losses(frames: Frames, main: MainFrames) -> tuple[Finding, ...]:
    notes = []
    if "G" in frames.starts and (count := frames.starts["G"].size):
        words = f"left out: {count} GPS positions, because their reference position changes"
        notes.append(note(LEFT_OUT, words, value=count))
    if frames.damage or main.dropped:
        places = len(frames.damage)
        words = f"{places} damaged frame{'' if places == 1 else 's'} skipped"
        if main.dropped:
            words += f", and {main.dropped} more frames that are differences from a lost one"
        notes.append(note("damage.skipped", words, value=places + main.dropped))
    return tuple(notes)


# Numbers of a blackbox log: the contents of its frames plus the firmware's predictions, for the
# plausible frames.
#
# An I frame is independent; each P frame has differences from the prediction by earlier frames. A
# run is an I frame with the P frames up to the next one. Runs are independent, so the k-th frames
# of all runs are computed at once. Fields are independent too, except that a motor may depend on
# the first one.
#
# The arithmetic is that of the firmware: 32 bits that overflow silently, and division towards zero.
# An unsigned field has the same bits.

_LONGEST_JUMP = 10_000_000
"""Longest step between frames [us], as in the firmware's tools; a longer one is misread."""


class Runs(NamedTuple):
    """Runs of frames: `begin` (R,) and `length` (R,), in the file's order."""

    begin: np.ndarray
    length: np.ndarray


def main_frames(frames: Frames, head: Header) -> MainFrames:
    """Return the I and P frames with predictions added, in the order of the file."""
    # The finder separates the kinds. A difference refers to the previous frame in the file, so both
    # kinds are merged by their positions.
    starts = np.concatenate([frames.starts["I"], frames.starts["P"]])
    order = np.argsort(starts, kind="stable")
    starts, is_first = starts[order], order < frames.starts["I"].size
    runs = _runs(starts, is_first, np.asarray(frames.damage, np.int64))
    names = head.layouts["I"].names

    def numbers(i: int, motor: np.ndarray) -> np.ndarray:
        written = np.concatenate([frames.rows[letter][:, i] for letter in "IP"])[order]
        add_predictions(written, i, runs, is_first, motor, head)
        return written

    none = np.zeros(starts.size, np.int32)
    motor = numbers(names.index("motor[0]"), none) if "motor[0]" in names else none
    stamps = numbers(names.index("time"), motor).view(np.uint32)
    keep, times = _plausible(stamps, runs, frames, starts)
    keep = np.arange(starts.size) if keep is None else keep
    columns = {
        name: numbers(i, motor)[keep].view(np.int32 if has_sign else np.uint32)
        for i, (name, has_sign) in enumerate(zip(names, head.layouts["I"].signed, strict=True))
    }
    return MainFrames(columns, times, starts[keep], starts.size - keep.size)


def _runs(starts: np.ndarray, is_first: np.ndarray, damage: np.ndarray) -> Runs:
    """Return the runs of frames; P frames after damage are in none."""
    first = np.flatnonzero(is_first)
    end = np.append(first[1:], starts.size)
    # First frame after each damaged place: the lost difference is missing in all that follow.
    behind = np.searchsorted(starts, damage)
    for place in np.unique(behind):
        run = int(np.searchsorted(first, place, side="right")) - 1
        # An I frame directly after the damage is independent of the frames before it.
        if run >= 0 and first[run] < place:
            end[run] = min(end[run], place)
    return Runs(first, end - first)


def _plausible(
    stamps: np.ndarray, runs: Runs, frames: Frames, starts: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the plausible frames, None if all are, and their times [us].

    The times of plausible frames continue from the previous ones.
    """
    resumed = set(np.searchsorted(starts, np.asarray(frames.resumes, np.int64)).tolist())
    # Frames that are in a run.
    edges = np.zeros(stamps.size + 1, np.int8)
    edges[runs.begin] += 1
    np.subtract.at(edges, runs.begin + runs.length, 1)
    inside = np.cumsum(edges[:-1], dtype=np.int8) > 0
    rows = None if inside.all() else np.flatnonzero(inside)
    kept = stamps if rows is None else stamps[rows]
    # Modulo 2^32, so that an overflow of the counter is a small step, and a step back is a huge
    # one.
    steps = np.diff(kept)
    # Usually nothing is wrong, and no loop over the runs is needed.
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
        # The firmware's counter overflows after 71 minutes.
        base = stamp if now is None else now + ((stamp - now) & 0xFFFFFFFF)
        # After a pause that the firmware announces, the time may jump by any amount. Any other jump
        # is a misread stamp.
        if not (now is None or begin in resumed or _goes_on(now, stamp)):
            # Two consistent I frames outvote the frames before them.
            if rejected is None or not _goes_on(rejected, stamp):
                rejected = stamp
                continue
            base = now + ((stamp - now + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
            while times and times[-1][-1] >= base:
                keep.pop()
                times.pop()
        rejected = None
        steps = np.diff(stamps[begin : begin + count]).astype(np.int64)
        # The appended False ends the search in a run without a jump. In a run with a jump, the
        # frames before it are kept.
        whole = int(np.argmin(np.append(steps < _LONGEST_JUMP, False))) + 1
        keep.append(np.arange(begin, begin + whole))
        times.append(base + np.concatenate([[0], np.cumsum(steps[: whole - 1])]))
        now = int(times[-1][-1])
    if not keep:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(keep), np.concatenate(times)


def _goes_on(before: int, stamp: int) -> bool:
    return ((stamp - before) & 0xFFFFFFFF) < _LONGEST_JUMP


def constant(predictor: int, head: Header) -> int:
    """Return the constant that a predictor uses for a whole flight; 0 for other predictors."""
    match predictor:
        case frames_of.MIN_THROTTLE:
            return head.integer("minthrottle", 1150)
        case frames_of.FIFTEEN_HUNDRED:
            return 1500
        case frames_of.VBAT_REFERENCE:
            return head.integer("vbatref", 4095)
        case frames_of.MIN_MOTOR:
            return head.integer("motorOutput", 0)
    return 0


def add_predictions(
    values: np.ndarray, i: int, runs: Runs, is_first: np.ndarray, motor: np.ndarray, head: Header
) -> None:
    """Add the predictions to the written numbers of a field, in place.

    Args:
        values: (N,) int32 of all frames in the file's order; frames in no run get arbitrary values.
        i: index of the field.
        runs: runs of the frames.
        is_first: mask (N,) of the I frames.
        motor: command of the first motor (N,) int32, if a predictor of this field uses it.
        head: header of the flight.
    """
    # No frame precedes an I frame, so only constants and the first motor can be its predictors.
    for letter, rows in (("I", is_first), ("P", ~is_first)):
        predictor = head.layouts[letter].predictors[i]
        if predictor == frames_of.MOTOR_0:
            values[rows] += motor[rows]
        elif number := constant(predictor, head):
            values[rows] += np.int64(number).astype(np.int32)
    has_sign = head.layouts["I"].signed[i]
    match head.layouts["P"].predictors[i]:
        case frames_of.PREVIOUS:
            _add_up(values, runs)
        case frames_of.STRAIGHT_LINE:
            # A line through the two previous frames: the frame has the change of the step. An I
            # frame counts as both frames before the first P frame.
            at_first = values[runs.begin]
            values[runs.begin] = 0
            _add_up(values, runs)
            values[runs.begin] = at_first
            _add_up(values, runs)
        case frames_of.AVERAGE:
            _step(values, runs, lambda last, earlier: _mean(last, earlier, has_sign))
        case frames_of.INCREMENT:
            ahead = _iterations_ahead(head)
            _step(values, runs, lambda last, _: ahead[last.view(np.uint32) % ahead.size] + last)


def _add_up(values: np.ndarray, runs: Runs) -> None:
    """Sum the numbers (N,) cumulatively within each run, in place."""
    before = values[runs.begin]
    np.cumsum(values, dtype=values.dtype, out=values)
    # Remove the sum of the previous runs, and of frames after them that are in no run.
    np.subtract(before, values[runs.begin], out=before)
    if runs.begin.size:
        until = np.diff(runs.begin, append=values.size)
        values[runs.begin[0] :] += np.repeat(before, until)


def _step(
    values: np.ndarray, runs: Runs, expected: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> None:
    """Add to each P frame the value that is `expected` from the two previous frames."""
    longest_first = np.argsort(-runs.length, kind="stable")
    begin, length = runs.begin[longest_first], runs.length[longest_first]
    # An I frame counts as both frames before the first P frame.
    last = earlier = values[begin]
    going_on = begin.size
    for k in range(1, int(length.max(initial=0))):
        going_on = int(np.searchsorted(-length[:going_on], -k))
        last, earlier = last[:going_on], earlier[:going_on]
        rows = begin[:going_on] + k
        now = values[rows] + expected(last, earlier)
        values[rows] = now
        last, earlier = now, last


def _mean(last: np.ndarray, earlier: np.ndarray, has_sign: bool) -> np.ndarray:
    """Return the mean (R,) int32 of numbers (R,) int32, with or without a sign."""
    kind = np.int32 if has_sign else np.uint32
    both = last.view(kind).astype(np.int64) + earlier.view(kind)
    # Division in C rounds towards zero, in NumPy towards minus infinity. Odd negative sums would be
    # off by one, and the error would accumulate.
    return ((both + (both < 0)) >> 1).astype(np.int32)


def _iterations_ahead(head: Header) -> np.ndarray:
    """Return the iterations to the next logged frame, int32, by phase between two I frames."""
    between, part, whole = head.intervals
    # The same condition as in the firmware. The count is not in the frame, so it must be
    # reconstructed.
    phase = np.arange(between)
    logged = (phase + part - 1) % whole < part
    logged[0] = True  # an I frame
    # Steps from each phase to the next logged iteration, at most to the next I frame.
    ahead = np.flatnonzero(np.append(logged, True))
    return (ahead[np.searchsorted(ahead, phase, side="right")] - phase).astype(np.int32)
