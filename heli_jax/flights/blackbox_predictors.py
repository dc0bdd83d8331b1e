"""The numbers of a blackbox: what its frames hold plus what the firmware predicted.

An I frame stands alone; each P frame holds differences from what the frames before it let expect.
So a run is an I frame with the P frames up to the next, and runs do not depend on each other: the
k-th frames of all runs are computed at once. Nor does a field depend on another, save a motor on
the first.

All arithmetic is that of the firmware: 32 bits that overflow silently, division towards zero. A
field without a sign has the same bits.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heli_jax.flights import blackbox_header as header
from heli_jax.flights.blackbox_header import Header


class Runs(NamedTuple):
    """Where runs `begin` (R,), of `length` (R,), in frames of the file's order."""

    begin: np.ndarray
    length: np.ndarray


def constant(predictor: int, head: Header) -> int:
    """What a predictor expects that is one number for a whole flight; 0 for others."""
    match predictor:
        case header.MIN_THROTTLE:
            return head.integer("minthrottle", 1150)
        case header.FIFTEEN_HUNDRED:
            return 1500
        case header.VBAT_REFERENCE:
            return head.integer("vbatref", 4095)
        case header.MIN_MOTOR:
            return head.integer("motorOutput", 0)
    return 0


def add_predictions(
    values: np.ndarray, i: int, runs: Runs, is_first: np.ndarray, motor: np.ndarray, head: Header
) -> None:
    """Make the numbers of a field, as written, those that were logged.

    Args:
        values: (N,) int32 of all frames in the file's order; changed in place. Those of frames in
            no run come out as anything.
        i: the field's place.
        runs: of these frames.
        is_first: which (N,) are I frames.
        motor: what the first motor was told (N,) int32, where a predictor of this field is that.
        head: the flight's header.
    """
    # Nothing stands before an I frame, so of the predictors only constants and the first motor can
    # be meant in it.
    for letter, rows in (("I", is_first), ("P", ~is_first)):
        predictor = head.layouts[letter].predictors[i]
        if predictor == header.MOTOR_0:
            values[rows] += motor[rows]
        elif number := constant(predictor, head):
            values[rows] += np.int64(number).astype(np.int32)
    has_sign = head.layouts["I"].signed[i]
    match head.layouts["P"].predictors[i]:
        case header.PREVIOUS:
            _add_up(values, runs)
        case header.STRAIGHT_LINE:
            # A line through the two frames before: what is written is the change of the step. An
            # I frame counts as both of those before the first P frame.
            at_first = values[runs.begin]
            values[runs.begin] = 0
            _add_up(values, runs)
            values[runs.begin] = at_first
            _add_up(values, runs)
        case header.AVERAGE:
            _step(values, runs, lambda last, earlier: _mean(last, earlier, has_sign))
        case header.INCREMENT:
            ahead = _iterations_ahead(head)
            _step(values, runs, lambda last, _: ahead[last.view(np.uint32) % ahead.size] + last)


def uses_motor(i: int, head: Header) -> bool:
    """Whether the numbers of a field are differences from the first motor's."""
    return any(head.layouts[letter].predictors[i] == header.MOTOR_0 for letter in "IP")


def _add_up(values: np.ndarray, runs: Runs) -> None:
    """Each number (N,) plus all before it in its run, in place."""
    before = values[runs.begin]
    np.cumsum(values, dtype=values.dtype, out=values)
    # What the runs before have added up to, the frames behind them that are in no run included.
    np.subtract(before, values[runs.begin], out=before)
    if runs.begin.size:
        until = np.diff(runs.begin, append=values.size)
        values[runs.begin[0] :] += np.repeat(before, until)


def _step(
    values: np.ndarray, runs: Runs, expected: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> None:
    """Add to each P frame what is `expected` of the one before it and the one before that."""
    longest_first = np.argsort(-runs.length, kind="stable")
    begin, length = runs.begin[longest_first], runs.length[longest_first]
    # An I frame counts as both frames before the first P frame.
    last = earlier = values[begin]
    going_on = begin.size
    for k in range(1, int(length.max(initial=0))):
        going_on = int(np.searchsorted(-length[:going_on], -k))
        last, earlier = last[:going_on], earlier[:going_on]
        rows = begin[:going_on] + k
        now = values[rows] + expected(last, earlier)
        values[rows] = now
        last, earlier = now, last


def _mean(last: np.ndarray, earlier: np.ndarray, has_sign: bool) -> np.ndarray:
    """The mean (R,) int32 of numbers (R,) int32 whose top bit is a sign or not."""
    kind = np.int32 if has_sign else np.uint32
    both = last.view(kind).astype(np.int64) + earlier.view(kind)
    # Division in C goes towards zero, NumPy's towards minus infinity: odd negative sums would be
    # off by one, and each frame would hand the error on to the next.
    return ((both + (both < 0)) >> 1).astype(np.int32)


def _iterations_ahead(head: Header) -> np.ndarray:
    """By the phase of an iteration between two I frames, how many there are to the next that the
    firmware logs: int32."""
    between, part, whole = head.intervals
    # The condition is the one by which the firmware leaves iterations out. The count is not in the
    # frame, so it has to be made up in the same way.
    phase = np.arange(between)
    logged = (phase + part - 1) % whole < part
    logged[0] = True  # an I frame
    # From each phase, the steps to the next that is logged: at most to the next I frame.
    ahead = np.flatnonzero(np.append(logged, True))
    return (ahead[np.searchsorted(ahead, phase, side="right")] - phase).astype(np.int32)
