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

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.identifiability.ends_by_likelihood import (
    Inside,
    Profile,
    deviance_of,
    follow,
    squares_of,
)
from heli_jax.identification.identifiability.sensitivity import unknowns_of, verdict_of
from heli_jax.identification.identifiability.verdict import Z95, Unknown, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution, value_of
from heli_jax.identification.unknowns.nuisances import weak_unknowns

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
