"""Blackbox logs of Rotorflight, Betaflight and Cleanflight (.bbl, .bfl, .TXT).

Source of the format: 'Blackbox logging internals' of Cleanflight; the events of Rotorflight are
those that its firmware writes. The channels keep the firmware's own numbers and names.
"""

import hashlib
import re
from collections import deque
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
"""bytes: opened it takes about ten times as much"""
_MOST_FLIGHTS = 1000
_DEGREES_PER_SECOND = "0x3f800000"
"""gyro_scale of firmware whose gyro counts are degrees per second: the float 1.0"""


@dataclass(frozen=True)
class MainFrames:
    """The frames of the control loop: `columns` of (N,) by name, `times` (N,) [us] from the
    firmware's start, `starts` (N,) [bytes]; `dropped` frames could not be computed or have
    impossible times."""

    columns: Mapping[str, np.ndarray]
    times: np.ndarray
    starts: np.ndarray
    dropped: int


def open_blackbox(path: Path) -> tuple[ChannelLog, ...]:
    """The flights of a blackbox file, without those that hold no frame."""
    data = read_regular(path, "a blackbox log", _LARGEST)
    starts = [match.start() for match in re.finditer(re.escape(MARK), data)]
    if not starts:
        raise wrong(str(path), "is no blackbox log, expected one that begins with its header")
    if len(starts) > _MOST_FLIGHTS:
        raise wrong(str(path), f"expected at most {_MOST_FLIGHTS} flights, got {len(starts)}")
    # Of the whole file and not of a flight's bytes, so that it is the number that sha256sum gives
    # for the file a user has.
    sha256, size = hashlib.sha256(data).hexdigest(), len(data)
    # Each flight's bytes are let go of once its frames are found: beside them and what is made of
    # them there would not be three times the file, but four.
    rest = deque(data[start:end] for start, end in pairwise([*starts, size]))
    del data
    flights: list[ChannelLog] = []
    problems: list[InputError] = []
    for i, start in enumerate(starts):
        progress.advance(start)
        try:
            log = _flight(str(path), rest.popleft(), sha256, size, (i + 1, len(starts)))
        except InputError as e:
            # One flight that cannot be read shall not cost the others of the file. Its problem is
            # told only where there is nothing else to show.
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
    """One flight from its bytes; None where it holds no frame."""
    head = read_header(path, data)
    frames = find_frames(data, head.start, head.layouts)
    del data
    main = main_frames(frames, head)
    if not main.times.size:
        return None
    # P frames have the names and signs of I frames, so one layout is right for all rows.
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
        # The lines named Field say how the bytes are packed, which is no setting of the vehicle.
        parameters={k: v for k, v in head.settings.items() if not k.startswith("Field ")},
        notes=_losses(frames, main),
        flight=flight,
    )


def _units(layout: FrameLayout, head: Header) -> dict[str, str]:
    """The units that are sure whatever the version of the firmware."""
    # A field that is not here keeps a count without a unit. A unit that is right for some firmware
    # alone would be copied into a configuration, and scale a fit by a wrong factor.
    units = {"time": "us", "headspeed": "rpm", "tailspeed": "rpm"}
    if head.settings.get("gyro_scale", "").lower() == _DEGREES_PER_SECOND:
        gyros = [n for n in layout.names if n.startswith(("gyroADC[", "gyroRAW[", "gyroUnfilt["))]
        units |= dict.fromkeys(gyros, "deg/s")
    return {name: unit for name, unit in units.items() if name in layout.names}


def _slow(frames: Frames, head: Header, main: MainFrames) -> Topic | None:
    """Settings that change in flight (S frames) as a topic; None where there are none."""
    if "S" not in head.layouts or not frames.starts["S"].size:
        return None
    layout = head.layouts["S"]
    values = frames.rows["S"] + np.array([constant(p, head) for p in layout.predictors], np.int64)
    # They stand between main frames: the time of the one before.
    last = np.maximum(np.searchsorted(main.starts, frames.starts["S"]) - 1, 0)
    # A field may stand in several kinds of frames; a channel's name has to be one topic's alone.
    columns = {
        f"slow.{name}" if name in main.columns else name: _signed(values[:, i], has_sign)
        for i, (name, has_sign) in enumerate(zip(layout.names, layout.signed, strict=True))
    }
    return Topic("slow", main.times[last] * 1e-6, columns, {}, "time of the main frame before")


def _signed(values: np.ndarray, has_sign: bool) -> np.ndarray:
    """The lowest 32 bits of numbers (N,), with a sign or without."""
    return values.astype(np.int64).astype(np.uint32).view(np.int32 if has_sign else np.uint32)


