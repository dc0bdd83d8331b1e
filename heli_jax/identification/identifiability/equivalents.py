"""Other parameter values with the same residuals as those of an optimum, and the combinations of
parameters that are equal at all of them.

One search serves all: some values are set elsewhere, all other unknowns follow (`Valley.visit`),
and the sum of squares shows whether the point fits as well. The values come from null directions
(`Valley.determined_combinations`), or from an exchange of two modes (`second_solutions`).
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import OperatingPoint, operating_point
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate, named
from heli_jax.identification.estimation.levenberg_marquardt import measured_count, optimise
from heli_jax.identification.identifiability.verdict import (
    Z95,
    Combination,
    SecondSolution,
    Unknown,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution

_STEPS = 20
"""evaluations of one search"""


def own_record(at: Solution, e: Evaluation) -> tuple[Solution, Evaluation]:
    """Return the point with the record that the model itself simulates there, with the same samples
    missing: its residuals are those of the priors alone."""
    flights = tuple(
        flight._replace(
            outputs={
                n: jnp.where(jnp.isfinite(y), jnp.asarray(run[n], jnp.asarray(y).dtype), jnp.nan)
                for n, y in flight.outputs.items()
            }
        )
        for flight, run in zip(at.data.flights, e.simulated, strict=True)
    )
    at = at._replace(data=at.data._replace(flights=flights))
    return at, evaluate(*at)


# Products of powers, such as a/Ixx, and sums, such as La + Lb, that do not change along the null
# directions at one point.

_ROUNDED = 0.02
"""distance of a power or factor from a multiple of a quarter that is noise"""
_LARGEST_FACTOR = 4.0
"""of a parameter in a sum"""
_LARGEST = 700.0
"""log of the largest value: exp overflows at 709"""


def unit_vector(v: np.ndarray) -> np.ndarray:
    """Return the vector with length one, its largest part positive."""
    v = v / np.linalg.norm(v)
    return v if v[np.argmax(np.abs(v))] > 0 else -v


def combinations(
    null: Sequence[np.ndarray],
    covariance: np.ndarray,
    unknowns: tuple[Unknown, ...],
    units: Mapping[str, str | None] | None = None,
) -> tuple[Combination, ...]:
    """Return the products of powers that do not change along the null directions (q,), or with
    `units` the sums of parameters of one unit; with sds by a covariance (q, q)."""
    # From a relative coordinate to log |value|, or for sums to the value.
    to = np.array([u.per_log for u in unknowns])
    if units is not None:
        to = to * [u.value if u.logarithmic else 0.0 for u in unknowns]
    moved = [v * to for v in null]
    if not moved or not all(np.linalg.norm(v) > 0 for v in moved):
        return ()
    W, pivots = row_reduced(np.array([unit_vector(v) for v in moved]), unknowns)
    found = []
    for i in range(W.shape[1]):
        if i in pivots or not np.any(abs(W[:, i]) >= (0.1 if units is None else _ROUNDED)):
            continue
        # W has the identity in the pivots' columns: unknown i less W[:, i] times the pivots is
        # constant along the null directions.
        weights = np.zeros(W.shape[1])
        weights[i] = 1.0
        weights[pivots] = -W[:, i]
        weights = np.array([_rounded(w, units is not None) for w in weights])
        members = [unknowns[k] for k in np.flatnonzero(weights)]
        if not all(u.logarithmic for u in members):
            continue
        if units is None:
            # a/Ixx rather than Ixx/a
            weights = -weights if weights[pivots].sum() < 0 else weights
        elif (
            len(members) < 2
            or np.abs(weights).max() > _LARGEST_FACTOR
            or len({units.get(u.name, u.name) for u in members}) > 1
        ):
            continue
        by_name = {u.name: float(w) for u, w in zip(unknowns, weights, strict=True) if w}
        values = {u.name: u.value for u in members}
        made = _product if units is None else _sum
        along = weights * to
        sd = math.sqrt(max(0.0, float(along @ covariance @ along)))
        found.append(made(by_name, values, sd))
    return tuple(c for c in found if c.is_bounded)


def row_reduced(W: np.ndarray, unknowns: tuple[Unknown, ...]) -> tuple[np.ndarray, list[int]]:
    """Row-reduce the null directions; pivots are late parameters, so that ratios read a/Ixx."""
    W, pivots = W.copy(), []
    for k in range(W.shape[0]):
        size = np.max(np.abs(W[k:]), axis=0)
        size[pivots] = 0.0
        # Half of the largest pivot is stable enough.
        near = [i for i in range(W.shape[1]) if size[i] >= 0.5 * size.max()]
        # The pivot is in the denominator.
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


def _rounded(weight: float, simple: bool) -> float:
    """Return the nearest quarter if the weight is near it or of a sum, else two digits."""
    quarter = round(weight * 4) / 4
    if abs(weight) < _ROUNDED and simple:
        return 0.0
    return quarter if simple or abs(weight - quarter) < _ROUNDED else round(weight, 2)


def _product(powers: dict[str, float], values: dict[str, float], sd: float) -> Combination:
    """Return a product of powers; `sd` is that of its logarithm."""
    log = sum(e * math.log(abs(values[n])) for n, e in powers.items())
    value = math.exp(log) if abs(log) < _LARGEST else math.inf
    factor = math.exp(min(Z95 * sd, _LARGEST))

    def power(name: str, e: float) -> str:
        return name if e == 1 else f"{name}^{e:g}"

    over = " * ".join(power(n, e) for n, e in powers.items() if e > 0) or "1"
    under = [power(n, -e) for n, e in powers.items() if e < 0]
    below = under[0] if len(under) == 1 else f"({' * '.join(under)})"
    name = f"{over}/{below}" if under else over
    return Combination(name, powers, value, value * sd, value / factor, value * factor)


def _sum(factors: dict[str, float], values: dict[str, float], sd: float) -> Combination:
    def term(name: str, factor: float) -> str:
        size = "" if abs(factor) == 1 else f"{abs(factor):g} "
        return f"{'-' if factor < 0 else '+'} {size}{name}"

    value = sum(w * values[n] for n, w in factors.items())
    name = " ".join(term(n, w) for n, w in factors.items())
    name = name.removeprefix("+ ") if name.startswith("+") else name.replace("- ", "-", 1)
    ends = (value - Z95 * sd, value + Z95 * sd)
    return Combination(name, factors, value, sd, *ends, kind="sum")


# Slopes at one point do not distinguish a product from a sum: La + Lb has the slope of La Lb if
# both are equal. So each unknown is moved by a finite factor, all others follow, and a combination
# that stays constant is determined.

SAME = 3.84
"""excess of the squares up to which a point fits as well: 95 % point of chi-squared"""
_FACTOR = 1.5
"""by which each unknown is moved"""
_MOVED = 0.3
"""least change of the logarithms of a combination's parameters"""
_STAYS = 0.02
"""part of that by which the combination may change, as exponents are rounded"""


