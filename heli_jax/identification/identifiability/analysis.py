"""The identifiability analysis: what the data determine of the free parameters, and what not.

Everything is done in relative coordinates: log |value| for parameters of one sign, value over a
scale for those that may be zero. Initial states and biases are projected out first.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.combinations import combinations, row_reduced
from heli_jax.identification.identifiability.directions import (
    TAKES_NO_PART,
    TAKES_PART,
    WithoutWeakPriors,
    directions,
    unit_vector,
    with_further,
    with_too_wide,
    without_effect,
)
from heli_jax.identification.identifiability.equivalents import Valley
from heli_jax.identification.identifiability.sentences import sentences
from heli_jax.identification.identifiability.verdict import (
    FACTOR,
    ROUGHLY,
    Z95,
    Combination,
    Group,
    Pair,
    SecondSolution,
    Unknown,
    Verdict,
    Weakest,
    connected,
)

ILL_CONDITIONED = 1e4
"""condition number above which the verdict warns: the data determine all, some of it hardly"""
STRONG = 0.99
"""correlation beyond which the verdict names a pair; rank alone does not show it (a stand's damping
and the flybar's have correlation 1.00000 and full rank)"""


class Around(NamedTuple):
    """What is known of points other than the one whose slopes are asked."""

    aliased: Collection[str] = ()
    """the parameters that move a mode which the samples do not tell from its aliases"""
    second: tuple[SecondSolution, ...] = ()
    """other values that fit as well"""
    valley: Valley | None = None
    """tells which combinations are the same far from the point; else its slopes are believed"""
    null: tuple[np.ndarray, ...] = ()
    """directions (q,) in relative coordinates that are open at another point as likely"""
    one_sided: tuple[str, ...] = ()
    """the parameters that the likelihood does not bound within the factor of ten"""
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """by parameter the ends of its 95 % interval by the likelihood, where the slopes have others"""
    combined: bool = True
    """whether combinations have numbers at all"""

    def tied(
        self, null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
    ) -> tuple[Combination, ...]:
        """Return what is determined along null directions, as `combinations` has it."""
        if not self.combined:
            return ()
        asked = self.valley.tied if self.valley is not None else combinations
        return asked(null, covariance, unknowns)


NOTHING_ELSE = Around()


def analyse(
    sensitivity: np.ndarray,
    unknowns: tuple[Unknown, ...],
    *,
    without_weak: WithoutWeakPriors | None = None,
    reported: np.ndarray | None = None,
    around: Around = NOTHING_ELSE,
    remedies: Mapping[str, str] = MappingProxyType({}),
    switches: Iterable[str] = (),
) -> Verdict:
    """Return the verdict from a whitened sensitivity in relative coordinates.

    Args:
        sensitivity: (any, q) with the nuisances free but for their weak priors. Priors of the
            unknowns are no rows of it; they come with the unknowns.
        unknowns: (q,) what the columns are.
        without_weak: the same without the weak priors, which count as data where it is not given.
        reported: covariance (q, q) of the intervals that are reported, in relative coordinates,
            where it is not that of white residuals: these must not reach further than the factor
            either.
        remedies: by name of an unknown, a further way out that the model offers.
    """
    bare = sensitivity if without_weak is None else without_weak.sensitivity
    scale, own = np.array([u.scale for u in unknowns]), np.array([u.prior for u in unknowns])
    # The rank is that without the weak priors: they give every nuisance a finite interval, and so
    # would lend one to each parameter that a bias or an initial state can take the place of.
    # A prior is a measurement of the parameter itself: a row with one over its sd.
    total, data = directions(np.vstack([bare, np.diag(own)]), scale), directions(bare, scale)
    null, covariance = total.not_determined, total.covariance
    if not null:
        # All is determined: the intervals are those of the fit, which has the weak priors.
        covariance = directions(np.vstack([sensitivity, np.diag(own)]), scale, 0.0).covariance
    null = _null(null, (total.covariance, covariance, reported), unknowns, around)
    # Two lists: what nothing determines is an error of the experiment, what rests on a prior is a
    # number that the prior has put there, and its combinations have no prior in them.
    resting = []
    if not null and own.any():
        resting = with_too_wide(data.not_determined, data.covariance, unknowns)
    dead = without_effect(sensitivity, unknowns)
    of_rows = (sensitivity, without_weak)
    groups = _groups(null, covariance, unknowns, of_rows, around, dead)
    resting_groups = _groups(resting, data.covariance, unknowns, of_rows, around)
    undetermined = tuple(
        u.name
        for i, u in enumerate(unknowns)
        if any(abs(v[i]) > TAKES_NO_PART for v in null)
        or any(u.name in other.changed for other in around.second)
    )
    # A variance of nothing may be rounding of either sign.
    variance = np.diag(covariance if reported is None else reported)
    known = [
        (u, float(sd))
        for u, sd in zip(unknowns, np.sqrt(np.maximum(variance, 0.0)), strict=True)
        if u.name not in (*undetermined, *dead)
    ]
    singular, names = total.singular, [u.name for u in unknowns]
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else math.inf
    correlation = _correlation(covariance)
    hardly = condition > ILL_CONDITIONED and not (null or resting or around.second)
    shares = _shares(covariance, total.covariance, bare, own)
    explained, by_own, by_weak = (dict(zip(names, s.tolist(), strict=True)) for s in shares)
    # Where a nuisance is exchangeable with a parameter the data say nothing of it, whatever
    # interval the weak priors make.
    explained |= dict.fromkeys((n for g in groups if g.exchanged for n in g.names), 1.0)
    verdict = Verdict(
        unknowns=unknowns,
        identifiable=not (null or around.second),
        rank=int(total.kept.sum()),
        rank_without_priors=int(data.kept.sum()),
        condition=condition,
        singular_values=singular,
        null_directions=tuple(dict(zip(names, map(float, v), strict=True)) for v in null),
        combinations=tuple(c for group in (*groups, *resting_groups) for c in group.combinations),
        pairs=_pairs(correlation, names, undetermined),
        without_effect=dead,
        undetermined=undetermined,
        covariance=covariance,
        correlation=correlation,
        prior_share=explained,
        own_share=by_own,
        weak_share=by_weak,
        groups=groups,
        resting_groups=resting_groups,
        factors=_factors(known, around.limits),
        weakest=_weakest(covariance, unknowns) if hardly else None,
        remedies=remedies,
        switches=frozenset(switches),
        through_zero=tuple(u.name for u, sd in known if _holds_zero(u, sd, around.limits)),
        second=around.second,
    )
    return replace(verdict, sentences=sentences(verdict))


def _null(
    null: list[np.ndarray],
    covariances: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    unknowns: tuple[Unknown, ...],
    around: Around,
) -> list[np.ndarray]:
    """Return the directions that are not determined: those without effect, those whose interval
    reaches too far, and those that other points leave open.

    Args:
        null: those without effect.
        covariances: (q, q) each, without the weak priors, with them, and as it is reported.
        unknowns: (q,) what the coordinates are.
    """
    bare, covariance, reported = covariances
    null = with_too_wide(null, bare, unknowns)
    # Those of one sign have the factor of ten. Of what may be zero weak priors alone hold one whose
    # sd without them is beyond its scale and ten times the one with them.
    weakly = [
        bare[:, i]
        for i, u in enumerate(unknowns)
        if not u.logarithmic and bare[i, i] > max(1.0, FACTOR**2 * covariance[i, i])
    ]
    # An alias is another optimum, of which no slope at this one tells.
    aliased = [v for v, u in zip(np.eye(len(unknowns)), unknowns, strict=True) if u.aliased]
    # What goes with one that the likelihood does not bound, without those that it does.
    open_ = np.array([u.name in around.one_sided for u in unknowns])
    sds = np.sqrt(np.where(open_, np.diag(covariance), 1.0))
    one_sided = [np.where(open_, covariance[:, i] / sds, 0.0) for i in np.flatnonzero(open_)]
    null = with_further(null, [*weakly, *aliased, *around.null, *one_sided])
    return null if reported is None else with_too_wide(null, reported, unknowns)


def _groups(
    null: list[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    of_rows: tuple[np.ndarray, WithoutWeakPriors | None],
    around: Around,
    dead: tuple[str, ...] = (),
) -> tuple[Group, ...]:
    """Return the parameters in null directions, those apart that no direction ties together.

    Args:
        covariance: (q, q) of what is determined.
        unknowns: (q,) what the coordinates are.
        of_rows: the sensitivity with the weak priors and without them.
        dead: parameters without effect, which have a sentence of their own, and no combination.
    """
    alive = np.array([u.name not in dead for u in unknowns])
    null = [v for v in null if np.abs(v[alive]).max(initial=0.0) > TAKES_PART]
    if not null:
        return ()
    # Any basis of the null space serves; the reduced one has zeros wherever it can, and so shows
    # which parameters are not tied together.
    rows = [unit_vector(v) for v in row_reduced(np.array(null), unknowns)[0]]
    parts = [set(np.flatnonzero((np.abs(v) > TAKES_PART) & alive).tolist()) for v in rows]
    sensitivity, without_weak = of_rows
    groups = []
    for members in connected(parts):
        mine = [v for v, part in zip(rows, parts, strict=True) if part & members]
        exchanged = []
        if without_weak is not None:
            exchanged = [n for v in mine for n in without_weak.exchanged(v, sensitivity)]
        groups.append(
            Group(
                tuple(unknowns[i].name for i in sorted(members)),
                len(mine),
                around.tied(mine, covariance, unknowns),
                tuple(dict.fromkeys(exchanged)),
            )
        )
    return tuple(groups)


def _correlation(covariance: np.ndarray) -> np.ndarray:
    """(q, q) of a covariance; one that takes part in no determined direction has none."""
    sd = np.sqrt(np.diag(covariance))
    safe = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.clip(correlation, -1.0, 1.0)


def _pairs(
    correlation: np.ndarray, names: list[str], undetermined: tuple[str, ...]
) -> tuple[Pair, ...]:
    """Pairs beyond the limit; what is not determined has no correlation."""
    pairs = [
        Pair(names[j], names[i], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > STRONG and not {names[i], names[j]} & {*undetermined}
    ]
    return tuple(sorted(pairs, key=lambda p: -abs(p.correlation)))


def _shares(
    covariance: np.ndarray, without_weak: np.ndarray, bare: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (q,) each the shares of the variance by all priors, of the precision by the unknown's
    own, and of that by the weak ones."""
    variance = np.diag(covariance)
    safe = np.where(variance > 0, variance, 1.0)
    bare_variance = np.diag(without_weak)
    # The estimates' variance P = P (B'B + R) P is that of the data, whose rows are B, and that of
    # all priors R. An unknown without a prior rests on another's where only the two together show.
    of_data = np.sum((bare @ covariance) ** 2, axis=0)
    explained = np.where(variance > 0, 1.0 - of_data / safe, 0.0)
    # Precisions add, so a prior's share is its precision times the variance that is left.
    ratio = variance / np.where(bare_variance > 0, bare_variance, 1.0)
    weak = np.where(bare_variance > 0, 1.0 - ratio, 0.0)
    clipped = (np.clip(s, 0.0, 1.0) for s in (explained, variance * own**2, weak))
    explained, by_own, by_weak = clipped
    return explained, by_own, by_weak


def _factors(
    known: list[tuple[Unknown, float]], limits: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """By unknown that is determined in a wide interval, the factor to its ends; infinite of one
    whose interval holds zero, or reaches the end of its search."""
    factors = {}
    for u, sd in known:
        # A coordinate that is no logarithm has no factor.
        factor = math.exp(Z95 * sd) if u.logarithmic else 1.0
        if u.name in limits and u.logarithmic:
            ratios = [end / u.value for end in limits[u.name]]
            factor = max(max(r, 1.0 / r) if r > 0 else math.inf for r in ratios)
        if Z95 * sd >= u.room and not u.at_bound:
            factor = math.inf
        if factor > math.exp(Z95 * ROUGHLY):
            factors[u.name] = factor
    return factors


def _holds_zero(u: Unknown, sd: float, limits: Mapping[str, tuple[float, float]]) -> bool:
    """True if the 95 % interval of an unknown of either sign holds zero: no factor describes it."""
    low, high = limits.get(u.name, (0.0, 0.0))
    return u.symmetric and (low <= 0.0 <= high if u.name in limits else Z95 * sd >= u.distance)


def _weakest(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> Weakest:
    """Return the least determined direction, and what is determined far better."""
    direction = unit_vector(np.linalg.eigh(covariance)[1][:, -1])
    parts = {
        u.name: float(v) for u, v in zip(unknowns, direction, strict=True) if abs(v) > TAKES_PART
    }
    return Weakest(parts, combinations([direction], covariance, unknowns))


def with_combinations(verdict: Verdict, change: Callable[[Combination], Combination]) -> Verdict:
    """Return the verdict with other intervals of its combinations, without those that then
    determine nothing.
    """

    def changed(groups: tuple[Group, ...]) -> tuple[Group, ...]:
        each = (tuple(map(change, g.combinations)) for g in groups)
        kept = (tuple(c for c in joint if c.is_bounded) for joint in each)
        return tuple(g._replace(combinations=k) for g, k in zip(groups, kept, strict=True))

    groups, resting = changed(verdict.groups), changed(verdict.resting_groups)
    joint = tuple(c for group in (*groups, *resting) for c in group.combinations)
    verdict = replace(verdict, combinations=joint, groups=groups, resting_groups=resting)
    return replace(verdict, sentences=sentences(verdict))
