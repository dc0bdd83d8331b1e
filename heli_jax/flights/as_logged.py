"""What is set right and noted of signals before anything is made of them: marks, and turns.

Both would be spread over their neighbours by any filter or straight line: a -9999 that stands for
no value, and the jump of an angle from 180 deg to -180 deg.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from heli_jax import units
from heli_jax.flights.flight import Signal, Source
from heli_jax.flights.onto_grid import FEWEST, Key
from heli_jax.flights.request import Request
from heli_jax.flights.signal_facts import SignalFacts, facts_of_all
from heli_jax.flights.slower import Timed
from heli_jax.flights.table import column, shown, wrong

_MARKS = (
    *(sign * nines for nines in (999.0, 9999.0, 99999.0, 999999.0) for sign in (1.0, -1.0)),
    *(sign * nines for nines in (999.9, 9999.9, 999.99) for sign in (1.0, -1.0)),
    *(2.0**bits - 1 for bits in (15, 16, 31, 32)),
    *(-(2.0**bits) for bits in (15, 31)),
    *(655.35, 327.67, -327.68),
)
"""numbers that loggers write where they have none: nines, and the ends of integers"""
_SORTED = np.sort(_MARKS)
_SINGLE = 1e-6
"""of a mark, by which its number may miss it: single precision, and units that are converted"""
_ABSURD = 1e9
"""in the log's own numbers: larger ones are no measurement, such as 1e10 and 3.4e38"""
_APART = 1.0
"""times the range of all other values, by which a mark lies outside of it"""
_LEVELS = 4
"""distinct values that a signal has beside its marks, at least"""
_MOST = 0.2
"""part of the samples that are marks, at most: what is there more often may be a value"""
_JUMP = (0.75, 1.001)
"""of a turn: by how much a wrapped angle jumps from a sample to the next, at least and at most"""
_STEP = 0.125
"""of a turn: by how much else it moves from a sample to the next, at most"""
_TURNS = (360.0, 2 * np.pi, 36000.0)
"""degrees, radians, hundredths of a degree"""
_NEARLY = 0.9
"""turns that an angle of no stated unit has to go over"""
_TURN = 1.001
"""turns that a wrapped angle goes over, at most; its ends may be rounded"""


@dataclass(frozen=True, eq=False)
class AsLogged:
    """Signals as they were logged, by key: each on its clock, in SI, without marks and turns.

    `notes` say what was done, in sentences.
    """

    signals: dict[Key, Timed]
    facts: dict[Key, SignalFacts]
    notes: tuple[str, ...]

    def source(self, source: Source, begin: float, end: float) -> Source:
        """Of a flight from `begin` to `end` [s] on the signals' clocks, with what they were."""
        facts = {key: f.within(begin, end) for key, f in self.facts.items()}
        return replace(source, facts=facts)


def as_logged(request: Request, signals: Mapping[Key, Timed]) -> AsLogged:
    """The signals without marks and turns, and what they were.

    Args:
        request: names them.
        signals: by key, in SI, each on its own clock.

    Raises:
        InputError: an input has marks; it acts all the time, so that none of it may be missing.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # differences of huge values
        return _as_logged(request, signals)


def _as_logged(request: Request, signals: Mapping[Key, Timed]) -> AsLogged:
    made, marks, notes = {}, {}, []
    for key, timed in signals.items():
        signal, name = request.signals[key], shown(request.signals[key].name)
        numbers = _in_log(signal, timed.values)
        at = at_marks(numbers)
        marks[key] = counted(numbers, at)
        if at.any():
            if key[1] == "input":
                first = float(timed.seconds[np.flatnonzero(at)[0]])
                problem = f"has {mark_words(marks[key])}, first at {first:.6g} s"
                remedy = "expected an input that is known all the time; give a window without them"
                raise wrong(request.path, f"{problem}; {remedy}", column(signal.name))
            notes.append(f"{name} has {mark_words(marks[key])}: taken as missing")
        values = np.where(at, np.nan, timed.values)
        turn = _turn(signal)
        if turn is not None and is_wrapped(values, turn):
            values, note = unwrapped(values, turn)
            notes.append(f"{name} {note}")
        made[key] = Timed(timed.seconds, values)
    outputs = frozenset(key for key in made if key[1] == "output")
    facts = facts_of_all({key: (t.seconds, t.values) for key, t in made.items()}, outputs)
    facts = {key: replace(f, marks=marks[key]) for key, f in facts.items()}
    return AsLogged(made, facts, tuple(notes))


def without_marks_and_turns(numbers: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Numbers (N,) of a log whose unit nobody states, with marks as missing and angles unwrapped
    that are surely some, and what was done in words."""
    notes, at = [], at_marks(numbers)
    if at.any():
        notes.append(f"has {mark_words(counted(numbers, at))}: taken as missing")
        numbers = np.where(at, np.nan, numbers)
    for turn in _TURNS:
        y = numbers[np.isfinite(numbers)]
        if y.size and np.ptp(y) > _NEARLY * turn and is_wrapped(numbers, turn):
            after, words = unwrapped(numbers, turn)
            steps = np.abs(np.diff(after[np.isfinite(after)]))
            # Beside its jumps it goes through all of a turn by small steps: a mode or a switch
            # between 0 and 360 does not.
            if steps.max() < (1 - _JUMP[0]) * turn and steps.sum() > _NEARLY * turn:
                return after, [*notes, words]
    return numbers, notes


