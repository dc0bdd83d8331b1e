"""Unit at the end of a channel's name, in usual spellings."""

import re

from heli_jax import units

# Longest first, so that deg/s is not read as deg.
_UNIT_WORDS = {
    "deg/s": "deg/s", "deg per s": "deg/s", "degs": "deg/s", "dps": "deg/s", "rad/s": "rad/s",
    "rads": "rad/s", "radps": "rad/s", "deg": "deg", "degree": "deg", "degrees": "deg",
    "grad": "deg",
    "rad": "rad", "mrad": "mrad", "rpm": "rpm", "percent": "%", "pct": "%", "mps": "m/s",
    "m/s": "m/s", "cm": "cm", "mm": "mm", "kt": "kt", "kn": "kt", "kts": "kt", "knot": "kt",
    "knots": "kt", "fps": "ft/s", "ft/s": "ft/s", "kmh": "km/h", "km/h": "km/h", "volt": "V",
    "volts": "V", "amp": "A", "amps": "A", "degc": "degC", "hz": "Hz",
    # Autopilots use hundredths of degrees, thousandths of radians, and centimetres.
    "cdeg": "cdeg", "cd": "cdeg", "centideg": "cdeg", "cdegs": "cdeg/s", "cds": "cdeg/s",
    "cdeg/s": "cdeg/s", "mrads": "mrad/s", "mradps": "mrad/s", "mrad/s": "mrad/s", "cms": "cm/s",
    "cm/s": "cm/s", "mms": "mm/s", "mm/s": "mm/s",
}  # fmt: skip
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
_RATE = re.compile(
    rf"(.*?)[-_ .,]+({'|'.join(_PLAIN)})(?:[_ .]*per[_ .]*|[_ ]?p[_ .]?|[/_ .])"
    r"(?:s|sec|second|seconds)(?:\^?-?([12]))?",
    re.IGNORECASE,
)
"""Rates and speeds, such as `roll_rate_deg_s` and `p degrees per second`."""
# For names without a separator before the unit: rollDeg.
_JOINED_UNIT = re.compile(
    r"(.*[a-z0-9XYZ])(Deg|Rad|Dps|Degs|Rads|Radps|Rpm|Mps|Pct|Percent)((?:_?[A-Z]?[a-z]+)?)"
)
# Only capitals: a small v or a is a speed or an acceleration.
_LETTERS = ("V", "A", "%")
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]([^\[\]()]+)[\])]\s*$")
# Words after a name that do not change its meaning; roll_rate is no roll angle.
FILLERS = {
    *("pwm", "us", "raw", "filt", "filtered", "meas", "measured", "value", "values", "data", "adc"),
    *("counts", "norm", "in", "input", "body", "imu", "est", "out1"),
}


def without_unit(name: str) -> tuple[str, str]:
    """Return a name without the unit at its end, and the unit, or an empty string."""
    match = _BRACKETS.fullmatch(name)
    if match and (unit := _UNIT_WORDS.get(match[2].strip().lower())):
        return match[1], unit
    # gyroADC[1] is an index, not a unit.
    if match and not match[2].strip().isdigit() and units.is_unit(match[2].strip()):
        return match[1], match[2].strip()
    if match := _RATE.fullmatch(name):
        return match[1], f"{_PLAIN[match[2].lower()]}/s{'^2' if match[3] == '2' else ''}"
    for letter in _LETTERS:
        if name.endswith((f"_{letter}", f" {letter}")):
            return name[:-2], letter
    for word, unit in _UNIT_WORDS.items():
        for mark in ("_", " ", ".", "-", ","):
            if name.lower().endswith(mark + word):
                return name[: -len(word) - 1], unit
    match = _JOINED_UNIT.fullmatch(name)
    # rollDegFilt, but not rollDegree: the rest must be a word.
    if match and match[3].strip("_").lower() in {"", *FILLERS}:
        return match[1], _UNIT_WORDS[match[2].lower()]
    # q_dps_meas: a neutral word follows the unit.
    stem, _, last = name.rpartition("_")
    if stem and last.lower() in FILLERS:
        before, unit = without_unit(stem)
        return (f"{before}_{last}", unit) if unit else (name, "")
    return name, ""
