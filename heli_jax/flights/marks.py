"""Numbers of a log that were not measured: marks such as -9999, strays, repeated values."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.log import listed, sample_count, shown

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


# Strays: samples that no motion reaches, and numbers that no sensor measures.

_MOST_STRAYS = 0.05
"""Largest share of strays."""
_MOTION = 50
"""Fewest samples that define the range of a motion."""
_FAR, _FARTHER = 5.0, 20.0
"""Distance of a stray output and input, in ranges of all other samples. A stick may briefly be
pushed out of noise."""
_QUICK = 0.04
"""Longest usual step [s] within which a motion cannot come and go."""
_LONGEST = 3
"""Most strays in a row."""
_STRAY_LEVELS = 8
"""Fewest distinct values of a signal besides its strays."""


@dataclass(frozen=True, eq=False)
class Strays:
    """Samples that may mean no value but are kept, because that is not certain.

    `times` (K,) [s], `values` (K,) in the log's numbers, and `why` they are unusual.
    """

    times: np.ndarray
    values: np.ndarray
    why: str

    def within(self, begin: float, end: float) -> "Strays":
        """Return the stray samples from `begin` to `end` [s], with times from `begin`."""
        at = (self.times >= begin) & (self.times <= end)
        return Strays(self.times[at] - begin, self.values[at], self.why)


def strays(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[Strays, ...]:
    """Return samples that probably mean no value but are not certain marks.

    They are isolated samples that no motion reaches, or samples larger than any measurement.
    """
    absurd, (alone, far) = is_impossible(numbers), _unreached(seconds, numbers, kind)
    off = f"impossible as motion: more than {far:g} times the range of the other values away"
    kinds = ((absurd, "larger than any measurement"), (alone & ~absurd, off))
    return tuple(Strays(seconds[at], numbers[at], words) for at, words in kinds if at.any())


def stray_words(strays: Strays) -> str:
    """Describe stray samples by count, range and first time."""
    low, high = strays.values.min(), strays.values.max()
    return (
        f"{sample_count(strays.values.size)} from {low:.4g} to {high:.4g}, the first at "
        f"{strays.times[0]:.6g} s, {strays.why}"
    )


def _unreached(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[np.ndarray, float]:
    """Return a mask of isolated numbers (N,) that no motion reaches, and their limit [ranges]."""
    seen, none = np.flatnonzero(np.isfinite(numbers)), np.zeros(numbers.shape, bool)
    x, far = numbers[seen], _FAR if kind == "output" else _FARTHER
    if x.size < _MOTION or float(np.median(np.diff(seconds[seen]))) > _QUICK:
        return none, far
    low, high = np.quantile(x, [_MOST_STRAYS, 1 - _MOST_STRAYS])
    alone = _alone(_beyond(x, low, high, far), x)
    if not alone.any():
        return none, far
    rest = x[~alone]
    if np.unique(rest).size >= _STRAY_LEVELS:
        alone &= _beyond(x, rest.min(), rest.max(), far)
        if np.count_nonzero(alone) <= _MOST_STRAYS * x.size:
            none[seen[alone]] = True
    return none, far


def _beyond(y: np.ndarray, low: float, high: float, far: float) -> np.ndarray:
    away = far * (high - low)
    return (y > high + away) | (y < low - away)


def _alone(out: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a mask of the samples `out` (N,) of y, a few in a row, to one side of the others.

    A value that begins or ends the record was reached by a motion.
    """
    edges = np.flatnonzero(np.diff(np.r_[False, out, False].astype(int)))
    at, above = np.zeros(out.shape, bool), y > np.median(y)
    for begin, end in edges.reshape(-1, 2):
        inside = begin > 0 and end < out.size and end - begin <= _LONGEST
        at[begin:end] = inside and np.ptp(above[begin:end].astype(int)) == 0
    return at


# Slow outputs in fast tables: many loggers repeat the last value until the next sample. Used as
# measurements, repeated values mean that the signal was constant in between.

REPEATS = ("auto", "keep", "missing")
"""Options for repeated values: missing if unmistakable, or as stated."""

