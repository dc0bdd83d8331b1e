"""Slow outputs in fast tables: many loggers write the last value again until the next is there.

Taken as measurements, the repeated values say that the signal stood still between two samples, and
twenty times over.
"""

from collections.abc import Mapping

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.resample import Timed, usual_step

REPEATS = ("auto", "keep", "missing")
"""What is made of repeated values: missing samples where that is unmistakable, or as stated."""

_SHORTEST = 3
"""samples that a run of equal values has at least: two are equal by chance or resolution"""
_RUNS = 20
"""complete runs from which the length of one is told"""
_REGULAR = 0.9
"""part of the runs that are of one length, or of twice that"""
_FEWEST_SINGLE = 0.8
"""part of the runs that are of the one length"""
_ONE_COUNT = 0.5
"""part of the jumps that are one count of the resolution, from which on a slow motion that is
coarsely resolved looks the same"""
_SURE = 50
"""clear runs from which on nothing else has to show that values are repeated"""
_CLEAR = 8.0
"""steps of the resolution: where a signal moves by more than that before a value and after it, two
measurements in a row agree by chance at one of 20 at most"""
_REPEATED = 0.3
"""part of the clear runs that are longer than one sample, from which on they are repeats"""
_EXACT = 0.98
"""part of so many runs that are of one length to the sample, from which on that is a clock"""
_RECUR = 0.5
"""distinct values for each run at least: a command in steps comes back to its values"""
_LATE = 0.25
"""of the time between two measurements, by which one of a regular clock is off"""
_MOVES = 0.5
"""part of its samples at which another output moves, which shows that the vehicle did"""


def usual_run(values: np.ndarray) -> int | None:
    """Return the number of samples for which each value of an output (N,) is repeated; None
    unless unmistakable."""
    lengths, jumps = _runs(values)
    if lengths.size < _RUNS:
        return None
    usual = round(float(np.median(lengths)))
    if usual < _SHORTEST:
        return None
    near = max(1.0, 0.1 * usual)
    single = np.abs(lengths - usual) <= near
    double = np.abs(lengths - 2 * usual) <= 2 * near  # two samples of the same value
    if single.mean() < _FEWEST_SINGLE or (single | double).mean() < _REGULAR:
        return None
    # A slow motion in whole degrees repeats values too, and then goes on by one.
    if np.mean(jumps <= 1.5 * jumps.min()) >= _ONE_COUNT:
        return None
    return usual


def carried_on(seconds: np.ndarray, values: np.ndarray) -> bool:
    """True if rows between the measurements of an output surely repeat the last one.

    So a forward-filled join does it, whose rows lie anywhere between: its runs are of any length.
    What tells is the resolution. A signal that moves by many of its steps before a value and after
    it does not measure the same value twice in a row; and new values come at a clock of their own.
    """
    lengths, jumps = _runs(values)
    if lengths.size < _SURE:
        return False
    seen = ~np.isnan(values)
    y, s = values[seen], seconds[seen]
    levels = np.unique(y).size
    # Rounding makes jumps that are smaller than the resolution: levels tell it too.
    step = max(float(jumps.min()), float(np.ptp(y)) / (4.0 * levels))
    clear = np.minimum(jumps[:-1], jumps[1:]) >= _CLEAR * step
    if np.count_nonzero(clear) < _SURE or np.mean(lengths[clear] > 1) < _REPEATED:
        return False
    if levels < _RECUR * lengths.size:
        return False
    begins = np.diff(s[np.flatnonzero(y[1:] != y[:-1]) + 1])[clear]
    usual = float(np.median(begins))
    # By a row: a join onto the clock of another topic shows a new value at that one's next row.
    near = _LATE * usual + float(np.median(np.diff(s))) * (1 + 1e-6)
    regular = np.abs(begins - usual) <= near
    double = np.abs(begins - 2 * usual) <= near
    return bool(np.mean(regular | double) >= _REGULAR)


def first_of_each(values: np.ndarray) -> np.ndarray:
    """An output (N,) with the first sample of each value alone, the others missing."""
    seen = np.flatnonzero(~np.isnan(values))
    again = seen[1:][values[seen[1:]] == values[seen[:-1]]]
    made = values.copy()
    made[again] = np.nan
    return made


def without_repeats(values: np.ndarray, usual: int) -> np.ndarray:
    """An output (N,) with the first sample of each value alone, the others missing.

    Where a value stays for longer than the `usual` number of samples it was measured again, and
    every so many are kept.
    """
    begins = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    ends = np.r_[begins[1:], values.size]
    since = np.arange(values.size) - np.repeat(begins, ends - begins)
    left = np.repeat(ends, ends - begins) - np.arange(values.size)
    # A run that is one sample too long is one measurement, and not two.
    measured = (since == 0) | ((since % usual == 0) & (left > usual / 2))
    return np.where(measured, values, np.nan)


def repeats_removed(
    outputs: Mapping[str, Timed], stated: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], list[Finding]]:
    """Outputs (N,), each on its own clock, with repeated values as missing samples, and notes."""
    made, notes = {n: y.values for n, y in outputs.items()}, []
    runs = {n: usual_run(y) for n, y in made.items()}
    moving = [n for n, y in made.items() if runs[n] is None and _moves(y)]
    for name, (seconds, y) in outputs.items():
        if stated[name] == "keep":
            continue
        usual = runs[name]
        # Hardly any run has another length than the usual one, or a multiple of it.
        lengths, _ = _runs(y)
        exact = (
            usual is not None
            and lengths.size >= _SURE
            and bool(np.mean(lengths % usual == 0) >= _EXACT)
        )
        sure = exact or carried_on(seconds, y)
        if sure and not exact:
            made[name] = first_of_each(y)
            hz = 1.0 / usual_step(seconds[~np.isnan(made[name])])
            words = (
                f"{name} is carried on from row to row, with a new value at about {hz:.4g} Hz: "
                "taken as missing in between (`repeats: keep` leaves it)"
            )
            notes.append(note("repeats.carried-on", words, name, value=hz))
            continue
        if stated[name] == "missing":
            # Stated by somebody who knows: then no further sign is asked for.
            usual = usual or round(float(np.median(lengths))) if lengths.size else None
            if usual is None or usual < 2:
                continue
        elif usual is None:
            continue
        elif not (moving or sure):
            # Nothing else shows that the vehicle moved while this signal stood still.
            words = (
                f"{name} keeps each value for {usual} samples; if it was measured so slowly, state "
                "`repeats: missing`"
            )
            notes.append(note("repeats.kept", words, name, value=usual))
            continue
        made[name] = without_repeats(y, usual)
        words = (
            f"{name} keeps each value for {usual} samples: taken as measured at the first of them "
            "and missing at the others (`repeats: keep` leaves them)"
        )
        notes.append(note("repeats.missing", words, name, value=usual))
    return made, notes


def _runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (r,) of the complete runs of equal values, and sizes (r + 1,) of the jumps."""
    seen = values[~np.isnan(values)]
    at = np.flatnonzero(seen[1:] != seen[:-1])
    with np.errstate(over="ignore"):  # of huge values infinite jumps: no less regular
        return np.diff(at), np.abs(seen[at + 1] - seen[at])


def _moves(values: np.ndarray) -> bool:
    seen = values[~np.isnan(values)]
    return seen.size > 1 and float(np.mean(seen[1:] != seen[:-1])) >= _MOVES
