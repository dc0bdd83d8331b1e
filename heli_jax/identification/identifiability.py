"""The verdict: what the data determine of the free parameters, and what they do not.

Everything is done in relative coordinates: log |value| for parameters of one sign, value over a
scale for those that may be zero. Initial states and biases are projected out first.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

NULL = 1e-8
"""A singular value below this part of the largest counts as zero."""
FACTOR = 10.0
"""A 95 % interval that reaches further than this factor to either side determines nothing."""
ILL_CONDITIONED = 1e4
STRONG = 0.99
_TAKES_PART = 0.1  # of a unit direction: less is not worth naming
Z95 = 1.959963984540054


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
    pairs: tuple[Pair, ...]
    without_effect: tuple[str, ...]
    undetermined: tuple[str, ...]
    covariance: np.ndarray
    """(q, q) in relative coordinates; the undetermined directions are left out of it"""
    correlation: np.ndarray
    prior_share: dict[str, float]
    sentences: tuple[str, ...]

    @property
    def text(self) -> str:
        """The verdict in words."""
        return " ".join(self.sentences)


def projected(J: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """The (q, q) triangle that holds what J (n, q) says once the nuisance columns are free.

    By orthogonal factors, never by normal equations: singular values keep their full precision.
    """
    q, k = J.shape[1], nuisances.shape[1]
    both = np.hstack([nuisances, J])
    if both.shape[0] < q + k:
        both = np.vstack([both, np.zeros((q + k - both.shape[0], q + k))])
    R = np.linalg.qr(both, mode="r")
    return R[k : k + q, k:]


def judge(
    sensitivity: np.ndarray,
    unknowns: tuple[Unknown, ...],
    remedy: str = "",
    null_below: float = NULL,
) -> Verdict:
    """The verdict from a whitened sensitivity (any rows, q) in relative coordinates.

    Priors are no rows of it; they come with the unknowns.

    `null_below` is the part of the largest singular value that counts as zero. `remedy` is a
    further way out that the model offers, such as a run with a known inertia.
    """
    names = tuple(u.name for u in unknowns)
    scale = np.array([u.scale for u in unknowns])
    prior = np.diag([u.prior for u in unknowns])
    data = _directions(sensitivity, scale)
    total = _directions(np.vstack([sensitivity, prior]), scale)
    kept = total.singular > null_below * max(total.singular[0], 1e-300)
    covariance = _covariance(total, kept, scale)
    null = [_unit(scale * v) for v in total.right[~kept]]
    if not null:
        null = _too_wide(np.vstack([sensitivity, prior]), covariance, unknowns)
    combinations = _combinations(null, covariance, unknowns)
    sizes = np.linalg.norm(sensitivity, axis=0) * scale
    dead = tuple(
        n for n, s in zip(names, sizes, strict=True) if not s > 1e-12 * max(sizes.max(), 1e-300)
    )
    undetermined = tuple(n for i, n in enumerate(names) if any(abs(v[i]) > 1e-3 for v in null))
    correlation = _correlation(covariance)
    pairs = _pairs(correlation, names, undetermined)
    smallest = total.singular[-1]
    condition = float(total.singular[0] / smallest) if smallest > 0 else math.inf
    data_rank = int(np.sum(data.singular > null_below * max(data.singular[0], 1e-300)))
    share = {
        u.name: float(np.clip(covariance[i, i] * u.prior**2, 0.0, 1.0))
        for i, u in enumerate(unknowns)
    }
    data_null = [_unit(scale * v) for v in data.right[data_rank:]]
    sentences = _sentences(
        names, null, combinations, dead, pairs, condition, data_null, unknowns, remedy, covariance
    )
    return Verdict(
        names=names,
        identifiable=not null,
        rank=int(kept.sum()),
        rank_without_priors=data_rank,
        condition=condition,
        singular_values=total.singular,
        null_directions=tuple(dict(zip(names, map(float, v), strict=True)) for v in null),
        combinations=combinations,
        pairs=pairs,
        without_effect=dead,
        undetermined=undetermined,
        covariance=covariance,
        correlation=correlation,
        prior_share=share,
        sentences=sentences,
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


def _too_wide(
    total: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of full rank along which a 95 % interval still spans more than the factor."""
    limit = math.log(FACTOR) / Z95
    sized = [u.logarithmic or u.symmetric for u in unknowns]
    wide = [s and covariance[i, i] > limit**2 for i, s in enumerate(sized)]
    if not any(wide):
        return []
    plain = _directions(total, np.ones(len(unknowns)))
    weak = [_unit(v) for s, v in zip(plain.singular, plain.right, strict=True) if s * limit < 1]
    return weak or [_unit(plain.right[-1])]