class Point(NamedTuple):
    """A point at which the residuals were evaluated."""

    values: dict[str, float]
    """of the unknowns of interest, SI"""
    excess: float
    """sum of squares above that of the optimum"""
    expected: float
    """the same as predicted by the slopes at the optimum"""


class Valley(NamedTuple):
    """The surroundings of a solution."""

    problem: Problem
    at: Solution
    e: Evaluation

    def visit(
        self, held: Mapping[str, float], guess: Mapping[str, float], *, priors: bool = False
    ) -> Point | None:
        """Return the best point with some values held; None if no finite one is found.

        Args:
            held: fixed values, SI.
            guess: values of other unknowns of interest at which the search begins; those of the
                solution unless named.
            priors: True to count the parameters' priors.
        """
        layout, data = self.at.layout, self.at.data
        names, z = layout.of_interest, np.array(self.at.z, np.float64)
        for name, value in {**guess, **held}.items():
            at = value
            if name in layout.free:
                kind = layout.kinds[layout.free.index(name)]
                at = transforms.coordinate(self.problem.free[name], kind, value)
            if at is None:
                return None
            z[names.index(name)] = at
        fixed = np.array([i < len(names) and names[i] in held for i in range(layout.size)])
        cost = self.e.cost
        if not priors:
            data = data._replace(prior_sd=jnp.full_like(data.prior_sd, jnp.inf))
            # The rows of the parameters' priors stand before those of the nuisances.
            last = self.e.r.size - (layout.size - layout.first_nuisance)
            cost -= float(np.sum(np.square(self.e.r[last - len(layout.free) : last])))
        optimum = optimise(layout, data, self.at.noise, z, _STEPS, held=fixed)
        excess = optimum.cost * measured_count(data) - cost
        if not math.isfinite(excess):
            return None
        values, _ = named(layout, data, jnp.asarray(optimum.z, self.at.z.dtype))
        predicted = np.asarray(self.e.J, np.float64) @ np.asarray(optimum.z - self.at.z)
        by_name = {n: float(v) for n, v in zip(names, values, strict=True)}
        return Point(by_name, excess, float(predicted @ predicted))

    def determined_combinations(
        self, null: Sequence[np.ndarray], covariance: np.ndarray, unknowns: tuple[Unknown, ...]
    ) -> tuple[Combination, ...]:
        """Return the products of powers, else the sums, that are constant along null directions,
        at the optimum and far from it."""
        params = self.problem.model.Params
        units = {u.name: naming.unit(params, u.name) for u in unknowns if u.is_parameter}
        found = [
            *combinations(null, covariance, unknowns),
            *combinations(null, covariance, unknowns, units),
        ]
        points = self._far_points(null, unknowns) if found else []
        stays = [c for c in found if _stays(c, unknowns, points)]
        return tuple(c for c in stays if c.kind == stays[0].kind)

    def _far_points(
        self, null: Sequence[np.ndarray], unknowns: tuple[Unknown, ...]
    ) -> list[dict[str, float]]:
        """Return the values at points along the valley, to which each unknown is moved in turn."""
        N = np.array(null) * np.array([u.per_log if u.logarithmic else 0.0 for u in unknowns])
        # The projection on the null directions: how all logarithms move with one.
        onto, points = np.linalg.pinv(N) @ N, []
        for i, u in enumerate(unknowns):
            if not onto[i, i] > 1e-2:
                continue
            powers = onto[i] / onto[i, i]
            guess = {
                other.name: other.value * _FACTOR**power
                for other, power in zip(unknowns, powers.tolist(), strict=True)
                if other.name != u.name and abs(power) > 1e-6
            }
            point = self.visit({u.name: u.value * _FACTOR}, guess)
            if point is not None and point.excess <= SAME:
                points.append(point.values)
        return points


