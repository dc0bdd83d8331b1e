"""Profile likelihood: the likelihood along one parameter with all other unknowns at their best.

A parameter is held at values further and further from the optimum. Its 95 % interval ends where the
deviance (twice the loss of log-likelihood, priors included) passes the point of chi-squared. A fit
does this for each parameter whose interval by the slopes is wide: the slopes at the optimum of a
record with little information may bound a parameter that the likelihood does not.
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special

from heli_jax.identification.estimation.evaluation import Evaluation, pseudoinverse
from heli_jax.identification.estimation.levenberg_marquardt import (
    measured_count,
    optimise,
    residual_and_jacobian,
)
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution, value_of

_REACHES = (3.0, 9.0)
"""standard deviations to either side of a requested profile; the second if the first does not hold
the whole interval"""
_POINTS = 13
"""of such a profile; odd, so that the optimum is one of them"""
_STEPS = 20
"""evaluations of one search"""
_OUTWARDS = (0.35, 0.6, 1.0, 1.7, 2.9, 4.9, 8.4, 14.0, 24.0, 41.0)
"""points of a search for an interval's end, over the end by the slopes"""
_AS_EXPECTED = 1.15
"""factor by which the root of the deviance may differ from the slopes' without a search"""
_WIDE = 0.15
"""relative sd of an estimate from which on its likelihood is profiled"""
_INFLATED = 1.5
"""largest factor by which autocorrelated residuals may widen an interval that is profiled: beyond
it, the likelihood of white residuals means little"""


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
    """Return the profile of a free parameter, for white residuals."""
    i = at.layout.free.index(name)
    made = residual_and_jacobian(*at)
    line = _line(at, float(made.cost), np.asarray(made.J), i)
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
    """Return the distance at which the signed root of the deviance passes the limit."""
    seen = np.isfinite(root)
    root, t = root[seen], t[seen]
    order = np.argsort(root)
    return float(np.interp(limit, root[order], t[order], left=math.nan, right=math.nan))


class _Line(NamedTuple):
    """The line along which one unknown is moved and the others follow."""

    at: Solution
    i: int
    tangent: np.ndarray
    """(q,) change of all unknowns by a unit of this one, to first order"""
    sd: float
    """of the unknown's coordinate"""
    cost: float
    """of the optimum, see `Optimum`"""

    def roots(self, side: int, distances: Iterable[float]) -> Iterator[tuple[float, float]]:
        """Yield distances from the optimum to one side, each with the root of the deviance there.

        Each search begins on the line through the optimum and the point before.
        """
        z0 = np.asarray(self.at.z, np.float64)
        held, guess, tangent = np.arange(z0.size) == self.i, z0, self.tangent
        for t in distances:
            guess = guess + tangent * (z0[self.i] + side * t - guess[self.i])
            found = optimise(*self.at[:3], guess, _STEPS, held=held)
            guess = np.asarray(found.z, np.float64)
            if t > 0.0:
                tangent = (guess - z0) / (guess[self.i] - z0[self.i])
            yield t, math.sqrt(self._deviance(found.cost))

    def _deviance(self, cost: float) -> float:
        """Return the deviance at a cost; zero where it is below that of the optimum."""
        if not math.isfinite(cost):
            return math.inf
        return max(0.0, measured_count(self.at.data) * (cost - self.cost))

    def value(self, distance: float) -> float:
        """Return the parameter, in its unit."""
        z = jnp.asarray(float(self.at.z[self.i]) + distance)
        return float(value_of(self.at.layout, self.at.data, self.i, z))


def _line(at: Solution, cost: float, J: np.ndarray, i: int) -> _Line:
    """Return the line along unknown i, by the cost and the Jacobian at the optimum."""
    inverse = pseudoinverse(J)
    along = inverse @ inverse[i]
    cost = cost / measured_count(at.data)
    return _Line(at, i, along / along[i], math.sqrt(along[i]), cost)


