"""Sources of a flight: a log, and others of the same flight with clocks of their own."""

import copy
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from heli_jax.errors import InputError
from heli_jax.finding import Finding, note, sentences
from heli_jax.flights.align import Lag, NotAligned, lag_between
from heli_jax.flights.as_logged import measured
from heli_jax.flights.derived import DerivedTable, with_derived
from heli_jax.flights.flight import Flight, Signal, Source
from heli_jax.flights.formats.arrays import ArrayTable, by_clocks
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.marks import without_marks
from heli_jax.flights.onto_grid import Key
from heli_jax.flights.open_log import open_log
from heli_jax.flights.read_channels import (
    ClockedSignal,
    channel_window_note,
    flight_of_signals,
    rows_in_window,
    signals_of,
)
from heli_jax.flights.read_table import load_table
from heli_jax.flights.request import Also, ReadOptions, Request, with_file_units
from heli_jax.flights.table import Table, shown, wrong

_SHARED = 0.5
"""of the shorter of two logs of one clock that the other covers too, at least"""


class Beside(NamedTuple):
    """The signals of a further log, by the clock of the first [s], and a note on how that was
    found."""

    signals: Mapping[Key, ClockedSignal]
    note: Finding


class Opened(NamedTuple):
    """Logs that are read for one flight."""

    log: ChannelLog
    keys: frozenset[Key]
    """the signals that the first log holds"""
    beside: tuple[Beside, ...]


def opened(request: Request, log: ChannelLog | Table | None = None) -> tuple[Opened, Request]:
    """The logs of a request, those beside the first aligned with it, and the request for the
    signals of all of them.
    """
    first = _open(request, log)
    request = with_file_units(first, request)
    keys, everything, beside = frozenset(request.signals), copy.copy(request), []
    for also in request.options.also:
        signals = {(n, "input"): s for n, s in also.inputs.items()}
        signals |= {(n, "output"): s for n, s in also.outputs.items()}
        twice = next((key for key in signals if key in everything.signals), None)
        if twice is not None:
            raise wrong(also.path, f"{twice[1]} {twice[0]!r} is taken from two logs, expected one")
        everything.signals = {**everything.signals, **signals}
        one, asked = _beside(first, request, also)
        everything.signals = {**everything.signals, **asked.signals}
        beside.append(one)
    return Opened(first, keys, tuple(beside)), everything


def clocked(logs: Opened, request: Request) -> tuple[dict[Key, ClockedSignal], tuple[Finding, ...]]:
    """The signals inside the window, each on its clock, in seconds from the first log's
    beginning, and notes."""
    signals, notes = signals_of(logs.log, _only(request, logs.keys))
    for one in logs.beside:
        signals |= {key: _within(s, request) for key, s in one.signals.items()}
    return signals, notes


def flight_from(logs: Opened, request: Request) -> Flight:
    """The flight inside the window."""
    log, alongside = logs.log, tuple(one.note for one in logs.beside)
    notes = (*log.notes, *beyond(logs, request), *alongside)
    try:
        signals, more = clocked(logs, request)
        source = Source(
            log.path,
            log.sha256,
            (*notes, *more),
            log.firmware,
            log.parameters,
            cautions=log.cautions,
            first_time=log.begin,
        )
        return flight_of_signals(signals, request, source)
    except InputError as e:
        # A wrong unit of the clock makes errors of other kinds.
        said = [n for n in log.notes if n.code == "units.contradicted"]
        if not said:
            raise
        raise InputError("; ".join([str(e), *sentences(said)])) from e


def beyond(logs: Opened, request: Request) -> tuple[Finding, ...]:
    """A note where the window reaches beyond the first log."""
    return channel_window_note(logs.log, _only(request, logs.keys))


def _open(request: Request, log: ChannelLog | Table | None = None) -> ChannelLog:
    log = log or _of_file(request)
    if request.time is None and not isinstance(log, ChannelLog):
        # Arrays may have clocks of their own beside them in the file.
        table = log.table if isinstance(log, DerivedTable) else log
        grouped = by_clocks(table) if isinstance(table, ArrayTable) else None
        if grouped is not None:
            return with_derived(grouped, log.swashplate if isinstance(log, DerivedTable) else None)
    if not isinstance(log, ChannelLog):
        return load_table(log, request)
    if request.time is not None:
        problem = "its topics have clocks of their own, expected no time to be stated, got "
        raise wrong(log.path, problem + shown(request.time.name))
    return log


def _of_file(request: Request) -> ChannelLog | Table:
    return with_derived(open_log(request.path, request.options.number))


def _only(request: Request, keys: frozenset[Key]) -> Request:
    part = copy.copy(request)
    part.signals = {key: s for key, s in request.signals.items() if key in keys}
    return part


def _whole(request: Request) -> Request:
    """The same over all of the log: a lag is found from as much as there is."""
    request = copy.copy(request)
    request.options = dataclasses.replace(request.options, window=None)
    return request


