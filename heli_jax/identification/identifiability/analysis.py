"""Identifiability analysis: rank, covariance and null directions of the free parameters.

It works in relative coordinates: log |value| for parameters of one sign, value over a scale for
those that may be zero. Initial states and biases are projected out first. A null direction has a
singular value below rounding, or makes a 95 % interval that reaches further than a factor of ten.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

from heli_jax.flights.flight import labels
from heli_jax.identification.estimation.evaluation import NULL, Evaluation
from heli_jax.identification.identifiability.equivalents import Valley, row_reduced, unit_vector
from heli_jax.identification.identifiability.verdict import (
    FACTOR,
    Z95,
    Group,
    Pair,
    SecondSolution,
    Unknown,
    Verdict,
)
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import FlightUnknown, Layout, flight_unknowns

TAKES_PART = 0.01
"""component of a unit null direction from which on an unknown takes part in it"""
_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches as far as the factor"""
_SHARPER = 100.0
"""sensitivity with known nuisances over that with free ones from which on a direction is
exchangeable with nuisances"""
_DEAD = 1e-12
"""norm of a column without effect, over the largest"""
_NEAR_ZERO = 1e-2
"""value over its reference below which a parameter is in no product of powers"""
_AT_END = 1e-3
"""distance to the largest time shift, over that, of a shift at its end"""
NO_EFFECT = 1e-6
"""norm of a nuisance's column [sds of the noise] below which it is left out"""


def unknowns_of(
    problem: Problem, layout: Layout, values: Float[np.ndarray, " q"]
) -> tuple[Unknown, ...]:
    """Return the parameters of interest with their size and prior in relative coordinates.

    Args:
        values: their values, SI.
    """
    unknowns = []
    for name, value in zip(layout.of_interest, map(float, values), strict=True):
        if name in problem.free:
            u = _parameter(problem, name, value)
        elif name == "time_shift":
            # Its unit is a sample. The search is through a tanh, which approaches its end.
            at_bound = MAX_TIME_SHIFT - abs(value) < _AT_END * MAX_TIME_SHIFT
            dt = problem.training[0].dt
            u = Unknown(name, value, False, 1.0, 0.0, False, dt, at_bound=at_bound)
        else:
            u = Unknown(name, value, True, 1.0, 0.0, False, abs(value))
        unknowns.append(u)
    return tuple(unknowns)


def _parameter(problem: Problem, name: str, value: float) -> Unknown:
    """Return a free parameter of the model as an unknown."""
    free, late = problem.free[name], name in problem.model.delay_parameters
    low, high = free.lower, free.upper
    # A delay may be zero too.
    symmetric = late or transforms.changes_sign(free)
    reference, log = abs(value), True
    if low is not None and high is not None and low < 0 < high:
        reference, log = 0.5 * (high - low), False
    elif symmetric:
        # The unit of a value near zero is the size of the start; of a delay a sample at least.
        reference = max(abs(value), transforms.scale(free))
        reference = max(reference, problem.training[0].dt) if late else reference
        log = abs(value) > _NEAR_ZERO * reference
    # The scale is the prior's sd, or half the interval.
    prior, scale = reference / free.prior.sd if free.prior else 0.0, 1.0
    if prior:
        scale = 1.0 / prior
    elif log and low and high:
        scale = max(0.5 * float(np.log(high / low)), 1e-3)
    at_bound = transforms.at_bound(free, value)
    return Unknown(name, value, log, scale, prior, True, reference, symmetric, at_bound=at_bound)


class Sensitivity(NamedTuple):
    """Rows of the data at one point, columns in relative coordinates."""

    unknowns: tuple[Unknown, ...]
    """the parameters of interest"""
    shared: Float[np.ndarray, "n s"]
    """by the parameters of interest, then by the noise's parameters of filter error"""
    own: Float[np.ndarray, "n k"]
    """by initial states, biases and input offsets, in sds of their weak priors"""

    def part(self, rows: np.ndarray) -> "Sensitivity":
        """Return some of the rows."""
        return self._replace(shared=self.shared[rows], own=self.own[rows])


def sensitivity_at(problem: Problem, layout: Layout, e: Evaluation) -> Sensitivity:
    """Return the rows of the data of an evaluation."""
    unknowns, q = unknowns_of(problem, layout, e.named), len(layout.of_interest)
    J, first = np.array(e.J, dtype=np.float64), layout.first_nuisance
    slopes = np.asarray(e.slopes, dtype=np.float64)
    J[:, :q] *= relative_slopes(unknowns, slopes)
    # The last rows are the nuisances' weak priors, before them the parameters' priors; defects
    # between windows count as data.
    data = J[: J.shape[0] - (layout.size - first) - len(layout.free)]
    return Sensitivity(unknowns, data[:, :first], data[:, first:])


