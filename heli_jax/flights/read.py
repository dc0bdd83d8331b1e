"""Flights from logs of any format."""

import copy
import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.align import NotAligned, lag_between
from heli_jax.flights.as_logged import measured
from heli_jax.flights.derived import with_derived
from heli_jax.flights.flight import Flight, Signal, Source
from heli_jax.flights.formats.arrays import ArrayTable, by_clocks
from heli_jax.flights.holds import Decision
from heli_jax.flights.log import ChannelLog, Table, shown, wrong
from heli_jax.flights.marks import without_marks
from heli_jax.flights.onto_grid import (
    ClockedSignal,
    clocks_of,
    fast_clocks,
    flight_of_signals,
    holds_of_inputs,
    rows_in_window,
    signals_of,
    window_note,
)
from heli_jax.flights.open_log import open_log
from heli_jax.flights.parts import is_too_short, stretches
from heli_jax.flights.read_table import load_table
from heli_jax.flights.request import FEWEST, Also, Key, ReadOptions, Request, with_file_units

_DEFAULT = ReadOptions()
_SHORTEST = 0.05
"""Shortest flight [s]: no vehicle responds to a stick sooner."""
_STILL = 1e-100
"""Largest range of an output that counts as constant [SI]."""

type _Log = str | Path | ChannelLog | Table


def read_flight(
    path: _Log,
    *,
    time: str | Signal | None = None,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    options: ReadOptions = _DEFAULT,
    **keywords: Any,
) -> Flight:
    """Read one run from a log.

    Args:
        path: path of the log: a table, arrays or an autopilot's log (docs/logs.md); or a log opened
            by `heli_jax.flights.open_log.open_log`.
        time: column of time stamps, in seconds if only its name is given; None for an autopilot's
            log, whose topics have their own clocks.
        inputs: the log's signals by the model's names; two inputs may share a column. `hold` is an
            input's behaviour between samples; "auto" decides it from the log. An input that the log
            lacks may be a `constant`.
        outputs: the same for the measured outputs.
        options: part and rate of the log to read; by default all of it.
        **keywords: fields of ReadOptions that replace those of `options`: `rate` [Hz], `window`
            [s], `known` [SI], `hold_out`, `name`, `number`, `also`.

    Raises:
        InputError: the log or an argument is wrong; the message is one sentence.
        TypeError: a keyword that is no field of ReadOptions.
    """
    options = dataclasses.replace(options, **keywords)
    logs = _opened(path, time, inputs, outputs, options)
    return _flight(logs, logs.request)


