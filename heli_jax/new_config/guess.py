"""Guesses of the signal and the unit of each channel, with reasons."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax import units
from heli_jax.flights.name_units import FILLERS, without_unit

_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue"})
_NUMBERED = re.compile(r"(?<=[a-z])(?=[0-9])")
"""Boundary between a word and its number: chan1."""
_STICK_COMMANDS = {"cmd", "command", "commanded"}
_COMMANDS = _STICK_COMMANDS | {
    *("des", "desired", "sp", "setpoint", "ref", "target", "err", "error"),
}
# Words of channels that are no rate, angle or speed, whatever follows: Batt_v.
_OTHER = {
    *("batt", "battery", "bat", "volt", "voltage", "power", "temp"),
    *("temperature", "rssi", "motor", "esc", "servo", "pid", "gain", "quat", "var", "noise"),
}
# gyro_roll is no roll angle, accel_x no speed.
_CHANGES = {
    *("gyro", "gyr", "rate", "rates", "vel", "acc", "accel", "acceleration"),
    *("vitesse", "taux"),
}
_EXCITATIONS = {
    *("sweep", "chirp", "sid", "sysid", "inject", "injected", "injection", "excitation"),
    *("excite", "multisine", "prbs"),
}
_PULSES = ("us", "µs", "usec", "microseconds")
"""Units of pulse widths."""
_AXES = {"r": "roll", "p": "pitch", "y": "yaw"}
_SETPOINTS = {letter + word for letter in _AXES for word in ("des", "out", "tar")}


class Series(NamedTuple):
    """One channel: times and values (N,), and the unit that the log states, or empty."""

    times: np.ndarray
    values: np.ndarray
    unit: str = ""


class Guess(NamedTuple):
    """A channel for a signal of the model.

    Attributes:
        channel: its name in the log.
        unit: unit of the scaled numbers.
        scale: factor of the log's numbers; `EDIT` if only the user knows it.
        offset: offset in the log's own numbers.
        remarks: guesses, in words for a comment.
    """

    channel: str
    unit: str
    scale: float | str = 1.0
    offset: float = 0.0
    remarks: tuple[str, ...] = ()


def words_of(name: str) -> tuple[str, ...]:
    """Return the words of a channel's name in lower case, without its unit.

    Args:
        name: such as `gyro.x`, `rollRate_deg/s`, `Roll (deg)`.
    """
    stem = without_unit(name)[0]
    stem = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", stem).translate(_UMLAUTS)
    # Other accents are removed; otherwise Régime would leave an r, the name of a yaw rate.
    stem = unicodedata.normalize("NFKD", stem)
    stem = "".join(c for c in stem if not unicodedata.combining(c))
    return tuple(w for w in re.split(r"[^a-z0-9]+", stem.lower()) if w)


def by_name(
    called: Sequence[str], names: Sequence[str], commanded: Sequence[str] = ()
) -> list[str]:
    """Return the channels that may be a signal, the likeliest first.

    Args:
        called: usual names of the signal.
        names: names of the channels.
        commanded: further names of its command, such as `roll` in roll_cmd.
    """
    forms = [tuple(c.split()) for c in called]
    commands = {*forms, *(tuple(c.split()) for c in commanded)} if commanded else set()
    scored = []
    for place, name in enumerate(names):
        words = words_of(name)
        # Ranked after the sticks: a command may have passed through a controller.
        if commands and _STICK_COMMANDS & set(words):
            left = tuple(w for w in words if w not in _STICK_COMMANDS | FILLERS)
            if left in commands:
                scored.append((3, 0, place, name))
            continue
        if not words or _COMMANDS & set(words):
            continue
        # First the full name, then a name that ends so, such as the path log.roll. Names with
        # neutral words after them come last: ch1_aileron_us.
        core = _without_fillers(words)
        if words in forms:
            # P and p: of letters that differ only in case, the model's own is first.
            place = -1 if name in called else place
            scored.append((0, forms.index(words), place, name))
        elif any(len(f) < len(words) and words[-len(f) :] == f for f in forms):
            scored.append((1, 0, place, name))
        elif any(core[-len(f) :] == f for f in forms):
            scored.append((2, 0, place, name))
    return [name for *_, name in sorted(scored)]


def spelled_out(names: Sequence[str]) -> dict[str, str]:
    """Spell out the axis in names of rates that have a letter for it.

    ArduPilot's RATE.R, RATE.P and RATE.Y are roll, pitch and yaw, but rate_p, rate_q and rate_r are
    p, q and r.
    """
    groups: dict[tuple[str, ...], dict[str, str]] = {}
    for name in names:
        *path, last = words_of(name) or ("",)
        if path and path[-1] in ("rate", "rates"):
            groups.setdefault(tuple(path), {})[last] = name
    spelled = {}
    for group in groups.values():
        # The two are distinguished by the letter that only one has, or by a neighbour: RDes.
        if "q" not in group and ("y" in group or _SETPOINTS & set(group)):
            spelled |= {
                group[letter]: f"{group[letter]} {axis} rate"
                for letter, axis in _AXES.items()
                if letter in group
            }
    return spelled


def by_number(called: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the channels identified by a number, such as `chan1_raw` and `servoRaw.servo1`."""
    forms = {tuple(c.split()) for c in called}
    return [n for n in names if _numbered(n) in forms]


