"""Numbers and verdicts as text, with no more digits than the standard deviation allows."""

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

NOTHING = "–"
WORST = -10.0
"""VAF below which only the bound is printed: the simulation is far off."""
_LONG = 1e5
"""Percentage from which `number` prints a power of ten."""
_UP = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """Format a number to some significant digits, with a power of ten if it is far from one."""
    # None and NaN mean 'not estimated' and become a dash. 'nan' would look like an error.
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    # Round first: 0.0009999 to two digits is 0.0010 and not 10·10⁻⁴.
    power = _power(float(f"{value:.{max(digits, 1) - 1}e}"))
    # 10**-324 underflows, so the smallest numbers take two steps.
    mantissa = value / 10.0 ** max(power, -300) / 10.0 ** min(power + 300, 0)
    text = f"{mantissa:.{digits}g}"
    # `g` switches to an exponent if more digits than requested are left of the point. The power of
    # ten is already separate.
    if "e" in text:
        text = f"{mantissa:.0f}"
    return _signed(text) + _times(power)


def p_value(p: float) -> str:
    """Format a probability, without digits if it is negligible."""
    # Tails of distributions are not accurate to such digits, and 0 is an underflow.
    return f"{p:.2g}" if p >= 1e-6 else "below 1e-6"


def percent(value: float | None, digits: int = 2) -> str:
    """Format a share (1 is 100 %) as a percentage."""
    if value is None or not math.isfinite(value):
        return NOTHING
    share = 100 * value
    # A diverging simulation would give meaningless digits.
    if abs(share) >= _LONG:
        return f"{number(share, 3)} %"
    return f"{_signed(f'{share:.{digits}f}')} %"


def vaf_percent(value: float | None, digits: int = 2) -> str:
    """Format a VAF or a fit (1 is 100 %) as a percentage; poor values are given as a bound."""
    if value is not None and value < WORST:
        return f"below {percent(WORST, 0)}"
    return percent(value, digits)


def vaf_text(value: float, digits: int = 1) -> str:
    """Format as `vaf_percent`, in ASCII for sentences; one decimal separates 0.949 from the gate
    0.95.
    """
    return plain_words(vaf_percent(value, digits))


def explained_text(share: float) -> str:
    """Format an explained share (1 is 100 %); 'none' if the model is worse than the mean."""
    return "none" if share < 0 else f"{100 * share:.0f} %"


def relative(sd: float | None, value: float) -> str:
    """Format sd over |value| as a percentage with two digits."""
    if sd is None or value == 0 or not math.isfinite(sd / value):
        return NOTHING
    share = 100 * abs(sd / value)
    # Above 100 % the digits are meaningless, and '1.2e+02 %' is hard to read.
    if share >= 100:
        return f"{number(share, 3) if share >= _LONG else f'{share:.0f}'} %"
    # '#' keeps the zero of 1.0 %: with one digit, 1 % could mean 0.6 to 1.4.
    return f"{share:#.2g}".rstrip(".") + " %" if share >= 1e-4 else f"{number(share, 2)} %"


_FAR = 10.0
"""Distance at which an end of an interval is rounded on its own [sd, or multiples of the value]."""


# Pages and terminal share one rule: `measured` and `number` choose digits and rounding. `plain`
# converts to ASCII with Python's exponents, so that numbers can be pasted into a vehicle file.


def rounded(value: float, sd: float) -> tuple[str, str]:
    """Format a value and its standard deviation to the second digit of the latter, in ASCII."""
    return plain(measured(sd, value)[0]), plain(measured(sd, value)[1])


def terse(value: float | None, digits: int = 4) -> str:
    """Format a number as `number` does, in ASCII for the terminal."""
    return plain(number(value, digits))


_WORDS = {"∞": "inf", "−∞": "-inf", NOTHING: "-", "−": "-"}
_DOWN = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def lowered(power: str) -> str:
    """Return a page's exponent in ASCII: `⁻⁴` as `-4`."""
    return power.translate(_DOWN)


def plain(text: str) -> str:
    """Return a page's number in ASCII, with the same digits: `1.7000·10⁻⁴` as `1.7000e-04`."""
    if text in _WORDS:
        return _WORDS[text]
    digits, _, power = text.replace("−", "-").partition("·10")
    if not power:
        return digits
    # Each number gets its own power: 0.0012·10⁻⁴ beside 1.7000·10⁻⁴ is 1.2e-07.
    value = Decimal(digits).scaleb(int(lowered(power)))
    if not value:
        return digits
    mantissa, _, exponent = f"{value:e}".partition("e")
    if _is_readable(int(exponent)):
        return f"{value:f}"
    return f"{mantissa}e{int(exponent):+03d}"


_NUMBER = re.compile(r"[−-]?\d[\d.]*·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+|[−-]?\d[\d.]*|−?∞|−|–")


