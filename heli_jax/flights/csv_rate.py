"""How fast a table without times was sampled, as the lines above it say."""

import math
import re

from heli_jax.flights.row_clock import FASTEST, SLOWEST
from heli_jax.flights.table import shown
from heli_jax.flights.time_units import SECONDS, time_unit

_LONGEST = 100_000
"""characters above a table that are searched"""
_BETWEEN = r"[\s:=,;\"'\]\[()|\t_-]*"
# No time of day and no date: 12:30.
_NUMBER = r"(?P<number>(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)(?![\d.:/-])"
_UNIT = r"[\s,;\"'\[(]*(?P<unit>[^\W\d_]+)?"
_SAMPLING = r"(?:sampl(?:e|es|ing)|update|output|logging|acquisition|capture)"
_ABOUT = r"(?:[\s_-]*(?:data|frame))?"
_RATE = re.compile(
    rf"\b(?:{_SAMPLING}{_ABOUT}[\s_-]*(?:rate|freq(?:uency)?)|fs)\b"
    rf"{_BETWEEN}(?:\(?\s*(?:hz|khz)\s*\)?{_BETWEEN})?{_NUMBER}{_UNIT}",
    re.IGNORECASE,
)
_STEP = re.compile(
    rf"\b(?:{_SAMPLING}{_ABOUT}[\s_-]*(?:time|period|interval|step)|ts|dt)\b"
    rf"{_BETWEEN}{_NUMBER}{_UNIT}",
    re.IGNORECASE,
)
_HERTZ = {"": 1.0, "hz": 1.0, "hertz": 1.0, "khz": 1e3, "sps": 1.0}


def rate_above(text: str) -> tuple[float, str] | None:
    """The rate [Hz] that the lines above a table state, and the words that do; None where none
    does, or several that differ.

    Args:
        text: what stands above the rows, comments too.
    """
    text = text[:_LONGEST]
    rates: dict[float, str] = {}
    for match in _RATE.finditer(text):
        factor = _HERTZ.get((match["unit"] or "").casefold())
        _take(rates, float(match["number"]) * (factor or 1.0), match, factor is not None)
    for match in _STEP.finditer(text):
        unit = time_unit(match["unit"] or "")
        step = float(match["number"]) * SECONDS[unit or "s"]
        _take(rates, 1.0 / step if step > 0 else 0.0, match, unit is not None)
    return next(iter(rates.items())) if len(rates) == 1 else None


def _take(rates: dict[float, str], rate: float, match: re.Match[str], has_unit: bool) -> None:
    if not SLOWEST <= rate <= FASTEST:
        return
    # 1/0.02 is 50 in numbers of the machine, 1/0.033 is what it is.
    near = round(rate, 6)
    rate = near if math.isclose(rate, near, rel_tol=1e-9) else rate
    end = match.end("unit" if has_unit and match["unit"] else "number")
    words = match.string[match.start() : end]
    rates.setdefault(rate, shown(" ".join(words.split())))