def _losses(frames: Frames, main: MainFrames) -> tuple[Finding, ...]:
    notes = []
    if "G" in frames.starts and (count := frames.starts["G"].size):
        words = f"left out: {count} positions of GPS, as differences from a home that is set anew"
        notes.append(note(LEFT_OUT, words, value=count))
    if frames.damage or main.dropped:
        places = len(frames.damage)
        words = f"{places} damaged frame{'' if places == 1 else 's'} skipped"
        if main.dropped:
            words += f", {main.dropped} more frames lost that were differences from a lost one"
        notes.append(note("damage.skipped", words, value=places + main.dropped))
    return tuple(notes)


# The numbers of a blackbox log: what its frames hold plus what the firmware predicted, and which
# frames can be believed.
#
# An I frame stands alone; each P frame holds differences from what the frames before it let expect.
# So a run is an I frame with the P frames up to the next, and runs do not depend on each other: the
# k-th frames of all runs are computed at once. Nor does a field depend on another, save a motor on
# the first.
#
# All arithmetic is that of the firmware: 32 bits that overflow silently, division towards zero. A
# field without a sign has the same bits.

_LONGEST_JUMP = 10_000_000
"""us between frames, as firmware's own tools have it: what jumps further was misread"""


class Runs(NamedTuple):
    """Runs of frames: `begin` (R,) and `length` (R,), in the file's order."""

    begin: np.ndarray
    length: np.ndarray


def main_frames(frames: Frames, head: Header) -> MainFrames:
    """The frames I and P with predictions added, in the order of the file."""
    # The finder keeps each kind apart. A difference needs the frame that stood before it in the
    # file, so the two kinds are merged by their positions.
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
    # In a run.
    edges = np.zeros(stamps.size + 1, np.int8)
    edges[runs.begin] += 1
    np.subtract.at(edges, runs.begin + runs.length, 1)
    inside = np.cumsum(edges[:-1], dtype=np.int8) > 0
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


def _goes_on(before: int, stamp: int) -> bool:
    return ((stamp - before) & 0xFFFFFFFF) < _LONGEST_JUMP


def constant(predictor: int, head: Header) -> int:
    """Return the constant that a predictor expects for a whole flight; 0 for other predictors."""
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
    """Make the numbers of a field, as written, those that were logged.

    Args:
        values: (N,) int32 of all frames in the file's order; changed in place. Those of frames in
            no run come out as anything.
        is_first: which (N,) are I frames.
        motor: what the first motor was told (N,) int32, where a predictor of this field is that.
    """
    # Nothing stands before an I frame, so of the predictors only constants and the first motor can
    # be meant in it.
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
            # A line through the two frames before: what is written is the change of the step. An
            # I frame counts as both of those before the first P frame.
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
    """Each number (N,) plus all before it in its run, in place."""
    before = values[runs.begin]
    np.cumsum(values, dtype=values.dtype, out=values)
    # What the runs before have added up to, the frames behind them that are in no run included.
    np.subtract(before, values[runs.begin], out=before)
    if runs.begin.size:
        until = np.diff(runs.begin, append=values.size)
        values[runs.begin[0] :] += np.repeat(before, until)


def _step(
    values: np.ndarray, runs: Runs, expected: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> None:
    """Add to each P frame what is `expected` of the one before it and the one before that."""
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
    """The mean (R,) int32 of numbers (R,) int32 whose top bit is a sign or not."""
    kind = np.int32 if has_sign else np.uint32
    both = last.view(kind).astype(np.int64) + earlier.view(kind)
    # Division in C goes towards zero, NumPy's towards minus infinity: odd negative sums would be
    # off by one, and each frame would hand the error on to the next.
    return ((both + (both < 0)) >> 1).astype(np.int32)


def _iterations_ahead(head: Header) -> np.ndarray:
    """By the phase of an iteration between two I frames, how many there are to the next that the
    firmware logs: int32."""
    between, part, whole = head.intervals
    # The condition is the one by which the firmware leaves iterations out. The count is not in the
    # frame, so it has to be made up in the same way.
    phase = np.arange(between)
    logged = (phase + part - 1) % whole < part
    logged[0] = True  # an I frame
    # From each phase, the steps to the next that is logged: at most to the next I frame.
    ahead = np.flatnonzero(np.append(logged, True))
    return (ahead[np.searchsorted(ahead, phase, side="right")] - phase).astype(np.int32)