def plain_words(text: str) -> str:
    """Return a page's sentence for the terminal, with numbers as in `plain`."""
    return _NUMBER.sub(lambda m: plain(m[0]), text)


# Skip words, paths and the user's own text in quotes.
_EXPONENT = re.compile(r"(?<![\w./'\"-])([-+]?\d+(?:\.\d+)?)e([-+]?\d+)(?![\w/'\"]|\.\w)")


def terminal_sentence(text: str) -> str:
    """Rewrite Python's exponents in a sentence by the rule of `number`: 1.2e+03 as 1200."""
    return _EXPONENT.sub(lambda m: _decimal(m) or m[0], text)


def page_sentence(text: str) -> str:
    """Rewrite Python's exponents for a page: 7.5e-06 as 7.5·10⁻⁶."""

    def written(m: re.Match[str]) -> str:
        return _decimal(m) or _signed(m[1].removeprefix("+")) + _times(int(m[2]))

    return _EXPONENT.sub(written, text)


def _decimal(m: re.Match[str]) -> str | None:
    """Return a number with exponent in full; None if it reads better with a power of ten."""
    value = Decimal(m[1]).scaleb(int(m[2]))
    sign = "+" if m[1].startswith("+") else ""
    return f"{sign}{value:f}" if _is_readable(value.adjusted()) or not value else None


_POWER = re.compile(r"[−-]?\d[\d.]*·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_OF_UNITS = str.maketrans({"²": "^2", "³": "^3", "⁴": "^4", "−": "-", "∞": "inf"})


def plain_cell(text: str) -> str:
    """Return a page's table cell for the terminal: powers of ten, signs and units in ASCII."""
    return _POWER.sub(lambda m: plain(m[0]), text).translate(_OF_UNITS)


def aligned(values: Sequence[float], step: float) -> tuple[str, ...]:
    """Format numbers, such as axis values, with one power of ten and enough decimals for a step.

    Args:
        step: the least difference between two numbers, above zero.
    """
    power = _power(max(abs(v) for v in values))
    places = min(max(0, power - math.floor(math.log10(step) + 1e-9)), 15)
    texts = (_signed(f"{v / 10.0**power:.{places}f}") for v in values)
    return tuple(t + (_times(power) if t.strip("0.") else "") for t in texts)


def measured(sd: float | None, *values: float | None) -> tuple[str, ...]:
    """Format values to the second digit of their standard deviation, then that deviation.

    All share one power of ten. Without an sd above zero they have six digits.
    """
    first = values[0]
    if sd is None or not (math.isfinite(sd) and sd > 0) or first is None:
        return (*(number(v, 6) for v in values), number(sd, 2))
    # The larger of the two sets the power, so that an sd above its value stays readable.
    power = _power(max(abs(first), sd))
    # Number of decimals to the second digit of sd, after the power. A double has at most 15.
    places = min(1 - math.floor(math.log10(sd)) + power, 15)

    def text_of(v: float | None) -> str:
        if v is None or not math.isfinite(v):
            return number(v)
        # The end of an interval over powers of ten is rounded on its own.
        if abs(v - first) > _FAR * sd and abs(v) > _FAR * abs(first):
            return number(v, 3)
        # Round first, since the format cannot round left of the point (places < 0).
        return _signed(f"{round(v / 10.0**power, places):.{max(places, 0)}f}") + _times(power)

    return (*(text_of(v) for v in values), text_of(sd))


def with_sd(value: float, sd: float) -> str:
    """Format a value with its sd: `0.024000 ± 0.000021`."""
    text, deviation = measured(sd, value)
    return f"{text} ± {deviation}"


def _power(value: float) -> int:
    """Return the power of ten to separate; 0 for numbers that read well without it."""
    if value == 0 or not math.isfinite(value):
        return 0
    power = math.floor(math.log10(abs(value)))
    return 0 if _is_readable(power) else power


def _is_readable(power: int) -> bool:
    """True if numbers of this magnitude read well in full, such as 0.0032 and 12345."""
    return -4 < power < 5


def _times(power: int) -> str:
    return f"·10{str(power).translate(_UP)}" if power else ""


def _signed(text: str) -> str:
    """Use a true minus sign, and no sign for zero."""
    # A number that rounds to zero has no sign: '−0.000' would claim one that the digits do not
    # show.
    if text.startswith("-"):
        return text[1:] if not text.strip("-0.") else f"−{text[1:]}"
    return text


ADEQUATE = {True: "yes", False: "no", None: "not judged"}
"""Words for `adequate` of fit.json."""


def adequacy_of(content: Mapping[str, Any]) -> str:
    """Return the adequacy in words; only yes or no for fits of earlier versions."""
    summary = (content.get("adequacy") or {}).get("summary")
    return str(summary or ADEQUATE[content["adequate"]])
