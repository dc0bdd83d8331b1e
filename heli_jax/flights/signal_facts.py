"""Facts of a signal as it was logged: clipped ends, steps, stuck parts.

Taken before any resampling: a low-pass filter rounds off a flat top and fills the steps of a coarse
log, and what then looks smooth is none the better for it.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from heli_jax.flights.marks import Strays

_PILE = 5.0
"""times as many samples at an extreme as at the values beside it, for a rail. A sine logged in
steps has 3 times as many at its turning points as at the three values before"""
FEW = 8
"""distinct values of a signal below which its extremes are no rails: steps between a few levels"""
_RUN = 3
"""samples in a row at a rail, once at least"""
_VISITS = 2
"""times at least that a signal comes to a rail"""
RAIL_SHARE = 0.005
"""part of the samples at a rail from which on it is spoken of"""
_LATTICE = 1e-3
"""of a step, by which differences of values may miss a multiple of it: units are converted"""
_STUCK, STUCK_SECONDS = 20.0, 0.5
"""times the usual number of equal samples in a row, and time, from which on a signal is stuck"""
_AT_REST = 1e-3
"""of a usual move: what is nearer to a value before it stays there has come to it by itself"""
_OFTEN = 3
"""times at one value that need last so long together alone"""
_REGULAR = 0.9
"""part of the runs of equal samples that are no longer than usual: a slow motion in coarse steps
has runs of any length"""
_TURNS = 0.3
"""part of a signal's moves that go back, from which on its noise is as large as its steps"""
_TIMES = 5.0
"""times the longest usual run of such a signal, from which on it is stuck"""
_DROPS, DROP_SHARE = 5, 0.01
"""visits of a value, and part of the samples at it, from which on they are dropouts"""
_TRIFLE = 0.2
"""of its usual deviation or move, by which another signal has to move while one is stuck"""
_RUNS = 20
"""runs of equal samples, from which on their usual length is known"""


@dataclass(frozen=True, eq=False)
class Rail:
    """A value at which a signal is cut off, or to which it drops again and again, and the times
    (K,) [s] of its samples there; none where an end of its range is no rail.
    """

    value: float
    times: np.ndarray


@dataclass(frozen=True)
class Stuck:
    """One value, from the time `begin` to `end` [s], of a signal that else changes all along."""

    begin: float
    end: float
    value: float


@dataclass(frozen=True, eq=False)
class SignalFacts:
    """Facts of one signal as it was logged, in SI; times count from the flight's first sample.

    Attributes:
        size: samples that there are.
        low: the lower end of its range.
        high: the upper one.
        step: of which all differences of values are multiples; 0 where there is none.
        levels: distinct values.
        moves: part of the samples that differ from the one before.
        usual: the usual time between samples [s].
        stretches: times at one value, of an output while other signals move; the longest first.
        dropouts: where an output jumps to one value from anywhere.
        strays: samples that may stand for none, and are kept.
    """

    size: int
    low: Rail
    high: Rail
    step: float
    levels: int
    moves: float
    usual: float
    stretches: tuple[Stuck, ...] = ()
    dropouts: Rail | None = None
    strays: tuple[Strays, ...] = ()

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
        """Return the facts of the part from `begin` to `end` [s], with times from `begin`;
        levels and steps stay those of the whole."""

        def cut(rail: Rail) -> Rail:
            times = rail.times[(rail.times >= begin) & (rail.times <= end)]
            return replace(rail, times=times - begin)

        inside = [
            Stuck(max(one.begin, begin) - begin, min(one.end, end) - begin, one.value)
            for one in self.stretches
            if one.begin < end and one.end > begin
        ]
        stretches = _that_count(inside, end - begin)
        drops = None if self.dropouts is None else cut(self.dropouts)
        size = min(self.size, round((end - begin) / self.usual) + 1) if self.usual > 0 else 0
        strays = (s.within(begin, end) for s in self.strays)
        return replace(
            self,
            size=size,
            low=cut(self.low),
            high=cut(self.high),
            stretches=stretches,
            dropouts=drops if drops and drops.times.size else None,
            strays=tuple(s for s in strays if s.times.size),
        )


def signal_facts(seconds: np.ndarray, x: np.ndarray) -> SignalFacts:
    """The facts of one signal by itself."""
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    if not y.size:
        none = Rail(float("nan"), np.zeros(0))
        return SignalFacts(0, none, none, 0.0, 0, 0.0, 0.0)
    # Once for all that is asked: sorting is what takes the time in a long log.
    levels, counts = np.unique(y, return_counts=True)
    none = np.zeros(y.shape, bool)
    few = levels.size < FEW
    low, high = (none, none) if few else (_at_top(-y, counts), _at_top(y, counts[::-1]))
    return SignalFacts(
        size=y.size,
        low=Rail(float(y.min()), s[low]),
        high=Rail(float(y.max()), s[high]),
        step=_lattice(levels),
        levels=levels.size,
        moves=float(np.mean(np.diff(y) != 0)) if y.size > 1 else 0.0,
        usual=float(np.median(np.diff(s))) if s.size > 1 else 0.0,
    )


