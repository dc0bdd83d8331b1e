"""The verdict: what the data determine of the free parameters, and what they do not.

Everything is done in relative coordinates: log |value| for parameters of one sign, value over a
scale for those that may be zero. Initial states and biases are projected out first.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.combinations import (
    TAKES_PART,
    combinations,
    row_reduced,
    unit_vector,
)
from heli_jax.identification.identifiability.directions import (
    Directions,
    Exchange,
    Held,
    covariance_of,
    directions,
)
from heli_jax.identification.identifiability.sentences import Facts, Open, Weakest, sentences
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Pair, Unknown, Verdict

NULL = 1e-8
"""A singular value below this part of the largest counts as zero."""
ILL_CONDITIONED = 1e4
STRONG = 0.99
_PART = 1e-3
"""of a unit direction that is not determined: less leaves an unknown determined"""


_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches just as far as the factor"""


class _Known(NamedTuple):
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


def _known(
    sensitivity: np.ndarray,
    bare: np.ndarray,
    prior: np.ndarray,
    unknowns: tuple[Unknown, ...],
    null_below: float,
    reported: np.ndarray | None,
) -> _Known:
    """Directions without effect, then those whose interval reaches too far.

    Args:
        sensitivity, bare: (any, q) with and without the nuisances' weak priors.
        prior: (q, q) rows of the unknowns' own priors.
    """
    scale = np.array([u.scale for u in unknowns])
    total = directions(np.vstack([bare, prior]), scale)
    with_weak = directions(np.vstack([sensitivity, prior]), scale)
    kept = total.singular > null_below * max(total.singular[0], 1e-300)
    without_weak = covariance_of(total, kept, scale)
    covariance = without_weak
    null = [unit_vector(scale * v) for v in total.right[~kept]]
    if not null:
        covariance = covariance_of(with_weak, with_weak.singular > 0, scale)
        null = _too_wide(np.vstack([bare, prior]), without_weak, unknowns)
    # What one direction leaves open says nothing of the parameters that take no part in it.
    null += _further(_weakly_held(without_weak, covariance, unknowns), null)
    null += _further(_single_too_wide(without_weak, unknowns), null)
    if reported is not None:
        wide = (
            _single_too_wide(reported, unknowns) if null else _reported_too_wide(reported, unknowns)
        )
        null += _further(wide, null)
    return _Known(null, covariance, without_weak, total, int(kept.sum()))


class _ByData(NamedTuple):
    """The same by the data alone, where priors make everything determined."""

    null: list[np.ndarray]
    covariance: np.ndarray
    rank: int


def _by_data(
    bare: np.ndarray, known: _Known, unknowns: tuple[Unknown, ...], null_below: float
) -> _ByData:
    scale = np.array([u.scale for u in unknowns])
    data = directions(bare, scale)
    kept = data.singular > null_below * max(data.singular[0], 1e-300)
    covariance = covariance_of(data, kept, scale)
    null = []
    if not known.null and any(u.prior for u in unknowns):
        null = [unit_vector(scale * v) for v in data.right[~kept]]
        null = null or _too_wide(bare, covariance, unknowns)
    return _ByData(null, covariance, int(kept.sum()))


