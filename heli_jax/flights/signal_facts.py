"""What a signal was as it was logged: ends at which it was cut off, its steps, where it stuck.

Taken before any resampling: a low-pass filter rounds off a flat top and fills the steps of a coarse
log, and what then looks smooth is none the better for it.
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

import numpy as np

FEW = 8
"""distinct values of a signal below which its extremes are no rails: steps between a few levels"""
_PILE = 5.0
"""times as many samples at an extreme as at the values beside it, for a rail. A sine logged in
steps has 3 times as many at its turning points as at the three values before"""
_RUN = 3
"""samples in a row at a rail, once at least"""
_VISITS = 2
"""times at least that a signal comes to a rail"""
RAIL_SHARE = 0.005
"""part of the samples at a rail from which on it is spoken of"""
_BINS = 100
"""of a signal's range: the outermost holds a rail with noise on it"""
_NOISY_SHARE = 0.02
"""part of the samples in that bin, for a rail"""
_LEVEL = 3.0
"""times as many samples beside a rail as elsewhere, at most: a motion that comes to rest by itself
slows down before, and is seen there more often"""
_FEWEST_IN_BIN = 3
"""samples of a usual bin, by which a signal passes through all of its range"""
_LATTICE = 1e-3
"""of a step, by which differences of values may miss a multiple of it: units are converted"""
_STUCK, STUCK_SECONDS = 20.0, 0.5
"""times the usual number of equal samples in a row, and time, from which on a signal is stuck"""
_AT_REST = 1e-3
"""of a usual move: what is nearer to a value before it stays there has come to it by itself"""
_REGULAR = 0.9
"""part of the runs of equal samples that are no longer than usual: a slow motion in coarse steps
has runs of any length"""
_RUNS = 20
"""runs of equal samples, from which on their usual length is known"""


@dataclass(frozen=True, eq=False)
class Rail:
    """An end of a signal's range: its value, and the times (K,) [s] of the samples there, none
    where it is no rail; `exact` where they are all of one value."""

    value: float
    times: np.ndarray
    exact: bool = True


@dataclass(frozen=True)
class Stuck:
    """One value, from the time `begin` to `end` [s], of a signal that else changes all along."""

    begin: float
    end: float
    value: float


Counts = tuple[tuple[float, int], ...]
"""values, as the log has them, and how many of each there are"""


@dataclass(frozen=True, eq=False)
class Strays:
    """Samples that may stand for no value and are kept, since nobody knows: their times (K,) [s],
    their values (K,), as the log has them, and `why` they are odd."""

    times: np.ndarray
    values: np.ndarray
    why: str

    def within(self, begin: float, end: float) -> "Strays":
        """Those from `begin` to `end` [s], with times from `begin`."""
        at = (self.times >= begin) & (self.times <= end)
        return Strays(self.times[at] - begin, self.values[at], self.why)


@dataclass(frozen=True, eq=False)
class SignalFacts:
    """Of one signal as it was logged, in SI; times count from the flight's first sample.

    Attributes:
        size: samples that there are.
        low: the lower end of its range.
        high: the upper one.
        step: of which all differences of values are multiples; 0 where there is none.
        levels: distinct values.
        moves: part of the samples that differ from the one before.
        usual: the usual time between samples [s].
        stuck: the longest time at one value, of an output while other signals change.
        marks: values that stand for none, such as -9999, as the log has them, and how many there
            were; they are missing in the flight.
        strays: samples that may stand for none, and are kept.
    """

    size: int
    low: Rail
    high: Rail
    step: float
    levels: int
    moves: float
    usual: float
    stuck: Stuck | None = None
    marks: Counts = ()
    strays: tuple[Strays, ...] = ()

    @property
    def shares(self) -> tuple[float, float]:
        """Of the samples at the lower and at the upper rail."""
        n = max(self.size, 1)
        return self.low.times.size / n, self.high.times.size / n

    def within(self, begin: float, end: float) -> "SignalFacts":
        """Of the part from `begin` to `end` [s], whose times count from `begin`; levels, steps and
        marks stay those of the whole."""

        def cut(rail: Rail) -> Rail:
            times = rail.times[(rail.times >= begin) & (rail.times <= end)]
            return replace(rail, times=times - begin)

        stuck = self.stuck
        if stuck is not None:
            inside = (max(stuck.begin, begin) - begin, min(stuck.end, end) - begin)
            longer = inside[1] - inside[0] >= STUCK_SECONDS
            stuck = Stuck(*inside, stuck.value) if longer else None
        size = min(self.size, round((end - begin) / self.usual) + 1) if self.usual > 0 else 0
        left = [inside for s in self.strays if (inside := s.within(begin, end)).times.size]
        low, high, strays = cut(self.low), cut(self.high), tuple(left)
        return replace(self, size=size, low=low, high=high, stuck=stuck, strays=strays)


def signal_facts(seconds: np.ndarray, x: np.ndarray) -> SignalFacts:
    """The facts of one signal by itself.

    Args:
        seconds: stamps (N,) [s], increasing.
        x: samples (N,), NaN where one is missing.
    """
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    if not y.size:
        none = Rail(float("nan"), np.zeros(0))
        return SignalFacts(0, none, none, 0.0, 0, 0.0, 0.0)
    # Once for all that is asked: sorting is what takes the time in a long log.
    levels, counts = np.unique(y, return_counts=True)
    low, high = _at_rails(y, y, levels, counts)
    return SignalFacts(
        size=y.size,
        low=_rail(s, y, low, float(y.min())),
        high=_rail(s, y, high, float(y.max())),
        step=_lattice(levels),
        levels=levels.size,
        moves=float(np.mean(np.diff(y) != 0)) if y.size > 1 else 0.0,
        usual=float(np.median(np.diff(s))) if s.size > 1 else 0.0,
    )


