"""Other parameter values that the data do not tell from those of an optimum."""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import OperatingPoint, operating_point
from heli_jax.identification.estimation.evaluation import Evaluation, named
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.identifiability.combinations import combinations
from heli_jax.identification.identifiability.verdict import Combination, SecondSolution, Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution

# The smallest sum of squares with some coordinates held: how a profile, a valley and the search for
# the same responses move all other unknowns.


class Rows(NamedTuple):
    """Residuals at a point, whitened, and their derivatives."""

    r: np.ndarray
    """(n,)"""
    J: np.ndarray
    """(n, q)"""


def rows_at(at: Solution, z: np.ndarray | jax.Array) -> Rows:
    """Return the rows of the fit at z (q,)."""
    made = residual_and_jacobian(at.layout, at.data, at.noise, jnp.asarray(z, at.z.dtype))
    return Rows(*(np.asarray(v, np.float64) for v in jax.device_get((made.r, made.J))))


def squares_of(r: np.ndarray) -> float:
    """Return the sum of squares; infinite or NaN where one is."""
    r = np.asarray(r, np.float64)
    with np.errstate(all="ignore"):
        return float(r @ r)


_RIDGE = 1.0 / 3.0
"""one over how far a step may go, in coordinates most of which are logarithms, for nothing"""
_ENOUGH = 0.05
"""squares that a further step may promise where a search stops"""
_STEPS = 10
_HUGE = 1e50


def descend(
    rows: Callable[[np.ndarray], Rows],
    z: np.ndarray,
    moving: np.ndarray,
    *,
    floor: float = _RIDGE,
    enough: float = _ENOUGH,
    steps: int = _STEPS,
) -> tuple[np.ndarray, float]:
    """Return the point (q,) of the least squares near z by Levenberg and Marquardt, and the sum
    there less what a further step promises, infinite where nothing finite is found.

    Args:
        z: (q,) where the search begins.
        moving: (q,) the coordinates that may change.
        floor: to which the ridge falls: zero where all directions are determined.
        enough: squares that a further step may promise at the end.
        steps: at most.
    """
    now, ridge, promised = rows(z), _RIDGE, math.inf
    squares = squares_of(now.r)
    for _ in range(steps):
        J = now.J[:, moving]
        # Past that the squares of a simulation that has diverged are no numbers.
        if not (squares < _HUGE and np.abs(J).max(initial=0.0) < _HUGE):
            return z, math.inf
        Q, R = np.linalg.qr(J)
        left = -(Q.T @ now.r)
        damped = np.vstack([R, ridge * np.eye(R.shape[1])])
        target = np.concatenate([left, np.zeros(R.shape[1])])
        step = np.zeros(z.size)
        step[moving] = np.linalg.lstsq(damped, target, rcond=None)[0]
        promised = float(left @ left - np.sum((left - R @ step[moving]) ** 2))
        if promised < enough:
            break
        then = rows(z + step)
        gained = squares - squares_of(then.r)
        # Negated: also what is not finite is no step.
        if gained > 0:
            z, now, squares = z + step, then, squares - gained
            ridge = max(floor, ridge / 10.0)
        elif ridge > _RIDGE * 1e4:
            break
        else:
            ridge = max(10.0 * ridge, _RIDGE)
    return z, squares - promised


# Points far from an optimum at which the residuals are the same: what is true along all of them.
#
# A slope at one point tells a product of powers from a sum by nothing: La + Lb has the slope of
# La Lb where both are equal. So one unknown after the other is moved by a finite factor, the rest
# follow by Gauss and Newton, and only what has stayed is determined.


