"""Profile likelihood: what a parameter may be when all others adapt to it.

One parameter is held at values further and further from the optimum, all other unknowns follow, and
the deviance (twice the log-likelihood that is lost, priors included) ends its interval where it
passes the point of chi-squared. A fit asks so of each parameter whose interval by the slopes is
wide: an optimum of a record that tells little is one of chance, and its slopes may bound a
parameter that the likelihood, a little further off, does not.
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special

from heli_jax.identification.estimation.evaluation import Evaluation, evaluate, pseudoinverse
from heli_jax.identification.estimation.levenberg_marquardt import measured_count
from heli_jax.identification.identifiability.analysis import Around, unknowns_of, verdict_of
from heli_jax.identification.identifiability.equivalents import (
    Rows,
    descend,
    rows_at,
    squares_of,
)
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution, flight_places, value_of

_REACHES = (3.0, 9.0)
"""standard deviations to either side of a profile that is asked for; the second only where the
first holds no whole interval"""
_POINTS = 13
"""of such a profile; odd, so that the optimum is one of them"""
_OUTWARDS = (0.35, 0.6, 1.0, 1.7, 2.9, 4.9, 8.4, 14.0, 24.0, 41.0)
"""the points of a search for an interval's end, over the end by the slopes"""
_AS_EXPECTED = 1.15
"""factor by which the root of the deviance may differ from what the slopes say: the interval of the
slopes is then as wide as that of the likelihood within about as much"""
_WIDE, _WIDE_IN_A_VALLEY = 0.2, 0.1
"""sd in relative coordinates, as intervals are reported, from which on the likelihood is asked: of
any parameter, and of one that lies along a valley with another, which bends"""
_VALLEY = 0.9
"""correlation beyond which two parameters lie along a valley"""
_INFLATED = 1.5
"""factor by which autocorrelated residuals may make intervals wider: beyond, a disturbance does,
and the likelihood of white residuals means little"""
_BY_CHANCE = 1e-3
"""probability that initial states which are those of rest gain as much of the likelihood"""
_REST = 1e-6
"""initial states below this, in sds of their weak priors, are those of rest already"""


class Profile(NamedTuple):
    """The likelihood along one parameter, everything else at its best there."""

    values: np.ndarray
    """(k,) in the parameter's unit, rising in size"""
    deviance: np.ndarray
    """(k,) twice the log-likelihood lost (priors included); NaN where nothing finite was found"""
    lower95: float
    upper95: float
    """where the deviance passes 3.84; NaN where it does not within nine standard deviations"""


def profile(at: Solution, name: str) -> Profile:
    """Return the profile of a free parameter; white residuals are taken for granted."""
    i = at.layout.free.index(name)
    line = _line(at, rows_at(at, at.z), i)
    for reach in _REACHES:
        t = np.linspace(-reach, reach, _POINTS) * line.sd
        left = [root for _, root in line.roots(-1, -t[t < 0][::-1])][::-1]
        right = [root for _, root in line.roots(1, t[t > 0])]
        root = np.array([-r for r in left] + [0.0] + right)
        root = np.where(np.isfinite(root), root, np.nan)
        z = [_crossing(root, t, side * Z95) for side in (-1, 1)]
        values = np.array([line.value(float(d)) for d in (*z, *t)])
        # Negative parameters fall as their logarithm rises; what is missing comes last.
        bounds = sorted(values[:2].tolist(), key=lambda v: (np.isnan(v), v))
        if np.isfinite(bounds).all():
            break
    return Profile(values[2:], root**2, *bounds)


def _crossing(root: np.ndarray, t: np.ndarray, limit: float) -> float:
    """Return the distance at which the signed root of the deviance, nearly a straight line, passes
    the limit."""
    seen = np.isfinite(root)
    root, t = root[seen], t[seen]
    order = np.argsort(root)
    return float(np.interp(limit, root[order], t[order], left=math.nan, right=math.nan))