def facts_of_all[K: Hashable](
    signals: Mapping[K, tuple[np.ndarray, np.ndarray]], outputs: frozenset[K]
) -> dict[K, SignalFacts]:
    """The facts of signals that were logged together, stuck outputs among them."""
    # Differences of huge values overflow, and no more is known of such signals then.
    with np.errstate(over="ignore", invalid="ignore"):
        facts = {key: signal_facts(s, x) for key, (s, x) in signals.items()}
        for key in outputs:
            others = [one for other, one in signals.items() if other != key]
            # A vehicle that stands on the ground holds everything still, and no sensor is stuck.
            found = [
                one
                for one in _stretches(*signals[key], facts[key])
                if any(_goes_on(*other, one.begin, one.end) for other in others)
            ]
            counted = _that_count(found, facts[key].size * facts[key].usual)
            drops = _dropouts(*signals[key])
            facts[key] = replace(facts[key], stretches=counted, dropouts=drops)
    return facts


def _stretches(seconds: np.ndarray, x: np.ndarray, facts: SignalFacts) -> list[Stuck]:
    """The times at one value that are out of all proportion."""
    seen = np.isfinite(x)
    s, y = seconds[seen], x[seen]
    moves = np.diff(y)
    begins = np.flatnonzero(np.r_[True, moves != 0])
    lengths = np.diff(np.r_[begins, y.size])
    if lengths.size < _RUNS:
        return []
    # What rests at a rail is told as such.
    rails = [rail.value for rail in (facts.low, facts.high) if rail.times.size]
    lengths = np.where(np.isin(y[begins], rails), 0, lengths)
    usual = float(np.median(np.abs(moves[moves != 0])))
    stuck, noisy = [], _turns(moves) >= _TURNS
    for i in np.flatnonzero(lengths >= _longest_by_itself(lengths, moves)):
        first, last = begins[i], begins[i] + lengths[i] - 1
        one = Stuck(float(s[first]), float(s[last]), float(y[first]))
        # A simulated signal without noise comes to rest within the last digit.
        rests = first > 0 and abs(moves[first - 1]) < _AT_REST * usual
        # What has no noise may rest for a while without being stuck.
        if not rests and (noisy or one.end - one.begin >= STUCK_SECONDS):
            stuck.append(one)
    return stuck


def _goes_on(seconds: np.ndarray, x: np.ndarray, begin: float, end: float) -> bool:
    """True where another signal moves from `begin` to `end` [s] about as it does all along."""
    seen = np.isfinite(x)
    inside = x[(seconds >= begin) & (seconds <= end) & seen]
    if inside.size < 2:
        return False
    if float(np.std(inside)) >= _TRIFLE * float(np.std(x[seen])):
        return True
    # Within so short a time a signal goes no way, and its moves from sample to sample count.
    moves = np.abs(np.diff(x[seen]))
    if end - begin >= STUCK_SECONDS or not moves.any():
        return False
    return float(np.median(np.abs(np.diff(inside)))) >= _TRIFLE * float(np.median(moves[moves > 0]))


def _that_count(stuck: Sequence[Stuck], duration: float) -> tuple[Stuck, ...]:
    """The longest first of those that last; all, where short ones take a share of a record [s]."""
    total = sum(one.end - one.begin for one in stuck)
    often = len(stuck) >= _OFTEN and total >= max(STUCK_SECONDS, DROP_SHARE * duration)
    counted = [one for one in stuck if often or one.end - one.begin >= STUCK_SECONDS]
    return tuple(sorted(counted, key=lambda one: one.begin - one.end))


def _turns(moves: np.ndarray) -> float:
    """The part of a signal's moves that go back."""
    ways = np.sign(moves[moves != 0])
    return float(np.mean(ways[1:] != ways[:-1])) if ways.size > 1 else 0.0


def _longest_by_itself(lengths: np.ndarray, moves: np.ndarray) -> float:
    """The number of samples in a row from which on a signal does not stay at one value by itself;
    inf where it may for any time."""
    least = _STUCK * float(np.median(lengths))
    if np.mean(lengths <= 1.5 * float(np.median(lengths))) >= _REGULAR:
        return least
    # A slow motion in coarse steps has runs of any length; noise as large as the steps turns back
    # at every other one, and ends each run by chance.
    if _turns(moves) < _TURNS:
        return np.inf
    # The runs in which all but a hundredth of the time is spent, those that are stuck left out.
    ordered = np.sort(lengths[lengths < least])
    spent = np.cumsum(ordered) / ordered.sum()
    return max(least, _TIMES * float(ordered[int(np.searchsorted(spent, 0.99))]))


def _dropouts(seconds: np.ndarray, x: np.ndarray) -> Rail | None:
    """The value to which a signal jumps from anywhere, again and again."""
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
    # What comes to a value by itself comes by way of its neighbours.
    jumps = np.abs(y[into] - levels[k])
    # Once stuck there is no coming back: the longest visit does not count.
    edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0]))
    many = counts[k] - int(np.max(edges[1::2] - edges[::2]))
    often = into.size >= _DROPS and many >= max(DROP_SHARE * y.size, 5.0 * near.max())
    moves = np.abs(np.diff(y))
    far = max(5.0 * float(gap), 0.3 * float(np.median(moves[moves > 0])))
    if not often or float(np.median(jumps)) < far:
        return None
    return Rail(float(levels[k]), s[at])


def _at_top(x: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return a mask of the samples (N,) at the largest value, where that is a rail; `counts` of
    each value, the largest first."""
    # Beside the values next to it also those of all the signal: random steps are held unequally.
    usual = max(float(counts[1:4].mean()), float(np.median(counts[1:])))
    piled = counts[0] > _PILE * usual and counts[0] >= RAIL_SHARE * x.size
    # Visits to the end of the range, and not a signal at rest.
    at = x == x.max()
    edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0])).reshape(-1, 2)
    visits = len(edges) >= _VISITS and np.diff(edges).max() >= _RUN and not (at[0] and at[-1])
    return at & (piled and visits)


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
