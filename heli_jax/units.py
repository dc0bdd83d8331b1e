"""Units: internal values are in SI; conversion happens once, when a file is read.

The angle is a dimension of its own here, so a length cannot pass for an angle. Hz means turns per
second: 25 Hz of rotor speed is 157 rad/s.
"""

import functools
import math
import re
from collections.abc import Mapping
from typing import Any

from heli_jax.errors import nearest

# pint's default registry makes the radian dimensionless, so a metre of stick would pass for a
# radian of blade. It also reads 'a' as a year and loads a thousand units.
_DEFINITIONS = """
milli- = 1e-3 = m-
micro- = 1e-6 = u- = µ-
nano- = 1e-9 = n-
centi- = 1e-2 = c-
hecto- = 100 = h-
kilo- = 1e3 = k-
mega- = 1e6 = M-
meter = [length] = m = metre
second = [time] = s = sec
gram = [mass] = g
radian = [angle] = rad
stick = []
percent = 0.01 = %
permille = 0.001
degree = 0.017453292519943295 * radian = deg = °
turn = 6.283185307179586 * radian = rev = revolution
inch = 0.0254 * meter = in
foot = 0.3048 * meter = ft
minute = 60 * second = min
hour = 3600 * second = h
day = 24 * hour
pound = 0.45359237 * kilogram = lb
newton = kilogram * meter / second ** 2 = N
watt = newton * meter / second = W
pascal = newton / meter ** 2 = Pa
hertz = turn / second = Hz
rpm = turn / minute
g_0 = 9.80665 * meter / second ** 2 = gee
slug = 14.593902937206 * kilogram
pound_force = 4.4482216152605 * newton = lbf
nautical_mile = 1852 * meter = nmi
mile = 1609.344 * meter = mi
knot = nautical_mile / hour = kt = kn
joule = newton * meter = J
ampere = [current] = A
kelvin = [temperature] = K
volt = watt / ampere = V
ohm = volt / ampere
henry = volt * second / ampere = H
farad = ampere * second / volt = F
"""


@functools.cache
def _registry() -> Any:
    import pint  # slow import

    registry = pint.UnitRegistry(None)
    for line in _DEFINITIONS.strip().splitlines():
        registry.define(line)
    return registry


# A unit is a product or quotient of names with small integer exponents; no other arithmetic.
_FACTOR = r"(?:1|[A-Za-zµ°%_]+)(?:\s*(?:\^|\*\*)\s*-?\d)?"
_UNIT = re.compile(rf"{_FACTOR}(?:\s*[*/·]\s*{_FACTOR}|\s+{_FACTOR})*")
_EXAMPLES = (
    *("m", "mm", "cm", "km", "in", "ft", "mi", "nmi", "s", "ms", "us", "min", "h"),
    *("rad", "mrad", "rad/s", "deg", "deg/s", "rev", "rpm", "Hz", "kt"),
    *("kg", "g", "lb", "slug", "N", "lbf", "gee"),
    *("Pa", "J", "W", "A", "V", "ohm", "H", "F", "%", "stick"),
)
"""Units that error messages list; docs/units.md has all."""


# Spellings of units in files: `degrees_per_second`, `deg s-1`, `m/s²`, `Grad/s`, `deg_s`.
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_RAISED = re.compile(r"([A-Za-z°%])([⁻]?[¹²³⁴⁵⁶⁷⁸⁹])")
_PER = re.compile(r"(?<=[A-Za-z°%])(?:_| )+per(?:_| )+|(?<=[a-z])p(?=s$|s\^?2$)")
# UDUNITS spelling (Unidata): the exponent follows the name, and a point is a product.
_EXPONENT = re.compile(r"(?<=[A-Za-zµ°])(-?[1-9])(?![0-9.])")
_POINT = re.compile(r"(?<=[A-Za-z0-9])\.(?=[A-Za-z])")
# Names cannot contain a slash: deg_s. Logs do not have products of these units and a second.
_UNDERLINED = re.compile(
    r"(deg|degree|degrees|rad|radian|radians|mrad|cdeg|m|meter|meters|metre|metres|cm|mm|ft|km)"
    r"_(s|sec|secs|second|seconds|h|min)(\^?2)?"
)
_WORDS = {
    "dps": "deg/s", "radps": "rad/s", "mps": "m/s", "metre": "m", "metres": "m",
    "Grad": "deg", "grad": "deg", "percentage": "percent", "pct": "percent", "secs": "s",
    **dict.fromkeys(("U/min", "Upm", "tr/min"), "rpm"),
}  # fmt: skip
_WORD = re.compile(r"[A-Za-zµ°%_]+")