def _stays(
    c: Combination, unknowns: tuple[Unknown, ...], points: Sequence[Mapping[str, float]]
) -> bool:
    """True if a combination is constant at all points, and its parameters change at one."""
    values, has_moved = {u.name: u.value for u in unknowns}, False
    for point in points:
        if c.kind == "sum":
            parts = [w * (point[n] - values[n]) for n, w in c.exponents.items()]
            size, sd = max(abs(values[n]) for n in c.exponents), c.sd
        else:
            ratios = {n: point[n] / values[n] for n in c.exponents}
            if any(ratio <= 0 for ratio in ratios.values()):
                return False
            parts = [w * math.log(ratios[n]) for n, w in c.exponents.items()]
            size, sd = 1.0, c.sd / c.value if c.value else 0.0
        moved = sum(abs(part) for part in parts)
        if abs(sum(parts)) > max(2.0 * sd, _STAYS * moved):
            return False
        has_moved |= moved > _MOVED * size
    return has_moved


# A fast servo before a slow vehicle has the same response as a slow servo before a fast vehicle
# with another gain. So for each pair of real modes the parameters are changed such that the two
# modes are exchanged, and all others follow.

_APART = 9.0
"""squares predicted by the slopes below which two solutions are one"""
_COMPENSATED = 0.2
"""excess over the squares predicted by the slopes above which nothing compensates an exchange"""
_CHANGED = 0.05
"""relative change of a parameter that counts"""
_RATIO = 1.1
"""of two modes, below which they are not exchanged"""
_MAKES = 0.05
"""smallest singular value over the largest, and smallest logarithm, of an exchange"""
_REACH = math.log(300.0)
"""largest change of a parameter's logarithm"""
_DIFFERENCE = 1e-5
"""relative step of a parameter"""


def second_solutions(problem: Problem, at: Solution, e: Evaluation) -> tuple[SecondSolution, ...]:
    """Return other admissible values of the free parameters that fit as well or better."""
    here = {n: float(v) for n, v in zip(at.layout.of_interest, e.named, strict=True)}
    here = {n: here[n] for n in problem.free if n in here}
    if len(here) < 2:
        return ()
    finite = np.isfinite(e.r).all() and np.isfinite(e.J).all()
    if not (finite and all(map(math.isfinite, here.values()))):
        return ()
    valley, solutions = Valley(problem, at, e), []
    for held in _exchanged_modes(problem, here):
        # First with the exchanged values held, then all together.
        point = valley.visit(held, {}, priors=True)
        if point is not None and point.excess <= _COMPENSATED * point.expected:
            guess = {n: point.values[n] for n in here}
            point = valley.visit({}, guess, priors=True)
        # A point within the interval by the slopes is no other solution.
        if point is None or not (point.excess <= SAME and point.expected > _APART):
            continue
        there = {n: point.values[n] for n in here}
        changed = tuple(n for n, v in here.items() if not _alike(v, there[n]))
        known = (all(map(_alike, s.values.values(), there.values())) for s in solutions)
        if changed and not any(known):
            solutions.append(SecondSolution(there, changed))
    return tuple(solutions)