_SHORTEST_RUN = 3
"""Shortest run of equal values [samples]; two may be equal by chance or resolution."""
_REPEATED = 20
"""Fewest complete runs from which the usual length is known."""
_REGULAR = 0.9
"""Smallest share of runs with the usual length or twice that."""
_FEWEST_SINGLE = 0.8
"""Smallest share of runs with the usual length."""
_ONE_COUNT = 0.5
"""Share of jumps by one count of the resolution, from which on a slow motion with coarse resolution
looks the same."""
_STALE = 0.02, 0.8
"""Smallest and largest share of stale samples."""
_CHANCE = 0.02
"""Largest share of values equal to the last but one: so many would also repeat by chance."""
_NOISY = 0.3
"""Smallest share of moves that turn back, which shows noise."""


def stale(values: np.ndarray) -> np.ndarray:
    """Return a mask of the samples of an output (N,) that a logger or a radio link wrote again.

    Only noise of fine resolution shows them: it never repeats a value by itself.
    """
    seen = np.flatnonzero(~np.isnan(values))
    at, y = np.zeros(values.shape, bool), values[seen]
    with np.errstate(over="ignore"):
        moves = np.diff(y)
    ways = np.sign(moves[moves != 0])
    # A signal at the end of its range may be clipped.
    low, high = np.min(y, initial=np.inf), np.max(y, initial=-np.inf)
    again = (moves == 0) & (y[1:] > low) & (y[1:] < high)
    if ways.size < _REPEATED or not _STALE[0] <= again.mean() <= _STALE[1]:
        return at
    fresh = y[np.r_[True, moves != 0]]
    by_chance = np.mean(fresh[2:] == fresh[:-2])
    if by_chance < _CHANCE and np.mean(ways[1:] != ways[:-1]) >= _NOISY:
        at[seen[1:][again]] = True
    return at


def usual_run(values: np.ndarray) -> int | None:
    """Return for how many samples each value of an output (N,) is repeated; None if unclear."""
    lengths, jumps = _runs(values)
    if lengths.size < _REPEATED:
        return None
    usual = round(float(np.median(lengths)))
    if usual < _SHORTEST_RUN:
        return None
    near = max(1.0, 0.1 * usual)
    single = np.abs(lengths - usual) <= near
    double = np.abs(lengths - 2 * usual) <= 2 * near  # two samples of the same value
    if single.mean() < _FEWEST_SINGLE or (single | double).mean() < _REGULAR:
        return None
    # A slow motion in whole degrees also repeats values, but then moves by one count.
    if np.mean(jumps <= 1.5 * jumps.min()) >= _ONE_COUNT:
        return None
    return usual


def without_repeats(values: np.ndarray, usual: int) -> np.ndarray:
    """Return an output (N,) with only the first sample of each value, the others missing.

    A value that stays for longer than the `usual` number of samples was measured again, so every
    `usual`-th sample is kept.
    """
    begins = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    ends = np.r_[begins[1:], values.size]
    since = np.arange(values.size) - np.repeat(begins, ends - begins)
    left = np.repeat(ends, ends - begins) - np.arange(values.size)
    # A run that is one sample too long is one measurement, not two.
    measured = (since == 0) | ((since % usual == 0) & (left > usual / 2))
    return np.where(measured, values, np.nan)


def repeats_removed(
    outputs: Mapping[str, np.ndarray], stated: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], list[Finding]]:
    """Return outputs (N,), each on its own clock, with repeats as missing samples, and notes."""
    made, notes = dict(outputs), []
    for name, y in outputs.items():
        if stated[name] == "keep":
            continue
        usual, lengths = usual_run(y), _runs(y)[0]
        if stated[name] == "missing" and usual is None and lengths.size:
            # Stated by the user, so no further evidence is needed.
            usual = round(float(np.median(lengths)))
        if usual is None:
            again = stale(y)
            made[name], value = np.where(again, np.nan, y), int(np.count_nonzero(again))
            words = f"{value} samples of {name} repeat the previous value, as its noise never does"
        else:
            made[name], value = without_repeats(y, usual), usual if usual > 1 else 0
            words = f"{name} keeps each value for {usual} samples"
        if value:
            words += ": repeats count as missing (`repeats: keep` keeps them)"
            notes.append(note("repeats.missing", words, name, value=value))
    return made, notes


def _runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths (r,) of complete runs of equal values, and sizes (r + 1,) of the jumps."""
    seen = values[~np.isnan(values)]
    at = np.flatnonzero(seen[1:] != seen[:-1])
    with np.errstate(over="ignore"):  # huge values give infinite jumps, which are no less regular
        return np.diff(at), np.abs(seen[at + 1] - seen[at])
