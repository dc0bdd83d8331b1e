"""Numbers and verdicts as text: no more digits than a standard deviation allows."""

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

NOTHING = "–"
WORST = -10.0
"""VAF below which its digits say nothing but that a simulation is far off"""
_LONG = 1e5
"""per cent from which a power of ten is taken out, as `number` takes it"""
_UP = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """A number to some significant digits, with a power of ten where it is far from one."""
    # None and NaN stand for 'not estimated': a dash, since a reader would take 'nan' for an error.
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    # Of the rounded value, since 0.0009999 to two digits is 0.0010 and not 10·10⁻⁴.
    power = _power(float(f"{value:.{max(digits, 1) - 1}e}"))
    # 10**-324 is no number: of the smallest in two steps.
    mantissa = value / 10.0 ** max(power, -300) / 10.0 ** min(power + 300, 0)
    text = f"{mantissa:.{digits}g}"
    # `g` falls back to an exponent where the digits left of the point are more than asked for;
    # the power of ten has been taken out already, and a number has one.
    if "e" in text:
        text = f"{mantissa:.0f}"
    return _signed(text) + _times(power)


def p_value(p: float) -> str:
    """A chance of something, without digits where it is none to speak of."""
    # The tail of a distribution is known to no such digits, and 0 is a number that underflowed.
    return f"{p:.2g}" if p >= 1e-6 else "below 1e-6"


def percent(value: float | None, digits: int = 2) -> str:
    """A share (1 is 100 %) as a percentage."""
    if value is None or not math.isfinite(value):
        return NOTHING
    share = 100 * value
    # Of a simulation that diverges the digits would fill lines, and mean nothing.
    if abs(share) >= _LONG:
        return f"{number(share, 3)} %"
    return f"{_signed(f'{share:.{digits}f}')} %"


def vaf_percent(value: float | None, digits: int = 2) -> str:
    """A VAF or a fit (1 is 100 %) as a percentage: that of a simulation which is off is a bound."""
    if value is not None and value < WORST:
        return f"below {percent(WORST, 0)}"
    return percent(value, digits)


def vaf_text(value: float, digits: int = 1) -> str:
    """`vaf_percent` in ASCII, for sentences: one place tells 0.949 from 0.95 as the gates ask."""
    return plain_words(vaf_percent(value, digits))


def explained_text(share: float) -> str:
    """A share that is explained (1 is 100 %); none where all is worse than with the mean."""
    return "none" if share < 0 else f"{100 * share:.0f} %"


def relative(sd: float | None, value: float) -> str:
    """sd over |value| in percent, to two digits."""
    if sd is None or value == 0 or not math.isfinite(sd / value):
        return NOTHING
    share = 100 * abs(sd / value)
    # Past 100 % the digits say nothing, and '1.2e+02 %' is what two of them would look like.
    if share >= 100:
        return f"{number(share, 3) if share >= _LONG else f'{share:.0f}'} %"
    # '#' keeps the zero of 1.0 %: two digits are promised, and 1 % could be 0.6 to 1.4.
    return f"{share:#.2g}".rstrip(".") + " %" if share >= 1e-4 else f"{number(share, 2)} %"


_FAR = 10.0
"""standard deviations, or times the value, past which an end of an interval is on its own"""


# One rule for pages and terminal: `measured` and `number` decide on digits and rounding, and
# `plain` writes what they give in ASCII, with an exponent as Python writes it, so that a number
# can be pasted into a vehicle file.


def rounded(value: float, sd: float) -> tuple[str, str]:
    """A value to the second digit of its standard deviation, and that deviation, for the terminal:
    `measured` in ASCII."""
    return plain(measured(sd, value)[0]), plain(measured(sd, value)[1])


def terse(value: float | None, digits: int = 4) -> str:
    """A number to some significant digits for the terminal: `number` in ASCII."""
    return plain(number(value, digits))


_WORDS = {"∞": "inf", "−∞": "-inf", NOTHING: "-", "−": "-"}
_DOWN = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def lowered(power: str) -> str:
    """An exponent of a page in ASCII: `⁻⁴` as `-4`."""
    return power.translate(_DOWN)


def plain(text: str) -> str:
    """A number of a page in ASCII, with the same digits: `1.7000·10⁻⁴` as `1.7000e-04`."""
    if text in _WORDS:
        return _WORDS[text]
    digits, _, power = text.replace("−", "-").partition("·10")
    if not power:
        return digits
    # A power of its own: 0.0012·10⁻⁴ beside a value of 1.7000·10⁻⁴ is 1.2e-07.
    value = Decimal(digits).scaleb(int(lowered(power)))
    if not value:
        return digits
    mantissa, _, exponent = f"{value:e}".partition("e")
    if _reads_well(int(exponent)):
        return f"{value:f}"
    return f"{mantissa}e{int(exponent):+03d}"


