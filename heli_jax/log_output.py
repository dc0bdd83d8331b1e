"""What `heli-jax info` prints of a log, as text of at most 80 columns or as JSON.

On a terminal of fewer columns tables leave some of theirs out, and sentences go on a line below.

Apart from `output.py`, which imports JAX: a look at a log need not wait for it.
"""

import dataclasses
import fnmatch
import json
import math
import re
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

from heli_jax.finding import as_data
from heli_jax.flights.describe import ColumnInfo, LogInfo, TimeInfo, TopicInfo
from heli_jax.flights.preset import fitting_presets
from heli_jax.flights.rotor_lines import LEAST, RotorLines
from heli_jax.flights.row_clock import ROWS
from heli_jax.flights.vibration import SMALLEST, line_words
from heli_jax.numbers import terse
from heli_jax.terminal_table import plain_text

# The width of a terminal that nobody has widened, and one below which nothing is narrowed.
_WIDTH, _NARROWEST = 80, 44
_ROOM = 12
"""columns of the screen for a channel's name at least, before a number more is shown"""
_MOST_CHANNELS = 150
"""that are listed without being asked for: a PX4 log has a thousand"""
_MOST_LINES = 10
"""of gaps, and of notes"""
_MOST_FILTERS = 40
_MOST_OF_BURST, _BURST = 200, 0.02
"""messages, and seconds within which they came, that are no signal with a rate"""
_MOST_VIBRATIONS = 3
"""of a channel"""
_NUMBER = 10
"""columns of the screen for a number"""


def print_flights(
    flights: Sequence[LogInfo], pattern: str | None = None, chosen: bool = False
) -> None:
    """The flights of one log on standard output.

    Args:
        flights: of one file, at least one.
        pattern: of the channels' names, as a shell has them; all that are few enough without one.
        chosen: whether they were asked for, and the file may hold others.
    """
    log = flights[0]
    rows = "" if log.topics else f", {log.n_rows} rows"
    words = f"{log.format}, {log.size} bytes{rows}"
    name = plain_text(log.path)
    width = min(_WIDTH, max(_NARROWEST, shutil.get_terminal_size((_WIDTH, 24)).columns))
    # A path has no end that could be left out, and a hash is copied whole.
    print(f"{name}: {words}" if len(name) + len(words) + 2 <= width else f"{name}\n{words}")
    print(f"sha256 {log.sha256}")
    for flight in flights:
        count = flight.flight[1] if chosen else len(flights)
        for line in _flight_lines(flight, count, pattern, width):
            print("\n".join(map(plain_text, _lines(line, width))))


def as_json(flights: Sequence[LogInfo]) -> str:
    """The flights of one log as JSON, without channels twice; what is no number is null."""
    log = flights[0]
    # What is of the file stands once; a file may hold many flights.
    content = {
        "path": log.path,
        "format": log.format,
        "size": log.size,
        "sha256": log.sha256,
        "flights": [_flight_content(flight) for flight in flights],
    }
    # NaN is no JSON, though Python writes it: other programs could not read the text.
    return json.dumps(_finite(content), indent=1, allow_nan=False)


def _flight_content(flight: LogInfo) -> dict[str, Any]:
    """Any: text, numbers, lists and records, as JSON has them."""
    whole = {"number": flight.flight[0], "of": flight.flight[1], "firmware": flight.firmware}
    whole |= {"duration": flight.duration, "notes": [as_data(n) for n in flight.notes]}
    # A table of rows is shown as a log of one topic, so that a script needs to know one shape.
    topics = flight.topics or (TopicInfo("", flight.n_rows, flight.time, flight.columns),)
    whole["vibration"] = _vibration_content(flight.vibration)
    whole["topics"] = [_topic_content(topic) for topic in topics]
    return whole | {"filters": dict(flight.filters), "parameters": dict(flight.parameters)}


def _topic_content(topic: TopicInfo) -> dict[str, Any]:
    channels = []
    for channel in topic.columns:
        content = dataclasses.asdict(channel)
        content["nan_share"] = _nan_share(channel)
        channels.append(content)
    time = None if topic.time is None else dataclasses.asdict(topic.time)
    return {"name": topic.name, "rows": topic.n_rows, "time": time, "channels": channels}


