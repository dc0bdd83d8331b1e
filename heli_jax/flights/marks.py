"""Numbers of a log that were not measured: marks such as -9999, repeated values."""

from collections.abc import Iterable, Mapping

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.log import listed, shown

_FEWEST = 8
"""Fewest samples of a signal besides its marks."""
_NINES = tuple(
    sign * nines
    for nines in (999.0, 9999.0, 99999.0, 999999.0, 999.9, 9999.9, 99999.9, 999.99, 9999.99)
    for sign in (1.0, -1.0)
)
_KNOWN = np.sort(
    [
        # Numbers that people choose for no value.
        *(*_NINES, -7777.0, -8888.0, -88888.0),
        # Limits of integer types, also in hundredths.
        *(2.0**b - 1 for b in (15, 16, 31, 32)),
        *(-(2.0**b) for b in (15, 31)),
        *(-327.68, 327.67, 655.35),
    ]
)
_SMALLEST = 300.0
"""Smallest magnitude of a mark; it excludes most signals quickly."""
_SINGLE = 1e-6
"""Relative tolerance of a mark, for single precision and converted units."""
_ABSURD = 1e9
"""Magnitude in the log's numbers above which nothing is a measurement, as 1e10 and 3.4e38."""
_MOST, _FEW = 0.2, 2
"""Largest share of absurd samples, unless they have at most `_FEW` values. A counter may be as
large half of the time."""
_APART = 1.0
"""Distance of a mark from all other values, in ranges of those values."""
_LEVELS = 4
"""Fewest distinct values of a signal besides its marks."""


