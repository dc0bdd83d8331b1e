"""The verdict: what the data determine of the free parameters, and what they do not.

Everything is done in relative coordinates: log |value| for parameters of one sign, value over a
scale for those that may be zero. Initial states and biases are projected out first.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from heli_jax.identification import words

NULL = 1e-8
"""A singular value below this part of the largest counts as zero."""
FACTOR = 10.0
"""A 95 % interval that reaches further than this factor to either side determines nothing."""
ILL_CONDITIONED = 1e4
STRONG = 0.99
_PART = 1e-3
"""of a unit direction that is not determined: less leaves an unknown determined"""
_TAKES_PART = 0.1  # of a unit direction: less is not worth naming
_HELD = 3.0
"""weak priors hold a direction that is this many times as sharp with them: 8/9 of what is known"""
Z95 = 1.959963984540054


_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches just as far as the factor"""


class Unknown(NamedTuple):
    """One free parameter as the verdict sees it."""

    name: str
    value: float
    logarithmic: bool
    """whether its relative coordinate is log |value|"""
    scale: float
    """size of its prior or interval in that coordinate; 1 where it has neither"""
    prior: float
    """1 / sd of its prior in that coordinate; 0 without one"""
    is_parameter: bool = True
    """False for gains and time shifts"""
    per_log: float = 1.0
    """what turns its relative coordinate into log |value|"""
    symmetric: bool = False
    """whether it may have either sign: its interval is then symmetric about the value, and
    determines nothing where it reaches further than log 10 times its size to either side"""


class Combination(NamedTuple):
    """A product of powers that the data determine."""

    name: str
    exponents: dict[str, float]
    value: float
    sd: float
    lower95: float
    upper95: float


class Pair(NamedTuple):
    """Two parameters that the data hardly tell apart."""

    first: str
    second: str
    correlation: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the data (with the priors) determine."""

    names: tuple[str, ...]
    identifiable: bool
    rank: int
    rank_without_priors: int
    condition: float
    singular_values: np.ndarray
    """(q,) of the whitened, scaled sensitivity, largest first"""
    null_directions: tuple[dict[str, float], ...]
    """unit vectors in relative coordinates along which nothing changes"""
    combinations: tuple[Combination, ...]
    """what the data alone determine of parameters that they do not determine one by one"""
    pairs: tuple[Pair, ...]
    without_effect: tuple[str, ...]
    undetermined: tuple[str, ...]
    covariance: np.ndarray
    """(q, q) in relative coordinates; the undetermined directions are left out of it"""
    correlation: np.ndarray
    prior_share: dict[str, float]
    """share of what is known of a parameter that came from priors: its own, and the weak ones of
    the nuisances; 1 where the data said nothing"""
    sentences: tuple[str, ...]
    resting: tuple[str, ...] = ()
    """parameters that are determined by priors, and not by the data alone"""
    exchangeable: tuple[str, ...] = ()
    """nuisances, as 'flight 1/bias p', that make up for what is not determined"""

    @property
    def text(self) -> str:
        """The verdict in words."""
        return " ".join(self.sentences)


class Held(NamedTuple):
    """What is left of the data where the nuisances' weak priors are taken away.

    Initial states, biases and input offsets carry priors of ten times the signal, so that one that
    no output shows does no harm. What only these hold up of a parameter the data do not determine.
    """

    sensitivity: np.ndarray
    """(any, q) with the nuisances free: no prior of any kind"""
    compensation: np.ndarray
    """(k, q) by how much the nuisances move, in sds of their weak priors, to make up for a unit of
    each unknown"""
    nuisances: tuple[str, ...]
    """(k,) in words, as 'the bias of p'"""
    labels: tuple[str, ...]
    """(k,) as the fit names them, as 'flight 1/bias p'"""
    switched_off: dict[str, np.ndarray]
    """by the nuisance's switch, as 'nuisance.bias', the sensitivity (any, q) without it"""


