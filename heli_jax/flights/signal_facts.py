"""Facts of a signal as it was logged: clipped ends, stuck parts.

They are computed before any resampling, because a low-pass filter rounds a clipped top.
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

import numpy as np

_PILE = 5.0
"""Ratio of samples at an extreme to samples at the values beside it, for a rail. A sine logged in
steps has a ratio of 3."""
FEW = 8
"""Fewest distinct values of a signal with rails; the extremes of a step signal are none."""
_RUN = 3
"""Samples in a row at a rail, at least once."""
_VISITS = 2
"""Fewest visits to a rail."""
RAIL_SHARE = 0.005
"""Smallest share of samples at a rail that is reported."""
_STUCK, STUCK_SECONDS = 20.0, 0.5
"""Length of a stuck part: ratio to the usual number of equal samples, and time [s]."""
_AT_REST = 1e-3
"""Largest last move before a rest by itself, relative to the usual move."""
_REGULAR = 0.9
"""Smallest share of runs of equal samples with the usual length. A slow motion in coarse steps has
runs of any length."""
_TURNS = 0.3
"""Share of a signal's moves that reverse, above which its noise is as large as its steps."""
_TIMES = 5.0
"""Ratio to such a signal's longest usual run, above which it is stuck."""
_DROPS, DROP_SHARE = 5, 0.01
"""Visits of a value, and share of samples at it, from which on they are dropouts."""
_TRIFLE = 0.2
"""Smallest sd of another signal while one is stuck, relative to its usual sd."""
_RUNS = 20
"""Fewest runs of equal samples from which their usual length is known."""


@dataclass(frozen=True, eq=False)
class Rail:
    """A value at which a signal is clipped, or to which it drops repeatedly.

    `times` (K,) [s] are those of its samples there; none if an end of the range is no rail.
    """

    value: float
    times: np.ndarray


@dataclass(frozen=True)
class Stuck:
    """One value, from `begin` to `end` [s], of a signal that otherwise changes all the time."""

    begin: float
    end: float
    value: float


