"""The verdict: what the data determine of the free parameters, and what they do not.

Everything is done in relative coordinates: log |value| for parameters of one sign, value over a
scale for those that may be zero. Initial states and biases are projected out first.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.directions import (
    NOT_ASKED,
    TAKES_NO_PART,
    TAKES_PART,
    Directions,
    Elsewhere,
    Exchange,
    Tied,
    WithoutWeakPriors,
    combinations,
    correlation_of,
    covariance_of,
    directions,
    factor,
    further,
    holds_zero,
    one_sided,
    reported_too_wide,
    row_reduced,
    single_too_wide,
    too_wide,
    unit_vector,
    weakly_held,
    without_effect_of,
)
from heli_jax.identification.identifiability.sentences import (
    Facts,
    Inseparable,
    Weakest,
    sentences,
)
from heli_jax.identification.identifiability.verdict import (
    ROUGHLY,
    Z95,
    Pair,
    SecondSolution,
    Unknown,
    Verdict,
)

NULL = 1e-8
"""A singular value below this part of the largest counts as zero."""
ILL_CONDITIONED = 1e4
"""condition number above which the verdict warns: the data determine all, some of it hardly"""
STRONG = 0.99
"""correlation beyond which the verdict names a pair; rank alone does not show it (a stand's damping
and the flybar's have correlation 1.00000 and full rank)"""


class _Determined(NamedTuple):
    """What is known of the unknowns, and along which directions nothing is."""

    null: list[np.ndarray]
    """unit directions (q,) that are not determined"""
    covariance: np.ndarray
    """(q, q) of what is determined"""
    without_weak: np.ndarray
    """(q, q) the same with the nuisances' weak priors taken away"""
    total: Directions
    """of the data and the priors of the unknowns"""
    rank: int
    sd: np.ndarray
    """(q,) as reported, in relative coordinates"""


def _determined(
    sensitivity: np.ndarray,
    bare: np.ndarray,
    unknowns: tuple[Unknown, ...],
    reported: np.ndarray | None,
    elsewhere: Elsewhere,
) -> _Determined:
    """Directions without effect, then those whose interval reaches too far.

    Args:
        sensitivity, bare: (any, q) with and without the nuisances' weak priors.
    """
    scale = np.array([u.scale for u in unknowns])
    prior = np.diag([u.prior for u in unknowns])
    # The rank is that without the weak priors: they give every nuisance a finite interval, and so
    # would lend one to each parameter that a bias or an initial state can take the place of.
    # A prior is a measurement of the parameter itself: a row with one over its sd.
    total = directions(np.vstack([bare, prior]), scale)
    kept = total.singular > NULL * max(total.singular[0], 1e-300)
    without_weak = covariance_of(total, kept, scale)
    covariance = without_weak
    null = [unit_vector(scale * v) for v in total.right[~kept]]
    if not null:
        # All is determined: the intervals are those of the fit, which has the weak priors.
        with_weak = directions(np.vstack([sensitivity, prior]), scale)
        covariance = covariance_of(with_weak, with_weak.singular > 0, scale)
        null = too_wide(np.vstack([bare, prior]), without_weak, unknowns)
    # What one direction leaves open says nothing of the parameters that take no part in it.
    null += further(weakly_held(without_weak, covariance, unknowns), null)
    null += further(single_too_wide(without_weak, unknowns), null)
    # An alias is another optimum, of which no slope at this one tells.
    aliased = [np.eye(len(unknowns))[i] for i, u in enumerate(unknowns) if u.aliased]
    null += further(aliased, null)
    null += further([unit_vector(v) for v in elsewhere.null], null)
    null += further(one_sided(covariance, unknowns, elsewhere.one_sided), null)
    if reported is not None:
        wide = single_too_wide if null else reported_too_wide
        null += further(wide(reported, unknowns), null)
    # A variance of nothing may be rounding of either sign.
    sd = np.sqrt(np.maximum(np.diag(covariance if reported is None else reported), 0.0))
    return _Determined(null, covariance, without_weak, total, int(kept.sum()), sd)


class _ByData(NamedTuple):
    """The same by the data alone, where priors make everything determined."""

    null: list[np.ndarray]
    covariance: np.ndarray
    rank: int


def _by_data(bare: np.ndarray, determined: _Determined, unknowns: tuple[Unknown, ...]) -> _ByData:
    scale = np.array([u.scale for u in unknowns])
    data = directions(bare, scale)
    kept = data.singular > NULL * max(data.singular[0], 1e-300)
    covariance = covariance_of(data, kept, scale)
    null = []
    # Without priors this is what has been found already.
    if not determined.null and any(u.prior for u in unknowns):
        null = [unit_vector(scale * v) for v in data.right[~kept]]
        null = null or too_wide(bare, covariance, unknowns)
    return _ByData(null, covariance, int(kept.sum()))


class _Analysis(NamedTuple):
    """All that the verdict is made of."""

    unknowns: tuple[Unknown, ...]
    determined: _Determined
    data: _ByData
    bare: np.ndarray
    """(any, q) sensitivity without any prior"""
    without_effect: tuple[str, ...]
    groups: tuple[Inseparable, ...]
    """what is not determined"""
    resting: tuple[Inseparable, ...]
    """what priors determine, and the data alone do not"""
    exchange: Exchange
    second: tuple[SecondSolution, ...]
    limits: Mapping[str, tuple[float, float]]
    """by name the ends of an interval that is not the slopes'"""

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Also those that take a small part in a direction that is not determined, and those that
        have other values as good."""
        return tuple(
            u.name
            for i, u in enumerate(self.unknowns)
            if any(abs(v[i]) > TAKES_NO_PART for v in self.determined.null)
            or any(u.name in other.changed for other in self.second)
        )

    @property
    def condition(self) -> float:
        """Largest over smallest singular value."""
        singular = self.determined.total.singular
        return float(singular[0] / singular[-1]) if singular[-1] > 0 else math.inf


def analyse(
    sensitivity: np.ndarray,
    unknowns: tuple[Unknown, ...],
    remedies: Mapping[str, str] | None = None,
    without_weak: WithoutWeakPriors | None = None,
    reported: np.ndarray | None = None,
    elsewhere: Elsewhere = NOT_ASKED,
) -> Verdict:
    """The verdict from a whitened sensitivity in relative coordinates.

    Args:
        sensitivity: (any, q) with the nuisances free but for their weak priors. Priors of the
            unknowns are no rows of it; they come with the unknowns.
        unknowns: (q,) what the columns are.
        remedies: by name of an unknown, a further way out that the model offers, such as a run
            with a known inertia.
        without_weak: the same without the weak priors, which count as data where it is not given.
        reported: covariance (q, q) of the intervals that are reported, in relative coordinates,
            where it is not that of white residuals: these must not reach further than the factor
            either.
        elsewhere: what is known of other points.
    """
    bare = sensitivity if without_weak is None else without_weak.sensitivity
    determined = _determined(sensitivity, bare, unknowns, reported, elsewhere)
    data = _by_data(bare, determined, unknowns)
    dead = without_effect_of(sensitivity, unknowns)
    least = NULL * max(determined.total.singular[0], 1e-300)
    exchange = Exchange(sensitivity, without_weak, least)
    # Two lists: what nothing determines is an error of the experiment, what rests on a prior is a
    # number that the prior has put there.
    groups = _groups(
        determined.null, determined.covariance, unknowns, dead, (exchange, elsewhere.tied)
    )
    # What the data alone say, so that no prior is in it.
    resting = _groups(data.null, data.covariance, unknowns, (), (exchange, elsewhere.tied))
    analysis = _Analysis(
        unknowns,
        determined,
        data,
        bare,
        dead,
        groups,
        resting,
        exchange,
        elsewhere.second,
        elsewhere.limits,
    )
    return _verdict(analysis, remedies or {})


def _verdict(a: _Analysis, remedies: Mapping[str, str]) -> Verdict:
    names, known = tuple(u.name for u in a.unknowns), a.determined
    correlation = correlation_of(known.covariance)
    pairs = _pairs(correlation, names, a.undetermined)
    share = _shares(known.covariance, known.without_weak, a.bare, a.unknowns)
    nuisances_hold = [n for group in a.groups if group.nuisances for n in group.names]
    roughly, through_zero = _roughly(a), _through_zero(a)
    facts = Facts(
        a.unknowns,
        a.without_effect,
        a.groups,
        a.undetermined,
        a.resting,
        pairs,
        _weakest(a),
        share.weak,
        share.prior,
        dict(remedies),
        roughly,
        through_zero,
        a.second,
    )
    directions_not_determined = (*known.null, *a.data.null)
    return Verdict(
        names=names,
        identifiable=not (known.null or a.second),
        rank=known.rank,
        rank_without_priors=a.data.rank,
        condition=a.condition,
        singular_values=known.total.singular,
        null_directions=tuple(dict(zip(names, map(float, v), strict=True)) for v in known.null),
        combinations=tuple(c for group in (*a.groups, *a.resting) for c in group.combinations),
        pairs=pairs,
        without_effect=a.without_effect,
        undetermined=a.undetermined,
        covariance=known.covariance,
        correlation=correlation,
        # Where a nuisance is exchangeable with a parameter the data say nothing of it, whatever
        # interval the weak priors make.
        prior_share=share.explained | dict.fromkeys(nuisances_hold, 1.0),
        sentences=sentences(facts),
        resting=tuple(n for group in a.resting for n in group.names),
        roughly=tuple(roughly),
        through_zero=through_zero,
        exchangeable=tuple(
            dict.fromkeys(
                label for v in directions_not_determined for label in a.exchange.labels(v)
            )
        ),
        second=a.second,
    )


def _roughly(a: _Analysis) -> dict[str, float]:
    """By unknown that is determined in a wide interval, the factor to its ends; infinite of one
    whose interval reaches the end of its search."""
    lacking = (*a.undetermined, *a.without_effect)
    factors = {
        u.name: factor(u, float(sd), a.limits)
        for u, sd in zip(a.unknowns, a.determined.sd, strict=True)
        # A coordinate that is no logarithm has no factor; what has no effect has no variance.
        if u.logarithmic and u.name not in lacking
    }
    ended = {
        u.name: math.inf
        for u, sd in zip(a.unknowns, a.determined.sd, strict=True)
        if Z95 * float(sd) >= u.room and not u.at_bound and u.name not in lacking
    }
    return {n: ratio for n, ratio in factors.items() if ratio > math.exp(Z95 * ROUGHLY)} | ended


def _through_zero(a: _Analysis) -> tuple[str, ...]:
    """The parameters of either sign whose 95 % interval holds zero: no factor describes it."""
    lacking = (*a.undetermined, *a.without_effect)
    return tuple(
        u.name
        for u, sd in zip(a.unknowns, a.determined.sd, strict=True)
        if u.symmetric and u.name not in lacking and holds_zero(u, float(sd), a.limits)
    )


class _Shares(NamedTuple):
    """What comes of priors, by name."""

    prior: dict[str, float]
    """the share of the posterior precision (1 / variance) by the unknown's own"""
    weak: dict[str, float]
    """the same by the weak ones of nuisances"""
    explained: dict[str, float]
    """the share of the posterior variance by all priors, those of other unknowns among them"""


def _shares(
    covariance: np.ndarray,
    without_weak: np.ndarray,
    bare: np.ndarray,
    unknowns: tuple[Unknown, ...],
) -> _Shares:
    prior, weak, explained = {}, {}, {}
    # The estimates' variance P = P (B'B + R) P is that of the data, whose rows are B, and that of
    # all priors R. An unknown without a prior rests on another's where only the two together show.
    of_data = np.sum((bare @ covariance) ** 2, axis=0)
    for i, u in enumerate(unknowns):
        # Precisions add, so a prior's share is its precision times the variance that is left.
        prior[u.name] = float(np.clip(covariance[i, i] * u.prior**2, 0.0, 1.0))
        ratio = covariance[i, i] / without_weak[i, i] if without_weak[i, i] > 0 else 1.0
        weak[u.name] = float(np.clip(1.0 - ratio, 0.0, 1.0))
        variance = covariance[i, i]
        rest = 1.0 - of_data[i] / variance if variance > 0 else 0.0
        explained[u.name] = float(np.clip(rest, 0.0, 1.0))
    return _Shares(prior, weak, explained)


def _groups(
    null: list[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    dead: tuple[str, ...],
    asked: tuple[Exchange, Tied],
) -> tuple[Inseparable, ...]:
    """The parameters in null directions, those apart that no direction ties together."""
    names, (exchange, tied) = [u.name for u in unknowns], asked
    # Parameters without effect have a sentence of their own, and no combination to offer.
    gone = {names.index(n) for n in dead}
    alive = [v for v in null if np.delete(np.abs(v), list(gone)).max(initial=0.0) > TAKES_PART]
    if not alive:
        return ()
    # Any basis of the null space serves; the reduced one has zeros wherever it can, and so shows
    # which parameters are not tied together.
    W, _ = row_reduced(np.array(alive), unknowns)
    return tuple(
        Inseparable(
            tuple(names[i] for i in sorted(members)),
            len(rows),
            tied(rows, covariance, unknowns),
            exchange.words(rows),
            exchange.switches(rows),
        )
        for members, rows in _tied_together([unit_vector(v) for v in W], gone)
    )


def _tied_together(
    rows: list[np.ndarray], gone: set[int]
) -> list[tuple[set[int], list[np.ndarray]]]:
    """Directions that share an unknown, together with all their unknowns by number."""
    groups: list[tuple[set[int], list[np.ndarray]]] = []
    for v in rows:
        part = {int(i) for i in np.flatnonzero(np.abs(v) > TAKES_PART)} - gone
        if not part:
            continue
        joined, apart = (part, [v]), []
        # One direction may join several groups that were apart until now.
        for group in groups:
            if group[0] & part:
                joined = (joined[0] | group[0], [*group[1], *joined[1]])
            else:
                apart.append(group)
        groups = [*apart, joined]
    return groups


def _pairs(
    correlation: np.ndarray, names: tuple[str, ...], undetermined: tuple[str, ...]
) -> tuple[Pair, ...]:
    """Pairs beyond the limit; what is not determined has no correlation."""
    pairs = []
    for i in range(len(names)):
        for j in range(i):
            not_determined = names[i] in undetermined or names[j] in undetermined
            if abs(correlation[i, j]) > STRONG and not not_determined:
                pairs.append(Pair(names[j], names[i], float(correlation[i, j])))
    return tuple(sorted(pairs, key=lambda p: -abs(p.correlation)))


def _weakest(a: _Analysis) -> Weakest | None:
    """The least determined direction, and what is determined far better; None where there is more
    to say than that."""
    if a.determined.null or a.data.null or a.second or not a.condition > ILL_CONDITIONED:
        return None
    covariance = a.determined.covariance
    _, vectors = np.linalg.eigh(covariance)
    direction = unit_vector(vectors[:, -1])
    parts = {
        u.name: float(v) for u, v in zip(a.unknowns, direction, strict=True) if abs(v) > TAKES_PART
    }
    return Weakest(parts, combinations([direction], covariance, a.unknowns), a.condition)
