"""Points far from an optimum at which the residuals are the same: what is true along all of them.

A slope at one point tells a product of powers from a sum by nothing: La + Lb has the slope of
La Lb where both are equal. So one unknown after the other is moved by a finite factor, the rest
follow by Gauss and Newton, and only what has stayed is determined.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.identifiability.combinations import combinations, sums
from heli_jax.identification.identifiability.verdict import Combination, Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution

SAME = 3.84
"""squares by which a point may be worse and still be as good: the 95 % point of chi-squared"""
_FACTOR = 1.5
"""by which each unknown is moved, up and down; those tied to it move as far, or change sign"""
_LITTLE = 0.01 * SAME
"""squares that are not worth a further step"""
_STEPS = 5
"""of Gauss and Newton"""
_RIDGE = 1.0 / 3.0
"""one over how far a step may go, in coordinates most of which are logarithms, for nothing"""
_MOVED = 0.3
"""logarithm by which a combination's own parameters have to move for its staying to tell"""
_STAYS = 0.02
"""part of that by which it may change: what rounded exponents make"""


class Point(NamedTuple):
    """Where the residuals were looked at."""

    values: dict[str, float]
    """of the unknowns of interest, SI"""
    excess: float
    """by how much its sum of squares is above that of the optimum"""


class Valley(NamedTuple):
    """A solution whose surroundings may be visited."""

    problem: Problem
    at: Solution
    e: Evaluation
    """there"""

    def visit(
        self,
        held: Mapping[str, float],
        guess: Mapping[str, float],
        *,
        same: bool = False,
        priors: bool = False,
    ) -> Point | None:
        """The best point with some values held; None where there is none.

        Args:
            held: values that stay, SI.
            guess: of other unknowns of interest, where the search begins; the optimum's unless
                named.
            same: whether the residuals themselves have to stay, each of them, and not only the sum
                of their squares; asked where the valley's own point is no optimum too.
            priors: whether the parameters' own priors count.
        """
        layout = self.at.layout
        names, z = layout.of_interest, np.array(self.at.z, np.float64)
        for name, value in {**guess, **held}.items():
            at = self._coordinate(name, value)
            if at is None:
                return None
            z[names.index(name)] = at
        moving = np.array([i >= len(names) or names[i] not in held for i in range(layout.size)])
        now, here = self._at(z), self._rows(self.e, priors)[0]
        base = here if same else np.zeros(here.size)
        for _ in range(_STEPS):
            r, J = self._rows(now, priors)
            r = r - base
            if _squares(r) < _LITTLE:
                break  # there is no more to gain
            step = np.zeros(layout.size)
            ridge = _RIDGE * np.eye(int(moving.sum()))
            left = np.concatenate([-r, np.zeros(len(ridge))])
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                return None
            step[moving] = np.linalg.lstsq(np.vstack([J[:, moving], ridge]), left, rcond=None)[0]
            then = self._at(now.z + step)
            gained = _squares(r) - _squares(self._rows(then, priors)[0] - base)
            # Negated: also what is not finite is no step.
            if not gained > 0:
                break
            now = then
            if gained < _LITTLE:
                break
        excess = _squares(self._rows(now, priors)[0] - base) - _squares(here - base)
        values = {n: float(v) for n, v in zip(names, now.named, strict=True)}
        return Point(values, excess) if math.isfinite(excess) else None

    def tied(
        self, null: list[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
    ) -> tuple[Combination, ...]:
        """Of the products of powers, else of the sums, that do not change along null directions at
        the optimum, those that do not change far from it either.

        Args:
            null: unit directions (q,) in relative coordinates, of one group of unknowns.
            covariance: (q, q) of what is determined, in the same.
            unknowns: (q,) what the coordinates are.
        """
        products = combinations(null, covariance, unknowns)
        units = {
            u.name: naming.unit(self.problem.model.Params, u.name)
            for u in unknowns
            if u.is_parameter
        }
        added = sums(null, covariance, unknowns, units)
        if not (products or added):
            return ()
        points: list[dict[str, float]] = []
        # As many unknowns span the valley as it has directions; the others are asked only where
        # these left a combination's own parameters nearly where they were.
        for asked, more in enumerate(self._far_points(null, unknowns), start=1):
            points += more
            if asked >= len(null) and all(_told(c, unknowns, points) for c in (*products, *added)):
                break
        return tuple(c for c in products if _stays(c, unknowns, points)) or tuple(
            c for c in added if _stays(c, unknowns, points)
        )

    def _far_points(
        self, null: list[np.ndarray], unknowns: tuple[Unknown, ...]
    ) -> Iterator[list[dict[str, float]]]:
        """Points along the valley, by value of the unknowns, for each unknown that is moved.

        Those that together span the valley come first.
        """
        N = np.array(null) * np.array([u.per_log if u.logarithmic else 0.0 for u in unknowns])
        # Onto the null directions: how the logarithms of all go with that of one.
        onto = np.linalg.pinv(N) @ N
        pivoted: Any = scipy.linalg.qr(onto, mode="r", pivoting=True)
        for i in pivoted[1].tolist():
            u = unknowns[i]
            if not onto[i, i] > 1e-2:
                continue
            points, along = [], onto[i] / onto[i, i]
            for factor in (_FACTOR, 1.0 / _FACTOR):
                held = {u.name: u.value * factor}
                for guess in _tangents(along, factor, i, unknowns):
                    point = self.visit(held, guess, same=True)
                    if point is not None and point.excess <= SAME:
                        points.append(point.values)
                        break
            yield points

    def _coordinate(self, name: str, value: float) -> float | None:
        layout, data = self.at.layout, self.at.data
        if name not in layout.free:
            return value
        i = layout.free.index(name)
        if not transforms.inside(self.problem.free[name], value):
            return None
        # From NumPy: to index an array of JAX's is a program of its own to load.
        limits = tuple(np.asarray(of)[i] for of in (data.sign, data.low, data.high))
        z = float(transforms.to_coordinate(layout.kinds[i], value, *limits))
        return z if math.isfinite(z) else None

    def _at(self, z: np.ndarray) -> Evaluation:
        layout, data, noise, z0 = self.at
        return evaluate(layout, data, noise, jnp.asarray(z, z0.dtype))

    def _rows(self, e: Evaluation, priors: bool) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and Jacobian; the parameters' priors stand before the nuisances'."""
        layout = self.at.layout
        r, J = np.asarray(e.r, np.float64), np.asarray(e.J, np.float64)
        if priors:
            return r, J
        last = r.size - (layout.size - layout.first_nuisance)
        own = slice(last - len(layout.free), last)
        return np.delete(r, own), np.delete(J, own, axis=0)


def _squares(r: np.ndarray) -> float:
    with np.errstate(all="ignore"):
        return float(r @ r)


def _tangents(
    along: np.ndarray, factor: float, i: int, unknowns: tuple[Unknown, ...]
) -> Sequence[dict[str, float]]:
    """Where the others go with unknown i: by the same powers of the factor, or by equal steps."""
    others = [k for k in np.flatnonzero(abs(along) > 1e-6) if k != i and unknowns[k].logarithmic]
    powers = {unknowns[k].name: unknowns[k].value * factor ** float(along[k]) for k in others}
    steps = {
        unknowns[k].name: unknowns[k].value * (1.0 + (factor - 1.0) * float(along[k]))
        for k in others
    }
    return (powers, steps)


def _stays(
    c: Combination, unknowns: tuple[Unknown, ...], points: Sequence[Mapping[str, float]]
) -> bool:
    """Whether a combination is the same at all points, and its parameters are not."""
    changes = [_change(c, unknowns, point) for point in points]
    return any(one.moved for one in changes) and all(one.same for one in changes)


def _told(
    c: Combination, unknowns: tuple[Unknown, ...], points: Sequence[Mapping[str, float]]
) -> bool:
    """True where the points decide: the combination changed, or its parameters moved."""
    return any(one.moved or not one.same for one in (_change(c, unknowns, p) for p in points))


class _Change(NamedTuple):
    """The change of a combination at a point."""

    same: bool
    moved: bool
    """whether its own parameters moved far enough for that to tell"""


def _change(c: Combination, unknowns: tuple[Unknown, ...], point: Mapping[str, float]) -> _Change:
    values = {u.name: u.value for u in unknowns}
    if c.kind == "sum":
        parts = [w * (point[n] - values[n]) for n, w in c.exponents.items()]
        size, sd = max(abs(values[n]) for n in c.exponents), c.sd
    else:
        ratios = {n: point[n] / values[n] for n in c.exponents}
        if any(ratio <= 0 for ratio in ratios.values()):
            return _Change(same=False, moved=True)
        parts = [w * math.log(ratios[n]) for n, w in c.exponents.items()]
        size, sd = 1.0, c.sd / c.value if c.value else 0.0
    moved = sum(abs(part) for part in parts)
    return _Change(abs(sum(parts)) <= max(2.0 * sd, _STAYS * moved), moved > _MOVED * size)
