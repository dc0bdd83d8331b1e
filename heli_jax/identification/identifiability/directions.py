"""Directions of the unknowns: what the data say along them, and what they are exchanged with."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.verdict import (
    FACTOR,
    Z95,
    Combination,
    SecondSolution,
    Unknown,
)

# Products of powers, such as a/Ixx, and sums, such as La + Lb, that the data may determine where
# the parameters are not: by the slopes at one point, which `valley` asks far from it.


TAKES_PART = 0.1
"""of a unit direction: less is not worth naming"""


def unit_vector(v: np.ndarray) -> np.ndarray:
    """Of length one, its largest part positive."""
    v = v / np.linalg.norm(v)
    return v if v[np.argmax(np.abs(v))] > 0 else -v


def combinations(
    null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> tuple[Combination, ...]:
    """Products of powers that do not change along the null directions.

    Args:
        null: unit directions (q,) in relative coordinates.
        covariance: (q, q) of what is determined, in the same.
        unknowns: (q,) what the coordinates are.
    """
    if not null:
        return ()
    # The exponents are those of values, so all goes on in log |value|.
    per_log = np.array([u.per_log for u in unknowns])
    null = [unit_vector(v * per_log) for v in null]
    covariance = covariance * np.outer(per_log, per_log)
    W, pivots = row_reduced(np.array(null), unknowns)
    # One that takes no part in any null direction is determined by itself.
    part = [i for i in range(W.shape[1]) if i not in pivots and np.any(abs(W[:, i]) >= TAKES_PART)]
    # What may be zero or change its sign has no power.
    products = (
        _combination(exponents, covariance, unknowns)
        for exponents in (_exponents(W, i, pivots) for i in part)
        if all(unknowns[k].logarithmic for k in np.flatnonzero(exponents))
    )
    # An interval from nothing to anything determines a product as little as a parameter.
    return tuple(c for c in products if c.is_bounded)


def _exponents(W: np.ndarray, i: int, pivots: list[int]) -> np.ndarray:
    """Powers (q,) of the unknowns in the product that unknown i makes with the pivots."""
    # W holds the identity in the pivots' columns: the logarithm of unknown i less W[:, i] times
    # those of the pivots is the same all along the null directions.
    exponents = np.zeros(W.shape[1])
    exponents[i] = 1.0
    exponents[pivots] = -W[:, i]
    exponents = np.array([_rounded(e) for e in exponents])
    # a/Ixx rather than Ixx/a
    return -exponents if exponents[pivots].sum() < 0 else exponents


def row_reduced(W: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[np.ndarray, list[int]]:
    """Row-reduce the null directions; pivots are late parameters, so that ratios read a/Ixx."""
    W, pivots = W.copy(), []
    for k in range(W.shape[0]):
        size = np.max(np.abs(W[k:]), axis=0)
        size[pivots] = 0.0
        # Half of the largest pivot is as stable as it needs to be, and leaves a choice of names.
        near = [i for i in range(W.shape[1]) if size[i] >= 0.5 * size.max()]
        # The pivot is what the others are divided by, so if possible it is one that has powers.
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
    # What the record's noise leaves of a/Ixx is a/Ixx^0.99.
    quarter = round(exponent * 4) / 4
    return quarter if abs(exponent - quarter) < 0.02 else round(exponent, 2)


def _combination(
    exponents: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> Combination:
    by_name = {u.name: float(e) for u, e in zip(unknowns, exponents, strict=True) if e}
    log = sum(e * math.log(abs(u.value)) for u, e in zip(unknowns, exponents, strict=True) if e)
    # exp overflows at 709.
    value = math.exp(log) if abs(log) < 700 else math.inf
    # Rounding can leave the variance of what is known exactly a little below zero.
    sd = math.sqrt(max(0.0, float(exponents @ covariance @ exponents)))
    reach = math.exp(min(Z95 * sd, 700.0))
    return Combination(
        combination_name(by_name), by_name, value, value * sd, value / reach, value * reach
    )


_LARGEST_FACTOR = 4.0
"""of a parameter in a sum that is worth naming"""


def sums(
    null: list[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    units: Mapping[str, str | None],
) -> tuple[Combination, ...]:
    """Sums of parameters of one unit, with simple factors, that do not change along the null
    directions.

    Args:
        null: unit directions (q,) in relative coordinates.
        covariance: (q, q) of what is determined, in the same.
        unknowns: (q,) what the coordinates are.
        units: by name, of those that are parameters.
    """
    if not null:
        return ()
    # Of a logarithmic coordinate a unit is so much of the value itself.
    to_value = np.array([u.value * u.per_log if u.logarithmic else 0.0 for u in unknowns])
    moved = [v * to_value for v in null]
    if not all(np.linalg.norm(v) > 0 for v in moved):
        return ()
    W, pivots = row_reduced(np.array([unit_vector(v) for v in moved]), unknowns)
    combinations = []
    for i in range(W.shape[1]):
        factors = np.zeros(W.shape[1])
        factors[i] = 1.0
        factors[pivots] = -W[:, i]
        factors = np.where(np.abs(factors) < 0.02, 0.0, np.round(4.0 * factors) / 4.0)
        part = np.flatnonzero(factors)
        if i in pivots or part.size < 2 or np.abs(factors).max() > _LARGEST_FACTOR:
            continue
        members = [unknowns[k] for k in part]
        # What has another unit has no sum, and a gain or a shift is no parameter.
        if len({units.get(u.name, u.name) for u in members}) > 1:
            continue
        if all(u.logarithmic for u in members):
            combinations.append(_sum(factors, covariance, unknowns, to_value))
    return tuple(c for c in combinations if c.is_bounded)


def _sum(
    factors: np.ndarray,
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    to_value: np.ndarray,
) -> Combination:
    by_name = {u.name: float(w) for u, w in zip(unknowns, factors, strict=True) if w}
    value = float(sum(w * u.value for u, w in zip(unknowns, factors, strict=True)))
    along = factors * to_value
    sd = math.sqrt(max(0.0, float(along @ covariance @ along)))
    name = " ".join(_term(n, w, k == 0) for k, (n, w) in enumerate(by_name.items()))
    ends = (value - Z95 * sd, value + Z95 * sd)
    return Combination(name, by_name, value, sd, *ends, kind="sum")


def _term(name: str, factor: float, first: bool) -> str:
    sign = "-" if factor < 0 else "" if first else "+"
    size = "" if abs(factor) == 1 else f"{abs(factor):g} "
    return f"{sign}{'' if first else ' '}{size}{name}"


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


type Tied = Callable[[list[np.ndarray], np.ndarray, tuple[Unknown, ...]], tuple[Combination, ...]]
"""what is determined along null directions, as `combinations` has it"""


class Elsewhere(NamedTuple):
    """What slopes at one point do not tell."""

    second: tuple[SecondSolution, ...] = ()
    """other values that fit as well"""
    tied: Tied = combinations
    null: tuple[np.ndarray, ...] = ()
    """directions (q,) in relative coordinates that are open at another point as likely"""
    one_sided: tuple[str, ...] = ()
    """unknowns that the likelihood does not bound within the factor of ten"""
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """by unknown the ends of its 95 % interval, in its unit, where the slopes have others"""


NOT_ASKED = Elsewhere()


_SHARPER = 3.0
"""weak priors hold a direction that is this many times as sharp with them: 8/9 of what is known"""

_DETERMINES = Z95 / math.log(FACTOR)
"""1 / sd in relative coordinates of a direction whose 95 % interval reaches just as far as the
factor: what leaves it wider is no way out"""


class WithoutWeakPriors(NamedTuple):
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
    """by the nuisance's switch, as 'fit.nuisance.bias', the sensitivity (any, q) without it"""


