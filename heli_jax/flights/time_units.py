"""Units of clocks as files write them: words, abbreviations, at the end of a column's name."""

import re

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.table import column, shown, wrong

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0}
"""of the units that clocks have: pint, which knows all, takes a quarter of a second to load"""
_WORDS = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds"),
    "us": ("us", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds"),
    "ns": ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"),
    "min": ("min", "mins", "minute", "minutes"),
    "h": ("h", "hr", "hrs", "hour", "hours"),
    "day": ("d", "day", "days"),
}
_UNITS = {word: unit for unit, words in _WORDS.items() for word in words}
# A unit stands behind a name as time_ms, 'time ms', time[ms] or time(ms); the group tells whether a
# bracket was opened that has to be closed.
_AT_END = re.compile(r"^(.*?)\s*(?:_|\s|(?P<open>[\[(]))([^\W\d_]+)(?(open)[\])])$")
# TimeUS, timestampMs: joined by a capital alone.
_JOINED = re.compile(r"^(.*(?:[Tt]ime|[Ss]tamp|TIME))(US|Us|MS|Ms|NS|Ns|Sec|Secs|S)$")
_SINCE = re.compile(r"\s+since\s+\S", re.IGNORECASE)
"""of 'days since 2024-03-01', as the CF conventions write the unit of a clock"""
LETTERS = ("h", "d")
"""units that mean other things too, as pos_d a position down: with brackets around them alone"""
_SERIAL_DAYS = ((30_000.0, 66_000.0), (710_000.0, 760_000.0), (2_440_000.0, 2_480_000.0))
"""days of our time as they count: Excel and modified Julian, MATLAB's datenum, Julian"""
_SLOWEST = 5.0
"""s: no flight is logged once in more"""
_SHORTEST = 0.05
"""s: no fit takes less"""
_LONGEST_FLIGHT, _LONGEST_SLOW = 6 * 3600.0, 2 * 3600.0
"""s: ticks that would make a longer one are more likely of the next smaller unit, and those of a
slow log sooner: 20 s at 1 kHz in ms would be hours at 1 Hz in s"""


def time_unit(text: str) -> str | None:
    """The unit of time that a text means: `ms` of Milliseconds, msec and Ms; None for others.

    Of a clock, a capital is a way of writing: megaseconds nobody logs.
    """
    # Of which the epoch does not matter: times count from the first sample.
    text = _SINCE.split(text, maxsplit=1)[0]
    # The micro sign, and the Greek letter that looks the same.
    word = text.strip().casefold().replace("µ", "u").replace("μ", "u")
    return _UNITS.get(word)


def split_unit(name: str) -> tuple[str, str]:
    """A column's name without the unit of time at its end, and this unit, empty where there is
    none."""
    match = _AT_END.fullmatch(name)
    if match is None and (joined := _JOINED.fullmatch(name)):
        return joined[1], time_unit(joined[2]) or ""
    unit = time_unit(match[3]) if match else None
    if match and unit and not match["open"] and match[3].casefold() in LETTERS:
        return name, ""
    return (match[1], unit) if match and unit else (name, "")


def require_likely(
    path: str, name: str, unit: str, stamps: np.ndarray, assumed: bool = False
) -> tuple[Finding, ...]:
    """Refuse stamps in seconds that are a flight's in another unit alone, where their name says
    that one or nobody stated seconds; a caution where somebody did.

    Args:
        stamps: (N,)

    Raises:
        InputError: with what to state.
    """
    named, likely = split_unit(name)[1], likely_unit(stamps)
    if unit != "s" or likely == "s":
        return ()
    step, length = float(np.median(np.diff(stamps))), float(stamps[-1] - stamps[0])
    problem = f"in s its stamps are {step:.4g} s apart over {length:.4g} s: they look like {likely}"
    if named != likely and not assumed:
        words = f"time: {shown(name)}: {problem}."
        return (Finding("units.unlikely", "doubt", words, step, "seconds between stamps", (name,)),)
    why = f", as its name says {named}" if named == likely else ""
    remedy = f"expected its unit: {{signal: {name}, unit: {likely}}}"
    if named != likely:
        remedy += ", or unit: s where it is so slow"
    raise wrong(path, f"{problem}{why}; {remedy}", column(name))


def likely_unit(stamps: np.ndarray | None) -> str:
    """The unit of stamps (N,) by their usual step and their length: no flight is logged once in
    5 s, or lasts a day. Counted days, as spreadsheets and MATLAB have them, show by their size."""
    if stamps is None or stamps.size < 2:
        return "s"
    with np.errstate(all="ignore"):
        step = float(np.median(np.diff(stamps)))
        length = float(stamps[-1] - stamps[0])
    # In seconds they would be at tens of thousands a second.
    is_day = any(low <= stamps[0] and stamps[-1] <= high for low, high in _SERIAL_DAYS)
    if is_day and step * SECONDS["day"] < _SLOWEST and length * SECONDS["day"] <= _LONGEST_FLIGHT:
        return "day"
    # From the coarsest unit on: the first in which the usual step is that of a log is taken.
    for unit, most, slow in (("s", _SLOWEST, 0.5), ("ms", 1e3, 100.0), ("us", 1e6, np.inf)):
        longest = _LONGEST_SLOW if step >= slow else _LONGEST_FLIGHT
        # Of parts of a second nothing is finer.
        whole = unit == "ms" or step >= slow
        if not step >= most and not (whole and length * SECONDS[unit] > longest):
            return _of_a_flight(unit, step, length)
    return _of_a_flight("ns", step, length)


def _of_a_flight(unit: str, step: float, length: float) -> str:
    """The next coarser unit in place of one in which the stamps are no flight's, but an instant's:
    a sample a second counts a thousand ms and a million us."""
    finer = {"ns": "us", "us": "ms", "ms": "s"}
    while length * SECONDS[unit] < _SHORTEST and (coarser := finer.get(unit)):
        if step * SECONDS[coarser] >= _SLOWEST:
            break
        unit = coarser
    return unit
