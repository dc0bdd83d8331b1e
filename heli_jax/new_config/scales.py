"""Unit and scale of a channel's numbers: as stated, or guessed with a reason."""

import numpy as np

from heli_jax import units
from heli_jax.flights.name_units import without_unit
from heli_jax.new_config.guess import Guess, Series, are_whole, words_of
from heli_jax.yaml_file import EDIT

_PULSES = (700.0, 2300.0)
"""Pulse widths of receivers and servos [us]."""
_FULL_PULSE = 500.0
"""Pulse width from the middle to the end [us]."""
_MIDDLE, _TRIM = 1500.0, 150.0
"""Pulse width of a stick at rest, and largest shift by trims [us]."""
_LONG = 0.2
"""Share of a record above which a stick's value is its rest position."""
_FULL_COMMAND = 500.0
"""Count at a stick's stop in firmware that commands in pulse widths around the middle."""
_PARTS = 1.5
"""Largest value of a stick logged in parts of its travel."""
_FULL_TILT = np.pi / 4
"""Largest tilt of a blade or a swashplate by a stick [rad]."""
_FASTEST_TURN = 8.0
"""Fastest turn [rad/s] of a small helicopter in a log for identification."""


def scaled(channel: str, series: Series, si: str, *, is_input: bool = False) -> Guess:
    """Return a channel with unit and scale, from its name, the log or its numbers.

    Args:
        channel: name of the channel.
        si: SI unit of the model's signal.
        is_input: True for a stick or a servo.
    """
    values = series.values[np.isfinite(series.values)]
    low, high = float(np.min(values)), float(np.max(values))
    stated, source = series.unit, "the log"
    if not stated:
        stated, source = without_unit(channel)[1], "its name"
    if stated and units.fits(stated, si):
        return Guess(channel, stated, remarks=(f"unit by {source}",))
    if _PULSES[0] < low and high < _PULSES[1] and high - low > 20:
        return _of_pulses(channel, values, si)
    if si == "rad":
        # A heading may count from 0 to a turn; a pitch angle ends at a quarter turn.
        most = np.pi / 2 if {"pitch", "theta"} & set(words_of(channel)) else 2 * np.pi
        # Blades and swashplates tilt by less than half a right angle.
        most = _FULL_TILT if is_input else most
        if is_input and max(-low, high) > np.degrees(_FULL_TILT):
            guess = f"GUESS: {low:.4g} to {high:.4g} is too large for a blade angle; scale: rad per"
            guess += " unit of the log"
            return Guess(channel, si, EDIT, remarks=(guess,))
        unit = "deg" if max(-low, high) > most else "rad"
    elif si == "rad/s":
        # A rotor turns faster than a body; its speed in rpm is obvious at 4000.
        largest = max(-low, high)
        # Nobody logs whole numbers of rad/s.
        is_coarse = largest >= 2.0 and are_whole(values)
        unit = "deg/s" if largest > _FASTEST_TURN or is_coarse else "rad/s"
    elif si == "1" and stated:
        # A command in degrees: of an angle, or of the swashplate.
        remark = f"GUESS: {low:.4g} to {high:.4g} {stated}; scale: 1 / full travel in the log"
        return Guess(channel, "1", EDIT, remarks=(remark,))
    elif si == "1":
        return _of_stick(channel, low, high)
    elif units.fits("m", si):
        guess = "GUESS: scale unknown: full travel of the input per unit of the log"
        return Guess(channel, si, EDIT, remarks=(guess,))
    else:
        unit = si
    return Guess(channel, unit, remarks=(f"GUESS: {low:.4g} to {high:.4g} taken for {unit}",))


def _of_pulses(channel: str, values: np.ndarray, si: str) -> Guess:
    # Most records begin with the stick at rest; otherwise the receivers' middle is assumed. A
    # record that begins within a manoeuvre does not return to that position for long.
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


def _of_stick(channel: str, low: float, high: float) -> Guess:
    largest = max(-low, high)
    # Betaflight-type commands count to 500, their collective to about 1000.
    commanded = words_of(channel)[-3:-1] == ("rc", "command") and largest <= _FULL_COMMAND
    if commanded and largest > _PARTS:
        remark = f"GUESS: {low:.4g} to {high:.4g}, full travel {_FULL_COMMAND:g}"
        return Guess(channel, "1", 1.0 / _FULL_COMMAND, remarks=(remark,))
    for most, unit, scale in ((_PARTS, "1", 1.0), (105.0, "%", 1.0), (1050.0, "1", 0.001)):
        if largest <= most:
            what = "thousandths" if scale != 1.0 else {"1": "parts of full travel"}.get(unit, unit)
            remark = f"GUESS: {low:.4g} to {high:.4g} taken as {what}"
            return Guess(channel, unit, scale, remarks=(remark,))
    remark = f"GUESS: {low:.4g} to {high:.4g}; scale: 1 / full travel in the log"
    return Guess(channel, "1", EDIT, remarks=(remark,))


def rotor_speed(channel: str, series: Series) -> float:
    """Return the mean speed of a rotor [rad/s]; large numbers are taken as rpm."""
    mean = float(np.nanmean(series.values))
    unit = series.unit or without_unit(channel)[1]
    if unit and units.fits(unit, "rad/s"):
        return mean * units.factor(unit, "rad/s")
    return mean * units.factor("rpm", "rad/s") if mean > 500.0 else mean
