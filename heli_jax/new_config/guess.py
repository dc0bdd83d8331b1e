"""Which channel of a log is which signal, in which unit: guesses, each with its reason."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax import units
from heli_jax.flights.channel_names import no_stick
from heli_jax.new_config.name_units import FILLERS, without_unit
from heli_jax.yaml_file import EDIT

_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue"})
_NUMBERED = re.compile(r"(?<=[a-z])(?=[0-9])")
"""between a word and its number: chan1"""
_STICK_COMMANDS = {"cmd", "command", "commanded"}
_COMMANDS = _STICK_COMMANDS | {
    *("des", "desired", "sp", "setpoint", "ref", "target", "err", "error"),
}
# Words of what is neither a rate, an angle nor a speed, whatever stands behind them: Batt_v.
_OTHER = {
    *("batt", "battery", "bat", "volt", "voltage", "power", "temp"),
    *("temperature", "rssi", "motor", "esc", "servo", "pid", "gain", "quat", "var", "noise"),
}
# gyro_roll is no roll, accel_x no speed.
_CHANGES = {
    *("gyro", "gyr", "rate", "rates", "vel", "acc", "accel", "acceleration"),
    *("vitesse", "taux"),
}
_EXCITATIONS = {
    *("sweep", "chirp", "sid", "sysid", "inject", "injected", "injection", "excitation"),
    *("excite", "multisine", "prbs"),
}
_PULSES = (700.0, 2300.0)
"""us: what receivers and servos are sent"""
_FULL_PULSE = 500.0
"""us from the middle to the end"""
_MIDDLE, _TRIM = 1500.0, 150.0
"""us: a stick's place at rest, and how far from it trims may move that"""
_LONG = 0.2
"""part of a record, for which nobody holds a stick away from where it rests"""
_AXES = {"r": "roll", "p": "pitch", "y": "yaw"}
_SETPOINTS = {letter + word for letter in _AXES for word in ("des", "out", "tar")}
_ROTORS = {"rpm", "omega", "rotor", "headspeed", "head", "nr", "speed"}
_FULL_COMMAND = 500.0
"""at the stop of a stick, where firmware commands in steps of pulse widths around the middle"""
_PARTS = 1.5
"""above which a stick is not logged in parts of its travel"""
_FASTEST_TURN = 8.0
"""rad/s, which a small helicopter hardly exceeds in a log for identification"""
_LAGS = 0.5
"""s by which an output may follow an input"""
_RELATED = 0.4
"""correlation from which on two signals are taken to have to do with each other"""


class Series(NamedTuple):
    """One channel: times and values (N,), and the unit that the log states, empty without one."""

    times: np.ndarray
    values: np.ndarray
    unit: str = ""


class Guess(NamedTuple):
    """A channel for a signal of the model.

    Attributes:
        channel: its name in the log.
        unit: of the scaled numbers.
        scale: of the log's numbers; `EDIT` where nobody but the user knows it.
        offset: in the log's own numbers.
        remarks: what was guessed, in words for a comment.
    """

    channel: str
    unit: str
    scale: float | str = 1.0
    offset: float = 0.0
    remarks: tuple[str, ...] = ()


def words_of(name: str) -> tuple[str, ...]:
    """The words of a channel's name in lower case, without its unit.

    Args:
        name: such as `gyro.x`, `rollRate_deg/s`, `Roll (deg)`.
    """
    stem = without_unit(name)[0]
    stem = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", stem).translate(_UMLAUTS)
    # Other accents are left out: of Régime an r would remain, which is a yaw rate's name.
    stem = unicodedata.normalize("NFKD", stem)
    stem = "".join(c for c in stem if not unicodedata.combining(c))
    return tuple(w for w in re.split(r"[^a-z0-9]+", stem.lower()) if w)