def _in_log(signal: Signal, values: np.ndarray) -> np.ndarray:
    """What stands in the log for values (N,) in SI."""
    return signal.from_si(values)


def at_marks(numbers: np.ndarray) -> np.ndarray:
    """Which of the numbers (N,) of a log stand for no value, far outside of all others."""
    with np.errstate(invalid="ignore"):
        at = np.abs(numbers) > _ABSURD
    i = np.clip(np.searchsorted(_SORTED, numbers), 1, _SORTED.size - 1)
    for mark in (_SORTED[i - 1], _SORTED[i]):
        at |= np.abs(numbers - mark) <= _SINGLE * np.abs(mark)
    rest = numbers[np.isfinite(numbers) & ~at]
    if not at.any() or rest.size < FEWEST or at.sum() > _MOST * (at.sum() + rest.size):
        return np.zeros(numbers.shape, bool)
    # Of a switch between a few values any of them may be one.
    if np.unique(rest).size < _LEVELS:
        return np.zeros(numbers.shape, bool)
    low, high = float(rest.min()), float(rest.max())
    away = _APART * (high - low)
    return at & ((numbers > high + away) | (numbers < low - away))


def counted(numbers: np.ndarray, at: np.ndarray) -> tuple[tuple[float, int], ...]:
    """The marks in numbers (N,) of a log, and how many of each there are."""
    values, counts = np.unique(numbers[at], return_counts=True)
    return tuple((float(f"{v:.7g}"), int(n)) for v, n in zip(values, counts, strict=True))


def mark_words(marks: tuple[tuple[float, int], ...]) -> str:
    """`10 samples of -9999 and 1 of 1e+10, far outside of all others`."""
    listed = [f"{n} of {v:.7g}" for v, n in marks[:3]]
    listed[0] = listed[0].replace(" of", " sample of" if marks[0][1] == 1 else " samples of", 1)
    more = f" and {len(marks) - 3} more such values" if len(marks) > 3 else ""
    return " and ".join(listed) + more + ", far outside of all others"


def _turn(signal: Signal) -> float | None:
    """A full turn in the signal's SI unit; None where it is no angle."""
    try:
        return units.factor("turn", signal.si)
    except ValueError:
        return None


def is_wrapped(values: np.ndarray, turn: float) -> bool:
    """Whether an angle (N,) jumps by a turn at the ends of its range, and never leaves it.

    Args:
        values: NaN where one is missing.
        turn: in their unit.
    """
    y = values[np.isfinite(values)]
    if y.size < FEWEST or not np.ptp(y) <= _TURN * turn:
        return False
    jumps = np.abs(np.diff(y)) / turn
    wraps = (jumps >= _JUMP[0]) & (jumps <= _JUMP[1])
    # Beside them it moves by little from sample to sample, or it is a switch or a sawtooth.
    return bool(wraps.any() and np.max(jumps[~wraps], initial=0.0) <= _STEP)


def unwrapped(values: np.ndarray, turn: float) -> tuple[np.ndarray, str]:
    """An angle (N,) without its jumps of a turn, and in words what was done.

    Args:
        values: NaN where one is missing.
        turn: in their unit.
    """
    seen = np.isfinite(values)
    before = values[seen]
    after = np.unwrap(before, period=turn)
    made = np.array(values)
    made[seen] = after
    n = int(np.count_nonzero(np.abs(np.diff(after) - np.diff(before)) > 0.5 * turn))
    often = "once" if n == 1 else f"{n} times"
    words = f"jumps by a turn {often}, at the ends of its range: taken as going on (unwrapped)"
    unsure = int(np.count_nonzero(np.abs(np.diff(after)) > (1 - _JUMP[0]) * turn))
    if unsure:
        words += f"; {unsure} steps of more than a quarter of a turn remain, and may be wrong"
    return made, words
