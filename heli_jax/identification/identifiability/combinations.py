"""Products of powers, such as a/Ixx, and sums, such as La + Lb, that the data may determine where
the parameters are not: by the slopes at one point, which `valley` asks far from it."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.verdict import (
    Z95,
    Combination,
    SecondSolution,
    Unknown,
)

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