SAME = 3.84
"""squares by which a point may be worse and still be as good: the 95 % point of chi-squared"""
_FACTOR = 1.5
"""by which each unknown is moved, up and down; those tied to it move as far, or change sign"""
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
        """
        layout = self.at.layout
        names, z = layout.of_interest, np.array(self.at.z, np.float64)
        for name, value in {**guess, **held}.items():
            at = value
            if name in layout.free:
                kind = layout.kinds[layout.free.index(name)]
                at = transforms.coordinate(self.problem.free[name], kind, value)
            if at is None:
                return None
            z[names.index(name)] = at
        moving = np.array([i >= len(names) or names[i] not in held for i in range(layout.size)])
        # The parameters' priors stand before the nuisances'.
        last = self.e.r.size - (layout.size - layout.first_nuisance)
        own = slice(0) if priors else slice(last - len(layout.free), last)
        here = np.delete(np.asarray(self.e.r, np.float64), own)
        base = here if same else np.zeros(here.size)

        def rows(z: np.ndarray) -> Rows:
            r, J = rows_at(self.at, z)
            return Rows(np.delete(r, own) - base, np.delete(J, own, axis=0))

        z, squares = descend(rows, z, moving)
        excess = squares - squares_of(here - base)
        if not math.isfinite(excess):
            return None
        values, _ = named(layout, self.at.data, jnp.asarray(z, self.at.z.dtype))
        return Point({n: float(v) for n, v in zip(names, values, strict=True)}, excess)

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
        added = combinations(null, covariance, unknowns, units)
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
    """True if a combination is the same at all points, and its parameters are not."""
    changes = [_change(c, unknowns, point) for point in points]
    return any(moved for _, moved in changes) and all(same for same, _ in changes)


def _told(
    c: Combination, unknowns: tuple[Unknown, ...], points: Sequence[Mapping[str, float]]
) -> bool:
    """True if the points decide: the combination changed, or its parameters moved."""
    changes = [_change(c, unknowns, point) for point in points]
    return any(moved or not same for same, moved in changes)


def _change(
    c: Combination, unknowns: tuple[Unknown, ...], point: Mapping[str, float]
) -> tuple[bool, bool]:
    """Return whether a combination is the same at a point, and whether its own parameters moved far
    enough for that to tell."""
    values = {u.name: u.value for u in unknowns}
    if c.kind == "sum":
        parts = [w * (point[n] - values[n]) for n, w in c.exponents.items()]
        size, sd = max(abs(values[n]) for n in c.exponents), c.sd
    else:
        ratios = {n: point[n] / values[n] for n in c.exponents}
        if any(ratio <= 0 for ratio in ratios.values()):
            return False, True
        parts = [w * math.log(ratios[n]) for n, w in c.exponents.items()]
        size, sd = 1.0, c.sd / c.value if c.value else 0.0
    moved = sum(abs(part) for part in parts)
    return abs(sum(parts)) <= max(2.0 * sd, _STAYS * moved), moved > _MOVED * size


# Other parameters with the same responses: two real modes that other parameters make.
#
# A lag of a servo before the damping of the machine answers as a slow servo before a quick machine
# does, with another gain. No slope at one of the two tells of the other, and which of them a search
# ends at is a matter of its start. So for each pair of real modes the parameters that make them are
# put where they make each other's, the others follow until the linearised responses are the same,
# and the residuals are evaluated there.

_APART = 9.0
"""squares that the slopes let expect of the other values: below, the two are the same"""
_FREQUENCIES = 15
"""at which responses are compared, from the record's length to the samples'"""
_ALIKE = 0.02
"""relative difference of responses up to which residuals are asked whether they are the same"""
_THE_SAME = 1e-3
"""the same, up to which a filter is begun from there"""
_OPEN = 1e-4
"""part of the largest singular value below which the responses do not tell a direction"""
_RATIO = 1.1
"""of two modes: nearer ones have nothing to exchange"""
_MAKES = 0.2
"""relative change of a mode by that of a parameter, from which on the parameter makes it"""
_REACH = math.log(300.0)
"""how far a parameter may be put"""
_CANDIDATES = 12
"""points at most that a search of responses begins from"""
_RESPONSE_STEPS = 40
"""of such a search"""
_ARRIVED = 1e-14
"""squares of relative differences at its end"""
_DIFFERENCE = 1e-5
"""of a parameter's coordinate"""
_CHANGED = 0.05
"""relative change of a parameter's value that is worth naming"""
_FLOOR = 1e-4
"""of a response's largest gain, below which it is compared with that"""


def second_solutions(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    *,
    optimum: bool = True,
) -> tuple[SecondSolution, ...]:
    """Other admissible values of the free parameters that the data do not tell from those here.

    Args:
        optimum: whether it is one, about which the other unknowns may follow.
    """
    values = {n: float(v) for n, v in zip(at.layout.of_interest, e.named, strict=True)}
    values = {n: values[n] for n in problem.free if n in values}
    # At the start values nothing has been fitted: any step would make the other the better one. Of
    # rows that are sums over frequencies none stays.
    if len(values) < 2 or not (optimum or at.layout.noise_model == "white"):
        return ()
    finite = np.isfinite(e.r).all() and np.isfinite(e.J).all()
    if not (finite and all(map(math.isfinite, values.values()))):
        return ()
    family, solutions = _Family(problem, values), []
    for z in family.same_responses():
        point = Valley(problem, at, e).visit({}, family.by_name(z), same=not optimum, priors=True)
        if point is None or not point.excess <= SAME:
            continue
        there = {n: point.values[n] for n in values}
        changed = family.changed(there)
        # Along a valley other values are as good anyhow, and it is said what goes together there.
        if changed and not family.open_along(changed) and _expected(at, e, there) > _APART:
            solutions.append(SecondSolution(there, changed))
    return tuple(solutions)