def _as_known(text: str) -> str:
    """Return a unit in pint's spelling: names with `^` exponents, products and quotients."""
    text = _RAISED.sub(lambda m: f"{m[1]}^{m[2].translate(_SUPERSCRIPTS)}", text.strip())
    if text in _WORDS:
        return _WORDS[text]
    if match := _UNDERLINED.fullmatch(text):
        text = f"{match[1]}/{match[2]}{'^2' if match[3] else ''}"
    text = _EXPONENT.sub(r"^\1", _POINT.sub(" ", _PER.sub("/", text)))
    return _WORD.sub(lambda m: _WORDS.get(m[0], m[0]), text)


# Any, since pint's types cannot be imported without pint.
@functools.cache
def _parse(unit: str) -> Any:
    registry = _registry()
    # The Greek letter looks like the micro sign.
    text = _as_known(unit.strip().replace("·", "*").replace("μ", "µ"))
    if text in ("", "1", "-", "dimensionless"):
        return registry.Quantity(1.0)
    try:
        # Check before pint parses: pint evaluates powers, and 9**9**9**9 does not end.
        if len(text) > 60 or not _UNIT.fullmatch(text):
            raise ValueError
        expression = text.replace("%", "percent").replace("°", "degree")
        if _unknown_names(expression):
            raise ValueError
        quantity = registry.Quantity(
            1.0 * registry.parse_expression(expression, case_sensitive=True)
        )
        if not math.isfinite(quantity.magnitude):  # 'nan' and 'inf' parse as numbers
            raise ValueError
        return quantity
    except Exception as e:  # pint raises many types for text that is no unit
        raise ValueError(_unknown(unit, text)) from e


def _unknown_names(expression: str) -> list[str]:
    """Return the names in an expression that are no units."""
    return [n for n in re.findall(r"[A-Za-zµ°_]+", expression) if not _is_known(n)]


def _is_known(name: str) -> bool:
    registry = _registry()
    meanings = registry.parse_unit_name(name, case_sensitive=True)
    # pint reads a final s as a plural. This is right for whole words (degrees), but `rads` may mean
    # rad/s.
    if name.endswith("s") and len(name) > 1:
        singular = registry.parse_unit_name(name[:-1], case_sensitive=True)
        meanings = [m for m in meanings if m not in singular or name.endswith(f"{m[1]}s")]
    return bool(meanings)


_FROM_ANOTHER_ZERO = {
    **dict.fromkeys(("degC", "°C", "Celsius", "celsius"), "offset: -273.15, unit: K"),
    **dict.fromkeys(("degF", "°F", "Fahrenheit"), "offset: -459.67, scale: 0.5556, unit: K"),
}


def _unknown(unit: str, text: str) -> str:
    """Return a message on an unreadable unit, with the closest known names."""
    if text in _FROM_ANOTHER_ZERO:
        remedy = _FROM_ANOTHER_ZERO[text]
        return f"unit {text!r} has another zero than K; for a signal state {remedy}"
    wrong, place = text[:60], ""
    if len(text) <= 60 and _UNIT.fullmatch(text):
        names = _unknown_names(text.replace("%", "percent").replace("°", "degree"))
        wrong = names[0] if names else wrong
    if wrong != text[:60]:
        place = f" in {unit[:60]!r}"
    # Compare case first: by distance, `hz` is no closer to Hz than to h.
    alike = [n for n in _EXAMPLES if n.lower() == wrong.lower()]
    # There are few units, so listing all is useful.
    every = f"; known are {', '.join(_EXAMPLES)} and their products, as N m/A"
    near = nearest(wrong, alike or _EXAMPLES, every)
    return f"unknown unit {(wrong if place else unit[:60])!r}{place}{near}"


@functools.cache
def factor(unit: str, si: str) -> float:
    """Return the factor that converts a value in `unit` to the SI unit `si`.

    As in SI, a plain number may be an angle in radians (`1/s` for `rad/s`).

    Raises:
        ValueError: the unit is unknown, or of another kind than `si`.
    """
    have, want = _parse(unit), _parse(si)
    if have.dimensionality == want.dimensionality:
        return float((have / want).to_base_units().magnitude)
    # Only files may leave out the angle: '1/s' may mean rad/s. Hz or rad/s for 1/s is refused,
    # since a factor of 2 pi could go unnoticed.
    if "[angle]" not in dict(have.dimensionality) and _without_angle(have) == _without_angle(want):
        base = have.to_base_units()
        # Logs do not use radians per minute: 1/min usually means turns, a factor of 2 pi.
        if dict(have.dimensionality) == {"[time]": -1.0} and float(base.magnitude) != 1.0:
            raise ValueError(
                f"unit {unit!r} is a number per time, of turns or of radians, expected 'rpm' for "
                "turns per minute, or 'rad/min'"
            )
        if float(base.magnitude) == 1.0 or dict(base.dimensionality):
            return float(base.magnitude / want.to_base_units().magnitude)
    raise ValueError(f"unit {unit!r} is {_kind(have)}, expected {_kind(want)} such as {si!r}")


