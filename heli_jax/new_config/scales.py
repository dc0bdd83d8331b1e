"""The unit and the scale of a channel's numbers: as stated, or guessed with the reason."""

import numpy as np

from heli_jax import units
from heli_jax.new_config.guess import Guess, Series, are_whole, words_of
from heli_jax.new_config.name_units import without_unit
from heli_jax.yaml_file import EDIT

_PULSES = (700.0, 2300.0)
"""us: what receivers and servos are sent"""
_FULL_PULSE = 500.0
"""us from the middle to the end"""
_MIDDLE, _TRIM = 1500.0, 150.0
"""us: a stick's place at rest, and how far from it trims may move that"""
_SBUS_REST, _SBUS_STOP = 992.0, 819.5
"""counts of a receiver's serial bus at rest and from there to the end: 172 to 1811"""
_LONG = 0.2
"""part of a record, for which nobody holds a stick away from where it rests"""
_ROTORS = {"rpm", "omega", "rotor", "headspeed", "head", "nr", "speed"}
_FULL_COMMAND = 500.0
"""at the stop of a stick, where firmware commands in steps of pulse widths around the middle"""
_PARTS = 1.5
"""above which a stick is not logged in parts of its travel"""
_FULL_TILT = np.pi / 4
"""rad, beyond which no stick tilts a blade or a swashplate"""
_FASTEST_TURN = 8.0
"""rad/s, which a small helicopter hardly exceeds in a log for identification"""


def scaled(
    channel: str, series: Series, si: str, full: float | None = None, is_input: bool = False
) -> Guess:
    """A channel with the unit and the scale that its name, the log or its numbers tell.

    Args:
        full: what the log's sticks count to at their stops, where that is known.
        is_input: whether it is a stick's or a servo's.
    """
    values = series.values[np.isfinite(series.values)]
    low, high = float(np.min(values)), float(np.max(values))
    stated, source = series.unit, "the log"
    if not stated:
        stated, source = without_unit(channel)[1], "its name"
    if stated and units.fits(stated, si):
        return Guess(channel, stated, remarks=(f"unit by {source}",))
    if _is_sbus(channel, values):
        return _about(channel, si, ("counts of S.BUS", "", "a count"), _SBUS_REST, _SBUS_STOP)
    if _PULSES[0] < low and high < _PULSES[1] and high - low > 20:
        return _of_pulses(channel, values, si)
    if _are_counts(channel, values, si):
        return _of_counts(channel, values, si)
    if si == "rad":
        # A heading may count from 0 to a turn; a pitch angle ends at a quarter of it.
        most = np.pi / 2 if {"pitch", "theta"} & set(words_of(channel)) else 2 * np.pi
        # Blades and swashplates are tilted by less than half a right angle.
        most = _FULL_TILT if is_input else most
        if is_input and max(-low, high) > np.degrees(_FULL_TILT):
            guess = f"GUESS: {low:.4g} to {high:.4g} is too large for a blade angle; scale: rad per"
            guess += " unit of the log"
            return Guess(channel, si, EDIT, remarks=(guess,))
        unit = "deg" if max(-low, high) > most else "rad"
    elif si == "rad/s":
        # A rotor turns faster than a body: of its speed the unit is told by 4000 rpm.
        largest = max(-low, high)
        # Whole numbers of rad/s nobody logs.
        is_coarse = largest >= 2.0 and are_whole(values)
        unit = "deg/s" if largest > _FASTEST_TURN or is_coarse else "rad/s"
    elif si == "1" and stated:
        # A command in degrees: of an angle, or of the swashplate.
        remark = f"GUESS: {low:.4g} to {high:.4g} {stated}; scale: 1 / full travel in the log"
        return Guess(channel, "1", EDIT, remarks=(remark,))
    elif si == "1":
        return _of_stick(channel, low, high, full)
    elif units.fits("m", si):
        guess = "GUESS: scale unknown: full travel of the input per unit of the log"
        return Guess(channel, si, EDIT, remarks=(guess,))
    else:
        unit = si
    return Guess(channel, unit, remarks=(f"GUESS: {low:.4g} to {high:.4g} taken for {unit}",))