def _expected(at: Solution, e: Evaluation, values: Mapping[str, float]) -> float:
    """Squares that the slopes here let expect of other values, the nuisances following: with few of
    them the other values are within the interval of these."""
    names, J = at.layout.of_interest, np.asarray(e.J, np.float64)
    here = np.asarray(e.named, np.float64)
    there = np.array([values.get(n, v) for n, v in zip(names, here, strict=True)])
    moved = J[:, : len(names)] @ ((there - here) / np.where(e.slopes != 0, e.slopes, np.inf))
    others = J[:, len(names) :]
    if others.size:
        others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-300)
        moved = moved - others @ np.linalg.lstsq(others, moved, rcond=None)[0]
    return float(moved @ moved)


def same_responses(problem: Problem, values: Mapping[str, float]) -> list[dict[str, float]]:
    """Other values of the free parameters whose responses to the inputs are the same, and determine
    them.

    Args:
        problem: with bounds; its model is linearised.
        values: of the free parameters, SI.
    """
    family = _Family(problem, values)
    if family.open_along(tuple(values)):
        return []
    near = (z for z in family.same_responses() if family.apart(z) < _THE_SAME)
    others = (family.by_name(z) for z in near)
    return [o for o in others if all(transforms.inside(problem.free[n], v) for n, v in o.items())]