def _numbered(name: str) -> tuple[str, ...]:
    """Return the last word of a name before a number, and the number: of rcin_1, rcin1."""
    words = [part for word in words_of(name) for part in _NUMBERED.split(word)]
    words = list(_without_fillers(tuple(words)))
    if len(words) < 2 or not words[-1].isdigit():
        return ()
    # The first column of an array has number 0.
    return words[-2], str(int(words[-1]) + name.endswith("]"))


def _without_fillers(words: tuple[str, ...]) -> tuple[str, ...]:
    end = next((i for i in range(len(words), 0, -1) if words[i - 1] not in FILLERS), 0)
    return words[:end]


def of_known_unit(names: Sequence[str], log: Mapping[str, Series], si: str) -> str:
    """Return the first channel, or one with the same words and a known unit."""
    words = words_of(names[0])
    alike = [n for n in names if words_of(n) == words]
    known = (n for n in alike if units.fits(log[n].unit or without_unit(n)[1] or "none", si))
    return next(known, names[0])


def is_excitation(name: str) -> bool:
    """True if a channel's name means an excitation that an autopilot added to a stick."""
    return bool(_EXCITATIONS & set(words_of(name)))


def excitations(called: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the logged excitations of an input, by their names."""
    forms = {tuple(c.split()) for c in called}
    return [
        name
        for name in names
        if is_excitation(name)
        and tuple(w for w in words_of(name) if w not in _EXCITATIONS | FILLERS) in forms
    ]


def may_be(name: str, series: Series, called: Sequence[str], si: str) -> bool:
    """True if a channel's name and unit allow an output of the model."""
    unit = series.unit or without_unit(name)[1]
    # A model without a unit accepts any.
    if unit and si != "1" and not units.fits(unit, si):
        return False
    words, own = set(words_of(name)), {w for c in called for w in c.split()}
    return not (_OTHER | _CHANGES) & words - own


def may_be_input(name: str, series: Series, si: str) -> bool:
    """True if the unit of a channel, as the log or its name states it, allows an input."""
    unit = series.unit or without_unit(name)[1]
    if not unit or unit in _PULSES or not units.is_unit(unit):
        return True
    # Sticks and the blades that they move have angles, lengths, voltages or no unit.
    return any(units.fits(unit, other) for other in ("1", "rad", "m", "V", si))


def are_whole(values: np.ndarray) -> bool:
    """True if samples (N,) are whole numbers."""
    return bool(np.all(values == np.rint(values)))