def _alike(a: float, b: float) -> bool:
    return abs(a - b) <= _CHANGED * max(abs(a), abs(b))


class Modes(NamedTuple):
    """Linearised model in its eigenvectors."""

    at: OperatingPoint
    eigenvalues: np.ndarray
    """(n,) [1/s]"""
    right: np.ndarray
    """right eigenvectors (n, n), one per column"""
    left: np.ndarray
    """left eigenvectors (n, n), one per row"""
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray


# Params is Any: a record of the model's own class.
def modes_of(problem: Problem, params: Any, flight: Flight) -> Modes | None:
    """Return the model's modes at a flight's operating point.

    None if a matrix is not finite, or for a model with a controller, which acts at samples.
    """
    if problem.model.sampled is not None:
        return None
    at = operating_point(
        problem.model, params, flight.inputs, flight.outputs, flight.dt, substeps=problem.substeps
    )
    matrices = linearize(problem.model, params, at.state, at.inputs).matrices
    A, B, C, _ = (np.asarray(M, np.float64) for M in matrices)
    if not all(np.isfinite(M).all() for M in (A, B, C)):
        return None
    eigenvalues, right = np.linalg.eig(A)
    # The eigenvectors of a defective matrix have no inverse: the pseudoinverse spreads residues.
    return Modes(at, eigenvalues, right, np.linalg.pinv(right), A, B, C)


def relative_slopes(
    problem: Problem, values: Mapping[str, float], names: Sequence[str], modes: Modes
) -> dict[str, np.ndarray]:
    """Return by parameter the relative changes (n,), complex, of the eigenvalues over its own.

    First-order perturbation of simple eigenvalues.
    """
    slopes = {}
    for name in names:
        there = problem.params_with({**values, name: values[name] * (1.0 + _DIFFERENCE)})
        A = linearize(problem.model, there, modes.at.state, modes.at.inputs).matrices.A
        slope = (np.asarray(A, np.float64) - modes.A) / _DIFFERENCE
        changes = np.einsum("ki,ij,jk->k", modes.left, slope, modes.right)
        slopes[name] = changes / np.maximum(np.abs(modes.eigenvalues), 1e-300)
    return slopes


@np.errstate(all="ignore")
def _exchanged_modes(problem: Problem, values: Mapping[str, float]) -> list[dict[str, float]]:
    """Return for each pair of real modes of the linearised model the changed parameters that
    exchange the two, to first order in logarithms."""
    flight, found = problem.training[0], list[dict[str, float]]()
    names = [n for n, v in values.items() if v and n not in problem.model.delay_parameters]
    known = flight.known | dict(values)
    modes = modes_of(problem, problem.params_with(known), flight)
    here = np.zeros(0) if modes is None else modes.eigenvalues
    largest = np.max(np.abs(here), initial=0.0)
    real = np.flatnonzero((abs(np.imag(here)) < 1e-6 * largest) & (abs(here) > 1e-6 * largest))
    if modes is None or real.size < 2 or not names:
        return found
    # A shift of a decaying mode is relative to its size: the sign is that of the eigenvalue.
    relative = relative_slopes(problem, known, names, modes)
    slopes = np.array([np.real(relative[n]) * np.sign(np.real(here)) for n in names])
    for i, j in itertools.combinations(real, 2):
        ratio = float((here[j] / here[i]).real)
        if not (ratio > 0 and abs(math.log(ratio)) > math.log(_RATIO)):
            continue
        target, E = math.log(ratio) * np.array([1.0, -1.0]), slopes.T[[i, j]]
        # The smallest change of the parameters.
        z = np.linalg.pinv(E, rcond=_MAKES) @ target
        z[np.abs(z) < _MAKES] = 0.0
        if np.allclose(E @ z, target, rtol=0.1) and np.max(np.abs(z)) < _REACH:
            moved = {n: by for n, by in zip(names, z.tolist(), strict=True) if by}
            found.append({n: values[n] * math.exp(by) for n, by in moved.items()})
    return found