def _beside(log: ChannelLog, request: Request, also: Also) -> tuple[Beside, Request]:
    """The signals of a further log, its clock shifted to that of the first, and the request for
    them with the units that they have."""
    options = ReadOptions(number=also.number)
    asked = Request(also.path, also.time, also.inputs, also.outputs, options)
    # The log that is open already may be large.
    file = also.log or _of_file(asked)
    other = _open(asked, file)
    asked = with_file_units(other, asked)
    signals, _ = signals_of(other, asked)
    name = Path(also.path).name
    stated = f"{name} (sha256 {file.sha256[:12]})"
    if also.same:
        lag, said = _aligned(log, request, also, file, stated)
    else:
        lag = float(other.begin - log.begin)
        theirs = _span(signals, other.begin)
        ours = _span(signals_of(log, _whole(request))[0], log.begin)
        said = _as_one(request, also, ours, theirs, stated)
    return Beside({key: _shifted(s, lag, name) for key, s in signals.items()}, said), asked


def _aligned(
    log: ChannelLog, request: Request, also: Also, file: ChannelLog | Table, name: str
) -> tuple[float, Finding]:
    """Return the correction of a further log's times [s], by a motion that both logs hold."""
    key = next((key for key in request.signals if key[0] == also.same), None)
    if key is None:
        known = ", ".join(dict.fromkeys(name for name, _ in request.signals))
        problem = f"expected a signal of the first log ({known}), got {also.same!r:.60}"
        raise wrong(also.path, problem, "align.with")
    # Apart from the others, since it may well be one of them.
    options = ReadOptions(number=also.number)
    alone = Request(also.path, also.time, {}, {also.same: Signal(also.to, "1", "1")}, options)
    reference = signals_of(log, _only(_whole(request), frozenset({key})))[0][key].timed
    (twin,) = signals_of(_open(alone, file), alone)[0].values()
    reference = reference._replace(values=measured(request.signals[key], reference.values))
    # A scale does not matter for it, so that no unit is asked for.
    motion = (-1.0 if also.reverse else 1.0) * without_marks(twin.values)
    try:
        lag = lag_between(reference, twin.timed._replace(values=motion))
    except NotAligned as e:
        what = f"{also.same} of {Path(request.path).name} and {shown(also.to)}"
        raise wrong(also.path, f"cannot be aligned by {what}: {e}") from e
    return lag.lag, _note(name, also, lag)


def _as_one(
    request: Request,
    also: Also,
    ours: tuple[float, float],
    theirs: tuple[float, float],
    name: str,
) -> Finding:
    """A note that the times of two logs, from first to last [s], count alike."""
    first, shared = Path(request.path).name, min(ours[1], theirs[1]) - max(ours[0], theirs[0])
    if not shared >= _SHARED * min(ours[1] - ours[0], theirs[1] - theirs[0]):
        raise wrong(
            also.path,
            f"its times go from {theirs[0]:.6g} s to {theirs[1]:.6g} s and those of {first} from "
            f"{ours[0]:.6g} s to {ours[1]:.6g} s, so that they are no one clock; state a motion "
            "that both hold, align: {with: ..., to: ...}",
        )
    words = (
        f"{name}: its times are taken as those of {first}, with which it shares {shared:.4g} s; if "
        "each counts from a beginning of its own, state align"
    )
    return note("clock.taken-as-one", words, value=shared)


def _span(signals: Mapping[Key, ClockedSignal], first_time: float) -> tuple[float, float]:
    """First and last time of signals [s], in the log's own count."""
    clocks = [s.clock.seconds for s in signals.values()]
    return (
        first_time + min(float(c[0]) for c in clocks),
        first_time + max(float(c[-1]) for c in clocks),
    )


def _note(name: str, also: Also, lag: Lag) -> Finding:
    """A note on the offset between the clocks of two logs."""
    words = (
        f"{name}: {lag.lag:.6g} s (sd {1e3 * lag.sd:.2g} ms) were added to its times, counted from "
        f"its beginning, by which {shown(also.to)} agrees best with {also.same} (correlation "
        f"{lag.correlation:.3f} over {lag.overlap:.4g} s)"
    )
    return Finding(
        "clock.aligned", "note", words, lag.lag, "seconds added to its times", (also.same,)
    )


def _shifted(signal: ClockedSignal, lag: float, name: str) -> ClockedSignal:
    # Two files may well have topics of the same name.
    clock = signal.clock
    called = clock.name if clock.name == name else f"{name}, {clock.name}"
    clock = dataclasses.replace(clock, name=called, seconds=clock.seconds + lag)
    return dataclasses.replace(signal, clock=clock)


def _within(signal: ClockedSignal, request: Request) -> ClockedSignal:
    """The part of a signal inside the window."""
    if request.options.window is None:
        return signal
    clock = signal.clock
    rows = rows_in_window(request.path, clock.seconds, request.options.window, clock.name)
    return dataclasses.replace(signal, clock=clock.part(rows), values=signal.values[rows])