def projected(J: np.ndarray, nuisances: np.ndarray, smallest: float | None = None) -> np.ndarray:
    """What J (n, q) says once the nuisance columns (n, k) are free, as few rows (any, q).

    By orthogonal factors, never by normal equations: singular values keep their full precision.

    Args:
        smallest: the nuisances may be dependent: of their directions, with columns of equal size,
            those below this part of the largest have no effect of their own and are left out.
            Without it they have to be independent.
    """
    q, k = J.shape[1], nuisances.shape[1]
    both = np.hstack([nuisances, J])
    if both.shape[0] < q + k:
        both = np.vstack([both, np.zeros((q + k - both.shape[0], q + k))])
    R = np.linalg.qr(both, mode="r")
    if smallest is None or k == 0:
        return R[k : k + q, k:]
    N, S = R[:, :k], R[:, k:]
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    shown = left[:, singular > smallest * max(singular[0], 1e-300)]
    for _ in range(2):  # the second time takes off what rounding left the first time
        S = S - shown @ (shown.T @ S)
    return S


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
    scale = np.array([u.scale for u in unknowns])
    prior = np.diag([u.prior for u in unknowns])
    bare = sensitivity if held is None else held.sensitivity
    data, total = _directions(bare, scale), _directions(np.vstack([bare, prior]), scale)
    with_weak = _directions(np.vstack([sensitivity, prior]), scale)
    least = null_below * max(total.singular[0], 1e-300)
    kept = total.singular > least
    without_weak = _covariance(total, kept, scale)
    covariance = without_weak
    null = [_unit(scale * v) for v in total.right[~kept]]
    if not null:
        covariance = _covariance(with_weak, with_weak.singular > 0, scale)
        null = _too_wide(np.vstack([bare, prior]), without_weak, unknowns)
    # What one direction leaves open says nothing of the parameters that take no part in it.
    null += _further(_weakly_held(without_weak, covariance, unknowns), null)
    null += _further(_single_too_wide(without_weak, unknowns), null)
    if reported is not None:
        wide = (
            _single_too_wide(reported, unknowns) if null else _reported_too_wide(reported, unknowns)
        )
        null += _further(wide, null)
    data_kept = data.singular > null_below * max(data.singular[0], 1e-300)
    of_data = _covariance(data, data_kept, scale)
    data_null = []
    if not null and prior.any():
        data_null = [_unit(scale * v) for v in data.right[~data_kept]]
        data_null = data_null or _too_wide(bare, of_data, unknowns)
    sizes = np.linalg.norm(sensitivity, axis=0) * scale
    dead = tuple(
        n for n, s in zip(names, sizes, strict=True) if not s > 1e-12 * max(sizes.max(), 1e-300)
    )
    exchanged = _Exchange(sensitivity, held, least)
    groups = _groups(null, covariance, unknowns, dead, exchanged)
    # What the data alone say, so that no prior is in it.
    resting = _groups(data_null, of_data, unknowns, (), exchanged)
    undetermined = tuple(n for i, n in enumerate(names) if any(abs(v[i]) > _PART for v in null))
    correlation = _correlation(covariance)
    pairs = _pairs(correlation, names, undetermined)
    smallest = total.singular[-1]
    condition = float(total.singular[0] / smallest) if smallest > 0 else math.inf
    own, weak, share = _shares(covariance, without_weak, unknowns)
    for group in groups:
        if group.nuisances:
            share |= dict.fromkeys(group.names, 1.0)
    weakest = None
    if not null and condition > ILL_CONDITIONED and not data_null:
        weakest = _weakest(covariance, condition, unknowns)
    facts = words.Facts(
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
        rank=int(kept.sum()),
        rank_without_priors=int(data_kept.sum()),
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
        sentences=words.sentences(facts),
        resting=tuple(n for group in resting for n in group.names),
        exchangeable=tuple(
            dict.fromkeys(label for v in (*null, *data_null) for label in exchanged.labels(v))
        ),
    )


