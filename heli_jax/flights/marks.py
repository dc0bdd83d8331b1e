"""Numbers of a log that were not measured: marks such as -9999, strays, repeated values."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.log import shown

_FEWEST = 8
"""Fewest samples of a signal besides its marks."""
_NINES = tuple(
    sign * nines
    for nines in (999.0, 9999.0, 99999.0, 999999.0, 999.9, 9999.9, 99999.9, 999.99, 9999.99)
    for sign in (1.0, -1.0)
)
_DECIMAL = np.sort([*_NINES, -7777.0, -8888.0, -88888.0])
"""Numbers that people choose for no value: nines and eights."""
_BINARY = np.sort([*(2.0**b - 1 for b in (15, 16, 31, 32)), *(-(2.0**b) for b in (15, 31))])
"""Limits of integer types."""
_HUNDREDTHS = np.array([-327.68, 327.67, 655.35])
_KNOWN = np.sort(np.concatenate([_DECIMAL, _BINARY, _HUNDREDTHS]))
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
    absurd, known = is_impossible(numbers), _is_one_of(_KNOWN, numbers)
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
    return at & (far | (other_sign & _is_one_of(_DECIMAL, numbers)))


def infinite(values: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the values (N,) of an output that are infinite.

    The log's numbers (N,) that are marks are excepted: `inf` is a mark like 1e10.
    """
    return np.isinf(values) & ~at_marks(numbers)


def is_impossible(numbers: np.ndarray) -> np.ndarray:
    """Return a mask of the numbers (N,) of a log that no sensor measures, in any unit."""
    with np.errstate(invalid="ignore"):
        return np.abs(numbers) > _ABSURD