_NUMBER = re.compile(r"[−-]?\d[\d.]*·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+|[−-]?\d[\d.]*|−?∞|−|–")


def plain_words(text: str) -> str:
    """A sentence of a page for the terminal: its numbers as `plain` has them."""
    return _NUMBER.sub(lambda m: plain(m[0]), text)


# Not within words, paths, or what a user typed, which stands in quotes.
_EXPONENT = re.compile(r"(?<![\w./'\"-])([-+]?\d+(?:\.\d+)?)e([-+]?\d+)(?![\w/'\"]|\.\w)")


def terminal_sentence(text: str) -> str:
    """A sentence that a format of Python's wrote, by the rule of `number`: 1.2e+03 as 1200."""
    return _EXPONENT.sub(lambda m: _decimal(m) or m[0], text)


def page_sentence(text: str) -> str:
    """The same for a page: 7.5e-06 as 7.5·10⁻⁶."""

    def written(m: re.Match[str]) -> str:
        return _decimal(m) or _signed(m[1].removeprefix("+")) + _times(int(m[2]))

    return _EXPONENT.sub(written, text)


def _decimal(m: re.Match[str]) -> str | None:
    """All digits of a number with an exponent; None where it reads better with a power of ten."""
    value = Decimal(m[1]).scaleb(int(m[2]))
    sign = "+" if m[1].startswith("+") else ""
    return f"{sign}{value:f}" if _reads_well(value.adjusted()) or not value else None


_POWER = re.compile(r"[−-]?\d[\d.]*·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_OF_UNITS = str.maketrans({"²": "^2", "³": "^3", "⁴": "^4", "−": "-", "∞": "inf"})


def plain_cell(text: str) -> str:
    """A cell of a page's table for the terminal: powers of ten, signs and units in ASCII."""
    return _POWER.sub(lambda m: plain(m[0]), text).translate(_OF_UNITS)


def aligned(values: Sequence[float], step: float) -> tuple[str, ...]:
    """Numbers that a step tells apart, as of an axis: all with one power of ten and as many places.

    Args:
        step: the least difference between two of them, above zero.
    """
    power = _power(max(abs(v) for v in values))
    places = min(max(0, power - math.floor(math.log10(step) + 1e-9)), 15)
    texts = (_signed(f"{v / 10.0**power:.{places}f}") for v in values)
    return tuple(t + (_times(power) if t.strip("0.") else "") for t in texts)


def measured(sd: float | None, *values: float | None) -> tuple[str, ...]:
    """Values to the second digit of their standard deviation, then that deviation.

    All share the power of ten of the first. An sd of zero, or none, leaves six digits.
    """
    first = values[0]
    if sd is None or not (math.isfinite(sd) and sd > 0) or first is None:
        return (*(number(v, 6) for v in values), number(sd, 2))
    # The larger of the two decides on the power: an sd above its value must be readable too.
    power = _power(max(abs(first), sd))
    # The second digit of sd stands this many places after the point, once the power is out; past
    # 15 a double has none.
    places = min(1 - math.floor(math.log10(sd)) + power, 15)

    def text_of(v: float | None) -> str:
        if v is None or not math.isfinite(v):
            return number(v)
        # An end of an interval over powers of ten has digits of its own.
        if abs(v - first) > _FAR * sd and abs(v) > _FAR * abs(first):
            return number(v, 3)
        # Rounded first, since the format alone cannot round to the left of the point (places < 0).
        return _signed(f"{round(v / 10.0**power, places):.{max(places, 0)}f}") + _times(power)

    return (*(text_of(v) for v in values), text_of(sd))


def with_sd(value: float, sd: float) -> str:
    """`0.024000 ± 0.000021`."""
    text, deviation = measured(sd, value)
    return f"{text} ± {deviation}"


def _power(value: float) -> int:
    """The power of ten to take out: 0 for numbers that read well as they are."""
    if value == 0 or not math.isfinite(value):
        return 0
    power = math.floor(math.log10(abs(value)))
    return 0 if _reads_well(power) else power


def _reads_well(power: int) -> bool:
    """True if a number of this order of magnitude reads well: 0.0032 and 12345 do, 3.2·10⁻³ does
    not."""
    return -4 < power < 5


def _times(power: int) -> str:
    return f"·10{str(power).translate(_UP)}" if power else ""


def _signed(text: str) -> str:
    """A true minus sign, and none before a zero."""
    # What rounds to zero has no sign: '−0.000' would claim one that the digits do not show.
    if text.startswith("-"):
        return text[1:] if not text.strip("-0.") else f"−{text[1:]}"
    return text


ADEQUATE = {True: "yes", False: "no", None: "not judged"}
"""words for `adequate` of fit.json"""


def adequacy_of(content: Mapping[str, Any]) -> str:
    """The verdict on adequacy in words; by yes and no alone of fits of earlier versions."""
    summary = (content.get("adequacy") or {}).get("summary")
    return str(summary or ADEQUATE[content["adequate"]])