def profile_wide_intervals(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    verdict: Verdict,
    reaches: np.ndarray,
) -> tuple[dict[str, tuple[float, float]], tuple[str, ...]]:
    """Profile the parameters whose intervals are wide.

    Args:
        reaches: (q,) sds of white residuals that a 95 % interval of each unknown reaches.

    Returns:
        95 % intervals of parameters for which the likelihood is not quadratic, and parameters that
        it does not bound within the factor of ten.
    """
    if not (np.isfinite(e.r).all() and np.isfinite(e.J).all()):
        return {}, ()
    lacking = verdict.not_identifiable
    sds = np.sqrt(np.maximum(np.diag(verdict.covariance), 0.0))
    # Unknowns that the data leave open follow any other unknown.
    J = np.array(e.J, np.float64)
    J[:, [i for i, n in enumerate(verdict.names) if n in lacking]] = 0.0
    wide = [
        (i, u)
        for i, u in enumerate(verdict.unknowns)
        if not (u.name in lacking or u.at_bound or reaches[i] >= _INFLATED * Z95)
        and _is_wide(problem, u, float(sds[i] * reaches[i]))
    ]
    # Simultaneous intervals: single ones of three wide parameters covered 85 % (50 of 59 records).
    together = math.sqrt(scipy.special.chdtri(max(len(wide), 1), 0.05)) / Z95
    limits, one_sided = {}, []
    for i, u in wide:
        reach = together * float(reaches[i])
        line = _line(at, e.cost, J, i)
        ends = [_end(problem, line, e, u, side, reach) for side in (-1, 1)]
        bounded = [t for t in ends if t is not None]
        if len(bounded) < 2:
            one_sided.append(u.name)
        elif any(abs(t) != reach * line.sd for t in bounded):
            low, high = sorted(line.value(t) for t in bounded)
            limits[u.name] = (low, high)
    return limits, tuple(one_sided)


def _is_wide(problem: Problem, u: Unknown, reach: float) -> bool:
    """True if an interval reaches far, or holds zero."""
    if u.name not in problem.free or not (u.logarithmic or u.symmetric):
        return False
    low, high = transforms.limits(problem.free[u.name])
    # A parameter that acts through one that may be zero may have no effect there.
    holds_zero = u.symmetric and low < 0.0 < high and reach >= u.distance
    return holds_zero or reach > Z95 * _WIDE


def _end(
    problem: Problem, line: _Line, e: Evaluation, u: Unknown, side: int, reach: float
) -> float | None:
    """Return the distance at which the root of the deviance passes `reach`, negative to that side;
    None if it does not within the factor of ten, and no stated bound ends the interval."""
    up = (float(e.slopes[line.i]) > 0) == (side > 0)
    outwards = up == (u.value > 0)
    target = u.value * FACTOR if outwards else u.value / FACTOR
    if u.symmetric:
        step = math.log(FACTOR) * u.reference
        step = max(step, (FACTOR - 1.0) * abs(u.value)) if outwards else step
        target = u.value + (step if up else -step)
    free = problem.free[u.name]
    low, high = transforms.limits(free)
    width = high - low if math.isfinite(high - low) else abs(u.value)
    target = min(max(target, low + 1e-6 * width), high - 1e-6 * width)
    z = float(transforms.coordinates(free, line.at.layout.kinds[line.i], target))
    furthest = abs(z - float(line.at.z[line.i]))
    expected, inside = reach * line.sd, (0.0, 0.0)
    for t, root in line.roots(side, (min(factor * expected, furthest) for factor in _OUTWARDS)):
        if t == expected and 1.0 / _AS_EXPECTED < root / reach < _AS_EXPECTED:
            return side * t
        if root >= reach:
            share = (reach - inside[1]) / (root - inside[1])
            return side * (inside[0] + share * (t - inside[0]))
        if t >= furthest:
            return side * t if transforms.at_bound(free, target) else None
        inside = (t, root)
    return None