class _Family:
    """The linearised model by coordinates of its free parameters, zero where they are here."""

    def __init__(self, problem: Problem, values: Mapping[str, float]) -> None:
        self.problem, self.values, self.names = problem, values, list(values)
        flight, late = problem.training[0], problem.model.delay_parameters
        self.known, self.value = flight.known, np.array(list(values.values()))
        # What is zero has no relative change, nor has a delay, which may be: so many samples.
        self.relative = np.array([v != 0.0 and n not in late for n, v in values.items()])
        units = np.array([flight.dt if n in late else 1.0 for n in values])
        self.size = np.where(self.relative, self.value, units)
        # A logarithm keeps the sign.
        turns = np.array([transforms.changes_sign(problem.free[n]) for n in values])
        self.log = self.relative & ~turns
        self.about: OperatingPoint = operating_point(
            problem.model,
            self._params(np.zeros(len(values))),
            flight.inputs,
            flight.outputs,
            flight.dt,
            substeps=problem.substeps,
        )
        self.omega = np.geomspace(
            2.0 * np.pi / (flight.n_samples * flight.dt), np.pi / flight.dt, _FREQUENCIES
        )
        self.rows = [naming.names(problem.model.Outputs).index(n) for n in flight.outputs]

    def by_name(self, z: np.ndarray) -> dict[str, float]:
        """Values at coordinates (q,)."""
        change = np.where(self.log, np.expm1(np.where(self.log, z, 0.0)), z)
        return dict(zip(self.names, map(float, self.value + change * self.size), strict=True))

    def changed(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """The parameters whose values are others than here."""
        there = np.array([values[n] for n in self.names])
        size = np.maximum(np.abs(self.value), np.abs(there))
        moved = np.abs(there - self.value) > _CHANGED * (size + self.size * ~self.relative)
        return tuple(n for n, m in zip(self.names, moved, strict=True) if m)

    def _params(self, z: np.ndarray) -> Any:  # a record of the model's Params
        return self.problem.params_with(self.known | self.by_name(z))

    def _matrices(self, z: np.ndarray) -> list[np.ndarray]:
        at = (self.about.state, self.about.inputs)
        matrices = linearize(self.problem.model, self._params(z), *at).matrices
        return [np.asarray(M, np.float64) for M in matrices]

    def responses(self, z: np.ndarray) -> np.ndarray:
        """(k, p, m) of the measured outputs, with the delays of the inputs."""
        A, B, C, D = self._matrices(z)
        s = 1j * self.omega
        H = C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B[None] + 0j) + D
        late, params = dict(self.problem.model.delays), self._params(z)
        names = naming.names(self.problem.model.Inputs)
        delays = [float(getattr(params, late[n])) if n in late else 0.0 for n in names]
        return (H * np.exp(-s[:, None] * np.array(delays))[:, None, :])[:, self.rows]

    @functools.cached_property
    def here(self) -> tuple[np.ndarray, np.ndarray]:
        """Responses (k, p, m) at zero, and their sizes, by which differences are judged."""
        here = self.responses(np.zeros(len(self.names)))
        gain = np.abs(here)
        largest = np.max(gain, axis=0)
        # A response of nothing at all has no size of its own.
        largest = np.where(largest > 0, largest, max(float(np.max(gain)), 1e-300))
        return here, np.maximum(gain, _FLOOR * largest)

    def differences(self, z: np.ndarray) -> np.ndarray:
        """(2 k p m,) of the responses from those here, relative; their squares add up to a mean."""
        here, gain = self.here
        d = ((self.responses(z) - here) / gain).ravel()
        return np.concatenate([d.real, d.imag]) / math.sqrt(d.size)

    def apart(self, z: np.ndarray) -> float:
        """Their root mean square."""
        return float(np.linalg.norm(self.differences(z)))

    def rows_at(self, z: np.ndarray) -> Rows:
        """Return the differences and their derivatives by all coordinates."""
        r, steps = self.differences(z), _DIFFERENCE * np.eye(z.size)
        J = [(self.differences(z + h) - r) / _DIFFERENCE for h in steps]
        return Rows(r, np.stack(J, axis=1))

    def open_along(self, names: Sequence[str]) -> bool:
        """True if some of these parameters may move with all responses as they are."""
        J = self.rows_at(np.zeros(len(self.names))).J
        if not np.isfinite(J).all():
            return True
        size = np.linalg.norm(J, axis=0)
        # What has no effect on the responses, such as an output's offset, is nobody's partner.
        dead = size <= _OPEN * np.max(size, initial=0.0)
        _, values, right = np.linalg.svd(J / np.where(dead, 1.0, size), full_matrices=False)
        null = right[values < _OPEN * np.max(values)]
        return bool(np.any(np.abs(null[:, [self.names.index(n) for n in names]]) > 0.1))

    def same_responses(self) -> list[np.ndarray]:
        """Return other coordinates at which the model answers about alike."""
        others: list[np.ndarray] = []
        with np.errstate(all="ignore"):
            for start in self._exchanged():
                z, squares = start, 0.0
                # Held until the others have followed, or those that exchange the modes would come
                # back.
                for moving in (start == 0.0, np.ones(len(start), bool)):
                    z, squares = descend(
                        self.rows_at, z, moving, floor=0.0, enough=_ARRIVED, steps=_RESPONSE_STEPS
                    )
                moved = np.max(np.abs(z[self.relative]), initial=0.0)
                alike = squares < _ALIKE**2 and moved > _CHANGED
                if alike and not any(np.allclose(z, other, atol=0.02) for other in others):
                    others.append(z)
        return others

    def _exchanged(self) -> list[np.ndarray]:
        """Coordinates at which two real modes are exchanged, but for what is not linear in them."""
        q, A = len(self.names), self._matrices(np.zeros(len(self.names)))[0]
        if not np.isfinite(A).all():
            return []
        here: np.ndarray = np.asarray(np.linalg.eigvals(A))
        largest = np.max(np.abs(here), initial=0.0)
        real = np.flatnonzero((abs(np.imag(here)) < 1e-6 * largest) & (abs(here) > 1e-6 * largest))
        pairs = [
            (i, j)
            for i, j in itertools.combinations(real, 2)
            # The same mode twice has no slope, and nothing to exchange.
            if here[i].real * here[j].real > 0
            and abs(math.log((here[i] / here[j]).real)) > np.log(_RATIO)
        ]
        if not pairs:
            return []
        slopes = np.stack([self._slope(here, a) for a in range(q)], axis=1)
        starts = []
        for i, j in pairs:
            target = math.log((here[j] / here[i]).real) * np.array([1.0, -1.0])
            for a, b in itertools.combinations(range(q), 2):
                E = slopes[np.ix_([i, j], [a, b])]
                # Each of the two has to make a mode of its own.
                straight, crossed = np.abs(np.diag(E)), np.abs(np.diag(E[::-1]))
                each = max(straight.min(), crossed.min())
                if each < _MAKES or abs(np.linalg.det(E)) < _MAKES * each:
                    continue
                z = np.zeros(q)
                z[[a, b]] = np.linalg.solve(E, target)
                if np.max(np.abs(z)) < _REACH:
                    starts.append((each, np.where(self.log, z, np.expm1(z))))
        starts.sort(key=lambda one: -one[0])
        return [z for _, z in starts[:_CANDIDATES]]

    def _slope(self, here: np.ndarray, a: int) -> np.ndarray:
        """(n,) change of the logarithm of each pole by coordinate a, complex ones by their real
        part; which pole is which is told by nearness, as the step is small."""
        A = self._matrices(_DIFFERENCE * np.eye(len(self.names))[a])[0]
        if not (self.relative[a] and np.isfinite(A).all()):
            return np.zeros(len(here))
        there = np.linalg.eigvals(A)
        near = there[np.argmin(np.abs(here[:, None] - there[None, :]), axis=1)]
        ratio = np.where(here != 0, near / np.where(here != 0, here, 1.0), 1.0)
        slope = np.real(ratio - 1.0) / _DIFFERENCE
        return np.where(np.isfinite(slope), slope, 0.0)
