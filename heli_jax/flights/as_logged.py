"""Signals as they were logged, without marks for missing values and turns of angles; their facts.

Both would be spread over their neighbours by any filter or straight line: a -9999 that stands for
no value, and the jump of an angle from 180 deg to -180 deg.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Signal
from heli_jax.flights.log import column, shown, wrong
from heli_jax.flights.marks import (
    at_marks,
    mark_words,
    marks_note,
    stray_words,
    strays,
    without_marks,
)
from heli_jax.flights.request import FEWEST, Key, Request
from heli_jax.flights.resample import Timed
from heli_jax.flights.signal_facts import SignalFacts, facts_of_all

_MISSING = "taken as missing"
_JUMP = (0.75, 1.001)
"""of a turn: by how much a wrapped angle jumps from a sample to the next, at least and at most"""
_STEP = 0.125
"""of a turn: by how much else it moves from a sample to the next, at most"""
_TURNS = (360.0, 2 * np.pi, 36000.0)
"""degrees, radians, hundredths of a degree"""
_NEARLY = 0.9
"""turns that an angle of no stated unit has to go over"""
_DIGITS, _TINY = 1e-9, 1e-6
"""of a number that is compared with one that was stated, and the smallest that counts"""


@dataclass(frozen=True, eq=False)
class AsLogged:
    """Signals as they were logged, by key: each on its clock, in SI, without marks and turns.

    `notes` say what was done.
    """

    signals: dict[Key, Timed]
    facts: dict[Key, SignalFacts]
    notes: tuple[Finding, ...]


@np.errstate(over="ignore", invalid="ignore")  # differences of huge values
def as_logged(request: Request, signals: Mapping[Key, Timed]) -> AsLogged:
    """The signals without marks and turns, and what they were."""
    made, odd, notes = {}, {}, []
    for key, (seconds, values) in signals.items():
        signal, name = request.signals[key], shown(request.signals[key].name)
        numbers = signal.from_si(values)
        stated = _at_stated(signal, numbers)
        if stated.any():
            values, words = _without(values, stated, key[1])
            count = int(np.count_nonzero(stated))
            notes.append(note("samples.missing-as-stated", f"{name} {words}", key[0], value=count))
            numbers = signal.from_si(values)
        if (at := at_marks(numbers)).any():
            if key[1] == "input":
                problem = f"has {mark_words(numbers, at)}, first at {seconds[np.argmax(at)]:.6g} s"
                remedy = "an input needs a value at every sample: choose a window without them"
                raise wrong(request.path, f"{problem}; {remedy}", column(signal.name))
            notes.append(marks_note(name, numbers, at, _MISSING, key[0]))
            values = np.where(at, np.nan, values)
        turn = units.turn(signal.si)
        if turn is not None and is_wrapped(values, turn):
            values, unwrapping = unwrapped(values, turn, name)
            notes.append(unwrapping)
        # Behind the turns: a heading of about 180 deg may be -180 deg for a sample.
        odd[key] = strays(seconds, signal.from_si(values), key[1])
        for s in odd[key]:
            words = f"{name} has {stray_words(s)}: kept as measured"
            notes.append(note("samples.stray-kept", words, key[0], value=s.values.size))
        made[key] = Timed(seconds, values)
    outputs = frozenset(key for key in made if key[1] == "output")
    facts = facts_of_all({key: (t.seconds, t.values) for key, t in made.items()}, outputs)
    facts = {key: replace(f, strays=odd[key]) for key, f in facts.items()}
    return AsLogged(made, facts, tuple(notes))


def _at_stated(signal: Signal, numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the numbers (N,) that the configuration states to stand for no value."""
    at = np.zeros(numbers.shape, bool)
    for value in signal.missing:
        # Numbers have been through their unit and back.
        at |= np.abs(numbers - value) <= _DIGITS * max(abs(value), abs(signal.offset), _TINY)
    return at


def _without(values: np.ndarray, at: np.ndarray, kind: str) -> tuple[np.ndarray, str]:
    """Values (N,) without those that stand for none, and in words what was done."""
    count = int(np.count_nonzero(at))
    words = f"has {count} sample{'' if count == 1 else 's'} that are missing by the configuration"
    if kind == "output":
        return np.where(at, np.nan, values), words
    known = np.flatnonzero(~at)
    if not known.size:
        return values, words
    # An input acts all the time: a stick stays where it was.
    last = known[np.maximum(np.searchsorted(known, np.arange(at.size), side="right") - 1, 0)]
    return values[last], f"{words}: the value before it is used"


def measured(signal: Signal, values: np.ndarray) -> np.ndarray:
    """Values (N,) in SI of a signal, NaN where one stands for no value."""
    numbers = signal.from_si(values)
    none = np.isnan(without_marks(numbers)) | _at_stated(signal, numbers)
    return np.where(none, np.nan, values)


def without_marks_and_turns(name: str, numbers: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """Numbers (N,) of a log whose unit nobody states, with marks as missing and angles unwrapped
    that are surely some, and what was done; `name` is the channel's, as it is shown."""
    notes = []
    if (at := at_marks(numbers)).any():
        notes.append(marks_note(name, numbers, at, _MISSING))
        numbers = np.where(at, np.nan, numbers)
    for turn in _TURNS:
        if is_wrapped(numbers, turn):
            after, unwrapping = unwrapped(numbers, turn, name)
            steps = np.abs(np.diff(after[np.isfinite(after)]))
            # Beside its jumps it goes through all of a turn by small steps: a mode or a switch
            # between 0 and 360 does not.
            if steps.max() < (1 - _JUMP[0]) * turn and steps.sum() > _NEARLY * turn:
                return after, [*notes, unwrapping]
    return numbers, notes


def is_wrapped(values: np.ndarray, turn: float) -> bool:
    """True if an angle (N,) jumps by a turn at the ends of its range, and never leaves it."""
    y = values[np.isfinite(values)]
    if y.size < FEWEST or not np.ptp(y) <= _JUMP[1] * turn:
        return False
    jumps = np.abs(np.diff(y)) / turn
    wraps = (jumps >= _JUMP[0]) & (jumps <= _JUMP[1])
    # Beside them it moves by little from sample to sample, or it is a switch or a sawtooth.
    return bool(wraps.any() and np.max(jumps[~wraps], initial=0.0) <= _STEP)


def unwrapped(values: np.ndarray, turn: float, name: str) -> tuple[np.ndarray, Finding]:
    """An angle (N,) without its jumps of a turn, and what was done."""
    made, seen = np.array(values), np.isfinite(values)
    made[seen] = np.unwrap(values[seen], period=turn)
    moved = np.diff(made[seen]) - np.diff(values[seen])
    n = int(np.count_nonzero(np.abs(moved) > 0.5 * turn))
    often = "once" if n == 1 else f"{n} times"
    words = f"{name} jumps by a turn {often}, at the ends of its range: unwrapped"
    return made, note("angles.unwrapped", words, value=n)