def projected(J: np.ndarray, nuisances: np.ndarray, smallest: float | None = None) -> np.ndarray:
    """What the rows say of the unknowns once the nuisances are free, as few rows (any, q).

    Args:
        J: (n, q) whitened Jacobian by the unknowns.
        nuisances: (n, k) that by the nuisances.
        smallest: the nuisances may be dependent: of their directions, with columns of equal size,
            those below this part of the largest have no effect of their own and are left out.
            Without it they have to be independent.
    """
    # By orthogonal factors, never by normal equations, which square the condition number: singular
    # values down to 1e-8 of the largest are looked at, and their squares are below rounding.
    q, k = J.shape[1], nuisances.shape[1]
    both = np.hstack([nuisances, J])
    if both.shape[0] < q + k:
        both = np.vstack([both, np.zeros((q + k - both.shape[0], q + k))])
    R = np.linalg.qr(both, mode="r")
    # With the nuisances first, the lower right corner is what they cannot explain.
    if smallest is None or k == 0:
        return R[k : k + q, k:]
    S, spanned = R[:, k:], _span(R[:, :k], smallest)
    for _ in range(2):  # the second time takes off what rounding left the first time
        S = S - spanned @ (spanned.T @ S)
    return S


def _span(N: np.ndarray, smallest: float) -> np.ndarray:
    """Orthonormal columns that span those of N but for directions of no effect."""
    # Dependent columns leave directions of pure rounding in QR's Q; projecting those out too would
    # take some of the unknowns' effect away. Hence singular values, of columns of one size.
    norms = np.linalg.norm(N, axis=0)
    left, singular, _ = np.linalg.svd(N / np.where(norms > 0, norms, 1.0), full_matrices=False)
    return left[:, singular > smallest * max(singular[0], 1e-300)]