@dataclass(frozen=True, eq=False)
class SignalFacts:
    """Facts of one signal as it was logged, in SI; times count from the flight's first sample.

    Attributes:
        size: number of samples.
        low: lower end of its range.
        high: upper end.
        usual: usual time between samples [s].
        stretches: times at one value, of an output while other signals move; the longest first.
        dropouts: value to which an output jumps from anywhere.
    """

    size: int
    low: Rail
    high: Rail
    usual: float
    stretches: tuple[Stuck, ...] = ()
    dropouts: Rail | None = None

    @property
    def stuck(self) -> Stuck | None:
        """The longest time at one value."""
        return self.stretches[0] if self.stretches else None

    @property
    def dropped(self) -> float:
        """Share of the samples that are dropouts."""
        return 0.0 if self.dropouts is None else self.dropouts.times.size / max(self.size, 1)

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of the samples at the lower and at the upper rail."""
        n = max(self.size, 1)
        return self.low.times.size / n, self.high.times.size / n

    def within(self, begin: float, end: float) -> "SignalFacts":
        """Return the facts of the part from `begin` to `end` [s], with times from `begin`."""

        def cut(rail: Rail) -> Rail:
            times = rail.times[(rail.times >= begin) & (rail.times <= end)]
            return replace(rail, times=times - begin)

        inside = [
            Stuck(max(one.begin, begin) - begin, min(one.end, end) - begin, one.value)
            for one in self.stretches
            if one.begin < end and one.end > begin
        ]
        inside = [one for one in inside if one.end - one.begin >= STUCK_SECONDS]
        drops = None if self.dropouts is None else cut(self.dropouts)
        size = min(self.size, round((end - begin) / self.usual) + 1) if self.usual > 0 else 0
        return replace(
            self,
            size=size,
            low=cut(self.low),
            high=cut(self.high),
            stretches=tuple(sorted(inside, key=lambda one: one.begin - one.end)),
            dropouts=drops if drops and drops.times.size else None,
        )


def signal_facts(seconds: np.ndarray, x: np.ndarray) -> SignalFacts:
    """Return the facts of one signal by itself."""
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    if not y.size:
        none = Rail(float("nan"), np.zeros(0))
        return SignalFacts(0, none, none, 0.0)
    levels, counts = np.unique(y, return_counts=True)
    none = np.zeros(y.shape, bool)
    few = levels.size < FEW
    low, high = (none, none) if few else (_at_top(-y, counts), _at_top(y, counts[::-1]))
    return SignalFacts(
        size=y.size,
        low=Rail(float(y.min()), s[low]),
        high=Rail(float(y.max()), s[high]),
        usual=float(np.median(np.diff(s))) if s.size > 1 else 0.0,
    )


def facts_of_all[K: Hashable](
    signals: Mapping[K, tuple[np.ndarray, np.ndarray]], outputs: frozenset[K]
) -> dict[K, SignalFacts]:
    """Return the facts of signals that were logged together, with stuck outputs."""
    # Differences of huge values overflow; fewer facts of such signals are known.
    with np.errstate(over="ignore", invalid="ignore"):
        facts = {key: signal_facts(s, x) for key, (s, x) in signals.items()}
        for key in outputs:
            others = [one for other, one in signals.items() if other != key]
            # A vehicle on the ground holds every signal constant, and no sensor is stuck.
            found = [
                one
                for one in _stretches(*signals[key], facts[key])
                if any(_goes_on(*other, one.begin, one.end) for other in others)
            ]
            drops = _dropouts(*signals[key])
            facts[key] = replace(facts[key], stretches=tuple(found), dropouts=drops)
    return facts


def _stretches(seconds: np.ndarray, x: np.ndarray, facts: SignalFacts) -> list[Stuck]:
    """Return the times at one value that are unusually long, the longest first."""
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    moves = np.diff(y)
    begins = np.flatnonzero(np.r_[True, moves != 0])
    lengths = np.diff(np.r_[begins, y.size])
    if lengths.size < _RUNS:
        return []
    # A rest at a rail is reported as a rail.
    rails = [rail.value for rail in (facts.low, facts.high) if rail.times.size]
    lengths = np.where(np.isin(y[begins], rails), 0, lengths)
    usual = float(np.median(lengths))
    least = _STUCK * usual
    if np.mean(lengths <= 1.5 * usual) < _REGULAR:
        ways = np.sign(moves[moves != 0])
        # A slow motion in coarse steps may stay for any time. Noise as large as the steps reverses
        # often and ends each run by chance.
        if np.mean(ways[1:] != ways[:-1]) < _TURNS:
            return []
        # Runs that contain 99 % of the time, without those that are stuck.
        ordered = np.sort(lengths[lengths < least])
        spent = np.cumsum(ordered) / ordered.sum()
        least = max(least, _TIMES * float(ordered[int(np.searchsorted(spent, 0.99))]))
    move, stuck = float(np.median(np.abs(moves[moves != 0]))), []
    for i in np.flatnonzero(lengths >= least):
        first, last = begins[i], begins[i] + lengths[i] - 1
        # A simulated signal without noise comes to rest within the last digit.
        rests = first > 0 and abs(moves[first - 1]) < _AT_REST * move
        if not rests and s[last] - s[first] >= STUCK_SECONDS:
            stuck.append(Stuck(float(s[first]), float(s[last]), float(y[first])))
    return sorted(stuck, key=lambda one: one.begin - one.end)


def _goes_on(seconds: np.ndarray, x: np.ndarray, begin: float, end: float) -> bool:
    """True if another signal moves from `begin` to `end` [s] about as it usually does."""
    seen = np.isfinite(x)
    inside = x[(seconds >= begin) & (seconds <= end) & seen]
    return inside.size > 1 and float(np.std(inside)) >= _TRIFLE * float(np.std(x[seen]))


def _dropouts(seconds: np.ndarray, x: np.ndarray) -> Rail | None:
    """Return the value to which a signal repeatedly jumps from anywhere."""
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    levels, counts = np.unique(y, return_counts=True)
    if levels.size < _RUNS:
        return None
    k = int(np.argmax(counts))
    if k in (0, levels.size - 1):  # a rail
        return None
    near = np.r_[counts[max(k - 5, 0) : k], counts[k + 1 : k + 6]]
    gap = np.min(np.abs(np.diff(levels[max(k - 1, 0) : k + 2])))
    at = y == levels[k]
    into = np.flatnonzero(at[1:] & ~at[:-1])
    # A motion reaches a value by way of its neighbours.
    jumps = np.abs(y[into] - levels[k])
    # The longest visit does not count, because a stuck signal does not return.
    edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0]))
    many = counts[k] - int(np.max(edges[1::2] - edges[::2]))
    often = into.size >= _DROPS and many >= max(DROP_SHARE * y.size, 5.0 * near.max())
    moves = np.abs(np.diff(y))
    far = max(5.0 * float(gap), 0.3 * float(np.median(moves[moves > 0])))
    if not often or float(np.median(jumps)) < far:
        return None
    return Rail(float(levels[k]), s[at])


def _at_top(x: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return a mask of the samples (N,) at the largest value, if that is a rail.

    `counts` are those of each value, the largest value first.
    """
    # Compared with all values too, because random steps are held for unequal times.
    usual = max(float(counts[1:4].mean()), float(np.median(counts[1:])))
    piled = counts[0] > _PILE * usual and counts[0] >= RAIL_SHARE * x.size
    # A rail has repeated visits to the end of the range, unlike a signal at rest.
    at = x == x.max()
    edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0])).reshape(-1, 2)
    visits = len(edges) >= _VISITS and np.diff(edges).max() >= _RUN and not (at[0] and at[-1])
    return at & (piled and visits)