class _Line(NamedTuple):
    """The way along which one unknown is moved, and the others follow."""

    at: Solution
    i: int
    tangent: np.ndarray
    """(q,) change of all unknowns by a unit of this one, to first order"""
    sd: float
    """of the unknown's coordinate"""
    squares: float
    """at the optimum"""

    def roots(self, side: int, distances: Iterable[float]) -> Iterator[tuple[float, float]]:
        """Yield distances from the optimum to one side, each with the root of the deviance there.

        Each point is sought from the one before, where the line through that and the optimum goes.
        """
        z0 = np.asarray(self.at.z, np.float64)
        moving, guess, tangent = np.arange(z0.size) != self.i, z0, self.tangent
        for t in distances:
            guess = guess + tangent * (z0[self.i] + side * t - guess[self.i])
            guess, squares = descend(lambda z: rows_at(self.at, z), guess, moving)
            if t > 0.0:
                tangent = (guess - z0) / (guess[self.i] - z0[self.i])
            yield t, math.sqrt(deviance_of(self.at, self.squares, squares))

    def value(self, distance: float) -> float:
        """Return the parameter, in its unit."""
        z = jnp.asarray(float(self.at.z[self.i]) + distance)
        return float(value_of(self.at.layout, self.at.data, self.i, z))


def _line(at: Solution, here: Rows, i: int) -> _Line:
    """Return the line along unknown i."""
    inverse = pseudoinverse(here.J)
    along = inverse @ inverse[i]
    return _Line(at, i, along / along[i], math.sqrt(along[i]), squares_of(here.r))


def deviance_of(at: Solution, first: float, squares: float) -> float:
    """Return twice the log-likelihood between two sums of squares; none where the second is
    smaller."""
    if not math.isfinite(squares):
        return math.inf
    # What a further step promises may be all there is.
    if squares <= 0.0:
        return 0.0
    n = measured_count(at.data)
    # The cost is a mean over n. With the scale concentrated out it is the variance, whose logarithm
    # counts.
    cost, least = squares / n, first / n
    deviance = n * (np.log(cost / least) if at.layout.concentrated else cost - least)
    return max(0.0, float(deviance))


def beyond_slopes(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    verdict: Verdict,
    reaches: np.ndarray,
    around: Around,
) -> Around:
    """Ask the likelihood of the parameters whose intervals are wide; `around` itself where there
    are none.

    Args:
        reaches: (q,) sds of white residuals that a 95 % interval of each unknown reaches.
    """
    lacking = verdict.not_identifiable
    sds = np.sqrt(np.maximum(np.diag(verdict.covariance), 0.0))
    related = np.abs(np.where(np.eye(len(sds)), 0.0, verdict.correlation)).max(1, initial=0.0)
    least = Z95 * np.where(related > _VALLEY, _WIDE_IN_A_VALLEY, _WIDE)
    wide = [
        (i, u)
        for i, u in enumerate(unknowns_of(problem, at.layout, e))
        if not (u.name in lacking or u.at_bound or reaches[i] >= _INFLATED * Z95)
        and _is_wide(problem, u, float(sds[i] * reaches[i]), float(least[i]))
    ]
    if not wide or not (np.isfinite(e.r).all() and np.isfinite(e.J).all()):
        return around
    null = _open_at_rest(problem, at, e, lacking, reaches)
    opened = {n for v in null for n, part in zip(verdict.names, v, strict=True) if abs(part) > 0.1}
    # What is open already goes along with anything, and tells nothing of where the others go.
    J = np.array(e.J, np.float64)
    J[:, [i for i, n in enumerate(verdict.names) if n in lacking]] = 0.0
    # Several that go together along one valley have as many ways to fit the noise: their intervals
    # are those that hold for all of them at once.
    together = math.sqrt(scipy.special.chdtri(len(wide), 0.05)) / Z95
    limits, one_sided = {}, []
    for i, u in wide:
        if u.name in opened:
            continue
        line = _line(at, Rows(np.asarray(e.r), J), i)
        reach = together * float(reaches[i])
        ends = [_end(problem, line, e, u, side, reach) for side in (-1, 1)]
        bounded = [t for t in ends if t is not None]
        if len(bounded) < 2:
            one_sided.append(u.name)
        elif any(abs(t) != reach * line.sd for t in bounded):
            low, high = sorted(line.value(t) for t in bounded)
            limits[u.name] = (low, high)
    return around._replace(limits=limits, one_sided=tuple(one_sided), null=tuple(null))


def _is_wide(problem: Problem, u: Unknown, reach: float, least: float) -> bool:
    """True if the likelihood is asked of an unknown whose interval reaches so far."""
    if u.name not in problem.free or not (u.logarithmic or u.symmetric):
        return False
    # What acts through a parameter that may be zero may act not at all: slopes beside zero bound
    # what the likelihood there does not.
    low, high = transforms.limits(problem.free[u.name])
    may_vanish = u.symmetric and low < 0.0 < high and reach >= u.distance
    return may_vanish or reach > least