def _rail(seconds: np.ndarray, x: np.ndarray, at: np.ndarray, end: float) -> Rail:
    return Rail(end, seconds[at], bool(np.all(x[at] == end)))


def facts_of_all[K: Hashable](
    signals: Mapping[K, tuple[np.ndarray, np.ndarray]], outputs: frozenset[K]
) -> dict[K, SignalFacts]:
    """The facts of signals that were logged together, stuck outputs among them.

    Args:
        signals: stamps (N,) [s] and samples (N,) by key.
        outputs: keys of those that a machine cannot hold still.
    """
    # Differences of huge values overflow, and no more is known of such signals then.
    with np.errstate(over="ignore", invalid="ignore"):
        facts = {key: signal_facts(s, x) for key, (s, x) in signals.items()}
        for key in outputs:
            stuck = _stuck(*signals[key], facts[key])
            others = (one for other, one in signals.items() if other != key)
            # A machine that stands on the ground holds everything still, and no sensor is stuck.
            if stuck is not None and any(_changes(*other, stuck) for other in others):
                facts[key] = replace(facts[key], stuck=stuck)
    return facts


def _stuck(seconds: np.ndarray, x: np.ndarray, facts: SignalFacts) -> Stuck | None:
    """The longest time at one value, where that is out of all proportion."""
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    begins = np.flatnonzero(np.r_[True, y[1:] != y[:-1]])
    lengths = np.diff(np.r_[begins, y.size])
    if lengths.size < _RUNS:
        return None
    usual = float(np.median(lengths))
    if np.mean(lengths <= 1.5 * usual) < _REGULAR:
        return None
    # What rests at a rail is told as such.
    rails = [rail.value for rail in (facts.low, facts.high) if rail.times.size]
    lengths = np.where(np.isin(y[begins], rails), 0, lengths)
    i = int(np.argmax(lengths))
    begin, end = float(s[begins[i]]), float(s[begins[i] + max(lengths[i], 1) - 1])
    if lengths[i] < _STUCK * usual or end - begin < STUCK_SECONDS:
        return None
    # A simulated signal without noise comes to rest within the last digit.
    moves = np.abs(np.diff(y))
    before = moves[begins[i] - 1] if begins[i] else np.inf
    if before < _AT_REST * np.median(moves[moves > 0]):
        return None
    return Stuck(begin, end, float(y[begins[i]]))


def _changes(seconds: np.ndarray, x: np.ndarray, stuck: Stuck) -> bool:
    inside = x[(seconds >= stuck.begin) & (seconds <= stuck.end) & np.isfinite(x)]
    return np.unique(inside).size > 1


def at_rails(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which samples (N,) are at the lower and at the upper rail; none where there is no rail."""
    finite = x[np.isfinite(x)]
    return _at_rails(x, finite, *np.unique(finite, return_counts=True))


def _at_rails(
    x: np.ndarray, finite: np.ndarray, levels: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if levels.size < FEW:
        none = np.zeros(x.shape, bool)
        return none, none
    return _at_top(-x, -finite, counts), _at_top(x, finite, counts[::-1])


def _at_top(x: np.ndarray, finite: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The samples at the largest value, or near it, where that is a rail.

    Args:
        x: samples (N,), NaN where one is missing.
        finite: those that are not.
        counts: by distinct value, the largest first.
    """
    top = finite.max()
    # Beside the values next to it also those of all the signal: random steps are held unequally.
    usual = max(float(counts[1:4].mean()), float(np.median(counts[1:])))
    piled = counts[0] > _PILE * usual and counts[0] >= RAIL_SHARE * finite.size
    if piled and _comes_and_goes(finite == top):
        return x == top
    edge = _noisy_edge(finite)
    if edge is not None and _comes_and_goes(finite >= edge):
        return np.isfinite(x) & (x >= edge)
    return np.zeros(x.shape, bool)


def _comes_and_goes(at: np.ndarray) -> bool:
    """Whether samples at an end of a range are visits to it, and not where a signal rests."""
    if at[0] and at[-1]:
        return False
    edges = np.diff(np.concatenate([[0], at.astype(int), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return bool(begins.size >= _VISITS and (ends - begins).max() >= _RUN)


def _noisy_edge(x: np.ndarray) -> float | None:
    """Where the rail at the upper end begins, that has less noise than a hundredth of the range.

    A converter behind what was cut off adds its own noise, and no two samples are equal then.
    """
    top, span = float(x.max()), float(np.ptp(x))
    if not 0 < span < np.inf:
        return None
    counts = np.histogram((top - x) / span, bins=_BINS, range=(0.0, 1.0))[0]
    usual = float(np.median(counts[1:-1]))
    beside = float(counts[1:4].mean())
    piled = counts[0] > _PILE * max(beside, usual) and counts[0] >= _NOISY_SHARE * x.size
    level = usual >= _FEWEST_IN_BIN and beside <= _LEVEL * usual
    return top - span / _BINS if piled and level else None


def quantum(x: np.ndarray) -> float:
    """The step of which all differences of values (N,) are multiples; 0 if there is none."""
    return _lattice(np.unique(x[np.isfinite(x)]))


def _lattice(levels: np.ndarray) -> float:
    if levels.size < 2:
        return 0.0
    steps = np.diff(levels)
    # Smaller differences are rounding of one value.
    steps = steps[steps > 1e-9 * (levels[-1] - levels[0])]
    if not steps.size or not np.isfinite(steps).all():  # of huge values
        return 0.0
    step = float(steps.min())
    multiples = steps / step
    whole = np.abs(multiples - np.round(multiples)) <= _LATTICE * multiples
    return step if bool(np.all(whole)) else 0.0
