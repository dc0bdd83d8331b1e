"""Output of `heli-jax info`, as text or as JSON.

Separate from `output.py`, which imports JAX and is slow to load.
"""

import dataclasses
import fnmatch
import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

from heli_jax.cli.terminal import print_table, print_text
from heli_jax.finding import as_data
from heli_jax.flights.clock import ROWS
from heli_jax.flights.describe import ColumnInfo, LogInfo, TimeInfo, TopicInfo
from heli_jax.flights.name_units import without_unit
from heli_jax.flights.preset import fitting_presets
from heli_jax.numbers import terse

_WIDEST = 44
"""Longest name in a table [characters]."""
_MOST_CHANNELS = 150
"""Most channels that are listed without a pattern. A PX4 log has a thousand."""
_MOST_LINES = 10
"""Most lines of gaps, and of notes."""
_MOST_FILTERS = 40
_MOST_OF_BURST, _BURST = 200, 0.02
"""Most messages, and longest time [s], of a burst. A burst has no rate."""


def print_flights(
    flights: Sequence[LogInfo], pattern: str | None = None, chosen: bool = False
) -> None:
    """Print the flights of one log on standard output.

    Args:
        flights: the flights of one file, at least one.
        pattern: pattern of channel names, with shell wildcards; default: all channels, if there are
            few enough.
        chosen: True if the user chose the flights, so that the file may hold others.
    """
    log = flights[0]
    rows = f", {log.n_rows} rows" if log.is_table else ""
    print_text(f"{log.path}: {log.format}, {log.size} bytes{rows}\nsha256 {log.sha256}")
    for flight in flights:
        _print_flight(flight, flight.flight[1] if chosen else len(flights), pattern)


def _print_flight(flight: LogInfo, count: int, pattern: str | None) -> None:
    # A table has one clock and no firmware, so most of these lines would be empty.
    for line in _clock_lines(flight.time) if flight.is_table else _flight_lines(flight, count):
        print_text(line)
    # Notes on losses and assumptions come before the numbers they affect.
    for found in flight.notes[:_MOST_LINES]:
        print_text(f"! {found.sentence}")
    # With a pattern of channel names the topics are not shown.
    if not flight.is_table and pattern is None:
        _print_topics(flight.topics)
    _print_channels(flight.columns, pattern)
    if pattern is None:
        for line in _setting_lines(flight):
            print_text(line)


def as_json(flights: Sequence[LogInfo]) -> str:
    """Return the flights of one log as JSON, each channel once; NaN and infinity become null."""
    log = flights[0]
    # A file may hold many flights, so its own data appear once.
    content = {
        "path": log.path,
        "format": log.format,
        "size": log.size,
        "sha256": log.sha256,
        "flights": [_flight_content(flight) for flight in flights],
    }
    # Python writes NaN, which is not valid JSON.
    return json.dumps(_finite(content), indent=1, allow_nan=False)


def _flight_content(flight: LogInfo) -> dict[str, Any]:
    """Return the content of one flight. Any: text, numbers, lists and records, as in JSON."""
    whole = {"number": flight.flight[0], "of": flight.flight[1], "firmware": flight.firmware}
    whole |= {"duration": flight.duration, "notes": [as_data(n) for n in flight.notes]}
    whole["topics"] = [_topic_content(topic) for topic in flight.topics]
    return whole | {"filters": flight.filters, "parameters": dict(flight.parameters)}


def _topic_content(topic: TopicInfo) -> dict[str, Any]:
    channels = []
    for channel in topic.columns:
        content = dataclasses.asdict(channel)
        content["nan_share"] = _nan_share(channel)
        channels.append(content)
    time = None if topic.time is None else dataclasses.asdict(topic.time)
    return {"name": topic.name, "rows": topic.n_rows, "time": time, "channels": channels}