def judge(
    sensitivity: np.ndarray,
    unknowns: tuple[Unknown, ...],
    remedies: Mapping[str, str] | None = None,
    null_below: float = NULL,
    held: Held | None = None,
    reported: np.ndarray | None = None,
) -> Verdict:
    """The verdict from a whitened sensitivity (any rows, q) in relative coordinates.

    Args:
        sensitivity: with the nuisances free but for their weak priors. Priors of the unknowns are
            no rows of it; they come with the unknowns.
        remedies: by name of an unknown, a further way out that the model offers, such as a run
            with a known inertia.
        null_below: the part of the largest singular value that counts as zero.
        held: the same without the weak priors, which count as data where it is not given.
        reported: covariance (q, q) of the intervals that are reported, in relative coordinates,
            where it is not that of white residuals: these must not reach further than the factor
            either.
    """
    names = tuple(u.name for u in unknowns)
    bare = sensitivity if held is None else held.sensitivity
    prior = np.diag([u.prior for u in unknowns])
    known = _known(sensitivity, bare, prior, unknowns, null_below, reported)
    data = _by_data(bare, known, unknowns, null_below)
    null, covariance, total = known.null, known.covariance, known.total
    dead = _dead(sensitivity, unknowns)
    least = null_below * max(total.singular[0], 1e-300)
    exchanged = Exchange(sensitivity, held, least)
    groups = _groups(null, covariance, unknowns, dead, exchanged)
    # What the data alone say, so that no prior is in it.
    resting = _groups(data.null, data.covariance, unknowns, (), exchanged)
    undetermined = tuple(n for i, n in enumerate(names) if any(abs(v[i]) > _PART for v in null))
    correlation = _correlation(covariance)
    pairs = _pairs(correlation, names, undetermined)
    smallest = total.singular[-1]
    condition = float(total.singular[0] / smallest) if smallest > 0 else math.inf
    own, weak, share = _shares(covariance, known.without_weak, unknowns)
    for group in groups:
        if group.nuisances:
            share |= dict.fromkeys(group.names, 1.0)
    weakest = None
    if not null and condition > ILL_CONDITIONED and not data.null:
        weakest = _weakest(covariance, condition, unknowns)
    facts = Facts(
        unknowns,
        dead,
        groups,
        undetermined,
        resting,
        pairs,
        weakest,
        weak,
        own,
        dict(remedies or {}),
    )
    return Verdict(
        names=names,
        identifiable=not null,
        rank=known.rank,
        rank_without_priors=data.rank,
        condition=condition,
        singular_values=total.singular,
        null_directions=tuple(dict(zip(names, map(float, v), strict=True)) for v in null),
        combinations=tuple(c for group in (*groups, *resting) for c in group.combinations),
        pairs=pairs,
        without_effect=dead,
        undetermined=undetermined,
        covariance=covariance,
        correlation=correlation,
        prior_share=share,
        sentences=sentences(facts),
        resting=tuple(n for group in resting for n in group.names),
        exchangeable=tuple(
            dict.fromkeys(label for v in (*null, *data.null) for label in exchanged.labels(v))
        ),
    )