def by_name(
    called: Sequence[str], names: Sequence[str], commanded: Sequence[str] = ()
) -> list[str]:
    """The channels that may be a signal, the likeliest first.

    Args:
        called: what people call it, words by blanks.
        names: of the log's channels.
        commanded: what else a command of it may name, as `roll` in roll_cmd.
    """
    forms = [tuple(c.split()) for c in called]
    commands = {*forms, *(tuple(c.split()) for c in commanded)} if commanded else set()
    scored = []
    for place, name in enumerate(names):
        words = words_of(name)
        # Behind the sticks themselves: what a stick commands may have passed through a controller.
        if commands and _STICK_COMMANDS & set(words):
            left = tuple(w for w in words if w not in _STICK_COMMANDS | FILLERS)
            if left in commands:
                scored.append((3, 0, place, name))
            continue
        if not words or _COMMANDS & set(words):
            continue
        # The whole name, before a name that ends so, as of a path: log.roll; and either before
        # those with words behind them that change nothing: ch1_aileron_us.
        core = _without_fillers(words)
        if words in forms:
            # P beside p: of letters that differ in size alone the one as the model has it.
            place = -1 if name in called else place
            scored.append((0, forms.index(words), place, name))
        elif any(len(f) < len(words) and words[-len(f) :] == f for f in forms):
            scored.append((1, 0, place, name))
        elif any(core[-len(f) :] == f for f in forms):
            scored.append((2, 0, place, name))
    return [name for *_, name in sorted(scored)]


def spelled_out(names: Sequence[str]) -> dict[str, str]:
    """Names of rates that have a letter for their axis, with the axis in words: ArduPilot's RATE.R,
    RATE.P and RATE.Y are of roll, pitch and yaw, where rate_p, rate_q and rate_r are p, q and r.

    Args:
        names: of the log's channels.
    """
    groups: dict[tuple[str, ...], dict[str, str]] = {}
    for name in names:
        *path, last = words_of(name) or ("",)
        if path and path[-1] in ("rate", "rates"):
            groups.setdefault(tuple(path), {})[last] = name
    spelled = {}
    for group in groups.values():
        # Which of the two it is shows by the letter that the other has not, or by what
        # stands beside: RDes.
        if "q" not in group and ("y" in group or _SETPOINTS & set(group)):
            spelled |= {
                group[letter]: f"{group[letter]} {axis} rate"
                for letter, axis in _AXES.items()
                if letter in group
            }
    return spelled


def by_number(called: Sequence[str], names: Sequence[str]) -> list[str]:
    """The channels that a number alone gives away, as `chan1_raw` and `servoRaw.servo1`.

    Args:
        called: what they are called, word and number by a blank.
        names: of the log's channels.
    """
    forms = {tuple(c.split()) for c in called}
    return [n for n in names if _numbered(n) in forms]


def _numbered(name: str) -> tuple[str, ...]:
    """The last word of a name that is followed by a number, and the number: of rcin_1, rcin1."""
    words = [part for word in words_of(name) for part in _NUMBERED.split(word)]
    words = list(_without_fillers(tuple(words)))
    if len(words) < 2 or not words[-1].isdigit():
        return ()
    # Of an array's columns the first is number 0.
    return words[-2], str(int(words[-1]) + name.endswith("]"))


def _without_fillers(words: tuple[str, ...]) -> tuple[str, ...]:
    end = next((i for i in range(len(words), 0, -1) if words[i - 1] not in FILLERS), 0)
    return words[:end]


def of_known_unit(names: Sequence[str], log: Mapping[str, Series], si: str) -> str:
    """The first channel, or one of the same words whose unit is stated: rc_aileron(percent).

    Args:
        names: the likeliest first.
        log: the channels.
        si: the unit that the model has.
    """
    words = words_of(names[0])
    alike = [n for n in names if words_of(n) == words]
    known = (n for n in alike if _fits(log[n].unit or without_unit(n)[1] or "none", si))
    return next(known, names[0])


def is_excitation(name: str) -> bool:
    """Whether a channel's name says that it is an excitation that an autopilot added to a stick."""
    return bool(_EXCITATIONS & set(words_of(name)))


def excitations(called: Sequence[str], names: Sequence[str]) -> list[str]:
    """The logged excitations of an input, by their names.

    Args:
        called: what people call the input, words by blanks.
        names: of the log's channels.
    """
    forms = {tuple(c.split()) for c in called}
    return [
        name
        for name in names
        if is_excitation(name)
        and tuple(w for w in words_of(name) if w not in _EXCITATIONS | FILLERS) in forms
    ]


