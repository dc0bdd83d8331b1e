"""Slow outputs in fast tables: many loggers write the last value again until the next is there.

Taken as measurements, the repeated values say that the signal stood still between two samples, and
twenty times over.
"""

from collections.abc import Mapping

import numpy as np

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
_MOVES = 0.5
"""part of its samples at which another output moves, which shows that the machine did"""


def usual_run(values: np.ndarray) -> int | None:
    """How many samples each value of an output (N,) is repeated for; None unless unmistakable."""
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
    outputs: Mapping[str, np.ndarray], stated: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Outputs (N,), each on its own clock, with repeated values as missing samples, and notes.

    Args:
        outputs: by name, NaN where a sample is missing.
        stated: one of `REPEATS` by name.
    """
    made, notes = dict(outputs), []
    runs = {n: usual_run(y) for n, y in outputs.items()}
    moving = [n for n, y in outputs.items() if runs[n] is None and _moves(y)]
    for name, y in outputs.items():
        usual = runs[name]
        if stated[name] == "missing":
            lengths, _ = _runs(y)
            # Stated by somebody who knows: then no further sign is asked for.
            usual = usual or round(float(np.median(lengths))) if lengths.size else None
            if usual is None or usual < 2:
                notes.append(f"{name}: no value is repeated, though `repeats: missing` is stated")
                continue
        elif stated[name] == "keep" or usual is None:
            continue
        elif not moving:
            # Nothing else shows that the machine moved while this signal stood still.
            notes.append(
                f"{name} keeps each value for {usual} samples; if it was measured so slowly, state "
                "`repeats: missing`"
            )
            continue
        made[name] = without_repeats(y, usual)
        notes.append(
            f"{name} keeps each value for {usual} samples: taken as measured at the first of them "
            "and missing at the others (`repeats: keep` leaves them)"
        )
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
