"""From logs to flights, whatever the files' formats."""

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.as_logged import measured
from heli_jax.flights.flight import Flight, Signal
from heli_jax.flights.holds import Decision
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.onto_grid import FEWEST, decided_holds
from heli_jax.flights.origins import with_origins, without_constants
from heli_jax.flights.parts import is_too_short, stretches
from heli_jax.flights.read_channels import clocks_of, on_all_the_time
from heli_jax.flights.request import ReadOptions, Request
from heli_jax.flights.resample import Timed
from heli_jax.flights.sources import Opened, beyond, clocked, flight_from, opened
from heli_jax.flights.table import Table, wrong

_DEFAULT = ReadOptions()
_SHORTEST = 0.05
"""s: no vehicle answers a stick sooner"""
_STILL = 1e-100
"""SI: an output that moves by no more does not move"""


type _Log = str | Path | ChannelLog | Table
type _Finish = Callable[[Flight], Flight]
"""adds what is in no log, and what the signals are in theirs"""


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
        path: the log: a table, arrays or what an autopilot wrote (docs/logs.md); or one that is
            open, by `heli_jax.flights.open_log.open_log`.
        time: the column of time stamps, in seconds where only its name is given; None for an
            autopilot's log, whose topics have clocks of their own.
        inputs: the log's signals by the model's names; two inputs may share a column. What one
            does between samples is its `hold`; "auto" decides by how it moves in the log. One
            that the log lacks may be a `constant`.
        outputs: the same for what was measured.
        options: which part of the log, at which rate; all of it unless given.
        **keywords: fields of ReadOptions, in place of those of `options`: `rate` [Hz], `window`
            [s], `known` [SI], `hold_out`, `name`, `number`, `also`.

    Raises:
        InputError: one sentence on what is wrong with the log or with the arguments.
        TypeError: a keyword that is no field of ReadOptions.
    """
    options = dataclasses.replace(options, **keywords)
    logs, request, finish = _opened(path, time, inputs, outputs, options)
    return finish(flight_from(logs, request))


def read_parts(
    path: _Log,
    *,
    time: str | Signal | None = None,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    options: ReadOptions = _DEFAULT,
    **keywords: Any,
) -> tuple[Flight, ...]:
    """Read one run from a log, split where a gap is too long to be bridged, or the runs of a table
    in which the time begins anew.

    Args:
        path: as of `read_flight`, and so are the others.

    Returns:
        The run as it is where it has no such gap, else its parts, named `NAME, part 1` and so on.
        Parts of less than 2 s or 50 samples, and those in which no input moves where one does in
        others, are left out; the first one's notes say which.

    Raises:
        InputError: as `read_flight`, or no part is left.
    """
    options = dataclasses.replace(options, **keywords, split=True)
    logs, request, finish = _opened(path, time, inputs, outputs, options)
    # A slow sensor whose rows are padded with marks is needed at its own instants alone.
    signals = {
        key: dataclasses.replace(s, values=measured(request.signals[key], s.values))
        if key[1] == "output"
        else s
        for key, s in clocked(logs, request)[0].items()
    }
    rate = options.rate
    needed = clocks_of(signals.values()) if rate is None else on_all_the_time(signals, rate)
    clocks = [clock.seconds for clock in needed]
    intervals = stretches(clocks)
    if len(intervals) < 2:
        return (finish(flight_from(logs, request)),)
    values = {key: signal.values for key, signal in signals.items()}
    holds = decided_holds(request, values)
    inputs_of = [s.timed for (_, kind), s in signals.items() if kind == "input"]
    moving = [i for i in intervals if any(_moves(u, *i) for u in inputs_of)]
    parts, left_out, why = [], [], None
    for start, end in intervals:
        name = f"{options.name or 'flight 1'}, part {len(parts) + 1}"
        part = _of_part(request, (start, end), name, holds)
        try:
            if is_too_short((start, end), clocks):
                raise InputError("too short")
            # On the ground before and behind a flight; where nothing moves anywhere each part is a
            # free decay.
            if moving and inputs_of and (start, end) not in moving:
                raise InputError("no input moves")
            flight = _enough_measured(finish(flight_from(logs, part)))
        except InputError as e:
            left_out.append(f"{start:.6g} s to {end:.6g} s ({e.within})")
            why = e
            continue
        reasons = {
            key: d.reason
            for key, d in holds.items()
            # What the resampling made of it has the part's own reason.
            if d.reason and flight.hold.get(key) == d.hold
        }
        reasons = {**flight.hold_reason, **reasons}
        parts.append(dataclasses.replace(flight, hold_reason=reasons))
    if not parts:
        problem = (
            f"{len(intervals)} parts between gaps, expected one that is long enough; the last: "
        )
        raise wrong(request.path, problem + left_out[-1]) from why
    notes = (*beyond(logs, request), *_notes(intervals, left_out))
    return (_with_notes(parts[0], notes), *parts[1:])


def _moves(signal: Timed, start: float, end: float) -> bool:
    """True if a signal moves from `start` to `end` [s]."""
    values = signal.values[(signal.seconds >= start) & (signal.seconds <= end)]
    return values.size > 1 and bool(np.ptp(values) > 0)


def _opened(
    path: _Log,
    time: str | Signal | None,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    options: ReadOptions,
) -> tuple[Opened, Request, _Finish]:
    """The logs, what is asked of all of them, and what makes a flight of them whole."""
    logged, constants = without_constants(inputs)
    is_open = not isinstance(path, str | Path)
    # Checked before a log is opened, which may take minutes.
    request = Request(path.path if is_open else str(path), time, logged, outputs, options)
    logs, request = opened(request, path if is_open else None)
    # In the order in which they were asked for, those of further logs last; units as they are read.
    asked = [
        {**own, **{n: s for also in options.also for n, s in getattr(also, role).items()}}
        for role, own in (("inputs", inputs), ("outputs", outputs))
    ]
    signals = request.signals
    both = [
        {**of_kind, **{n: signals[n, kind] for n in of_kind if (n, kind) in signals}}
        for kind, of_kind in zip(("input", "output"), asked, strict=True)
    ]
    return logs, request, functools.partial(
        with_origins, inputs=both[0], outputs=both[1], constants=constants
    )  # fmt: skip


def _of_part(
    request: Request, window: tuple[float, float], name: str, holds: Mapping[str, Decision]
) -> Request:
    """The request for one part of a run."""
    part = copy.copy(request)
    part.options = dataclasses.replace(request.options, window=window, name=name)
    # By the whole run: of the few moves in a part the same stick may look different.
    part.signals = {
        key: dataclasses.replace(s, hold=holds[key[0]].hold) if key[1] == "input" else s
        for key, s in request.signals.items()
    }
    return part


def _notes(intervals: list[tuple[float, float]], left_out: list[str]) -> tuple[Finding, ...]:
    """A note on the gaps at which a log was split and the parts left out; `intervals` [s]."""
    gaps = [after - before for (_, before), (after, _) in itertools.pairwise(intervals)]
    words = f"gaps of up to {max(gaps):.3g} s split the run into {len(intervals)} parts"
    split = note("clock.gaps-split", words, value=max(gaps))
    if not left_out:
        return (split,)
    more = f" and {len(left_out) - 3} more" if len(left_out) > 3 else ""
    words = f"left out: {'; '.join(left_out[:3])}{more}"
    return (split, note("windows.left-out", words, value=len(left_out)))


def _enough_measured(flight: Flight) -> Flight:
    """Without outputs of which a part has next to nothing, such as those of a slow sensor."""
    few = [n for n, y in flight.outputs.items() if np.isfinite(y).sum() < FEWEST]
    if not few:
        return flight
    if len(few) == len(flight.outputs):
        raise InputError(f"fewer than {FEWEST} measured samples of {', '.join(few)}")
    outputs = {n: y for n, y in flight.outputs.items() if n not in few}
    sd = {n: v for n, v in flight.sd.items() if n not in few}
    flight = dataclasses.replace(flight, outputs=outputs, sd=sd)
    words = (
        f"{flight.name}: without {', '.join(few)}, of which fewer than {FEWEST} samples are seen"
    )
    return _with_notes(flight, (note(LEFT_OUT, words, *few),))


def _with_notes(flight: Flight, notes: tuple[Finding, ...]) -> Flight:
    assert flight.source is not None  # it was read from a log
    source = dataclasses.replace(flight.source, notes=(*flight.source.notes, *notes))
    return dataclasses.replace(flight, source=source)


def require_some_time(flight: Flight) -> None:
    """Refuse a flight in which no vehicle can have moved."""
    if flight.duration >= _SHORTEST:
        return
    path = flight.source.path if flight.source else flight.name or "flight"
    problem = f"{flight.n_samples} samples in {flight.duration:.3g} s, expected {_SHORTEST:g} s"
    raise wrong(path, f"{problem} at least: look at the window, and at the time's unit")


def require_moving_outputs(flight: Flight) -> None:
    """Refuse a flight in which no output does anything: gains of zero fit it, without any noise."""
    seen = {n: y[np.isfinite(y)] for n, y in flight.outputs.items()}
    still = {n: y[0] for n, y in seen.items() if y.size and np.ptp(y) <= _STILL}
    if not still or len(still) < len(seen):
        return
    path = flight.source.path if flight.source else flight.name or "flight"
    values = ", ".join(f"{n} at {value:.6g}" for n, value in still.items())
    problem = f"every output stays at one value (SI: {values}) for all of {flight.duration:.6g} s"
    raise wrong(path, f"{problem}; expected one that moves: look whether the sensor was logged")