def at_marks(numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the numbers (N,) of a log that certainly mean no value.

    These are known marks far outside of all other numbers, or the only ones of their sign, and
    numbers too large for any measurement.
    """
    absurd, known = is_impossible(numbers), _is_known(numbers)
    none = np.zeros(numbers.shape, bool)
    if not (absurd.any() or known.any()):
        return none
    # Known marks may have any share: with a slow sensor, they fill most rows of a table.
    others = numbers[absurd & ~known]
    # Absurd numbers must be few or nearly always the same.
    few = others.size <= _MOST * np.count_nonzero(np.isfinite(numbers) | (absurd & ~known))
    at = known | absurd if few or np.unique(others).size <= _FEW else known
    rest = numbers[np.isfinite(numbers) & ~at]
    # A switch between a few values may use any of them.
    if rest.size < _FEWEST or np.unique(rest).size < _LEVELS:
        return none
    low, high = float(rest.min()), float(rest.max())
    away = _APART * (high - low)
    far = (numbers > high + away) | (numbers < low - away)
    # Among rotor speeds -9999 is not far away, but it is the only negative number.
    other_sign = (numbers < 0) if low >= 0 else (numbers > 0) if high <= 0 else none
    return at & (far | (other_sign & known))


def infinite(values: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the values (N,) of an output that are infinite.

    The log's numbers (N,) that are marks are excepted: `inf` is a mark like 1e10.
    """
    return np.isinf(values) & ~at_marks(numbers)


def is_impossible(numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the numbers (N,) of a log that no sensor measures, in any unit."""
    with np.errstate(invalid="ignore"):
        return np.abs(numbers) > _ABSURD


def _is_known(numbers: np.ndarray) -> np.ndarray:
    at = np.zeros(numbers.shape, bool)
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(np.abs(numbers) > _SMALLEST)
    large = numbers[rows]
    i = np.clip(np.searchsorted(_KNOWN, large), 1, _KNOWN.size - 1)
    for mark in (_KNOWN[i - 1], _KNOWN[i]):
        at[rows] |= np.abs(large - mark) <= _SINGLE * np.abs(mark)
    return at


def without_marks(numbers: np.ndarray) -> np.ndarray:
    """Return numbers (N,) of a log, NaN where one means no value."""
    at = at_marks(numbers)
    return np.where(at, np.nan, numbers) if at.any() else numbers


def mark_notes(channels: Iterable[tuple[str, np.ndarray]]) -> list[Finding]:
    """Return notes on the marks in channels, each with a name and numbers (N,) of any kind."""
    notes = []
    for name, numbers in channels:
        # A signal that was never logged has only marks, and a switch may have any value. A damaged
        # log may hold signalling NaNs, which warn on conversion.
        if (x := np.asarray(numbers)).dtype.kind in "biuf":
            with np.errstate(invalid="ignore"):
                x = x.astype(np.float64)
            if (at := at_marks(x)).any():
                done = "a fit treats them as missing"
                notes.append(marks_note(shown(name), x, at, done, name))
    return notes


def marks_note(
    name: str, numbers: np.ndarray, at: np.ndarray, done: str, *subjects: str
) -> Finding:
    """Return a note on the marks of a channel (a mask of its numbers (N,)) and their treatment."""
    words = f"{name} has {mark_words(numbers, at)}: {done}"
    return note("samples.marks", words, *subjects, value=int(np.count_nonzero(at)))


def mark_words(numbers: np.ndarray, at: np.ndarray) -> str:
    """Describe the marks of a channel (a mask of its numbers (N,)), by value."""
    values, counts = np.unique(numbers[at], return_counts=True)
    share = counts.sum() / np.count_nonzero(~np.isnan(numbers))
    each = listed(f"{n} of {v:.7g}" for v, n in zip(values, counts, strict=True))
    return f"samples far outside the other values ({each}; {100 * share:.2g} % of all)"


# Slow outputs in fast tables: many loggers repeat the last value until the next sample. Used as
# measurements, repeated values mean that the signal was constant in between.

REPEATS = ("auto", "keep", "missing")
"""Options for repeated values: missing if unmistakable, or as stated."""

_FEWEST_RUNS = 20
"""Fewest values that are repeated."""
_ONE_COUNT = 0.5
"""Smallest ratio of moves by one count to repeated values, or to all moves, if the resolution makes
the repeats: a move by one count is then at least as frequent as none."""


def repeats(values: np.ndarray) -> np.ndarray:
    """Return a mask of the samples of an output (N,) that equal the one before, NaN aside."""
    seen = np.flatnonzero(~np.isnan(values))
    again = np.zeros(values.shape, bool)
    again[seen[1:]] = values[seen[1:]] == values[seen[:-1]]
    return again


def written_again(values: np.ndarray) -> np.ndarray:
    """Return a mask of the samples of an output (N,) that a logger or a radio link wrote again.

    A slow motion in coarse steps repeats values too, but then most of its moves are by one count.
    """
    again, none = repeats(values), np.zeros(values.shape, bool)
    fresh = values[~again & ~np.isnan(values)]
    if fresh.size < _FEWEST_RUNS:
        return none
    # A signal that comes back to the end of its range is clipped.
    for end in (fresh.min(), fresh.max()):
        if np.count_nonzero(fresh == end) > 1:
            again &= values != end
    runs = np.count_nonzero(again[1:] & ~again[:-1])
    with np.errstate(over="ignore"):
        moves = np.abs(np.diff(fresh))
    single = np.count_nonzero(moves <= 1.5 * moves.min())
    by_resolution = single >= _ONE_COUNT * min(runs, moves.size)
    return none if runs < _FEWEST_RUNS or by_resolution else again


def repeats_removed(
    outputs: Mapping[str, np.ndarray], stated: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], list[Finding]]:
    """Return outputs (N,), each on its own clock, with repeats as missing samples, and notes."""
    made, notes = dict(outputs), []
    for name, y in outputs.items():
        if stated[name] == "keep":
            continue
        again = repeats(y) if stated[name] == "missing" else written_again(y)
        if count := int(np.count_nonzero(again)):
            made[name] = np.where(again, np.nan, y)
            words = f"{count} samples of {name} repeat the previous value and count as missing"
            words += " (`repeats: keep` keeps them)"
            notes.append(note("repeats.missing", words, name, value=count))
    return made, notes
