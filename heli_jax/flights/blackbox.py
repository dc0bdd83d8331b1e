"""Blackbox logs of Rotorflight, Betaflight and Cleanflight (.bbl, .bfl, .TXT).

Source of the format: 'Blackbox logging internals' of Cleanflight; the events of Rotorflight are
those that its firmware writes. The channels keep the firmware's own numbers and names.
"""

import hashlib
from collections import deque
from itertools import pairwise
from pathlib import Path

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights import progress
from heli_jax.flights.blackbox_fields import (
    MARK,
    FrameLayout,
    Header,
    narrowed,
    read_header,
)
from heli_jax.flights.blackbox_frames import Frames, find_frames
from heli_jax.flights.blackbox_main import MainFrames, constant, main_frames
from heli_jax.flights.log import ChannelLog, Topic
from heli_jax.flights.table import wrong
from heli_jax.regular_file import read_regular

_LARGEST = 10**9
"""bytes: opened it takes about three times as much"""
_MOST_FLIGHTS = 1000
_DEGREES_PER_SECOND = "0x3f800000"
"""gyro_scale of firmware whose gyro counts are degrees per second: the float 1.0"""


def open_blackbox(path: Path) -> tuple[ChannelLog, ...]:
    """The flights of a blackbox file, without those that hold no frame.

    Raises:
        InputError: it is no blackbox file, or none of its flights can be read.
        OSError: it cannot be read.
    """
    data = read_regular(path, "a blackbox log", _LARGEST)
    starts = _flight_starts(data)
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


def _flight_starts(data: bytes) -> list[int]:
    starts, at = [], data.find(MARK)
    while at >= 0:
        starts.append(at)
        at = data.find(MARK, at + len(MARK))
    return starts


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
        # The lines named Field say how the bytes are packed, which is no setting of the machine.
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
        f"slow.{name}" if name in main.columns else name: narrowed(
            (values[:, i] & 0xFFFFFFFF).astype(np.uint32).view(np.int32 if has_sign else np.uint32)
        )
        for i, (name, has_sign) in enumerate(zip(layout.names, layout.signed, strict=True))
    }
    return Topic("slow", main.times[last] * 1e-6, columns, {}, "time of the main frame before")


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