def _dead(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """The unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    least = 1e-12 * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)


def _weakly_held(
    without_weak: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of unknowns that may be zero and that weak priors alone hold.

    For those of one sign the factor of ten tells it; here it is an sd, without the weak priors,
    beyond the unknown's scale and ten times the one with them.
    """
    return [
        unit_vector(without_weak[:, i] / math.sqrt(without_weak[i, i]))
        for i, u in enumerate(unknowns)
        if not u.logarithmic and without_weak[i, i] > max(1.0, FACTOR**2 * covariance[i, i])
    ]


def _shares(
    covariance: np.ndarray, without_weak: np.ndarray, unknowns: tuple[Unknown, ...]
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """By name, the share of what is known that comes from the unknown's own prior, from the weak
    priors of nuisances, and from both."""
    own, weak, share = {}, {}, {}
    for i, u in enumerate(unknowns):
        own[u.name] = float(np.clip(covariance[i, i] * u.prior**2, 0.0, 1.0))
        ratio = covariance[i, i] / without_weak[i, i] if without_weak[i, i] > 0 else 1.0
        weak[u.name] = float(np.clip(1.0 - ratio, 0.0, 1.0))
        share[u.name] = 1.0 - (1.0 - own[u.name]) * (1.0 - weak[u.name])
    return own, weak, share


def _groups(
    null: list[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    dead: tuple[str, ...],
    exchanged: Exchange,
) -> tuple[Open, ...]:
    """The parameters in null directions, those apart that no direction ties together."""
    names = [u.name for u in unknowns]
    gone = [names.index(n) for n in dead]
    alive = [v for v in null if np.delete(np.abs(v), gone).max(initial=0.0) > TAKES_PART]
    if not alive:
        return ()
    W, _ = row_reduced(np.array(alive), unknowns)
    groups: list[tuple[set[int], list[np.ndarray]]] = []
    for v in map(unit_vector, W):
        part = {int(i) for i in np.flatnonzero(np.abs(v) > TAKES_PART)} - set(gone)
        if not part:
            continue
        joined, apart = (part, [v]), []
        for group in groups:
            if group[0] & part:
                joined = (joined[0] | group[0], [*group[1], *joined[1]])
            else:
                apart.append(group)
        groups = [*apart, joined]
    return tuple(
        Open(
            tuple(names[i] for i in sorted(members)),
            len(directions),
            combinations(directions, covariance, unknowns),
            exchanged.words(directions),
            exchanged.switches(directions),
        )
        for members, directions in groups
    )


def _reaching_too_far(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[int]:
    """The unknowns whose 95 % interval reaches further than the factor."""
    return [
        i
        for i, u in enumerate(unknowns)
        if (u.logarithmic or u.symmetric) and covariance[i, i] > _FAR**2
    ]


def _too_wide(
    total: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of full rank along which a 95 % interval still spans more than the factor."""
    if not _reaching_too_far(covariance, unknowns):
        return []
    plain = directions(total, np.ones(len(unknowns)))
    weak = [
        unit_vector(v) for s, v in zip(plain.singular, plain.right, strict=True) if s * _FAR < 1
    ]
    return weak or [unit_vector(plain.right[-1])]


def _single_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """For each unknown whose interval reaches too far the direction in which it does."""
    return [
        unit_vector(covariance[:, i] / math.sqrt(covariance[i, i]))
        for i in _reaching_too_far(covariance, unknowns)
    ]


def _further(directions: list[np.ndarray], null: list[np.ndarray]) -> list[np.ndarray]:
    """Of the directions those that are led by an unknown which the null ones do not touch."""
    added: list[np.ndarray] = []
    for v in directions:
        leads = int(np.argmax(np.abs(v)))
        if all(abs(w[leads]) <= _PART for w in (*null, *added)):
            added.append(v)
    return added


def _reported_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """As `_too_wide` has them, by the covariance of the intervals that are reported."""
    if not _reaching_too_far(covariance, unknowns):
        return []
    values, vectors = np.linalg.eigh(covariance)
    return [unit_vector(v) for v in vectors[:, values > _FAR**2].T] or [unit_vector(vectors[:, -1])]


def _correlation(covariance: np.ndarray) -> np.ndarray:
    sd = np.sqrt(np.diag(covariance))
    safe = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.clip(correlation, -1.0, 1.0)


def _pairs(
    correlation: np.ndarray, names: tuple[str, ...], undetermined: tuple[str, ...]
) -> tuple[Pair, ...]:
    """Pairs beyond the limit; what is not determined has no correlation."""
    found = []
    for i in range(len(names)):
        for j in range(i):
            lost = names[i] in undetermined or names[j] in undetermined
            if abs(correlation[i, j]) > STRONG and not lost:
                found.append(Pair(names[j], names[i], float(correlation[i, j])))
    return tuple(sorted(found, key=lambda p: -abs(p.correlation)))


def _weakest(covariance: np.ndarray, condition: float, unknowns: tuple[Unknown, ...]) -> Weakest:
    """The least determined direction, and what is determined far better."""
    _, vectors = np.linalg.eigh(covariance)
    direction = unit_vector(vectors[:, -1])
    parts = {
        u.name: float(v) for u, v in zip(unknowns, direction, strict=True) if abs(v) > TAKES_PART
    }
    return Weakest(parts, combinations([direction], covariance, unknowns), condition)