class _Exchange(NamedTuple):
    """Which nuisances a direction of the unknowns is exchanged with."""

    sensitivity: np.ndarray
    held: Held | None
    least: float
    """singular value that counts as zero"""

    def moves(self, v: np.ndarray) -> np.ndarray:
        """(k,) whether each nuisance takes part; none where weak priors do not hold v."""
        if self.held is None or not self.held.nuisances:
            return np.zeros(0, bool)
        with_weak = np.linalg.norm(self.sensitivity @ v)
        without = np.linalg.norm(self.held.sensitivity @ v)
        size = np.abs(self.held.compensation @ v)
        if with_weak < max(self.least, _HELD * without):
            return np.zeros(size.size, bool)
        return size > _TAKES_PART * max(size.max(), 1e-300)

    def labels(self, v: np.ndarray) -> tuple[str, ...]:
        """As the fit names the nuisances."""
        moves = self.moves(v)
        return tuple(self.held.labels[i] for i in np.flatnonzero(moves)) if self.held else ()

    def words(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances that the directions are exchanged with, each once."""
        if self.held is None:
            return ()
        found = [self.held.nuisances[i] for v in rows for i in np.flatnonzero(self.moves(v))]
        return tuple(dict.fromkeys(found))

    def switches(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances without which every direction would be determined."""
        if self.held is None or not self.words(rows):
            return ()
        return tuple(
            name
            for name, other in self.held.switched_off.items()
            if all(
                np.linalg.norm(other @ v)
                > max(self.least, _HELD * np.linalg.norm(self.held.sensitivity @ v))
                for v in rows
            )
        )


def _weakly_held(
    without_weak: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of unknowns that may be zero and that weak priors alone hold.

    For those of one sign the factor of ten tells it; here it is an sd, without the weak priors,
    beyond the unknown's scale and ten times the one with them.
    """
    return [
        _unit(without_weak[:, i] / math.sqrt(without_weak[i, i]))
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
    exchanged: _Exchange,
) -> tuple[words.Open, ...]:
    """The parameters in null directions, those apart that no direction ties together."""
    names = [u.name for u in unknowns]
    gone = [names.index(n) for n in dead]
    alive = [v for v in null if np.delete(np.abs(v), gone).max(initial=0.0) > _TAKES_PART]
    if not alive:
        return ()
    W, _ = _reduced(np.array(alive), unknowns)
    groups: list[tuple[set[int], list[np.ndarray]]] = []
    for v in map(_unit, W):
        part = {int(i) for i in np.flatnonzero(np.abs(v) > _TAKES_PART)} - set(gone)
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
        words.Open(
            tuple(names[i] for i in sorted(members)),
            len(directions),
            _combinations(directions, covariance, unknowns),
            exchanged.words(directions),
            exchanged.switches(directions),
        )
        for members, directions in groups
    )


class _Directions(NamedTuple):
    singular: np.ndarray
    right: np.ndarray


def _directions(sensitivity: np.ndarray, scale: np.ndarray) -> _Directions:
    q = scale.size
    padded = np.vstack([sensitivity * scale, np.zeros((q, q))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    return _Directions(singular, right)


def _covariance(total: _Directions, kept: np.ndarray, scale: np.ndarray) -> np.ndarray:
    V = total.right[kept].T / total.singular[kept]
    return np.outer(scale, scale) * (V @ V.T)


def _unit(v: np.ndarray) -> np.ndarray:
    v = v / np.linalg.norm(v)
    return v if v[np.argmax(np.abs(v))] > 0 else -v


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
    plain = _directions(total, np.ones(len(unknowns)))
    weak = [_unit(v) for s, v in zip(plain.singular, plain.right, strict=True) if s * _FAR < 1]
    return weak or [_unit(plain.right[-1])]


def _single_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """For each unknown whose interval reaches too far the direction in which it does."""
    return [
        _unit(covariance[:, i] / math.sqrt(covariance[i, i]))
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
    return [_unit(v) for v in vectors[:, values > _FAR**2].T] or [_unit(vectors[:, -1])]


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


def _combinations(
    null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> tuple[Combination, ...]:
    """Products of powers that do not change along the null directions."""
    if not null:
        return ()
    per_log = np.array([u.per_log for u in unknowns])
    null = [_unit(v * per_log) for v in null]
    covariance = covariance * np.outer(per_log, per_log)
    W, pivots = _reduced(np.array(null), unknowns)
    found = []
    for i in range(len(unknowns)):
        if i in pivots or np.all(np.abs(W[:, i]) < _TAKES_PART):
            continue
        exponents = np.zeros(len(unknowns))
        exponents[i] = 1.0
        exponents[pivots] = -W[:, i]
        exponents = np.array([_rounded(e) for e in exponents])
        if exponents[pivots].sum() < 0:  # a/Ixx rather than Ixx/a
            exponents = -exponents
        if all(unknowns[k].logarithmic for k in np.flatnonzero(exponents)):
            found.append(_combination(exponents, covariance, unknowns))
    return tuple(found)


def _reduced(W: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[np.ndarray, list[int]]:
    """Row-reduce the null directions; pivots are late parameters, so that ratios read a/Ixx."""
    W, pivots = W.copy(), []
    for k in range(W.shape[0]):
        size = np.max(np.abs(W[k:]), axis=0)
        size[pivots] = 0.0
        near = [i for i in range(W.shape[1]) if size[i] >= 0.5 * size.max()]
        proper = [i for i in near if unknowns[i].is_parameter and unknowns[i].logarithmic]
        pivot = (proper or near)[-1]
        row = k + int(np.argmax(np.abs(W[k:, pivot])))
        W[[k, row]] = W[[row, k]]
        W[k] /= W[k, pivot]
        for other in range(W.shape[0]):
            if other != k:
                W[other] -= W[other, pivot] * W[k]
        pivots.append(pivot)
    return W, pivots


def _rounded(exponent: float) -> float:
    """A small fraction where the exponent is one, else two digits."""
    quarter = round(exponent * 4) / 4
    return quarter if abs(exponent - quarter) < 0.02 else round(exponent, 2)


def _combination(
    exponents: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> Combination:
    by_name = {u.name: float(e) for u, e in zip(unknowns, exponents, strict=True) if e}
    log = sum(e * math.log(abs(u.value)) for u, e in zip(unknowns, exponents, strict=True) if e)
    value = math.exp(log) if abs(log) < 700 else math.inf
    sd = math.sqrt(max(0.0, float(exponents @ covariance @ exponents)))
    reach = math.exp(min(Z95 * sd, 700.0))
    return Combination(
        combination_name(by_name), by_name, value, value * sd, value / reach, value * reach
    )


def combination_name(exponents: dict[str, float]) -> str:
    """`a/Ixx` for {a: 1, Ixx: -1}."""

    def power(name: str, e: float) -> str:
        return name if e == 1 else f"{name}^{e:g}"

    over = [power(n, e) for n, e in exponents.items() if e > 0]
    under = [power(n, -e) for n, e in exponents.items() if e < 0]
    if not under:
        return " * ".join(over)
    below = under[0] if len(under) == 1 else f"({' * '.join(under)})"
    return f"{' * '.join(over) or '1'}/{below}"


def _weakest(
    covariance: np.ndarray, condition: float, unknowns: tuple[Unknown, ...]
) -> words.Weakest:
    """The least determined direction, and what is determined far better."""
    _, vectors = np.linalg.eigh(covariance)
    direction = _unit(vectors[:, -1])
    parts = {
        u.name: float(v) for u, v in zip(unknowns, direction, strict=True) if abs(v) > _TAKES_PART
    }
    return words.Weakest(parts, _combinations([direction], covariance, unknowns), condition)