def read_parts(
    path: _Log,
    *,
    time: str | Signal | None = None,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    options: ReadOptions = _DEFAULT,
    **keywords: Any,
) -> tuple[Flight, ...]:
    """Read one run from a log, split at gaps that are too long, or at the runs of a table.

    Args:
        path: as in `read_flight`, and so are the other arguments.

    Returns:
        The unchanged run if it has no such gap, else its parts, named `NAME, part 1` and so on.
        Parts of less than 2 s or 50 samples are left out. Parts without a moving input are left out
        if an input moves in others. The notes of the first part list what was left out.

    Raises:
        InputError: as in `read_flight`, or no part is left.
    """
    options = dataclasses.replace(options, **keywords, split=True)
    logs = _opened(path, time, inputs, outputs, options)
    request = logs.request
    # A slow sensor padded with marks is needed only at its own instants.
    signals = {
        key: dataclasses.replace(s, values=measured(request.signals[key], s.values))
        if key[1] == "output"
        else s
        for key, s in _clocked(logs, request).items()
    }
    rate = options.rate
    needed = clocks_of(signals.values()) if rate is None else fast_clocks(signals, rate)
    clocks = [clock.seconds for clock in needed]
    intervals = stretches(clocks)
    if len(intervals) < 2:
        return (_flight(logs, request),)
    # Decided from the whole run, because a part has few moves and the same stick may look
    # different.
    holds = holds_of_inputs(request, {key: signal.values for key, signal in signals.items()})
    inputs_of = [s for (_, kind), s in signals.items() if kind == "input"]
    moving = [i for i in intervals if any(_moves(u, *i) for u in inputs_of)]
    parts, left_out, why = [], [], None
    for start, end in intervals:
        name = f"{options.name or 'flight 1'}, part {len(parts) + 1}"
        try:
            if is_too_short((start, end), clocks):
                raise InputError("too short")
            # Such a part is on the ground before or after a flight. If no input moves in any part,
            # each is a free decay.
            if moving and inputs_of and (start, end) not in moving:
                raise InputError("no input moves")
            part = _part(request, (start, end), name, holds)
            flight = _enough_measured(_flight(logs, part))
        except InputError as e:
            left_out.append(f"{start:.6g} s to {end:.6g} s ({e.within})")
            why = e
            continue
        # A hold that the resampling chose has the part's own reason.
        whole = {n: d.reason for n, d in holds.items() if d.reason and flight.hold[n] == d.hold}
        parts.append(dataclasses.replace(flight, hold_reason={**flight.hold_reason, **whole}))
    if not parts:
        problem = (
            f"{len(intervals)} parts between gaps, expected one of sufficient length; the last"
        )
        raise wrong(request.path, f"{problem}: {left_out[-1]}") from why
    gap = max(after - before for (_, before), (after, _) in itertools.pairwise(intervals))
    words = f"gaps of up to {gap:.3g} s split the run into {len(intervals)} parts"
    notes = [*_beyond(logs, request), note("clock.gaps-split", words, value=gap)]
    if left_out:
        more = f" and {len(left_out) - 3} more" if len(left_out) > 3 else ""
        words = f"left out: {'; '.join(left_out[:3])}{more}"
        notes.append(note("windows.left-out", words, value=len(left_out)))
    return (_with_notes(parts[0], *notes), *parts[1:])


def _moves(signal: ClockedSignal, start: float, end: float) -> bool:
    """True if a signal moves from `start` to `end` [s]."""
    seconds = signal.clock.seconds
    values = signal.values[(seconds >= start) & (seconds <= end)]
    return values.size > 1 and bool(np.ptp(values) > 0)


def _part(
    request: Request, window: tuple[float, float], name: str, holds: Mapping[str, Decision]
) -> Request:
    """Return the request for one part of a run."""
    part = copy.copy(request)
    part.options = dataclasses.replace(request.options, window=window, name=name)
    part.signals = {
        key: dataclasses.replace(s, hold=holds[key[0]].hold) if key[1] == "input" else s
        for key, s in request.signals.items()
    }
    return part


def _enough_measured(flight: Flight) -> Flight:
    """Remove outputs with too few samples in a part, such as those of a slow sensor."""
    few = [n for n, y in flight.outputs.items() if np.isfinite(y).sum() < FEWEST]
    if not few:
        return flight
    if len(few) == len(flight.outputs):
        raise InputError(f"fewer than {FEWEST} measured samples of {', '.join(few)}")
    outputs = {n: y for n, y in flight.outputs.items() if n not in few}
    sd = {n: v for n, v in flight.sd.items() if n not in few}
    flight = dataclasses.replace(flight, outputs=outputs, sd=sd)
    words = (
        f"{flight.name}: without {', '.join(few)}, which has fewer than {FEWEST} measured samples"
    )
    return _with_notes(flight, note(LEFT_OUT, words, *few))


def _with_notes(flight: Flight, *notes: Finding) -> Flight:
    assert flight.source is not None  # it was read from a log
    source = dataclasses.replace(flight.source, notes=(*flight.source.notes, *notes))
    return dataclasses.replace(flight, source=source)


# A log, and other logs of the same flight with their own clocks.


class _Opened(NamedTuple):
    """Logs that are read for one flight."""

    log: ChannelLog
    keys: frozenset[Key]
    """Signals in the first log."""
    further: Mapping[Key, ClockedSignal]
    """Signals of further logs, on the clock of the first."""
    notes: tuple[Finding, ...]
    """Notes on the alignment."""
    request: Request
    """Request for the signals of all logs."""
    inputs: Mapping[str, Signal]
    """All requested inputs, constants too, in the user's order."""