class Directions(NamedTuple):
    """Orthogonal directions of the scaled unknowns, the best determined first."""

    singular: np.ndarray
    """(q,) 1 / sd along each"""
    right: np.ndarray
    """(q, q) a direction a row"""


def directions(sensitivity: np.ndarray, scale: np.ndarray) -> Directions:
    """Those of a whitened sensitivity (any, q), each unknown in units of its scale (q,)."""
    q = scale.size
    # With fewer rows than unknowns the decomposition would leave the null directions out.
    padded = np.vstack([sensitivity * scale, np.zeros((q, q))])
    # Each unknown in units of its scale: without that, what counts as the weakest direction would
    # hang on the units of parameters.
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    return Directions(singular, right)


def covariance_of(total: Directions, kept: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Covariance (q, q) of the unknowns along the directions that are kept.

    Args:
        total: the directions of the scaled unknowns.
        kept: (q,) which of them are determined.
        scale: (q,) in relative coordinates, as `directions` had it.
    """
    # Only along what is determined: with the rest every variance would be infinite, also those of
    # parameters that the data determine well.
    V = total.right[kept].T / total.singular[kept]
    return np.outer(scale, scale) * (V @ V.T)


class Exchange(NamedTuple):
    """Which nuisances a direction of the unknowns is exchanged with."""

    sensitivity: np.ndarray
    """(any, q) with the weak priors"""
    without_weak: WithoutWeakPriors | None
    least: float
    """singular value that counts as zero"""

    def moves(self, v: np.ndarray) -> np.ndarray:
        """(k,) whether each nuisance takes part; none where weak priors do not hold v."""
        if self.without_weak is None or not self.without_weak.nuisances:
            return np.zeros(0, bool)
        with_weak = np.linalg.norm(self.sensitivity @ v)
        without = np.linalg.norm(self.without_weak.sensitivity @ v)
        # In sds of their weak priors, so that a bias in rad and an offset of a stick compare.
        size = np.abs(self.without_weak.compensation @ v)
        # Sharp by the weak priors and by nothing else: then what moves is what they hold.
        if with_weak < max(self.least, _SHARPER * without):
            return np.zeros(size.size, bool)
        return size > TAKES_PART * max(size.max(), 1e-300)

    def labels(self, v: np.ndarray) -> tuple[str, ...]:
        """As the fit names the nuisances."""
        moves = self.moves(v)
        return (
            tuple(self.without_weak.labels[i] for i in np.flatnonzero(moves))
            if self.without_weak
            else ()
        )

    def words(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances that the directions are exchanged with, each once."""
        if self.without_weak is None:
            return ()
        words = self.without_weak.nuisances
        moving = [words[i] for v in rows for i in np.flatnonzero(self.moves(v))]
        return tuple(dict.fromkeys(moving))

    def switches(self, rows: list[np.ndarray]) -> tuple[str, ...]:
        """The nuisances without which every direction would be determined."""
        if self.without_weak is None or not self.words(rows):
            return ()
        # Switched off one kind at a time; one that leaves a direction open is no way out of it.
        return tuple(
            name
            for name, other in self.without_weak.switched_off.items()
            if all(
                np.linalg.norm(other @ v)
                > max(
                    self.least,
                    _DETERMINES,
                    _SHARPER * np.linalg.norm(self.without_weak.sensitivity @ v),
                )
                for v in rows
            )
        )


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """(q, q) of a covariance; one that takes part in no determined direction has none."""
    sd = np.sqrt(np.diag(covariance))
    # An unknown that takes part in no determined direction has no variance in it.
    safe = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.clip(correlation, -1.0, 1.0)


def without_effect_of(sensitivity: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[str, ...]:
    """The unknowns without any effect."""
    sizes = np.linalg.norm(sensitivity, axis=0) * np.array([u.scale for u in unknowns])
    # So little beside the largest is what rounding leaves of no effect.
    least = 1e-12 * max(sizes.max(), 1e-300)
    return tuple(u.name for u, s in zip(unknowns, sizes, strict=True) if not s > least)


# Directions whose 95 % interval reaches so far that it determines nothing: the rule of the factor.
#
# A singular value may be far from zero and still leave a parameter anywhere between a tenth and ten
# times its value. Everything is in relative coordinates.


TAKES_NO_PART = 1e-3
"""of a unit direction that is not determined: less leaves an unknown determined"""

_FAR = math.log(FACTOR) / Z95
"""sd in relative coordinates of an interval that reaches just as far as the factor"""


def _reaching_too_far(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[int]:
    """The unknowns whose 95 % interval reaches further than the factor."""
    # Values between bounds of both signs have no factor to go by: theirs is `weakly_held`.
    return [
        i
        for i, u in enumerate(unknowns)
        if (u.logarithmic or u.symmetric) and covariance[i, i] > _FAR**2
    ]


def too_wide(
    rows: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of full rank along which a 95 % interval still spans more than the factor.

    Args:
        rows: (any, q) the whitened sensitivity, with the rows of priors that count.
        covariance: (q, q) of the unknowns by these rows.
        unknowns: (q,) what the columns are.
    """
    if not _reaching_too_far(covariance, unknowns):
        return []
    # Not scaled by priors or intervals, as the rank is: here a unit is a factor of e for all.
    plain = directions(rows, np.ones(len(unknowns)))
    wide = [
        unit_vector(v) for s, v in zip(plain.singular, plain.right, strict=True) if s * _FAR < 1
    ]
    # Several directions can make one interval wide of which none is so by itself.
    return wide or [unit_vector(plain.right[-1])]


def single_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """For each unknown whose interval reaches too far the direction in which it does."""
    # How the others move with it, by their regression on it: the column of the covariance.
    return [
        unit_vector(covariance[:, i] / math.sqrt(covariance[i, i]))
        for i in _reaching_too_far(covariance, unknowns)
    ]


def reported_too_wide(covariance: np.ndarray, unknowns: tuple[Unknown, ...]) -> list[np.ndarray]:
    """As `too_wide` has them, by the covariance of the intervals that are reported."""
    # Autocorrelated residuals have no rows of their own, only the covariance of the sandwich.
    if not _reaching_too_far(covariance, unknowns):
        return []
    # As in `too_wide`: if no single direction is too wide, the widest stands for their sum.
    values, vectors = np.linalg.eigh(covariance)
    return [unit_vector(v) for v in vectors[:, values > _FAR**2].T] or [unit_vector(vectors[:, -1])]


def weakly_held(
    without_weak: np.ndarray, covariance: np.ndarray, unknowns: tuple[Unknown, ...]
) -> list[np.ndarray]:
    """Directions of unknowns that may be zero and that weak priors alone hold.

    For those of one sign the factor of ten tells it; here it is an sd, without the weak priors,
    beyond the unknown's scale and ten times the one with them.

    Args:
        without_weak: (q, q) covariance without the weak priors of the nuisances.
        covariance: (q, q) with them.
        unknowns: (q,) what the columns are.
    """
    return [
        unit_vector(without_weak[:, i] / math.sqrt(without_weak[i, i]))
        for i, u in enumerate(unknowns)
        if not u.logarithmic and without_weak[i, i] > max(1.0, FACTOR**2 * covariance[i, i])
    ]


def further(directions: list[np.ndarray], null: list[np.ndarray]) -> list[np.ndarray]:
    """Of the directions those that are led by an unknown which the null ones do not touch."""
    # One that only leans on a null direction would say the same thing again in other words.
    added: list[np.ndarray] = []
    for v in directions:
        leads = int(np.argmax(np.abs(v)))
        if all(abs(w[leads]) <= TAKES_NO_PART for w in (*null, *added)):
            added.append(v)
    return added


def one_sided(
    covariance: np.ndarray, unknowns: tuple[Unknown, ...], names: tuple[str, ...]
) -> list[np.ndarray]:
    """For each of the unknowns that the likelihood does not bound its direction, without those
    that it does."""
    open_ = np.array([u.name in names for u in unknowns])
    return [
        unit_vector(np.where(open_, covariance[:, i] / np.sqrt(np.diag(covariance)), 0.0))
        for i in np.flatnonzero(open_)
    ]


def factor(u: Unknown, sd: float, limits: Mapping[str, tuple[float, float]]) -> float:
    """From the value to the further end of its interval; infinite where that holds zero."""
    if u.name not in limits:
        return math.exp(Z95 * sd)
    ratios = [end / u.value for end in limits[u.name]]
    return max(max(r, 1.0 / r) if r > 0 else math.inf for r in ratios)


def holds_zero(u: Unknown, sd: float, limits: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the interval of an unknown of either sign holds zero."""
    if u.name not in limits:
        return Z95 * sd >= u.distance
    low, high = limits[u.name]
    return low <= 0.0 <= high
