"""Signals as logged, without marks for missing values and wraps of angles, and their facts.

A filter or interpolation would spread both over their neighbours: a -9999 that means no value, and
the jump of an angle from 180 deg to -180 deg.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Signal
from heli_jax.flights.log import column, shown, wrong
from heli_jax.flights.marks import (
    at_marks,
    mark_words,
    marks_note,
    without_marks,
)
from heli_jax.flights.request import FEWEST, Key, Request
from heli_jax.flights.resample import Timed
from heli_jax.flights.signal_facts import SignalFacts, facts_of_all

_MISSING = "taken as missing"
_JUMP = (0.75, 1.001)
"""Smallest and largest jump of a wrapped angle between samples [turns]."""
_STEP = 0.125
"""Largest other move of an angle between samples [turns]."""
_TURNS = (360.0, 2 * np.pi, 36000.0)
"""One turn in degrees, radians and hundredths of a degree."""
_NEARLY = 0.9
"""Smallest total motion of an angle without a stated unit [turns]."""
_DIGITS, _TINY = 1e-9, 1e-6
"""Relative tolerance of a stated number, and the smallest magnitude for it."""


@dataclass(frozen=True, eq=False)
class AsLogged:
    """Signals as logged, by key: each on its clock, in SI, without marks and wraps.

    `notes` list the changes.
    """

    signals: dict[Key, Timed]
    facts: dict[Key, SignalFacts]
    notes: tuple[Finding, ...]


@np.errstate(over="ignore", invalid="ignore")  # differences of huge values
def as_logged(request: Request, signals: Mapping[Key, Timed]) -> AsLogged:
    """Remove marks and wraps from the signals, and find their facts."""
    made, notes = {}, []
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
        made[key] = Timed(seconds, values)
    outputs = frozenset(key for key in made if key[1] == "output")
    facts = facts_of_all({key: (t.seconds, t.values) for key, t in made.items()}, outputs)
    return AsLogged(made, facts, tuple(notes))


def _at_stated(signal: Signal, numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the numbers (N,) that the configuration states to mean no value."""
    at = np.zeros(numbers.shape, bool)
    for value in signal.missing:
        # The numbers were converted to SI and back.
        at |= np.abs(numbers - value) <= _DIGITS * max(abs(value), abs(signal.offset), _TINY)
    return at


def _without(values: np.ndarray, at: np.ndarray, kind: str) -> tuple[np.ndarray, str]:
    """Remove values (N,) that mean none; return the values and a description."""
    count = int(np.count_nonzero(at))
    words = f"has {count} sample{'' if count == 1 else 's'} marked as missing by the configuration"
    if kind == "output":
        return np.where(at, np.nan, values), words
    known = np.flatnonzero(~at)
    if not known.size:
        return values, words
    # An input acts all the time: a stick keeps its previous value.
    last = known[np.maximum(np.searchsorted(known, np.arange(at.size), side="right") - 1, 0)]
    return values[last], f"{words}: the previous value is used"


def measured(signal: Signal, values: np.ndarray) -> np.ndarray:
    """Return values (N,) in SI of a signal, NaN where one means no value."""
    numbers = signal.from_si(values)
    none = np.isnan(without_marks(numbers)) | _at_stated(signal, numbers)
    return np.where(none, np.nan, values)


def without_marks_and_turns(name: str, numbers: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """Remove marks and unwrap clear angles in numbers (N,) of unknown unit; return notes too.

    `name` is the channel's name, as it is shown.
    """
    notes = []
    if (at := at_marks(numbers)).any():
        notes.append(marks_note(name, numbers, at, _MISSING))
        numbers = np.where(at, np.nan, numbers)
    for turn in _TURNS:
        if is_wrapped(numbers, turn):
            after, unwrapping = unwrapped(numbers, turn, name)
            steps = np.abs(np.diff(after[np.isfinite(after)]))
            # Besides its jumps, an angle passes through a whole turn in small steps. A mode or a
            # switch between 0 and 360 does not.
            if steps.max() < (1 - _JUMP[0]) * turn and steps.sum() > _NEARLY * turn:
                return after, [*notes, unwrapping]
    return numbers, notes


def is_wrapped(values: np.ndarray, turn: float) -> bool:
    """True if an angle (N,) jumps by a turn at the ends of its range and never leaves it."""
    y = values[np.isfinite(values)]
    if y.size < FEWEST or not np.ptp(y) <= _JUMP[1] * turn:
        return False
    jumps = np.abs(np.diff(y)) / turn
    wraps = (jumps >= _JUMP[0]) & (jumps <= _JUMP[1])
    # Other moves are small, or it is a switch or a sawtooth.
    return bool(wraps.any() and np.max(jumps[~wraps], initial=0.0) <= _STEP)


def unwrapped(values: np.ndarray, turn: float, name: str) -> tuple[np.ndarray, Finding]:
    """Return an angle (N,) without its jumps of a turn, and a note."""
    made, seen = np.array(values), np.isfinite(values)
    made[seen] = np.unwrap(values[seen], period=turn)
    moved = np.diff(made[seen]) - np.diff(values[seen])
    n = int(np.count_nonzero(np.abs(moved) > 0.5 * turn))
    often = "once" if n == 1 else f"{n} times"
    words = f"{name} jumps by a turn {often}, at the ends of its range: unwrapped"
    return made, note("angles.unwrapped", words, value=n)
