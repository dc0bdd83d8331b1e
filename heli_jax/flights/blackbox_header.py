"""The header of a blackbox log: lines of `H name:value` that say how its frames are written."""

import re
from dataclasses import dataclass

from heli_jax.flights.blackbox_encodings import KNOWN
from heli_jax.flights.table import shown, wrong

MARK = b"H Product:Blackbox flight data recorder by Nicholas Sherlock"
"""with which every flight of a file begins"""

PREVIOUS, STRAIGHT_LINE, AVERAGE, MIN_THROTTLE, MOTOR_0, INCREMENT = 1, 2, 3, 4, 5, 6
HOME, FIFTEEN_HUNDRED, VBAT_REFERENCE, LAST_TIME, MIN_MOTOR = 7, 8, 9, 10, 11
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
    """What the header says: `settings` by name, `layouts` by the frames' letter.

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
    """The header at the beginning of `data`, which is one flight of the file `path`.

    Raises:
        InputError: it is damaged, or of a version or with an encoding that cannot be read.
    """
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
        signed = _numbers(path, settings, f"Field {letter} signed", len(names))
    else:
        names, signed = named.names, named.signed
    predictors = _numbers(path, settings, f"Field {letter} predictor", len(names))
    encodings = _numbers(path, settings, f"Field {letter} encoding", len(names))
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


def _numbers(path: str, settings: dict[str, str], name: str, count: int) -> tuple[int, ...]:
    text = settings.get(name, "")
    if not re.fullmatch(r"\d{1,3}(,\d{1,3})*", text) or text.count(",") + 1 != count:
        problem = f"expected {count} numbers with commas between them, got {shown(text)}"
        raise wrong(path, problem, "blackbox header", name)
    return tuple(int(number) for number in text.split(","))