def _opened(
    path: _Log,
    time: str | Signal | None,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    options: ReadOptions,
) -> _Opened:
    """Open the logs and align the further ones with the first."""
    logged = {name: s for name, s in inputs.items() if s.constant is None}
    is_open = not isinstance(path, str | Path)
    # Checked before a log is opened, which may take minutes.
    request = Request(path.path if is_open else str(path), time, logged, outputs, options)
    log = _open(request, path if is_open else None)
    request = with_file_units(log, request)
    keys, everything, further, notes = frozenset(request.signals), copy.copy(request), {}, []
    for also in options.also:
        signals = {(n, "input"): s for n, s in also.inputs.items()}
        signals |= {(n, "output"): s for n, s in also.outputs.items()}
        twice = next((key for key in signals if key in everything.signals), None)
        if twice is not None:
            raise wrong(also.path, f"{twice[1]} {twice[0]!r} comes from two logs, expected one")
        shifted, notice, requested = _beside(log, request, also)
        everything.signals = {**everything.signals, **requested.signals}
        further |= shifted
        notes.append(notice)
        inputs = {**inputs, **also.inputs}
    return _Opened(log, keys, further, tuple(notes), everything, inputs)


def _clocked(logs: _Opened, request: Request) -> dict[Key, ClockedSignal]:
    """Return the signals inside the window on their clocks [s], from the first log's beginning."""
    signals = signals_of(logs.log, _only(request, logs.keys))
    return signals | {key: _within(s, request) for key, s in logs.further.items()}


def _flight(logs: _Opened, request: Request) -> Flight:
    """Return the flight inside the window, with its constant inputs."""
    log = logs.log
    notes = (*log.notes, *_beyond(logs, request), *logs.notes)
    flight = flight_of_signals(
        _clocked(logs, request),
        request,
        Source(log.path, log.sha256, notes, log.firmware, log.parameters, first_time=log.begin),
    )
    assert flight.source is not None
    values, reasons = dict(flight.inputs), dict(flight.hold_reason)
    for name, signal in logs.inputs.items():
        if signal.constant is not None:
            # Scale and offset apply to numbers in a log, not to a constant.
            plain = dataclasses.replace(signal, scale=1.0, offset=0.0, invert=False)
            values[name] = plain.to_si(np.full(flight.n_samples, signal.constant))
            reasons[name] = "a constant"
    as_read = request.signals
    source = dataclasses.replace(
        flight.source,
        inputs={n: as_read.get((n, "input"), s) for n, s in logs.inputs.items()},
        outputs={n: as_read[n, "output"] for n in flight.outputs},
    )
    inputs = {name: values[name] for name in logs.inputs}
    return dataclasses.replace(flight, inputs=inputs, hold_reason=reasons, source=source)


def _beyond(logs: _Opened, request: Request) -> tuple[Finding, ...]:
    """Return a note if the window reaches beyond the first log."""
    log = logs.log
    times = [log.topic_of(request.signals[key].name).times for key in logs.keys]
    return window_note(request.options.window, times, log.first_time)


def _open(request: Request, log: ChannelLog | Table | None = None) -> ChannelLog:
    log = log or open_log(request.path, request.options.number)
    if request.time is None and isinstance(log, ArrayTable):
        # Arrays may have their own clocks in the file.
        log = by_clocks(log) or log
    if not isinstance(log, ChannelLog):
        return load_table(log, request)
    if request.time is not None:
        problem = "its topics have clocks of their own, expected no time to be stated, got "
        raise wrong(log.path, problem + shown(request.time.name))
    return with_derived(log, request.options.swashplate)


def _only(request: Request, keys: frozenset[Key], whole: bool = False) -> Request:
    """Return the request for some signals; over the whole log if `whole`, as a lag needs."""
    part = copy.copy(request)
    part.signals = {key: s for key, s in request.signals.items() if key in keys}
    if whole:
        part.options = dataclasses.replace(request.options, window=None)
    return part


