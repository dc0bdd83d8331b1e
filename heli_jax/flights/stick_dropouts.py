"""Where a stick's channel jumps to one value for a sample or so and back to where it was."""

import numpy as np

_SHORT = 3
"""samples that a dropout takes at most"""
_BACK = 0.2
"""of the jump, by which a stick may be elsewhere after it"""
_FAR = 0.1
"""of the range of all other samples, by which the value is off"""
_VISITS, _FROM = 5, 3
"""dropouts at least, and distinct values from which they come: a stick between three positions has
no more"""
_NEARLY_ALL = 0.8
"""part of the visits of the value that are such jumps: where a stick rests it stays"""


def stick_dropouts(x: np.ndarray) -> tuple[float, np.ndarray] | None:
    """The value to which an input (N,) drops out, and which samples (N,) these are; None where it
    has none."""
    if x.size < _VISITS or not np.isfinite(x).all():
        return None
    begins = np.flatnonzero(np.r_[True, x[1:] != x[:-1]])
    lengths, values = np.diff(np.r_[begins, x.size]), x[begins]
    if values.size < 2 * _VISITS:
        return None
    before, at, after = values[:-2], values[1:-1], values[2:]
    jump = np.minimum(np.abs(at - before), np.abs(at - after))
    away = (lengths[1:-1] <= _SHORT) & (np.abs(after - before) <= _BACK * jump)
    levels, counts = np.unique(at[away], return_counts=True)
    if not levels.size:
        return None
    value = float(levels[np.argmax(counts)])
    these = away & (at == value)
    rest = x[x != value]
    if (
        counts.max() < _VISITS
        or np.unique(before[these]).size < _FROM
        or counts.max() < _NEARLY_ALL * np.count_nonzero(values == value)
        or np.median(jump[these]) < _FAR * np.ptp(rest)
    ):
        return None
    return value, x == value