def _correlation(covariance: np.ndarray) -> np.ndarray:
    sd = np.sqrt(np.diag(covariance))
    safe = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.clip(correlation, -1.0, 1.0)


def _pairs(
    correlation: np.ndarray, names: tuple[str, ...], undetermined: tuple[str, ...]
) -> tuple[Pair, ...]:
    """Pairs beyond the limit; those within an undetermined direction are told by that."""
    found = []
    for i in range(len(names)):
        for j in range(i):
            both_lost = names[i] in undetermined and names[j] in undetermined
            if abs(correlation[i, j]) > STRONG and not both_lost:
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


def _listed(words: list[str], last: str = "and") -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def _sentences(
    names: tuple[str, ...],
    null: list[np.ndarray],
    combinations: tuple[Combination, ...],
    dead: tuple[str, ...],
    pairs: tuple[Pair, ...],
    condition: float,
    data_null: list[np.ndarray],
    unknowns: tuple[Unknown, ...],
    remedy: str,
    covariance: np.ndarray,
) -> tuple[str, ...]:
    said = [f"{name} has no effect on the measured outputs: fix it." for name in dead]
    lost = _mixed(null, names, dead)
    if lost:
        what = _listed([c.name for c in combinations]) if combinations else "no part"
        said.append(
            f"The data determine only {what} of {_listed(list(lost))}: "
            f"fix one of {', '.join(lost)}, give it a prior{remedy}."
        )
    elif null and not dead:
        said.append("The data do not determine what was asked.")
    if not null:
        resting = _mixed(data_null, names, ())
        if resting:
            combos = _combinations(data_null, covariance, unknowns)
            with_prior = [u.name for u in unknowns if u.prior > 0 and u.name in resting]
            what = _listed([c.name for c in combos]) if combos else "less than was asked"
            owners = f"the prior of {_listed(with_prior)}" if with_prior else "the priors"
            said.append(
                f"The data alone determine only {what}; {_listed(list(resting))} rest on {owners}."
            )
        else:
            said.append(f"The data determine {_listed(list(names))}.")
    told = set(lost) | (set(_mixed(data_null, names, ())) if not null else set())
    if not null and condition > ILL_CONDITIONED and not data_null:
        words, weak = _weakest(covariance, unknowns)
        told |= weak
        said.append(f"They are hardly separated (condition number {condition:.1e}): {words}")
    for pair in pairs:
        if {pair.first, pair.second} <= told:
            continue
        said.append(
            f"{pair.first} and {pair.second} can hardly be told apart (correlation "
            f"{pair.correlation:+.5f}): fix one of them or give it a prior."
        )
    return tuple(said)


def _mixed(
    null: list[np.ndarray], names: tuple[str, ...], dead: tuple[str, ...]
) -> tuple[str, ...]:
    """The parameters that take part in a direction with others."""
    return tuple(
        n
        for i, n in enumerate(names)
        if n not in dead and any(abs(v[i]) > _TAKES_PART for v in null)
    )


def _weakest(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, set[str]]:
    """The least determined direction in words, and who takes part in it."""
    _, vectors = np.linalg.eigh(covariance)
    direction = _unit(vectors[:, -1])
    parts = {u.name: v for u, v in zip(unknowns, direction, strict=True) if abs(v) > _TAKES_PART}
    words = ", ".join(f"{n} {v:+.2f}" for n, v in parts.items())
    combos = _combinations([direction], covariance, unknowns)
    better = _listed([c.name for c in combos]) if combos else "their combinations"
    return (
        f"the weakest direction is ({words}) in log coordinates, and {better} "
        f"{'is' if len(combos) == 1 else 'are'} determined far better than "
        f"{_listed(list(parts))}; fix one of them or give it a prior.",
        set(parts),
    )
