"""What the steps of a clock say of it, where samples are put on another grid."""

import numpy as np

from heli_jax.finding import Finding, note

_BLOCKS = 20
"""parts of a log of which each has a usual step"""
_SAME, _OTHER = 1.15, 1.4
"""times a usual step: within the first it is the same, beyond the second another"""
_MIXED = 0.1
"""part of the steps before a change of rate that may be as those behind it, and the other way"""
_LONG = 3.0
"""usual steps, from which on one is long"""
_MOST = 0.002
"""part of the steps that are long, at most, for them to be told one by one"""


def step_notes(seconds: np.ndarray, rate: float, longest: float) -> tuple[Finding, ...]:
    """Notes on a clock that was set or lost samples now and then, or went on at another rate.

    Args:
        seconds: stamps (N,) [s], increasing.
        rate: of the new grid [Hz].
        longest: step [s] that is bridged; what is longer is a gap, and told as one.
    """
    steps = np.diff(seconds)
    other = _second_rate(steps) if steps.size >= 5 * _BLOCKS else None
    if other is not None:
        row, before, after = other
        slower = 1.0 / max(before, after)
        words = (
            f"the clock steps by {before:.4g} s until {seconds[row]:.6g} s and by {after:.4g} s "
            "from there on"
        )
        if rate > 1.01 * slower:
            words += (
                f": at {rate:.6g} Hz the slower part has samples that were not measured; "
                f"`rate: {slower:.4g}` has none"
            )
        return (note("clock.other-rate", words, value=float(seconds[row])),)
    usual = float(np.median(steps))
    long = np.flatnonzero((steps > _LONG * usual) & (steps <= longest))
    if not 0 < long.size <= max(3, _MOST * steps.size):
        return ()
    worst = long[np.argmax(steps[long])]
    which = "a step" if long.size == 1 else f"{long.size} steps"
    size = f"of {steps[worst]:.4g} s" if long.size == 1 else f"of up to {steps[worst]:.4g} s"
    at = "at" if long.size == 1 else "the longest at"
    words = (
        f"the clock has {which} {size}, {at} {seconds[worst]:.6g} s, where {usual:.4g} s is "
        "usual: samples were lost there, or the clock was set; if it was set, what was flown "
        "before and after is farther apart than it was, and the estimates are off"
    )
    return (note("clock.long-steps", words, value=float(steps[worst])),)


def _second_rate(steps: np.ndarray) -> tuple[int, float, float] | None:
    """The row from which on the steps (N,) are others throughout, and the usual ones before and
    after [s]; None where they are not."""
    usual = np.array([np.median(part) for part in np.array_split(steps, _BLOCKS)])
    before, after = float(usual[0]), float(usual[-1])
    ratio = max(before, after) / min(before, after)
    if ratio < _OTHER:
        return None
    middle = np.sqrt(before * after)
    late = (usual > middle) == (after > middle)
    switch = int(np.argmax(late))
    # One change: all parts but that in which it falls have one of the two steps.
    for block, (step, is_late) in enumerate(zip(usual, late, strict=True)):
        near = after if is_late else before
        if is_late != (block >= switch) or (
            abs(block - switch) > 1 and not near / _SAME < step < near * _SAME
        ):
            return None
    # Where samples are lost now and then the usual step changes from part to part, and both steps
    # are found on either side.
    late_steps = (steps > middle) == (after > middle)
    signs = np.where(late_steps, -1.0, 1.0)
    row = int(np.argmax(np.cumsum(signs))) + 1
    clear = late_steps[:row].mean() < _MIXED and late_steps[row:].mean() > 1.0 - _MIXED
    return (row, before, after) if clear else None