def _finite(value: Any) -> Any:
    """The same with None for what JSON has no number for."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value


def _flight_lines(flight: LogInfo, count: int, pattern: str | None, width: int) -> Iterator[str]:
    # A table has one clock and no firmware, so most of the lines below would be empty.
    if not flight.topics:
        yield from _clock_lines(flight.time)
        yield from (f"! {n.sentence}" for n in flight.notes[:_MOST_LINES])
        yield from _channel_lines(_asked(flight.columns, pattern), flight.columns, pattern, width)
        return
    number, of = flight.flight
    if of > 1:
        yield ""
        yield f"flight {number} of {of}" + (f" ({count} with samples)" if count < of else "")
    if flight.firmware:
        yield f"firmware: {flight.firmware}"
    length = (
        "unknown: rows have an order and no times, which no fit can use"
        if math.isnan(flight.duration)
        else ""
    )
    yield f"duration: {length or f'{flight.duration:.6g} s'}"
    # What was lost or assumed stands before the numbers, which are read with that in mind.
    yield from (f"! {n.sentence}" for n in flight.notes[:_MOST_LINES])
    fitting = fitting_presets(flight.format, [column.name for column in flight.columns])
    if fitting:
        yield f"preset: {', '.join(fitting)} (docs/logs.md)"
    yield from _vibration_lines(flight.vibration)
    # Who asks for channels of a name has not asked for the topics.
    if pattern is None:
        yield from _topic_lines(flight.topics, width)
    yield from _channel_lines(_asked(flight.columns, pattern), flight.columns, pattern, width)
    if pattern is None:
        yield from _setting_lines(flight)


def _clock_lines(clock: TimeInfo | None) -> Iterator[str]:
    if clock is None:
        yield (
            "time: no column looks like a clock; --time NAME says which is one, --time-rate HZ how "
            "many samples a second has (in a configuration time: {rate: HZ})"
        )
        return
    if clock.problem:
        yield f"time: {clock.column} [{clock.unit}]"
        yield f"! {clock.problem}"
    else:
        uniform = "uniform" if clock.uniform else "not uniform"
        name = f"{clock.column} [{clock.unit}]"
        if clock.counted is not None:
            by = f" (by {clock.said})" if clock.said else ""
            name = f"{'rows' if clock.column == ROWS else clock.column}{by}"
        yield (
            f"time: {name}, {terse(clock.duration, 6)} s at {terse(clock.rate, 6)} Hz, {uniform}"
        )
        yield f"jitter {_percent(clock.jitter)} of a step, {_gap_words(clock)}"
    if clock.guessed and clock.counted is None:
        yield f"the unit {clock.unit} is guessed; --time-unit says which it is"
    # The longest are those that a fit minds: a lost row is bridged.
    for gap in sorted(clock.gaps, key=lambda gap: -gap.length)[:_MOST_LINES]:
        yield f"gap of {gap.length:.4g} s at {gap.start:.6g} s"
    if len(clock.gaps) > _MOST_LINES:
        yield f"and {len(clock.gaps) - _MOST_LINES} more gaps, none longer"


def _gap_words(clock: TimeInfo) -> str:
    if not clock.gaps:
        return "no gaps"
    longest = max(gap.length for gap in clock.gaps)
    if len(clock.gaps) == 1:
        return f"one gap of {longest:.4g} s"
    return f"{len(clock.gaps)} gaps, the longest {longest:.4g} s"


def _vibration_lines(rotor: RotorLines | None) -> Iterator[str]:
    if rotor is None:
        return
    if not rotor.signals:
        yield f"rotor: {rotor.channel} is not steady for {LEAST:g} s, no lines are named"
        return
    yield (
        f"rotor: {terse(rotor.hz)} Hz by {rotor.channel}, steady from {rotor.start:.4g} s to "
        f"{rotor.end:.4g} s"
    )
    quiet = [each.channel for each in rotor.signals if not each.lines]
    for each in rotor.signals:
        for line in each.lines[:_MOST_VIBRATIONS]:
            yield f"  {each.channel}: {line_words(line, rotor.hz)}"
    if quiet:
        yield f"  no line above {100 * SMALLEST:g} % of the variance: {', '.join(quiet)}"


def _vibration_content(rotor: RotorLines | None) -> dict[str, Any] | None:
    if rotor is None:
        return None
    signals = [
        {
            "signal": each.signal,
            "channel": each.channel,
            "lines": [line._asdict() | {"aliased": line.aliased} for line in each.lines],
        }
        for each in rotor.signals
    ]
    return rotor._asdict() | {"signals": signals}


def _topic_lines(topics: Sequence[TopicInfo], width: int) -> Iterator[str]:
    yield ""
    # How many channels, and how long the longest gap is, say least.
    wide = width >= _WIDTH
    room = 30 if wide else width - 32

    def start(name: str, channels: int | str, rows: int | str) -> str:
        count = f" {channels:>8}" if wide else ""
        return f"{_squeezed(name, room):{room}}{count} {rows:>7}"

    head = f"{start('topic', 'channels', 'rows')} {'rate Hz':>8} {'jitter':>7} {'gaps':>5}"
    yield f"{head} {'longest':>8}" if wide else head
    for topic in topics:
        clock = topic.time
        line = start(topic.name, len(topic.columns), topic.n_rows)
        if clock is None:
            yield f"{line} no times" if not wide else f"{line} no times, only an order"
        elif clock.problem:
            yield _cut(f"{line} {clock.problem}", width)
        elif _is_burst(clock, topic.n_rows):
            yield f"{line} all within {_short_time(clock.duration)}"
        else:
            # The longest says whether a rate can bridge them; the number alone does not.
            gaps = max((gap.length for gap in clock.gaps), default=0.0)
            longest = f" {_short_time(gaps) if gaps else '':>8}" if wide else ""
            jitter = _percent(clock.jitter)
            yield f"{line} {clock.rate:>8.4g} {jitter:>7} {len(clock.gaps):>5}{longest}"


def _is_burst(clock: TimeInfo, rows: int) -> bool:
    """Whether a few messages were written at once, as those of a mission: they have no rate."""
    return rows <= _MOST_OF_BURST and clock.duration < _BURST


def _short_time(seconds: float) -> str:
    """A length of time in at most eight columns."""
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "us")):
        if seconds * factor >= 0.1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.1g} us"


def _asked(columns: Sequence[ColumnInfo], pattern: str | None) -> list[ColumnInfo]:
    if pattern is None:
        # None rather than the first hundred, which would look like all there are.
        return list(columns) if len(columns) <= _MOST_CHANNELS else []
    # The brackets of gyroADC[0] are meant as they stand: of patterns only * and ? are known.
    literal = pattern.replace("[", "[[]")
    return [c for c in columns if fnmatch.fnmatchcase(c.name, literal)]


def _channel_lines(
    shown: list[ColumnInfo], columns: Sequence[ColumnInfo], pattern: str | None, width: int
) -> Iterator[str]:
    yield ""
    if not shown:
        which = (
            f"none is named {pattern!r}" if pattern else "--channels 'att*' lists those of a name"
        )
        yield f"{len(columns)} channels; {which}"
        return
    # The column of units is as wide as it has to be, and away where the log states none: the names
    # need the room.
    units = max((len(_cut(c.unit, 8)) for c in shown), default=0)
    units = max(units, 4) if units else 0
    words = ["min", "max", "mean"]
    left = width - 6 - (units + 1 if units else 0)
    if left - len(words) * (_NUMBER + 1) < _ROOM:
        words.pop()
    name = left - len(words) * (_NUMBER + 1)
    name = min(name, max(7, *(len(plain_text(c.name)) for c in shown)))
    unit = f" {'unit':{units}}" if units else ""
    heads = "".join(f" {word:>{_NUMBER}}" for word in words)
    yield f"{'channel':{name}}{unit}{heads} {'NaN %':>5}"
    for channel in shown:
        unit = f" {_cut(channel.unit, 8):{units}}" if units else ""
        if channel.kind == "text":
            content = channel.strays or f"text in {channel.count} rows"
            yield f"{_squeezed(channel.name, name):{name}}{unit} {content}"
            continue
        numbers = (channel.min, channel.max, channel.mean)[: len(words)]
        cells = "".join(f" {_number(v):>{_NUMBER}}" for v in numbers)
        yield f"{_squeezed(channel.name, name):{name}}{unit}{cells} {_share(channel):>5}"


def _setting_lines(flight: LogInfo) -> Iterator[str]:
    if not flight.parameters:
        return
    yield ""
    names = list(flight.filters)
    count = len(flight.parameters)
    yield f"{count} settings of the firmware (--json has all), {len(names)} of filters"
    for name in names[:_MOST_FILTERS]:
        yield f"  {name} = {flight.filters[name]}"
    if len(names) > _MOST_FILTERS:
        yield f"  and {len(names) - _MOST_FILTERS} more"


def _nan_share(channel: ColumnInfo) -> float:
    return channel.n_nan / channel.rows if channel.rows else 0.0


def _share(channel: ColumnInfo) -> str:
    share = 100 * _nan_share(channel)
    # A single one of a million is not none.
    if not channel.n_nan:
        return "0"
    # Of 99.5 and more two digits would be an exponent.
    return "<.01" if share < 0.01 else f"{share:.2g}" if share < 99.5 else f"{share:.3g}"


def _number(value: float) -> str:
    return terse(value)


def _percent(share: float) -> str:
    if math.isnan(share):
        return "-"
    return "0 %" if share < 1e-7 else f"{100 * share:.2g} %"  # below is the rounding of float64


def _cut(text: str, width: int) -> str:
    text = plain_text(text)
    return text if len(text) <= width else f"{text[: width - 3]}..."


def _squeezed(text: str, width: int) -> str:
    """A name that is cut in its middle: the ends tell the topic and the field."""
    text = plain_text(text)
    half = (width - 3) // 2
    return text if len(text) <= width else f"{text[:half]}...{text[half + 3 - width :]}"


def _lines(text: str, width: int) -> list[str]:
    """Lines no wider than the screen: a setting without its end, a sentence going on below."""
    text = plain_text(text).rstrip()
    if len(text) <= width:
        return [text]
    if re.match(r"  \S+ = ", text):
        return [_cut(text, width)]
    return textwrap.wrap(text, width, subsequent_indent="  ", break_on_hyphens=False)
