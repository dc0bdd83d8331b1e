"""Quantities that a channel's name and unit imply, and therefore excluded inputs."""

import re

from heli_jax import units
from heli_jax.flights.clock import words_in

_PLAIN = {
    **dict.fromkeys(("deg", "degree", "degrees", "grad"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    "mrad": "mrad",
    **dict.fromkeys(("cdeg", "centideg", "centidegrees"), "cdeg"),
    "cm": "cm",
    "mm": "mm",
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("ft", "feet"), "ft"),
}
"""Units that names may combine with 'per second', in their spellings."""
_TAIL = re.compile(
    rf"(.*?)[-_ .,]+({'|'.join(_PLAIN)})(?:[_ .]*per[_ .]*|[_ ]?p[_ .]?|[/_ .])"
    r"(?:s|sec|second|seconds)(?:\^?-?([12]))?",
    re.IGNORECASE,
)
_MEANINGS = {
    "rad/s": "an angular rate",
    "rad/s^2": "an angular acceleration",
    "m/s": "a speed",
    "m/s^2": "an acceleration",
    "s": "a time",
    "A": "a current",
    "Pa": "a pressure",
    "W": "a power",
    "rad": "an angle",
    "m": "a length",
    "V": "a voltage",
}
_OF_STICKS = ("rad", "m", "V")
"""Units of a stick or of the blades it moves, if the name is that of a stick."""
_PULSES = ("us", "µs", "usec", "microseconds")
_WORDS = {
    word: meaning
    for meaning, words in {
        "an angular rate": "rate rates gyro gyr gyrox gyroy gyroz omega phidot thetadot psidot",
        "an acceleration": "acc accel acceleration accelerometer imuacc",
        "a speed": "vel velocity speed airspeed climb",
        "a position": "pos position altitude alt latitude longitude gps baro height",
        "a rotor's or motor's speed": "rpm erpm headspeed",
        "a voltage": "volt volts voltage vbat vcc batt battery",
        "a current": "current amps amperage",
        "a temperature": "temp temperature",
        "a time": "time timestamp stamp seconds clock",
        "an angle": "angle phi theta psi attitude euler heading bank quat",
        "a field": "mag magnetometer compass",
    }.items()
    for word in words.split()
}
_AXIS = {"p", "q", "r"}
"""Names of rates, unless other words contradict."""
_STICKS = {
    *("stick", "sticks", "servo", "servos", "channel", "chan", "ch", "rc", "cmd", "command"),
    *("commanded", "input", "pwm", "pulse", "cyclic", "swash", "swashplate", "delta", "actuator"),
    *("control", "controls", "output", "out", "aileron", "ail", "elevator", "elev", "ele"),
    *("rudder", "rud", "pedal", "ped", "collective", "col", "lat", "lon", "lateral", "tail"),
    *(
        "longitudinal",
        "rccommand",
        "setpoint",
        "sp",
        "u",
        "joystick",
        "throttle",
        "thr",
        "des",
        "ref",
    ),
    *("desired", "target", "excitation", "sweep"),
}


def rate_at_end(name: str) -> tuple[str, str] | None:
    """Return a name without the unit of a rate or a speed at its end, and the unit; else None.

    Examples are `roll_rate_deg_s` and `p degrees per second`.
    """
    match = _TAIL.fullmatch(name)
    if match is None:
        return None
    return match[1], f"{_PLAIN[match[2].lower()]}/s{'^2' if match[3] == '2' else ''}"


def kind_of_unit(unit: str) -> str:
    """Return the SI unit of the same kind; empty if it may be a stick's."""
    if not unit or unit in _PULSES or not units.is_unit(unit):
        return ""
    return next((si for si in _MEANINGS if _is_of(unit, si)), "")


def quantity_of_output(name: str, unit: str, si: str) -> str:
    """Return the measured quantity, such as `an angular rate`, of a channel that is no input.

    It is empty if the channel can be an input.

    Args:
        name: name of the channel.
        unit: unit that the log or the name states, or empty.
        si: SI unit of the model's input.
    """
    words = words_in(name)
    called = is_stick_name(name)
    kind = kind_of_unit(unit)
    if kind and not _is_of(unit, si) and (kind not in _OF_STICKS or not called):
        return _MEANINGS[kind]
    # A speed is valid for an input that is a speed, such as a rotor's.
    if called or si in ("rad/s", "m/s", "rad/s^2", "m/s^2"):
        return ""
    if len(words) == 1 and words[0] in _AXIS:
        return "an angular rate"
    matches = [w for w in words if w in _WORDS]
    return _WORDS[matches[0]] if matches else ""


def is_stick_name(name: str) -> bool:
    """True if a word of a name means a stick, a servo or a command."""
    words = set(words_in(name))
    return bool(_STICKS & words) and "gps" not in words


def _is_of(unit: str, si: str) -> bool:
    """True if a unit has the kind of an SI unit; angles are a separate kind."""
    try:
        return units.base_of(unit) == units.base_of(si)
    except ValueError:
        return False
