"""What the likelihood itself says of parameters that the slopes at an optimum tell poorly.

An optimum of a record that tells little is one of chance: its slopes may bound a parameter that
the likelihood, a little further off, does not. So the parameters with wide intervals are moved to
the ends of these, the others follow, and the likelihood that is lost is compared with what the
slopes let expect.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import (
    measured_count,
    residual_and_jacobian,
)
from heli_jax.identification.identifiability.sensitivity import unknowns_of, verdict_of
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.initial_guess import weak_unknowns
from heli_jax.identification.unknowns.layout import Solution, value_of

# Where the likelihood along one parameter ends an interval: all others at their best.
#
# The slopes at an optimum say how far a parameter goes while little of the likelihood is lost. Here
# it is moved there, the others follow by Levenberg and Marquardt, and the deviance is computed.


_AS_EXPECTED = 1.15
"""factor by which the root of the deviance may differ from what the slopes say: the interval of the
slopes is then as wide as that of the likelihood within about as much"""
_ENOUGH = 0.05
"""squares that a further step may promise where a search stops"""
_STEPS = 10
"""of Levenberg and Marquardt at most for each point"""
_RIDGE = 1.0 / 3.0
"""one over how far a step may go, in coordinates most of which are logarithms, for nothing"""
_HUGE = 1e50
_OUTWARDS, _POINTS = 1.7, 7
"""factor from one point of a profile to the next further out, and how many there are to a side"""


class Inside(NamedTuple):
    """A point along an open parameter that is as likely as those within an interval."""

    z: np.ndarray
    """(q,)"""
    left: float
    """part of the interval of any other parameter that it leaves to that, 0 to 1"""


class Point(NamedTuple):
    """The best that is found with some coordinates held."""

    z: np.ndarray
    squares: float
    """sum of them, less what a further step promises; infinite where nothing is found"""


def follow(at: Solution, z: np.ndarray, held: np.ndarray) -> Point:
    """From z (q,) to the smallest sum of squares with the coordinates held (q,) where they are."""
    moving = ~held
    ridge = _RIDGE
    now = _rows_at(at, z)
    squares, promised = squares_of(now.r), math.inf
    for _ in range(_STEPS):
        J = now.J[:, moving]
        # Past that the squares of a simulation that has diverged are no numbers.
        if not (squares < _HUGE and np.abs(J).max(initial=0.0) < _HUGE):
            return Point(now.z, math.inf)
        Q, R = np.linalg.qr(J)
        left = -(Q.T @ now.r)
        damped = np.vstack([R, ridge * np.eye(len(R))])
        target = np.concatenate([left, np.zeros(len(R))])
        part = np.linalg.lstsq(damped, target, rcond=None)[0]
        promised = float(left @ left - np.sum((left - R @ part) ** 2))
        if promised < _ENOUGH:
            break
        step = np.zeros(z.size)
        step[moving] = part
        then = _rows_at(at, now.z + step)
        gained = squares - squares_of(then.r)
        # Negated: also what is not finite is no step.
        if gained > 0:
            now, squares, ridge = then, squares - gained, max(_RIDGE, ridge / 10.0)
        elif ridge > _RIDGE * 1e4:
            break
        else:
            ridge *= 10.0
    return Point(now.z, squares - promised)


class _Rows(NamedTuple):
    """All that a step needs of a point: the simulation in time would cost some methods more."""

    z: Float[np.ndarray, " q"]
    r: Float[np.ndarray, " n"]
    J: Float[np.ndarray, "n q"]


def _rows_at(at: Solution, z: np.ndarray) -> _Rows:
    there = jnp.asarray(z, at.z.dtype)
    made = residual_and_jacobian(at.layout, at.data, at.noise, there)
    each = jax.device_get((there, made.r, made.J))
    return _Rows(*(np.asarray(v, np.float64) for v in each))


def squares_of(r: np.ndarray) -> float:
    r = np.asarray(r, np.float64)
    with np.errstate(all="ignore"):
        return float(r @ r)


def deviance_of(at: Solution, first: float, squares: float) -> float:
    """Twice the log-likelihood between two sums of squares, none where the second is smaller."""
    if not math.isfinite(squares):
        return math.inf
    # What a further step promises may be all there is.
    if squares <= 0.0:
        return 0.0
    n = measured_count(at.data)
    deviance = at.layout.estimator.deviance(at.layout, squares / n, first / n, n)
    return max(0.0, float(deviance))


class End(NamedTuple):
    """One end of an interval."""

    value: float
    as_expected: bool
    """whether it is where the slopes have it"""


class Profile(NamedTuple):
    """The likelihood along one parameter, all others at their best."""

    problem: Problem
    at: Solution
    e: Evaluation
    """at the optimum"""
    i: int
    u: Unknown
    along: np.ndarray
    """(q,) column of the covariance: how the others go with it to first order"""
    reach: float
    """root of the deviance at the ends of the interval"""
    certain: float
    """root of the deviance that has to be exceeded at a factor of ten"""
    inside: list[Inside]
    """what was visited and is as likely as what is within the interval"""

    def ends(self) -> tuple[End, End] | None:
        """Both ends; None where one of them is not within the factor of ten."""
        low = self.end(-1)
        high = self.end(1) if low is not None else None
        return None if low is None or high is None else (low, high)

    def end(self, side: int) -> End | None:
        """The end of the interval towards smaller (-1) or larger (1) coordinates; None where
        the likelihood does not bound the parameter within the factor of ten."""
        sd = math.sqrt(float(self.along[self.i]))
        z0, first = np.asarray(self.at.z, np.float64), squares_of(self.e.r)
        t = self.reach * sd
        furthest = self._furthest(side)
        seen, guess = [(0.0, 0.0)], z0
        tangent = self._ahead(self.along / self.along[self.i])
        for k in range(_POINTS):
            t = min(t, furthest)
            guess = guess + tangent * (z0[self.i] + side * t - guess[self.i])
            point = follow(self.at, guess, np.arange(z0.size) == self.i)
            root = math.sqrt(deviance_of(self.at, first, point.squares))
            if k == 0 and 1.0 / _AS_EXPECTED < root / self.reach < _AS_EXPECTED:
                return End(self._value(z0[self.i] + side * t), True)
            if math.isfinite(root):
                seen.append((t, root))
            if root < self.reach:
                self.inside.append(Inside(point.z, self._left(root)))
                if t >= furthest:
                    return self._at_limit(side)
                # The direction in which the others went last is where they go on.
                tangent = self._ahead((point.z - z0) / (point.z[self.i] - z0[self.i]))
                guess, t = point.z, t * _OUTWARDS
                above = [s for s, r in seen if r >= self.reach]
                if above:
                    t = 0.5 * (min(above) + point.z[self.i] * side - z0[self.i] * side)
            elif root < _AS_EXPECTED * self.reach or k == _POINTS - 1:
                break
            else:
                inside = max(s for s, r in seen if r < self.reach)
                guess, tangent = z0, self._ahead(self.along / self.along[self.i])
                t = max(0.5 * (t + inside), t * self.reach / root) if root < math.inf else 0.5 * t
        # A likelihood that levels off is no bound, wherever it passes the limit: an optimum of
        # chance is one among many places where the noise may have put it.
        z = guess + tangent * (z0[self.i] + side * furthest - guess[self.i])
        point = follow(self.at, z, np.arange(z0.size) == self.i)
        if deviance_of(self.at, first, point.squares) < self.certain**2:
            self.inside.append(Inside(point.z, 0.0))
            return self._at_limit(side)
        return End(self._value(z0[self.i] + side * self._crossing(seen)), False)

    def _ahead(self, tangent: np.ndarray) -> np.ndarray:
        """A tangent (q,) along which to guess the next point."""
        layout = self.at.layout
        if not (layout.filtered and layout.concentrated):
            return tangent
        # All sizes are relative to the noise behind a filter, which may be next to nothing: they
        # go by it together, as far as their limits, from where no slope leads back.
        ahead = tangent.copy()
        ahead[[layout.disturbance_at(name) for name in layout.sizes]] = 0.0
        return ahead

    def _left(self, root: float) -> float:
        """What part of an interval is left where so much of the likelihood is lost already."""
        return math.sqrt(max(0.0, 1.0 - (root / self.reach) ** 2))

    def _crossing(self, seen: list[tuple[float, float]]) -> float:
        """Where the root of the deviance passes the reach: nearly a straight line."""
        inside = max(s for s in seen if s[1] < self.reach)
        beyond = [s for s in seen if s[1] >= self.reach and s[0] > inside[0]]
        if not beyond:
            return inside[0]
        outside = min(beyond)
        share = (self.reach - inside[1]) / (outside[1] - inside[1])
        return inside[0] + share * (outside[0] - inside[0])

    def _furthest(self, side: int) -> float:
        """Distance in the coordinate to a factor of ten, or to a bound."""
        free, value = self.problem.free[self.u.name], self.u.value
        size = abs(value) / self.u.distance if self.u.distance else abs(value)
        rising = float(self.e.slopes[self.i]) > 0
        up = rising == (side > 0)
        if self.u.symmetric:
            # Away from zero a factor, as for all; towards it as far on its other side.
            outwards = up == (value > 0)
            far = math.log(FACTOR) * size
            target = value + (far if up else -far)
            if outwards and abs(value) > 0.3 * size:
                target = value * FACTOR
        else:
            target = value * FACTOR if up == (value > 0) else value / FACTOR
        low, high = transforms.limits(free)
        width = high - low if math.isfinite(high - low) else abs(value)
        target = min(max(target, low + 1e-6 * width), high - 1e-6 * width)
        data, kind = self.at.data, self.at.layout.kinds[self.i]
        limits = (data.sign[self.i], data.low[self.i], data.high[self.i])
        z = float(transforms.to_coordinate(kind, target, *limits))
        return abs(z - float(self.at.z[self.i]))

    def _at_limit(self, side: int) -> End | None:
        """Beyond the furthest point: a bound that was stated bounds it, a factor of ten does
        not."""
        value = self._value(float(self.at.z[self.i]) + side * self._furthest(side))
        if transforms.at_bound(self.problem.free[self.u.name], value):
            return End(value, False)
        return None

    def _value(self, z: float) -> float:
        return float(value_of(self.at.layout, self.at.data, self.i, jnp.asarray(z)))


_WIDE, _WIDE_IN_A_VALLEY = 0.2, 0.1
"""sd in relative coordinates, as intervals are reported, from which on the likelihood is asked: of
any parameter, and of one that lies along a valley with another"""
_VALLEY = 0.9
"""correlation beyond which two parameters lie along a valley, which bends"""
_INFLATED = 1.5
"""factor by which autocorrelated residuals may make intervals wider"""
_TOGETHER = 0.99
"""correlation beyond which what is open of one parameter is open of the other"""
_SINGULAR = 0.999
"""correlation beyond which the valley is so long that chance has put the optimum along it"""
_BY_CHANCE = 1e-3
"""probability that initial states which are those of rest gain as much of the likelihood"""
_REST = 1e-6
"""initial states below this, in sds of their weak priors, are those of rest already"""

Limits = Mapping[str, tuple[float, float]]


class BeyondSlopes(NamedTuple):
    """What slopes at the optimum do not tell."""

    limits: Limits = MappingProxyType({})
    """by parameter the ends of its 95 % interval by the likelihood, in the parameter's unit, where
    those by the slopes are others"""
    one_sided: tuple[str, ...] = ()
    """parameters that the likelihood does not bound within the factor of ten to either side"""
    null: tuple[np.ndarray, ...] = ()
    """directions (q,) in relative coordinates that are open with the initial states at rest, where
    the data cannot tell them from that"""


AS_SLOPES = BeyondSlopes()


def beyond_slopes(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    verdict: Verdict,
    reaches: np.ndarray,
) -> BeyondSlopes:
    """Asks the likelihood of the parameters whose intervals are wide.

    Args:
        problem: with bounds and priors.
        at: the optimum.
        e: what it tells.
        verdict: what the data determine by the slopes there.
        reaches: (q,) sds of white residuals that a 95 % interval of each unknown reaches.
    """
    lacking = {*verdict.undetermined, *verdict.without_effect}
    wide = _wide(problem, at, e, verdict, reaches)
    if not wide or not (np.isfinite(e.r).all() and np.isfinite(e.J).all()):
        return AS_SLOPES
    null = _open_at_rest(problem, at, e, lacking, reaches)
    opened = {n for v in null for n, part in zip(verdict.names, v, strict=True) if abs(part) > 0.1}
    # What is open already goes along with anything, and tells nothing of where the others go.
    inverse = _inverse(e, verdict.names, lacking)
    limits, one_sided, along = {}, [], []
    for i, u in wide:
        # What goes along with one that is open to a side is open with it.
        if u.name in opened or _goes_with(verdict, i, one_sided):
            one_sided += [u.name] * (u.name not in opened)
            continue
        reach, far = _levels(verdict, i, len(wide))
        column, white = inverse @ inverse[i], float(reaches[i])
        profile = Profile(problem, at, e, i, u, column, reach * white, far * white, [])
        ends = profile.ends()
        if ends is None:
            one_sided.append(u.name)
            along += profile.inside
        elif not all(end.as_expected for end in ends):
            low, high = sorted(end.value for end in ends)
            limits[u.name] = (low, high)
    # Also those that were asked before the one that is open, or were too narrow to be asked.
    open_ended = tuple(one_sided)
    one_sided += [
        n
        for i, n in enumerate(verdict.names)
        if n in problem.free
        and n not in {*one_sided, *opened, *lacking}
        and _goes_with(verdict, i, open_ended)
    ]
    if along:
        # Where what is open stays. What was asked itself went along with it already.
        still = _inverse(e, verdict.names, {*lacking, *one_sided})
        n = len(verdict.names)
        distances = np.linalg.norm(still, axis=1)[:n] * reaches[:n]
        gone = {*one_sided, *opened, *lacking, *(u.name for _, u in wide)}
        each = zip(verdict.names, distances.tolist(), strict=True)
        limits |= _reaching(at, e, along, {name: d for name, d in each if name not in gone})
    limits = {n: ends for n, ends in limits.items() if n not in one_sided}
    return BeyondSlopes(limits, tuple(one_sided), tuple(null))


def _wide(
    problem: Problem, at: Solution, e: Evaluation, verdict: Verdict, reaches: np.ndarray
) -> list[tuple[int, Unknown]]:
    """The parameters that the likelihood is asked of, by their place among the unknowns."""
    sd = np.sqrt(np.maximum(np.diag(verdict.covariance), 0.0))
    n = len(sd)
    related = np.abs(np.where(np.eye(n), 0.0, verdict.correlation)).max(1, initial=0.0)
    # A disturbance makes intervals wide, of which it is said elsewhere, and leaves a likelihood of
    # white residuals that means little.
    asked = (reaches[:n] < _INFLATED * Z95) | (related > _TOGETHER)
    least = np.where(related > _VALLEY, _WIDE_IN_A_VALLEY, _WIDE)
    lacking = {*verdict.undetermined, *verdict.without_effect}
    return [
        (i, u)
        for i, u in enumerate(unknowns_of(problem, at.layout, e))
        if u.name in problem.free
        and (u.logarithmic or u.symmetric)
        and not (u.name in lacking or u.at_bound)
        and asked[i]
        and (sd[i] * reaches[i] > Z95 * least[i] or _may_vanish(problem, u, sd[i] * reaches[i]))
    ]


def _inverse(e: Evaluation, names: Sequence[str], open_: set[str]) -> Float[np.ndarray, "q k"]:
    """A root of the covariance of all unknowns by the slopes, without those that are open."""
    R = np.linalg.qr(np.asarray(e.J, np.float64), mode="r")
    R[:, [i for i, n in enumerate(names) if n in open_]] = 0.0
    # Columns of one size: beside one that is larger by far another would count as none at all.
    norms = np.linalg.norm(R, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return np.linalg.pinv(R / norms, rcond=1e-10) / norms[:, None]


def _goes_with(verdict: Verdict, i: int, names: Sequence[str]) -> bool:
    """Whether an unknown lies along one valley with any of those named."""
    at = [verdict.names.index(n) for n in names]
    return bool(np.abs(verdict.correlation[i, at]).max(initial=0.0) > _TOGETHER)


def _levels(verdict: Verdict, i: int, count: int) -> tuple[float, float]:
    """Factors to the reach of a parameter, one of so many that are asked: of its interval, and of
    what has to be lost at a factor of ten."""
    # Several that go together along one valley have as many ways to fit the noise: their intervals
    # are those that hold for all of them at once.
    together = math.sqrt(scipy.special.chdtri(count, 0.05)) / Z95
    others = np.abs(np.delete(verdict.correlation[i], i)).max(initial=0.0)
    certain = math.sqrt(scipy.special.chdtri(count, _BY_CHANCE)) / Z95
    return together, certain if others > _SINGULAR else together


def _may_vanish(problem: Problem, u: Unknown, reach: float) -> bool:
    """Whether an interval that reaches so far holds zero, and its parameter may be there.

    What acts through a parameter that may be zero may act not at all: slopes beside it bound what
    the likelihood there does not.
    """
    low, high = transforms.limits(problem.free[u.name])
    return u.symmetric and low < 0.0 < high and reach >= u.distance


def _reaching(
    at: Solution,
    e: Evaluation,
    along: list[Inside],
    reach: Mapping[str, float],
) -> dict[str, tuple[float, float]]:
    """Intervals that hold where the others go along a parameter that is open, if they do not yet.

    A slope tells how far a parameter goes where the open one stays; along with it, it may go as far
    as that does.

    Args:
        at: the optimum.
        e: what it tells.
        along: what is as likely as what is within an interval.
        reach: by parameter, from the optimum to the ends of its interval by slopes, in the
            optimiser's coordinate.
    """
    intervals = {}
    for name, distance in reach.items():
        i = at.layout.of_interest.index(name)

        def value(z: float, i: int = i) -> float:
            if i >= len(at.layout.kinds):
                # No parameter of the model: its coordinate is itself in other units.
                return float(e.named[i] + e.slopes[i] * (z - float(at.z[i])))
            return float(value_of(at.layout, at.data, i, jnp.asarray(z)))

        middle = float(at.z[i])
        known = (value(middle - distance), value(middle + distance))
        there = [value(float(p.z[i]) + side * p.left * distance) for p in along for side in (-1, 1)]
        low, high = min(*known, *there), max(*known, *there)
        if low < min(known) or high > max(known):
            intervals[name] = (low, high)
    return intervals


def _open_at_rest(
    problem: Problem, at: Solution, e: Evaluation, lacking: set[str], reaches: np.ndarray
) -> list[np.ndarray]:
    """Directions that nothing but initial states of chance determine.

    A transient is as large as the initial states that the fit has found, and so is what it tells
    of the parameters. Where the data do not tell these states from rest, it may as well be none.
    """
    layout = at.layout
    if not layout.estimator.nuisances_in_rows or any(count > 1 for count, _ in layout.windows):
        return []
    kinds = np.array([w.kind for w in weak_unknowns(problem, layout)])
    held = np.zeros(layout.size, bool)
    held[layout.first_nuisance :] = kinds == "initial_state"
    z = np.asarray(at.z, np.float64)
    if not (np.abs(z[held]) > _REST).any():
        return []
    point = follow(at, np.where(held, 0.0, z), held)
    deviance = deviance_of(at, squares_of(e.r), point.squares)
    # Autocorrelated residuals let chance gain more.
    wider = max(1.0, float(np.median(reaches[held])) / Z95)
    if deviance > wider**2 * scipy.special.chdtri(int(held.sum()), _BY_CHANCE):
        return []
    e = evaluate(layout, at.data, at.noise, jnp.asarray(point.z, at.z.dtype))
    if not np.isfinite(e.J).all():
        return []
    there = verdict_of(problem, layout, e)
    return [
        np.array([v[n] for n in there.names])
        for v in there.null_directions
        if not lacking & {n for n, part in v.items() if abs(part) > 0.1}
    ]
