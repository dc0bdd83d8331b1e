"""Values that a logger repeats for a moment while the sensor goes on: the next one is far off."""

import numpy as np

_SINGLE = 0.9
"""part of the values that stand once: of a signal that repeats more of them by itself runs say
nothing"""
_CHANCE = 1e-3
"""runs in a record that chance may make so long"""
_SHORTEST = 4.0
"""samples at least"""
_LEAVES = 0.5, 3.0
"""of a usual move, by which a noisy signal, and a smooth one, leaves a value that was repeated"""
_COMES = 0.1
"""of a usual move, by which a smooth signal comes to it: what comes to rest by itself moves less"""
_STEPS = 3.0
"""steps of the log, that these moves are at least: in coarse ones a slow motion stays and jumps"""
_TRIFLE = 0.2
"""of its usual deviation or move, by which another signal has to move while one is stuck"""


def short_holds(y: np.ndarray, begins: np.ndarray, noisy: bool, step: float) -> np.ndarray:
    """Which runs (R,) of equal samples are too long, and end too far off, to be chance.

    Args:
        y: samples (N,), none missing.
        begins: where the runs begin (R,).
        noisy: whether every move turns back as often as it goes on.
        step: of which all differences of values are multiples; 0 where there is none.
    """
    lengths = np.diff(np.r_[begins, y.size])
    moves = np.abs(np.diff(y))
    single, double = (int(np.count_nonzero(lengths == n)) for n in (1, 2))
    if single < _SINGLE * lengths.size or not moves.any():
        return np.zeros(lengths.size, bool)
    # By how many values are repeated once, how long a run chance makes.
    again = max(double / (single + double), 1.0 / lengths.size)
    by_chance = 1.0 + np.log(_CHANCE / lengths.size) / np.log(again)
    usual = float(np.median(moves[moves > 0]))
    into = moves[begins[1:] - 1]
    # A record that begins or ends so says nothing of what was before or comes after.
    comes, leaves = np.r_[0.0, into], np.r_[into, 0.0]
    far = leaves >= max(_LEAVES[0 if noisy else 1] * usual, _STEPS * step)
    if not noisy:
        far &= comes >= max(_COMES * usual, _STEPS * step)
    return (lengths >= max(_SHORTEST, by_chance)) & far


def goes_on(seconds: np.ndarray, x: np.ndarray, begin: float, end: float, brief: float) -> bool:
    """Whether another signal moves from `begin` to `end` [s] about as it does all along.

    Args:
        seconds: stamps (N,) [s].
        x: samples (N,), NaN where one is missing.
        begin: of the hold.
        end: of it.
        brief: time [s] below which a signal goes no way, and its moves from sample to sample count.
    """
    seen = np.isfinite(x)
    inside = x[(seconds >= begin) & (seconds <= end) & seen]
    if inside.size < 2:
        return False
    if float(np.std(inside)) >= _TRIFLE * float(np.std(x[seen])):
        return True
    moves = np.abs(np.diff(x[seen]))
    if end - begin >= brief or not moves.any():
        return False
    return float(np.median(np.abs(np.diff(inside)))) >= _TRIFLE * float(np.median(moves[moves > 0]))