def _is_sbus(channel: str, values: np.ndarray) -> bool:
    """True if whole numbers are counts of S.BUS: by the name, or by a centre and range that pulses
    do not have."""
    low, high = float(np.min(values)), float(np.max(values))
    if not are_whole(values) or abs(low - high) <= 20 or not 0 <= low <= high < 2048:
        return False
    if "sbus" in words_of(channel):
        return True
    rests = float(np.median(values))
    return abs(rests - _SBUS_REST) < 0.5 * _TRIM and high < _MIDDLE - _TRIM and low > _PULSES[0]


def _of_pulses(channel: str, values: np.ndarray, si: str) -> Guess:
    # Most records begin with the stick at rest; where this one does not, receivers' middle. One
    # that begins within a manoeuvre, stick held, does not come back to that place for long.
    begin = values[: max(len(values) // 100, 5)]
    first, small = float(np.median(begin)), 0.02 * float(np.ptp(values))
    is_still = np.ptp(begin) < small
    is_middle = abs(first - _MIDDLE) < _TRIM or np.mean(np.abs(values - first) < small) > _LONG
    rest = first if is_still and is_middle else _MIDDLE
    return _about(channel, si, ("pulse widths", " us", "a microsecond"), rest, _FULL_PULSE)


def _about(channel: str, si: str, words: tuple[str, str, str], rest: float, stop: float) -> Guess:
    """Return the scale of numbers that rest at one and end `stop` from it; `words`: what they are,
    their unit, and one of them."""
    what, unit, one = words
    remark = f"GUESS: {what}, {rest:g}{unit} at rest"
    if si == "1":
        return Guess(channel, "1", 1.0 / stop, rest, (f"{remark}, {stop:g}{unit} to the stop",))
    return Guess(channel, si, EDIT, rest, (f"{remark}; scale: {si} for {one}",))


def _are_counts(channel: str, values: np.ndarray, si: str) -> bool:
    """True if whole numbers far from zero are counts of a converter, and no angle or rate."""
    low, high = float(np.min(values)), float(np.max(values))
    if not are_whole(values) or low < 0.1 * high or _ROTORS & set(words_of(channel)):
        return False
    # A heading has 360 degrees; nothing turns by more than 100 deg/s all the time.
    return (si == "rad" and high > 2 * 360.0) or (si == "rad/s" and low > 100.0)


def _of_counts(channel: str, values: np.ndarray, si: str) -> Guess:
    rest = float(np.median(values[: max(len(values) // 100, 5)]))
    words = f"GUESS: counts, {rest:g} at the start; scale: {si} per count"
    return Guess(channel, si, EDIT, rest, (words,))


def _of_stick(channel: str, low: float, high: float, full: float | None) -> Guess:
    largest = max(-low, high)
    # What pilots command of Betaflight's family counts to 500, its collective to 1000 or so.
    commanded = words_of(channel)[-3:-1] == ("rc", "command") and largest <= _FULL_COMMAND
    travel = _FULL_COMMAND if commanded else full
    if travel and _PARTS < largest <= travel:
        remark = f"GUESS: {low:.4g} to {high:.4g}, full travel {travel:g}"
        return Guess(channel, "1", 1.0 / travel, remarks=(remark,))
    for most, unit, scale in ((_PARTS, "1", 1.0), (105.0, "%", 1.0), (1050.0, "1", 0.001)):
        if largest <= most:
            what = "thousandths" if scale != 1.0 else {"1": "parts of full travel"}.get(unit, unit)
            remark = f"GUESS: {low:.4g} to {high:.4g} taken as {what}"
            return Guess(channel, unit, scale, remarks=(remark,))
    remark = f"GUESS: {low:.4g} to {high:.4g}; scale: 1 / full travel in the log"
    return Guess(channel, "1", EDIT, remarks=(remark,))


def rotor_speed(channel: str, series: Series) -> float:
    """The mean speed of a rotor [rad/s], in rpm above what a rotor turns in rad/s."""
    mean = float(np.nanmean(series.values))
    unit = series.unit or without_unit(channel)[1]
    if unit and units.fits(unit, "rad/s"):
        return mean * units.factor(unit, "rad/s")
    return mean * units.factor("rpm", "rad/s") if mean > 500.0 else mean
