"""Where the likelihood along one parameter ends an interval: all others at their best.

The slopes at an optimum say how far a parameter goes while little of the likelihood is lost. Here
it is moved there, the others follow by Levenberg and Marquardt, and the deviance is computed.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import (
    measured_count,
    residual_and_jacobian,
)
from heli_jax.identification.identifiability.verdict import FACTOR, Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution, value_of

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
