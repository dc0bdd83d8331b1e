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
from heli_jax.finding import Finding, note
from heli_jax.flights import progress
from heli_jax.flights.blackbox_fields import (
    HOME,
    LAST_TIME,
    MARK,
    FrameLayout,
    Header,
    narrowed,
    read_header,
)
from heli_jax.flights.blackbox_frames import Frames, find_frames
from heli_jax.flights.blackbox_main import MainFrames, main_frames, other_frames
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
    # H frames make no topic: they hold the origin that the positions of G frames are told from, and
    # are added to these.
    topics += [t for letter in "SG" if (t := _other(frames, letter, head, main)) is not None]
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


def _other(frames: Frames, letter: str, head: Header, main: MainFrames) -> Topic | None:
    """Slow frames (S) or positions (G) as a topic; None where there are none."""
    if letter not in head.layouts or not frames.starts[letter].size:
        return None
    layout, home = head.layouts[letter], None
    if LAST_TIME in layout.predictors:
        _keep(frames, letter, _follows(frames, letter, main))
    if HOME in layout.predictors:
        home, known = _home(frames, head, main)
        if not known.all():  # a position is the distance from a home that is not known yet
            _keep(frames, letter, known)
            home = home[known]
    if not frames.starts[letter].size:
        return None
    values = other_frames(frames, letter, head, main, home)
    # They stand between main frames: the time of the one before, where they have none.
    last = np.maximum(np.searchsorted(main.starts, frames.starts[letter]) - 1, 0)
    times, clock = main.times[last], "time of the main frame before"
    if "time" in layout.names:
        # 32 bits, of which the main frames know the turns: the time nearest to theirs.
        stamps, clock = values[:, layout.names.index("time")], "time"
        times = times + ((stamps - times + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    names = {"S": "slow", "G": "GPS"}
    columns = {
        name: narrowed(values[:, i].astype(np.int32 if has_sign else np.uint32))
        for i, (name, has_sign) in enumerate(zip(layout.names, layout.signed, strict=True))
    }
    # A field such as time may stand in several kinds of frames, but a channel's name has to be one
    # topic's alone.
    taken = set(head.layouts["I"].names)
    columns = {k if k not in taken else f"{names[letter]}.{k}": v for k, v in columns.items()}
    return Topic(names[letter], times * 1e-6, columns, {}, clock)


def _follows(frames: Frames, letter: str, main: MainFrames) -> np.ndarray:
    """Whether the main frame before each frame (M,) is known: its time is told from that one's."""
    starts = frames.starts[letter].astype(np.int64)
    places = (frames.starts["I"], frames.starts["P"], np.asarray(frames.damage, np.int64))
    before = [np.append(-1, at)[np.searchsorted(at, starts)] for at in places]
    kept = np.append(-1, main.starts)[np.searchsorted(main.starts, starts)]
    return np.max(before, axis=0) <= kept


def _keep(frames: Frames, letter: str, which: np.ndarray) -> None:
    frames.rows[letter] = frames.rows[letter][which]
    frames.starts[letter] = frames.starts[letter][which]


def _home(frames: Frames, head: Header, main: MainFrames) -> tuple[np.ndarray, np.ndarray]:
    """By G frame the home position (M, 2) before it, and whether there is one (M,)."""
    count = frames.starts["G"].size
    if "H" not in head.layouts or not frames.starts["H"].size:
        return np.zeros((count, 2), np.int64), np.zeros(count, bool)
    homes = other_frames(frames, "H", head, main, None)[:, :2]
    # The header decides how many fields there are. Whoever adds a home indexes two columns,
    # latitude and longitude, so a damaged header must not leave one alone.
    if homes.shape[1] < 2:
        homes = np.repeat(homes, 2, axis=1)
    # The home can be set anew in flight, so the last H frame in front of each position counts.
    before = np.searchsorted(frames.starts["H"], frames.starts["G"]) - 1
    return homes[np.maximum(before, 0)], before >= 0


def _losses(frames: Frames, main: MainFrames) -> tuple[Finding, ...]:
    if not frames.damage and not main.dropped:
        return ()
    places = len(frames.damage)
    words = f"{places} damaged frame{'' if places == 1 else 's'} skipped"
    if main.dropped:
        words += f", {main.dropped} more frames lost that were differences from a lost one"
    return (note("damage.skipped", words, value=places + main.dropped),)