def _is_one_of(marks: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    at = np.zeros(numbers.shape, bool)
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(np.abs(numbers) > _SMALLEST)
    large = numbers[rows]
    i = np.clip(np.searchsorted(marks, large), 1, marks.size - 1)
    nearest = np.minimum(
        np.abs(large - marks[i - 1]) / np.abs(marks[i - 1]),
        np.abs(large - marks[i]) / np.abs(marks[i]),
    )
    at[rows[nearest <= _SINGLE]] = True
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
    """Return `10 samples of -9999 and 1 of 1e+10, far outside of all others`, and a large share."""
    share = np.count_nonzero(at) / np.count_nonzero(~np.isnan(numbers))
    often = f" ({100 * share:.0f} % of all)" if share > _MOST else ""
    return f"{value_words(numbers[at])}{often}, far outside the other values"


def value_words(values: np.ndarray) -> str:
    """Return `10 samples of -9999 and 1 of 1e+10`, for at least one value (K,)."""
    numbers, counts = np.unique(values, return_counts=True)
    words = [f"{n} of {v:.7g}" for v, n in zip(numbers[:3], counts[:3], strict=True)]
    words[0] = words[0].replace(" of", " sample of" if counts[0] == 1 else " samples of", 1)
    more = f" and {numbers.size - 3} more such values" if numbers.size > 3 else ""
    return " and ".join(words) + more


# Strays: samples that no motion reaches, and numbers that no sensor measures.

_MOST_STRAYS = 0.05
"""Largest share of strays."""
_MOTION = 50
"""Fewest samples that define the range of a motion."""
_FAR, _FARTHER = 5.0, 20.0
"""Distance of a stray, in ranges of all other samples. The second is for inputs, because a stick
may briefly be pushed out of noise, and for signals of few values."""
_QUICK = 0.04
"""Longest usual step [s] within which a motion cannot come and go."""
_LONGEST = 3
"""Most strays in a row; a value that a sensor holds counts once."""
_STRAY_LEVELS, _FEW_LEVELS = 8, 3
"""Distinct values of a signal besides its strays. Below the first it has few, below the second too
few to decide."""


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
    """Return `3 samples of -99, the first at 12.3 s, which ...`."""
    words = value_words(strays.values)
    if np.unique(strays.values).size > 3:
        low, high = strays.values.min(), strays.values.max()
        words = f"{strays.values.size} samples from {low:.4g} to {high:.4g}"
    at = "at" if strays.times.size == 1 else "the first at"
    return f"{words}, {at} {strays.times[0]:.6g} s, {strays.why}"


def _unreached(seconds: np.ndarray, numbers: np.ndarray, kind: str) -> tuple[np.ndarray, float]:
    """Return a mask of isolated numbers (N,) that no motion reaches, and their limit [ranges]."""
    seen, none = np.flatnonzero(np.isfinite(numbers)), np.zeros(numbers.shape, bool)
    x, far = numbers[seen], _FAR if kind == "output" else _FARTHER
    if x.size < _MOTION:
        return none, far
    # A value that a sensor holds counts once. A stick that stays was moved there.
    new = np.r_[True, x[1:] != x[:-1]] if kind == "output" else np.ones(x.size, bool)
    if np.count_nonzero(new) < _MOTION:
        new[:], far = True, _FARTHER
    y = x[new]
    quick = float(np.median(np.diff(seconds[seen][new]))) <= _QUICK
    if not quick and kind == "input":
        return none, far
    low, high = np.quantile(y, [_MOST_STRAYS, 1 - _MOST_STRAYS])
    out = _beyond(y, low, high, far)
    # A value that stays, begins or ends the record was reached by a motion, and so were values near
    # it.
    alone = _alone(out, y, _LONGEST if quick else 1)
    if not alone.any():
        return none, far
    rest = y[~alone]
    levels = np.unique(rest).size
    far = far if levels >= _STRAY_LEVELS else _FARTHER
    alone &= _beyond(y, rest.min(), rest.max(), far) & (levels >= _FEW_LEVELS)
    at = alone[np.cumsum(new) - 1]
    if np.count_nonzero(at) <= _MOST_STRAYS * x.size:
        none[seen[at]] = True
    return none, far


def _beyond(y: np.ndarray, low: float, high: float, far: float) -> np.ndarray:
    away = far * (high - low)
    return (y > high + away) | (y < low - away)


def _alone(out: np.ndarray, y: np.ndarray, most: int) -> np.ndarray:
    """Return a mask of the samples `out` (N,) to one side and between others.

    At most `most` are in a row.
    """
    edges = np.flatnonzero(np.diff(np.r_[False, out, False].astype(int)))
    at, above = np.zeros(out.shape, bool), y > np.median(y)
    for begin, end in edges.reshape(-1, 2):
        inside = begin > 0 and end < out.size and end - begin <= most
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
_MOVES = 0.5
"""Smallest share of samples at which another output must move to show that the vehicle did."""
_STALE = 0.02, 0.5
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
    runs = {n: usual_run(y) for n, y in outputs.items()}
    moving = any(runs[n] is None and _moves(y) for n, y in outputs.items())
    for name, y in outputs.items():
        usual, lengths = runs[name], _runs(y)[0]
        if stated[name] == "missing" and usual is None and lengths.size:
            # Stated by the user, so no further evidence is needed.
            usual = round(float(np.median(lengths)))
        if stated[name] == "auto" and usual is None and (again := stale(y)).any():
            made[name] = np.where(again, np.nan, y)
            count = int(np.count_nonzero(again))
            words = (
                f"{count} samples of {name} repeat the previous value, which its noise never "
                "does: they are treated as missing (`repeats: keep` keeps them)"
            )
            notes.append(note("repeats.missing", words, name, value=count))
        if stated[name] == "keep" or usual is None or usual < 2:
            continue
        if stated[name] == "auto" and not moving:
            # The other signals do not show motion while this one was constant.
            words = (
                f"{name} keeps each value for {usual} samples; if the sensor is that slow, state "
                "`repeats: missing`"
            )
            notes.append(note("repeats.kept", words, name, value=usual))
            continue
        made[name] = without_repeats(y, usual)
        words = (
            f"{name} keeps each value for {usual} samples: only the first is used (`repeats: "
            "keep` keeps all)"
        )
        notes.append(note("repeats.missing", words, name, value=usual))
    return made, notes


def _runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths (r,) of complete runs of equal values, and sizes (r + 1,) of the jumps."""
    seen = values[~np.isnan(values)]
    at = np.flatnonzero(seen[1:] != seen[:-1])
    with np.errstate(over="ignore"):  # huge values give infinite jumps, which are no less regular
        return np.diff(at), np.abs(seen[at + 1] - seen[at])


def _moves(values: np.ndarray) -> bool:
    seen = values[~np.isnan(values)]
    return seen.size > 1 and float(np.mean(seen[1:] != seen[:-1])) >= _MOVES