def _finite(value: Any) -> Any:
    """Return the value with None for numbers that JSON does not have."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value


def _flight_lines(flight: LogInfo, count: int) -> Iterator[str]:
    number, of = flight.flight
    if of > 1:
        yield f"\nflight {number} of {of}" + (f" ({count} with samples)" if count < of else "")
    if flight.firmware:
        yield f"firmware: {flight.firmware}"
    if math.isnan(flight.duration):
        yield "duration: unknown, because rows have no times; a fit needs times"
    else:
        yield f"duration: {flight.duration:.6g} s"
    fitting = fitting_presets(flight.format, [column.name for column in flight.columns])
    if fitting:
        yield f"preset: {', '.join(fitting)} (docs/logs.md)"


def _clock_lines(clock: TimeInfo | None) -> Iterator[str]:
    if clock is None:
        yield (
            "time: no column looks like a clock; name it by --time NAME, or give the samples per "
            "second by --time-rate HZ (in a configuration time: {rate: HZ})"
        )
        return
    if clock.problem:
        yield f"time: {clock.column} [{clock.unit}]"
        yield f"! {clock.problem}"
    else:
        uniform = "uniform" if clock.uniform else "not uniform"
        unit = f" [{clock.unit}]"
        name = clock.column if clock.column.endswith(unit) else f"{clock.column}{unit}"
        if clock.counted is not None:
            name = "rows" if clock.column == ROWS else clock.column
        yield (
            f"time: {name}, {terse(clock.duration, 6)} s at {terse(clock.rate, 6)} Hz, {uniform}"
        )
        most = "" if clock.uniform else " (95 % of the steps)"
        yield f"jitter {_percent(clock.jitter)} of a step{most}, {_gap_words(clock)}"
    if clock.guessed and clock.counted is None:
        yield f"the unit {clock.unit} is a guess; --time-unit states it"
    # The longest gaps come first, since they affect a fit. A single lost row is bridged.
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


def _print_topics(topics: Sequence[TopicInfo]) -> None:
    rows = []
    for topic in topics:
        clock, cells = topic.time, ("", "", "", "")
        if clock is None:
            cells = ("no times, only an order", "", "", "")
        elif clock.problem:
            cells = (_cut(clock.problem), "", "", "")
        elif topic.n_rows <= _MOST_OF_BURST and clock.duration < _BURST:
            cells = (f"all within {_short_time(clock.duration)}", "", "", "")
        else:
            # The longest gap, not their count, decides if a rate can bridge them.
            longest = max((gap.length for gap in clock.gaps), default=0.0)
            gaps = (str(len(clock.gaps)), _short_time(longest) if longest else "")
            cells = (f"{clock.rate:.4g}", _percent(clock.jitter), *gaps)
        rows.append((_squeezed(topic.name), str(len(topic.columns)), str(topic.n_rows), *cells))
    print_table(("topic", "channels", "rows", "rate Hz", "jitter", "gaps", "longest"), rows)


def _short_time(seconds: float) -> str:
    """Return a duration in at most eight characters."""
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "us")):
        if seconds * factor >= 0.1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.1g} us"


def _asked(columns: Sequence[ColumnInfo], pattern: str | None) -> list[ColumnInfo]:
    if pattern is None:
        # Show none: the first hundred would look like all channels.
        return list(columns) if len(columns) <= _MOST_CHANNELS else []
    # Brackets are literal (gyroADC[0]); only * and ? are wildcards.
    literal = pattern.replace("[", "[[]")
    return [c for c in columns if fnmatch.fnmatchcase(c.name, literal)]


def _print_channels(columns: Sequence[ColumnInfo], pattern: str | None) -> None:
    shown = _asked(columns, pattern)
    if not shown:
        of = (
            f"none is named {pattern!r}"
            if pattern
            else ("--channels 'att*' lists those whose names match")
        )
        print_text(f"{len(columns)} channels; {of}")
        return
    rows = []
    for c in shown:
        cells = (*map(terse, (c.min, c.max, c.mean)), _share(c))
        if c.kind == "text":
            cells = (_cut(c.strays or f"text in {c.count} rows"), "", "", "")
        unit = c.unit or without_unit(c.name)[1]
        rows.append((_squeezed(c.name), unit[:8], *cells))
    print_table(("channel", "unit", "min", "max", "mean", "NaN %"), rows)


def _setting_lines(flight: LogInfo) -> Iterator[str]:
    if not flight.parameters:
        return
    names = list(flight.filters)
    count = len(flight.parameters)
    yield f"\n{count} settings of the firmware (--json has all), {len(names)} of filters"
    for name in names[:_MOST_FILTERS]:
        yield f"  {name} = {_cut(str(flight.filters[name]))}"
    if len(names) > _MOST_FILTERS:
        yield f"  and {len(names) - _MOST_FILTERS} more"


def _nan_share(channel: ColumnInfo) -> float:
    return channel.n_nan / channel.rows if channel.rows else 0.0


def _share(channel: ColumnInfo) -> str:
    share = 100 * _nan_share(channel)
    # One NaN in a million must not show as zero.
    if not channel.n_nan:
        return "0"
    # From 99.5 on, two digits would give an exponent.
    return "<.01" if share < 0.01 else f"{share:.2g}" if share < 99.5 else f"{share:.3g}"


def _percent(share: float) -> str:
    if math.isnan(share):
        return "-"
    return "0 %" if share < 1e-7 else f"{100 * share:.2g} %"  # below: rounding errors


def _cut(text: str) -> str:
    return text if len(text) <= _WIDEST else f"{text[: _WIDEST - 3]}..."


def _squeezed(text: str) -> str:
    """Cut the middle of a name; its ends show the topic and the field."""
    half = (_WIDEST - 3) // 2
    return text if len(text) <= _WIDEST else f"{text[:half]}...{text[half + 3 - _WIDEST :]}"
