"""Times as files write them: units in words or at the end of a column's name, and times as text."""

import datetime
import re
from collections.abc import Callable, Sequence

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.table import column, shown, wrong

TIME_NAMES = {
    *("t", "time", "timestamp", "timestamps", "seconds", "sec", "elapsed", "clock", "zeit", "temps")
}
"""words in the names of clocks"""
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


# Dates of ISO 8601 and of German spreadsheets, times of day, counts with a unit.

_CLOCK = r"(\d{1,3}):(\d\d):(\d\d(?:[.,]\d{1,12})?)"
_ISO = re.compile(r"\d{4}[-/]\d\d[-/]\d\d[T ,]+\d\d:\d\d(?::\d\d.*)?")
_GERMAN = re.compile(r"(\d\d?)\.(\d\d?)\.(\d{4}),? (\d{1,2}:\d\d:\d\d(?:[.,]\d{1,6})?)")
_TIME_OF_DAY = re.compile(_CLOCK)
_SPAN = re.compile(rf"(\d{{1,5}}) ?days?,? +{_CLOCK}")
"""0 days 00:00:01.25, as pandas and Python write what has passed"""
_COUNT = re.compile(r"([+-]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([A-Za-zµμ]+)")
"""0.01 sec, as MATLAB writes durations"""
_LONGEST = 60
"""characters of a time; of a damaged file a cell may be as long as itself"""


def is_date(cell: str) -> bool:
    """True for a date with a time of day, a time of day, or a time with its unit."""
    return len(cell) <= _LONGEST and _reader(cell) is not None


def seconds_of_dates(cells: Sequence[str | None]) -> np.ndarray | int:
    """Seconds (N,) from the first midnight, NaN where a cell is empty.

    Times of day go on behind midnight. All cells have to be of one kind, and dates with an offset
    from UTC or without.

    Returns:
        The row of the first cell that is none, in place of the seconds.
    """
    filled = [i for i, cell in enumerate(cells) if cell is not None]
    values = np.full(len(cells), np.nan)
    if not filled:
        return values
    form = _reader(cells[filled[0]] or "")
    begin = None
    for i in filled:
        cell = cells[i] or ""
        if form is None or len(cell) > _LONGEST or _reader(cell) != form:
            return i
        try:
            time = form(cell)
            if isinstance(time, datetime.datetime):
                begin = begin or time.replace(hour=0, minute=0, second=0, microsecond=0)
                time = (time - begin).total_seconds()
        # TypeError: dates with an offset from UTC and without cannot be compared.
        except (ValueError, TypeError, OverflowError):
            return i
        values[i] = time
    if form is _of_clock:
        day = SECONDS["day"]
        falls = np.diff(values[filled]) < -0.5 * day
        values[filled] += np.cumsum(np.r_[0.0, np.where(falls, day, 0.0)])
    return values


type _Read = Callable[[str], datetime.datetime | float]


def _reader(cell: str) -> _Read | None:
    """Return the reader of cells such as this one; None if it is no time."""
    read = next((read for form, read in _FORMS if form.fullmatch(cell)), None)
    if read is None and (match := _COUNT.fullmatch(cell)):
        # 3D is what a receiver calls its fix, and no three days.
        unit = None if match[2].casefold() in LETTERS else time_unit(match[2])
        read = None if unit is None else _OF_COUNTS[unit]
    return read


def _of_iso(cell: str) -> datetime.datetime:
    text = cell.replace("/", "-").removesuffix(" UTC").removesuffix(" GMT")
    return datetime.datetime.fromisoformat(re.sub("[ ,]+", "T", text, count=1))


def _of_german(cell: str) -> datetime.datetime:
    date, clock = cell.replace(", ", " ").split(" ", 1)
    day, month, year = map(int, date.split("."))
    clock = clock.replace(",", ".").zfill(8)
    return datetime.datetime.fromisoformat(f"{year}-{month:02d}-{day:02d}T{clock}")


def _of_clock(cell: str) -> float:
    hours, minutes, seconds = cell.replace(",", ".").split(":")
    return 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds)


def _of_clock_and_days(cell: str) -> float:
    days, clock = cell.split("day")
    return SECONDS["day"] * int(days) + _of_clock(clock.lstrip("s, "))


def _of_count(unit: str) -> _Read:
    return lambda cell: SECONDS[unit] * float(_COUNT.sub(r"\1", cell))


_OF_COUNTS: dict[str, _Read] = {unit: _of_count(unit) for unit in SECONDS}
_FORMS: tuple[tuple[re.Pattern[str], _Read], ...] = (
    (_ISO, _of_iso),
    (_GERMAN, _of_german),
    (_TIME_OF_DAY, _of_clock),
    (_SPAN, _of_clock_and_days),
)
