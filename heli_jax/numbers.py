"""Numbers as text: no more digits than their standard deviation allows."""

import math

NOTHING = "–"
_UP = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """A number to some significant digits, with a power of ten where it is far from one."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    power = _power(value)
    text = f"{value / 10.0**power:.{digits}g}"
    if "e" in text:
        text = f"{value / 10.0**power:.0f}"
    return _signed(text) + _times(power)


def percent(value: float | None, digits: int = 2) -> str:
    """A share (1 is 100 %) as a percentage."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{_signed(f'{100 * value:.{digits}f}')} %"


def relative(sd: float | None, value: float) -> str:
    """sd over |value| in percent, to two digits."""
    if sd is None or value == 0 or not math.isfinite(sd / value):
        return NOTHING
    share = 100 * abs(sd / value)
    if share >= 100:
        return f"{share:.0f} %"
    return f"{share:#.2g}".rstrip(".") + " %" if share >= 1e-4 else f"{number(share, 2)} %"


_FAR = 10.0


def measured(sd: float | None, *values: float | None) -> tuple[str, ...]:
    """Values to the second digit of their standard deviation, then that deviation.

    All share the power of ten of the first. An sd of zero, or none, leaves six digits.
    """
    first = values[0]
    if sd is None or not (math.isfinite(sd) and sd > 0) or first is None:
        return (*(number(v, 6) for v in values), number(sd, 2))
    power = _power(max(abs(first), sd))
    places = min(1 - math.floor(math.log10(sd)) + power, 15)

    def one(v: float | None) -> str:
        if v is None or not math.isfinite(v):
            return number(v)
        # An end of an interval over powers of ten has digits of its own.
        if abs(v - first) > _FAR * sd and abs(v) > _FAR * abs(first):
            return number(v, 3)
        return _signed(f"{round(v / 10.0**power, places):.{max(places, 0)}f}") + _times(power)

    return (*(one(v) for v in values), one(sd))


def with_sd(value: float, sd: float) -> str:
    """`0.024000 ± 0.000021`."""
    text, deviation = measured(sd, value)
    return f"{text} ± {deviation}"


def _power(value: float) -> int:
    """The power of ten to take out: 0 for numbers that read well as they are."""
    if value == 0 or not math.isfinite(value):
        return 0
    power = math.floor(math.log10(abs(value)))
    return 0 if -3 < power < 5 else power


def _times(power: int) -> str:
    return f"·10{str(power).translate(_UP)}" if power else ""


def _signed(text: str) -> str:
    """A true minus sign, and none before a zero."""
    if text.startswith("-"):
        return text[1:] if not text.strip("-0.") else f"−{text[1:]}"
    return text