def _end(
    problem: Problem, line: _Line, e: Evaluation, u: Unknown, side: int, reach: float
) -> float | None:
    """Return the distance at which the root of the deviance passes `reach`, negative to that side;
    None where that is not within the factor of ten, and no stated bound ends the interval."""
    expected, furthest = reach * line.sd, _furthest(problem, line, e, u, side)
    [(t, root)] = line.roots(side, [min(expected, furthest)])
    if 1.0 / _AS_EXPECTED < root / reach < _AS_EXPECTED:
        return side * t
    inside, outside = (0.0, 0.0), (furthest, math.inf)

    def outwards() -> Iterator[float]:
        for factor in _OUTWARDS:
            yield min(factor * expected, furthest)
            if outside[1] < math.inf or inside[0] >= furthest:
                break
        # Once more where a straight line has the end.
        yield between()
        # A likelihood that levels off is no bound, wherever it passes the limit: an optimum of
        # chance is one among many places where the noise may have put it.
        if outside[0] < furthest:
            yield furthest

    def between() -> float:
        share = (reach - inside[1]) / (outside[1] - inside[1])
        return inside[0] + share * (outside[0] - inside[0])

    for t, root in line.roots(side, outwards()):
        if root < reach and t >= furthest:
            # A bound that was stated bounds it, a factor of ten does not.
            bounded = transforms.at_bound(problem.free[u.name], line.value(side * furthest))
            return side * furthest if bounded else None
        if root < reach:
            inside = (t, root)
        elif t < outside[0]:
            outside = (t, root)
    return side * between()


def _furthest(problem: Problem, line: _Line, e: Evaluation, u: Unknown, side: int) -> float:
    """Return the distance in the coordinate to a factor of ten, or to a bound."""
    up = (float(e.slopes[line.i]) > 0) == (side > 0)
    outwards = up == (u.value > 0)
    target = u.value * FACTOR if outwards else u.value / FACTOR
    if u.symmetric:
        # Towards zero as far on its other side; away from it a factor too, where that is further.
        step = math.log(FACTOR) * u.reference
        step = max(step, (FACTOR - 1.0) * abs(u.value)) if outwards else step
        target = u.value + (step if up else -step)
    low, high = transforms.limits(problem.free[u.name])
    width = high - low if math.isfinite(high - low) else abs(u.value)
    target = min(max(target, low + 1e-6 * width), high - 1e-6 * width)
    at, i = line.at, line.i
    limits = (at.data.sign[i], at.data.low[i], at.data.high[i])
    z = float(transforms.to_coordinate(at.layout.kinds[i], target, *limits))
    return abs(z - float(at.z[i]))


def _open_at_rest(
    problem: Problem, at: Solution, e: Evaluation, lacking: frozenset[str], reaches: np.ndarray
) -> list[np.ndarray]:
    """Return directions that nothing but initial states of chance determine: open with the initial
    states at rest, where the data cannot tell them from that.

    A transient is as large as the initial states that the fit has found, and so is what it tells
    of the parameters. Where the data do not tell these states from rest, it may as well be none.
    """
    layout = at.layout
    if layout.noise_model == "spectrum" or any(count > 1 for count, _ in layout.windows):
        return []
    held = np.zeros(layout.size, bool)
    for places in flight_places(layout):
        held[places.states] = True
    z = np.asarray(at.z, np.float64)
    if not (np.abs(z[held]) > _REST).any():
        return []
    rest, squares = descend(lambda z: rows_at(at, z), np.where(held, 0.0, z), ~held)
    deviance = deviance_of(at, squares_of(e.r), squares)
    # Autocorrelated residuals let chance gain more.
    wider = max(1.0, float(np.median(reaches[held])) / Z95)
    if deviance > wider**2 * scipy.special.chdtri(int(held.sum()), _BY_CHANCE):
        return []
    e = evaluate(layout, at.data, at.noise, jnp.asarray(rest, at.z.dtype))
    if not np.isfinite(e.J).all():
        return []
    there = verdict_of(problem, layout, e)
    return [
        np.array([v[n] for n in there.names])
        for v in there.null_directions
        if not lacking & {n for n, part in v.items() if abs(part) > 0.1}
    ]