def _beside(
    log: ChannelLog, request: Request, also: Also
) -> tuple[dict[Key, ClockedSignal], Finding, Request]:
    """Return the signals of a further log on the first log's clock, a note, and their request."""
    options = ReadOptions(number=also.number)
    requested = Request(also.path, also.time, also.inputs, also.outputs, options)
    # An open log is not opened again, because it may be large.
    file = also.log or open_log(requested.path, requested.options.number)
    other = _open(requested, file)
    requested = with_file_units(other, requested)
    signals = signals_of(other, requested)
    name = Path(also.path).name
    stated = f"{name} (sha256 {file.sha256[:12]})"
    if also.same:
        lag, notice = _aligned(log, request, also, file, stated)
    else:
        lag = float(other.begin - log.begin)
        first = Path(request.path).name
        words = (
            f"{stated}: its times are taken as those of {first}; if each log counts from its own "
            "start, state align"
        )
        notice = note("clock.taken-as-one", words, value=lag)
    shifted = {}
    for key, signal in signals.items():
        # Two files may have topics of the same name.
        clock = signal.clock
        called = clock.name if clock.name == name else f"{name}, {clock.name}"
        clock = dataclasses.replace(clock, name=called, seconds=clock.seconds + lag)
        shifted[key] = dataclasses.replace(signal, clock=clock)
    return shifted, notice, requested


def _aligned(
    log: ChannelLog, request: Request, also: Also, file: ChannelLog | Table, name: str
) -> tuple[float, Finding]:
    """Return the correction of a further log's times [s], from a motion in both logs."""
    key = next((key for key in request.signals if key[0] == also.same), None)
    if key is None:
        known = ", ".join(dict.fromkeys(name for name, _ in request.signals))
        problem = f"expected a signal of the first log ({known}), got {also.same!r:.60}"
        raise wrong(also.path, problem, "align.with")
    # In a request of its own, because it may also be one of the other signals.
    options = ReadOptions(number=also.number)
    alone = Request(also.path, also.time, {}, {also.same: Signal(also.to, "1", "1")}, options)
    reference = signals_of(log, _only(request, frozenset({key}), whole=True))[key].timed
    (twin,) = signals_of(_open(alone, file), alone).values()
    reference = reference._replace(values=measured(request.signals[key], reference.values))
    # The scale does not affect the correlation, so no unit is needed.
    motion = (-1.0 if also.reverse else 1.0) * without_marks(twin.values)
    try:
        lag = lag_between(reference, twin.timed._replace(values=motion))
    except NotAligned as e:
        what = f"{also.same} of {Path(request.path).name} and {shown(also.to)}"
        raise wrong(also.path, f"cannot be aligned by {what}: {e}") from e
    words = (
        f"{name}: its times were shifted by {lag.lag:.6g} s, counted from its "
        f"start, so that {shown(also.to)} agrees best with {also.same} "
        f"(correlation {lag.correlation:.3f} over {lag.overlap:.4g} s)"
    )
    return lag.lag, Finding(
        "clock.aligned", "note", words, lag.lag, "seconds added to its times", (also.same,)
    )


def _within(signal: ClockedSignal, request: Request) -> ClockedSignal:
    """Return the part of a signal inside the window."""
    if request.options.window is None:
        return signal
    clock = signal.clock
    rows = rows_in_window(request.path, clock.seconds, request.options.window, clock.name)
    return dataclasses.replace(signal, clock=clock.part(rows), values=signal.values[rows])


# Records that no fit can use.


def require_some_time(flight: Flight) -> None:
    """Refuse a flight too short for any vehicle to move."""
    if flight.duration >= _SHORTEST:
        return
    path = flight.source.path if flight.source else flight.name or "flight"
    problem = f"{flight.n_samples} samples in {flight.duration:.3g} s, expected {_SHORTEST:g} s"
    raise wrong(path, f"{problem} at least: check the window and the unit of time")


def require_moving_outputs(flight: Flight) -> None:
    """Refuse a flight in which all outputs are constant: gains of zero would fit without noise."""
    seen = {n: y[np.isfinite(y)] for n, y in flight.outputs.items()}
    still = {n: y[0] for n, y in seen.items() if y.size and np.ptp(y) <= _STILL}
    if not still or len(still) < len(seen):
        return
    path = flight.source.path if flight.source else flight.name or "flight"
    values = ", ".join(f"{n} at {value:.6g}" for n, value in still.items())
    problem = f"every output is constant (SI: {values}) for all of {flight.duration:.6g} s"
    raise wrong(
        path, (f"{problem}; expected an output that changes: check that the sensor was logged")
    )