def fits(unit: str, si: str) -> bool:
    """True if `factor` converts one into the other."""
    try:
        factor(unit, si)
    except ValueError:
        return False
    return True


def turn(si: str) -> float | None:
    """Return a full turn in an SI unit; None if the unit is no angle."""
    return factor("turn", si) if fits("turn", si) else None


_SI = (
    *("1", "rad", "rad/s", "rad/s^2", "m", "m/s", "m/s^2", "s", "kg", "kg*m^2", "N", "N*m", "1/s"),
    *("1/s^2", "W", "Pa", "1/rad", "kg/m^3", "A", "V", "ohm", "H", "F", "J", "N*m/A", "N*m*s/rad"),
    "K",
)


def si_of(unit: str) -> str:
    """Return the SI unit of the same kind as `unit`.

    Raises:
        ValueError: the unit is unknown, or of a kind that is not listed.
    """
    # pint's base units would give kg m^2/s^2 instead of the familiar N m.
    kind = _parse(unit).dimensionality
    for si in _SI:
        if _parse(si).dimensionality == kind:
            return si
    raise ValueError(f"unit {unit!r} is a {kind}, for which no SI unit is listed")


_BASE = {
    **{"[mass]": "kg", "[length]": "m", "[time]": "s", "[angle]": "rad", "[current]": "A"},
    "[temperature]": "K",
}


def base_of(unit: str) -> dict[str, int]:
    """Return the nonzero exponents of kg, m, s, rad, A and K in a unit.

    Raises:
        ValueError: the unit is unknown.
    """
    kind = dict(_parse(unit).dimensionality)
    return {si: round(kind[name]) for name, si in _BASE.items() if kind.get(name)}


def is_unit(unit: str) -> bool:
    """True if a text is a unit."""
    try:
        _parse(unit)
    except ValueError:
        return False
    return True


def as_text(exponents: Mapping[str, int]) -> str:
    """Return the SI unit with these exponents of kg, m, s, rad, A and K: `kg m^2`, `rad/s^2/V`."""

    def power(unit: str, n: int) -> str:
        return unit if n == 1 else f"{unit}^{n}"

    above = " ".join(power(u, n) for u, n in _shortest(exponents).items() if n > 0)
    below = "".join(f"/{power(u, -n)}" for u, n in _shortest(exponents).items() if n < 0)
    return f"{above or '1'}{below}"


def of_product(units: Mapping[str, str], powers: Mapping[str, float]) -> str:
    """Return the SI unit of a product of powers, by name; empty if it has fractional powers.

    Raises:
        ValueError: a unit is unknown.
    """
    exponents: dict[str, float] = {}
    for name, power in powers.items():
        for base, n in base_of(units[name]).items():
            exponents[base] = exponents.get(base, 0.0) + power * n
    if any(n % 1 for n in exponents.values()):
        return ""
    return as_text({base: round(n) for base, n in exponents.items() if n})


def _shortest(exponents: Mapping[str, int]) -> dict[str, int]:
    """Return the exponents with volt for ampere and newton for kg, if fewer remain."""
    spellings = [dict(exponents)]
    volts = -exponents.get("A", 0)
    for volt in range(min(volts, 0), max(volts, 0) + 1):  # kg m^2/s^3/A
        for newton in {0, exponents.get("kg", 0) - volt}:  # kg m/s^2
            taken = {"kg": newton + volt, "m": newton + 2 * volt, "s": -2 * newton - 3 * volt}
            taken |= {"A": -volt}
            rest = {u: exponents.get(u, 0) - taken.get(u, 0) for u in {**taken, **exponents}}
            first, last = ({"V": volt}, {}) if volt > 0 else ({}, {"V": volt})
            spellings.append({"N": newton} | first | rest | last)
    return min(spellings, key=lambda spelling: sum(map(abs, spelling.values())))


def is_plain(unit: str) -> bool:
    """True if `unit` is a plain ratio: `1`, `%`, `stick`."""
    return not dict(_parse(unit).dimensionality)


def is_time(unit: str) -> bool:
    """True if a text is a unit of time: `s`, `us`."""
    return is_unit(unit) and _parse(unit).dimensionality == _parse("s").dimensionality


def _without_angle(quantity: Any) -> dict[str, float]:
    return {k: v for k, v in dict(quantity.dimensionality).items() if k != "[angle]"}


_KINDS = {
    "rad": "an angle",
    "m": "a length",
    "s": "a time",
    "rad/s": "an angular speed",
    "rad/s^2": "an angular acceleration",
    "m/s": "a speed",
    "kg": "a mass",
    "kg m^2": "a moment of inertia",
    "A": "a current",
    "V": "a voltage",
    "K": "a temperature",
    "1": "a plain number",
}


def _kind(quantity: Any) -> str:
    for unit, words in _KINDS.items():
        if _parse(unit).dimensionality == quantity.dimensionality:
            return words
    return f"of the kind {quantity.dimensionality}"