def relative_slopes(
    unknowns: tuple[Unknown, ...], slopes: Float[np.ndarray, " q"]
) -> Float[np.ndarray, " q"]:
    """Return the derivatives of the coordinates in z by the relative ones.

    Args:
        slopes: derivatives of the values by the coordinates in z.
    """
    relative = np.array([u.reference * u.sign for u in unknowns])
    return np.divide(relative, slopes, out=np.zeros_like(slopes), where=slopes != 0)


def projected(J: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """Return whitened rows (any, q) of the information on the unknowns with the nuisances free.

    Args:
        J: (n, q) whitened Jacobian by the unknowns.
        nuisances: (n, k) that by the nuisances, which may be dependent.
    """
    # Orthogonal factors, no normal equations: singular values down to 1e-8 of the largest count,
    # and their squares are below rounding.
    k = nuisances.shape[1]
    R = np.linalg.qr(np.hstack([nuisances, J]), mode="r")
    N, S = R[:, :k], R[:, k:]
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    spanned = left[:, singular > NULL * max(singular.max(initial=0.0), 1e-300)]
    for _ in range(2):  # the second time takes off the rounding of the first
        S = S - spanned @ (spanned.T @ S)
    return np.linalg.qr(S, mode="r")


class Directions(NamedTuple):
    """Rank and covariance of the unknowns by a whitened sensitivity."""

    singular: np.ndarray
    """(q,) 1 / sd along orthogonal directions, each unknown in units of its scale; largest first"""
    rank: int
    null: list[np.ndarray]
    """null directions, as unit vectors (q,) in relative coordinates"""
    covariance: np.ndarray
    """(q, q) in relative coordinates, without the null directions"""


def directions(rows: np.ndarray, scale: np.ndarray) -> Directions:
    """Return rank and covariance by rows (any, q), of unknowns of a size (q,)."""
    # Rows of zeros: the decomposition has all q directions.
    padded = np.vstack([rows * scale, np.zeros((scale.size, scale.size))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    kept = singular > NULL * max(singular[0], 1e-300)
    V = scale[:, None] * right[kept].T / singular[kept]
    null = [unit_vector(scale * v) for v in right[~kept]]
    return Directions(singular, int(kept.sum()), null, V @ V.T)


def without_effect(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """Return the unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    least = _DEAD * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)


def with_wide_intervals(
    null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Return the null directions, and those of unknowns whose 95 % interval by the covariance
    (q, q) spans more than the factor."""
    # Values between bounds of both signs have no factor.
    far = [
        i
        for i, u in enumerate(unknowns)
        if (u.logarithmic or u.symmetric) and covariance[i, i] > _FAR**2
    ]
    # The widest first. Its column is the regression of the others on it.
    far.sort(key=lambda i: -covariance[i, i])
    return with_new_directions(null, [covariance[:, i] for i in far])


def with_new_directions(null: list[np.ndarray], others: list[np.ndarray]) -> list[np.ndarray]:
    """Return the null directions, and those others whose largest component is in none of them."""
    for v in map(unit_vector, others):
        if all(abs(w[np.argmax(np.abs(v))]) <= TAKES_PART for w in null):
            null = [*null, v]
    return null


class Nuisances(NamedTuple):
    """Initial states, biases and input offsets, which may be exchangeable with parameters."""

    free: np.ndarray
    """(any, q) sensitivity to the unknowns with the nuisances free"""
    bounded: np.ndarray
    """(any, q) the same with the nuisances bounded by their weak priors"""
    fixed: np.ndarray
    """(any, q) the same with the nuisances known"""
    compensation: np.ndarray
    """(k, q) change of the nuisances, in sds of their weak priors, that compensates a unit of each
    unknown"""
    names: tuple[FlightUnknown, ...]
    """(k,)"""

    def exchanged(self, v: np.ndarray) -> tuple[FlightUnknown, ...]:
        """Return the nuisances that are exchangeable with a direction v (q,) of the unknowns; none
        if it is no sharper with the nuisances known."""
        known, free = (np.linalg.norm(rows @ v) for rows in (self.fixed, self.free))
        if not self.names or known < max(NULL * np.linalg.norm(self.fixed), _SHARPER * free):
            return ()
        size = np.abs(self.compensation @ v)
        moves = size > 0.1 * max(size.max(), 1e-300)
        return tuple(n for n, m in zip(self.names, moves, strict=True) if m)


_ROUGHLY = 0.5
"""relative sd above which a parameter is determined only roughly: its 95 % interval reaches further
than a factor of 2.7 to either side"""
_STRONG = 0.99
"""correlation of a pair that is named"""


class Around(NamedTuple):
    """Facts on a point that its Jacobian does not have."""

    aliased: Collection[str] = ()
    """the parameters that move a mode whose aliases fit as well"""
    second: tuple[SecondSolution, ...] = ()
    """other values that fit as well"""
    valley: Valley | None = None
    """tests combinations far from the point; without it there are none"""
    one_sided: tuple[str, ...] = ()
    """the parameters that the likelihood does not bound within the factor of ten"""
    reported: np.ndarray | None = None
    """covariance (q, q) of the reported intervals if residuals are not white, in the optimiser's
    coordinates; for `analyse` in relative ones"""


def verdict_of(
    problem: Problem, layout: Layout, e: Evaluation, around: Around = Around()
) -> Verdict:
    """Return the identifiability analysis at one point.

    Raises:
        ValueError: the simulation is not finite there.
    """
    if not bool(np.all(np.isfinite(e.J))):
        raise ValueError(
            "the simulation is not finite at the given values: the model is unstable over this "
            "record; use other start values or a shorter window"
        )
    unknowns, shared, own = sensitivity_at(problem, layout, e)
    unknowns = tuple(u._replace(aliased=u.name in around.aliased) for u in unknowns)
    q, k = len(unknowns), own.shape[1]
    R = np.linalg.qr(np.hstack([shared, own]), mode="r")
    fixed, N = R[:, :q], R[:, q:]
    seen = np.linalg.norm(N, axis=0) > NO_EFFECT
    compensation = np.zeros((N.shape[1], q))
    compensation[seen] = -np.linalg.lstsq(N[:, seen], fixed, rcond=NULL)[0]
    named = flight_unknowns(layout, labels(problem.training))
    free = projected(fixed, N[:, seen])
    # The columns of the noise's parameters come before those of the nuisances.
    seen[N.shape[1] - k :] = True
    weak = np.eye(N.shape[1])[N.shape[1] - k :]
    bounded = projected(np.vstack([fixed, np.zeros((k, q))]), np.vstack([N, weak])[:, seen])
    nuisances = Nuisances(free, bounded, fixed, compensation[N.shape[1] - k :], named)
    to_relative = np.asarray(e.slopes, np.float64) * [u.sign / u.reference for u in unknowns]
    if around.reported is not None:
        around = around._replace(reported=around.reported * np.outer(to_relative, to_relative))
    return analyse(free, unknowns, nuisances=nuisances, around=around)


def analyse(
    sensitivity: np.ndarray,
    unknowns: tuple[Unknown, ...],
    *,
    nuisances: Nuisances | None = None,
    around: Around = Around(),
) -> Verdict:
    """Return the analysis of a whitened sensitivity in relative coordinates.

    Args:
        sensitivity: (any, q) with the nuisances free, and without rows of priors. Weak priors of
            nuisances would bound a parameter that is exchangeable with a bias.
    """
    if nuisances is None:
        none = np.zeros((0, len(unknowns)))
        nuisances = Nuisances(sensitivity, sensitivity, sensitivity, none, ())
    scale, own = np.array([u.scale for u in unknowns]), np.array([u.prior for u in unknowns])
    names = [u.name for u in unknowns]
    # A prior is a row with one over its sd.
    total, data = (
        directions(np.vstack([sensitivity, np.diag(own)]), scale),
        directions(sensitivity, scale),
    )
    covariance = total.covariance
    null = with_wide_intervals(total.null, covariance, unknowns)
    if not total.null:
        # The intervals are those of the fit, which has the weak priors.
        bounded = np.vstack([nuisances.bounded, np.diag(own)])
        covariance = directions(bounded, scale).covariance
    # Directions whose intervals by the slopes are short: aliased parameters, and the regression on
    # a one-sided parameter of those that are one-sided too.
    aliased = [v for v, u in zip(np.eye(len(unknowns)), unknowns, strict=True) if u.aliased]
    open_ = np.array([u.name in around.one_sided for u in unknowns])
    one_sided = [np.where(open_, covariance[:, i], 0.0) for i in np.flatnonzero(open_)]
    null = with_new_directions(null, [*aliased, *one_sided])
    reported = covariance
    if around.reported is not None:
        reported = around.reported
        null = with_wide_intervals(null, reported, unknowns)
    # Without a null direction: those that the data alone leave.
    resting = []
    if not null and own.any():
        resting = with_wide_intervals(data.null, data.covariance, unknowns)
    dead = without_effect(nuisances.fixed, unknowns)
    groups = _groups(null, reported, unknowns, nuisances, around, dead)
    resting_groups = _groups(resting, reported, unknowns, nuisances, around)
    moved = np.abs(null).max(axis=0) if null else np.zeros(len(unknowns))
    changed = {n for other in around.second for n in other.changed}
    undetermined = [
        n for n, part in zip(names, moved, strict=True) if part > TAKES_PART or n in changed
    ]
    sds = np.sqrt(np.maximum(np.diag(reported), 0.0)).tolist()
    sizes = np.sqrt(np.diag(covariance))
    sizes = np.where(sizes > 0, sizes, 1.0)
    correlation = np.clip(covariance / np.outer(sizes, sizes), -1.0, 1.0)
    np.fill_diagonal(correlation, 1.0)
    # The data have no information on a parameter that is exchangeable with a nuisance.
    share = dict(zip(names, _prior_share(covariance, sensitivity).tolist(), strict=True))
    share |= dict.fromkeys((n for g in groups if g.exchanged for n in g.names), 1.0)
    return Verdict(
        unknowns=unknowns,
        identifiable=not (null or around.second),
        rank=total.rank,
        rank_without_priors=data.rank,
        singular_values=total.singular,
        null_directions=tuple(dict(zip(names, v.tolist(), strict=True)) for v in null),
        pairs=_pairs(correlation, names, undetermined),
        without_effect=dead,
        undetermined=tuple(undetermined),
        covariance=covariance,
        correlation=correlation,
        prior_share=share,
        groups=groups,
        resting_groups=resting_groups,
        roughly=tuple(
            u.name
            for u, sd in zip(unknowns, sds, strict=True)
            if u.name not in (*undetermined, *dead)
            and ((u.logarithmic and sd > _ROUGHLY) or (u.symmetric and Z95 * sd >= u.distance))
        ),
        second=around.second,
    )


def _groups(
    null: list[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    nuisances: Nuisances,
    around: Around,
    dead: tuple[str, ...] = (),
) -> tuple[Group, ...]:
    """Return the groups of parameters that null directions connect, but for those without effect
    (`dead`)."""
    alive = np.array([u.name not in dead for u in unknowns])
    null = [v for v in null if np.abs(v[alive]).max(initial=0.0) > TAKES_PART]
    if not null:
        return ()
    # The reduced basis of the null space has the most zeros.
    rows = np.array([unit_vector(v) for v in row_reduced(np.array(null), unknowns)[0]])
    parts = (np.abs(rows) > TAKES_PART) & alive
    rows, parts = rows[parts.any(axis=1)], parts[parts.any(axis=1)]
    count, labels = connected_components((parts @ parts.T).astype(int))
    groups = []
    for k in range(count):
        mine, members = list(rows[labels == k]), parts[labels == k].any(axis=0)
        tied = ()
        if around.valley is not None:
            tied = around.valley.determined_combinations(mine, covariance, unknowns)
        exchanged = [n for v in mine for n in nuisances.exchanged(v)]
        names = tuple(unknowns[i].name for i in np.flatnonzero(members))
        groups.append(Group(names, len(mine), tied, tuple(dict.fromkeys(exchanged))))
    return tuple(groups)


def _pairs(correlation: np.ndarray, names: list[str], undetermined: list[str]) -> tuple[Pair, ...]:
    """Return the strongly correlated pairs of parameters that are determined."""
    strong = np.argwhere(np.tril(np.abs(correlation) > _STRONG, -1)).tolist()
    pairs = [Pair(names[j], names[i], float(correlation[i, j])) for i, j in strong]
    pairs = [p for p in pairs if not {p.first, p.second} & {*undetermined}]
    return tuple(sorted(pairs, key=lambda p: -abs(p.correlation)))


def _prior_share(covariance: np.ndarray, sensitivity: np.ndarray) -> np.ndarray:
    """Return the share (q,) of the variance by priors."""
    # P = P (B'B + R) P is the sum of the parts of the data, with rows B, and of the priors R.
    variance = np.diag(covariance)
    of_data = np.sum((sensitivity @ covariance) ** 2, axis=0)
    share = 1.0 - of_data / np.where(variance > 0, variance, 1.0)
    return np.clip(np.where(variance > 0, share, 0.0), 0.0, 1.0)