def may_be(name: str, series: Series, called: Sequence[str], si: str) -> bool:
    """Whether a channel's name and unit leave room for an output of the model.

    Args:
        name: of the channel.
        series: its samples.
        called: what people call the output, words by blanks.
        si: the unit that the model has.
    """
    unit = series.unit or without_unit(name)[1]
    # A model that states no unit takes any.
    if unit and si != "1" and not _fits(unit, si):
        return False
    words, own = set(words_of(name)), {w for c in called for w in c.split()}
    return not (_OTHER | _CHANGES) & words - own


def may_move(name: str, series: Series, si: str) -> bool:
    """Whether a channel's name and unit leave room for an input of the model.

    Args:
        name: of the channel.
        series: its samples.
        si: the unit that the model's input has.
    """
    return not no_stick(name, series.unit or without_unit(name)[1], si)


def by_motion(output: Series, channels: Mapping[str, Series]) -> tuple[str, float] | None:
    """The channel that an output follows, with the correlation; None where it follows none.

    Args:
        output: what moves.
        channels: those that may move it.
    """
    best: tuple[str, float] | None = None
    for name, series in channels.items():
        related = _largest_correlation(series, output)
        if related > max(_RELATED, best[1] if best else 0.0):
            best = name, related
    return best


def _largest_correlation(first: Series, second: Series) -> float:
    """Over the lags by which the second may follow the first."""
    begin = max(first.times[0], second.times[0])
    end = min(first.times[-1], second.times[-1])
    step = float(np.median(np.diff(second.times)))
    if not (end > begin and step > 0):
        return 0.0
    t = np.arange(begin, end, step)
    if t.size < 3 or np.ptp(first.values) == 0:
        return 0.0
    x, y = np.interp(t, *_finite(first)), np.interp(t, *_finite(second))
    x, y = x - np.mean(x), y - np.mean(y)
    most = min(int(_LAGS / step) + 1, t.size // 4)
    scale = float(np.linalg.norm(x) * np.linalg.norm(y))
    if not scale:
        return 0.0
    return max(abs(float(np.dot(x[: t.size - k], y[k:]))) for k in range(most)) / scale


def _finite(series: Series) -> tuple[np.ndarray, np.ndarray]:
    good = np.isfinite(series.values)
    return series.times[good], series.values[good]


def full_travel(sticks: Mapping[str, Series]) -> float | None:
    """What a log's sticks count to at their stops, where one of them was there; None if not.

    Args:
        sticks: channels that are named as sticks or what is commanded by them.
    """
    for series in sticks.values():
        values = series.values[np.isfinite(series.values)]
        # Radios of the EdgeTX family count to 1024, in whole numbers.
        if values.size and np.max(np.abs(values)) == 1024.0 and _are_whole(values):
            return 1024.0
    return None


def _are_whole(values: np.ndarray) -> bool:
    return bool(np.all(values == np.rint(values)))


def scaled(channel: str, series: Series, si: str, full: float | None = None) -> Guess:
    """A channel with the unit and the scale that its name, the log or its numbers tell.

    Args:
        channel: its name.
        series: its samples.
        si: the unit that the model has.
        full: what the log's sticks count to at their stops, where that is known.
    """
    values = series.values[np.isfinite(series.values)]
    low, high = float(np.min(values)), float(np.max(values))
    stated, source = series.unit, "the log"
    if not stated:
        stated, source = without_unit(channel)[1], "its name"
    if stated and _fits(stated, si):
        return Guess(channel, stated, remarks=(f"unit by {source}",))
    if _PULSES[0] < low and high < _PULSES[1] and high - low > 20:
        return _of_pulses(channel, values, si)
    if _are_counts(channel, values, si):
        return _of_counts(channel, values, si)
    if si == "rad":
        # A heading may count from 0 to a turn; a pitch angle ends at a quarter of it.
        most = np.pi / 2 if {"pitch", "theta"} & set(words_of(channel)) else 2 * np.pi
        unit = "deg" if max(-low, high) > most else "rad"
    elif si == "rad/s":
        # A rotor turns faster than a body: of its speed the unit is told by 4000 rpm.
        largest = max(-low, high)
        # Whole numbers of rad/s nobody logs.
        is_coarse = largest >= 2.0 and _are_whole(values)
        unit = "deg/s" if largest > _FASTEST_TURN or is_coarse else "rad/s"
    elif si == "1" and stated:
        # A command in degrees: of an angle, or of the swashplate.
        remark = f"GUESS: {low:.4g} to {high:.4g} {stated}; scale: 1 over what full travel is in it"
        return Guess(channel, "1", EDIT, remarks=(remark,))
    elif si == "1":
        return _of_stick(channel, low, high, full)
    elif _fits("m", si):
        guess = "GUESS: full travel of the input for 1 in the log is not known"
        return Guess(channel, si, EDIT, remarks=(guess,))
    else:
        unit = si
    return Guess(channel, unit, remarks=(f"GUESS: {low:.4g} to {high:.4g} taken for {unit}",))


def _fits(unit: str, si: str) -> bool:
    try:
        units.factor(unit, si)
    except ValueError:
        return False
    return True


def _of_pulses(channel: str, values: np.ndarray, si: str) -> Guess:
    # Most records begin with the stick at rest; where this one does not, receivers' middle. One
    # that begins within a manoeuvre, stick held, does not come back to that place for long.
    begin = values[: max(len(values) // 100, 5)]
    first, small = float(np.median(begin)), 0.02 * float(np.ptp(values))
    is_still = np.ptp(begin) < small
    is_middle = abs(first - _MIDDLE) < _TRIM or np.mean(np.abs(values - first) < small) > _LONG
    rest = first if is_still and is_middle else _MIDDLE
    remark = f"GUESS: pulse widths, {rest:g} us at rest"
    if si == "1":
        remark = f"{remark}, {_FULL_PULSE:g} us to the stop"
        return Guess(channel, "1", 1.0 / _FULL_PULSE, rest, (remark,))
    return Guess(channel, si, EDIT, rest, (f"{remark}; scale: {si} for a microsecond",))


def _are_counts(channel: str, values: np.ndarray, si: str) -> bool:
    """Whether whole numbers far from zero are those of a converter, and no angle or rate."""
    low, high = float(np.min(values)), float(np.max(values))
    if not _are_whole(values) or low < 0.1 * high or _ROTORS & set(words_of(channel)):
        return False
    # A heading has 360 degrees; nothing turns by more than 100 deg/s all the time.
    return (si == "rad" and high > 2 * 360.0) or (si == "rad/s" and low > 100.0)


def _of_counts(channel: str, values: np.ndarray, si: str) -> Guess:
    rest = float(np.median(values[: max(len(values) // 100, 5)]))
    words = f"GUESS: counts, {rest:g} at the beginning; scale: {si} for a count"
    return Guess(channel, si, EDIT, rest, (words,))


def _of_stick(channel: str, low: float, high: float, full: float | None) -> Guess:
    largest = max(-low, high)
    # What pilots command of Betaflight's family counts to 500, its collective to 1000 or so.
    commanded = words_of(channel)[-3:-1] == ("rc", "command") and largest <= _FULL_COMMAND
    travel = _FULL_COMMAND if commanded else full
    if travel and _PARTS < largest <= travel:
        remark = f"GUESS: {low:.4g} to {high:.4g}, {travel:g} at the stop"
        return Guess(channel, "1", 1.0 / travel, remarks=(remark,))
    for most, unit, scale in ((_PARTS, "1", 1.0), (105.0, "%", 1.0), (1050.0, "1", 0.001)):
        if largest <= most:
            what = "thousandths" if scale != 1.0 else {"1": "parts of full travel"}.get(unit, unit)
            remark = f"GUESS: {low:.4g} to {high:.4g} taken for {what}"
            return Guess(channel, unit, scale, remarks=(remark,))
    remark = f"GUESS: {low:.4g} to {high:.4g}; scale: 1 over what full travel is in the log"
    return Guess(channel, "1", EDIT, remarks=(remark,))


def rotor_speed(channel: str, series: Series) -> float:
    """The mean speed of a rotor [rad/s], in rpm above what a rotor turns in rad/s.

    Args:
        channel: its name.
        series: its samples.
    """
    mean = float(np.nanmean(series.values))
    unit = series.unit or without_unit(channel)[1]
    if unit and _fits(unit, "rad/s"):
        return mean * units.factor(unit, "rad/s")
    return mean * units.factor("rpm", "rad/s") if mean > 500.0 else mean
