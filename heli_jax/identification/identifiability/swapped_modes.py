"""Other parameters with the same responses: two real modes that other parameters make.

A lag of a servo before the damping of the machine answers as a slow servo before a quick machine
does, with another gain. No slope at one of the two tells of the other, and which of them a search
ends at is a matter of its start. So for each pair of real modes the parameters that make them are
put where they make each other's, the others follow until the linearised responses are the same,
and the residuals are evaluated there.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import OperatingPoint, operating_point
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.valley import SAME, Valley
from heli_jax.identification.identifiability.verdict import SecondSolution
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution

_APART = 9.0
"""squares that the slopes let expect of the other values: below, the two are the same"""
_FREQUENCIES = 15
"""at which responses are compared, from the record's length to the samples'"""
_ALIKE = 0.02
"""relative difference of responses up to which residuals are asked whether they are the same"""
_EQUAL = 1e-6
"""the same, of responses that are one"""
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
_STEPS = 25
"""of such a search"""
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
        problem: with bounds and priors.
        at: the point.
        e: what it tells.
        optimum: whether it is one, about which the other unknowns may follow.
    """
    values = {n: float(v) for n, v in zip(at.layout.of_interest, e.named, strict=True)}
    names = [n for n in problem.free if n in values]
    finite = np.isfinite(e.r).all() and np.isfinite(e.J).all()
    if len(names) < 2 or not (finite and all(math.isfinite(values[n]) for n in names)):
        return ()
    with np.errstate(all="ignore"):
        family = _Family(problem, values, names)
        starts = _starts(family)
        if not starts:
            return ()
        others: list[np.ndarray] = []
        for start in starts:
            z = _same_responses(family, start)
            if z is not None and not any(np.allclose(z, other, atol=0.02) for other in others):
                others.append(z)
    valley, solutions = Valley(problem, at, e), []
    for z in others:
        one = _as_good(valley, family, z, optimum)
        if one is not None:
            solutions.append(one)
    return tuple(solutions)


def _responses_of(
    problem: Problem, params: Any, about: OperatingPoint, omega: np.ndarray
) -> np.ndarray:
    """(k, p, m) of the linearised model, with the delays of its inputs."""
    matrices = linearize(problem.model, params, about.state, about.inputs).matrices
    A, B, C, D = (np.asarray(M, np.float64) for M in matrices)
    s = 1j * omega
    with np.errstate(all="ignore"):
        H = C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B[None] + 0j) + D
    late = dict(problem.model.delays)
    names = naming.names(problem.model.Inputs)
    delays = [float(getattr(params, late[n])) if n in late else 0.0 for n in names]
    return H * np.exp(-s[:, None] * np.array(delays))[:, None, :]


class _Family:
    """The linearised model by coordinates of its free parameters, zero where they are here."""

    def __init__(self, problem: Problem, values: dict[str, float], names: list[str]) -> None:
        self.problem, self.values, self.names = problem, values, names
        flight = problem.training[0]
        self.known = flight.known
        late = problem.model.delay_parameters
        # A logarithm keeps the sign; of what is zero, and of delays, which may be, so many samples.
        self.log = np.array([values[n] != 0.0 and n not in late for n in names])
        self.size = np.array([flight.dt if n in late else 1.0 for n in names])
        self.about: OperatingPoint = operating_point(
            problem.model,
            self._at(np.zeros(len(names))),
            flight.inputs,
            flight.outputs,
            flight.dt,
            substeps=problem.substeps,
        )
        self.omega = np.geomspace(
            2.0 * np.pi / (flight.n_samples * flight.dt), np.pi / flight.dt, _FREQUENCIES
        )
        self.rows = [naming.names(problem.model.Outputs).index(n) for n in flight.outputs]

    @functools.cached_property
    def here(self) -> np.ndarray:
        """Responses (k, p, m) at zero."""
        return self.responses(np.zeros(len(self.names)))

    @functools.cached_property
    def gain(self) -> np.ndarray:
        """Their sizes, by which differences are judged."""
        gain = np.abs(self.here)
        largest = np.max(gain, axis=0)
        # A response of nothing at all has no size of its own.
        largest = np.where(largest > 0, largest, max(float(np.max(gain)), 1e-300))
        return np.maximum(gain, _FLOOR * largest)

    def by_name(self, z: np.ndarray) -> dict[str, float]:
        """Values at coordinates (q,)."""
        here = np.array([self.values[n] for n in self.names])
        moved = np.where(self.log, here * np.exp(np.where(self.log, z, 0.0)), here + z * self.size)
        return dict(zip(self.names, map(float, moved), strict=True))

    def _at(self, z: np.ndarray):  # a record of the model's Params
        return self.problem.params_with(self.known | self.by_name(z))

    def poles(self, z: np.ndarray) -> np.ndarray:
        """Eigenvalues (n,) of A."""
        at = (self.about.state, self.about.inputs)
        A = linearize(self.problem.model, self._at(z), *at).matrices.A
        A = np.asarray(A, np.float64)
        return np.linalg.eigvals(A) if np.isfinite(A).all() else np.full(len(A), np.nan)

    def differences(self, z: np.ndarray) -> np.ndarray:
        """(2 k p m,) of the responses from those here, relative; their squares add up to a mean."""
        d = ((self.responses(z) - self.here) / self.gain).ravel()
        return np.concatenate([d.real, d.imag]) / math.sqrt(d.size)

    def apart(self, z: np.ndarray) -> float:
        """Their root mean square."""
        return float(np.linalg.norm(self.differences(z)))

    def open_along(self, names: Sequence[str]) -> bool:
        """Whether some of these parameters may move with all responses as they are."""
        q = len(self.names)
        steps = _DIFFERENCE * np.eye(q)
        J = np.stack([self.differences(h) / _DIFFERENCE for h in steps], axis=1)
        if not np.isfinite(J).all():
            return True
        size = np.linalg.norm(J, axis=0)
        # What has no effect on the responses, such as an output's offset, is nobody's partner.
        dead = size <= _OPEN * np.max(size, initial=0.0)
        _, values, right = np.linalg.svd(J / np.where(dead, 1.0, size), full_matrices=False)
        null = right[values < _OPEN * np.max(values)]
        return bool(np.any(np.abs(null[:, [self.names.index(n) for n in names]]) > 0.1))

    def responses(self, z: np.ndarray) -> np.ndarray:
        """(k, p, m) of the measured outputs."""
        return _responses_of(self.problem, self._at(z), self.about, self.omega)[:, self.rows]


def _starts(family: _Family) -> list[np.ndarray]:
    """Coordinates at which two real modes are exchanged, but for what is not linear in them."""
    q, here = len(family.names), family.poles(np.zeros(len(family.names)))
    if not np.isfinite(here).all():
        return []
    largest = np.max(np.abs(here), initial=0.0)
    real = [
        i
        for i, pole in enumerate(here)
        if abs(pole.imag) < 1e-6 * largest and abs(pole) > 1e-6 * largest
    ]
    pairs = [
        (i, j)
        for i, j in itertools.combinations(real, 2)
        # The same mode twice has no slope, and nothing to exchange.
        if here[i].real * here[j].real > 0
        and abs(math.log((here[i] / here[j]).real)) > np.log(_RATIO)
    ]
    if not pairs:
        return []
    slopes = np.stack([_slope(family, here, _DIFFERENCE * np.eye(q)[a]) for a in range(q)], axis=1)
    slopes = np.where(family.log & np.isfinite(slopes), slopes, 0.0)
    starts = []
    for i, j in pairs:
        target = math.log((here[j] / here[i]).real) * np.array([1.0, -1.0])
        for a, b in itertools.combinations(range(q), 2):
            E = slopes[np.ix_([i, j], [a, b])]
            # Each of the two has to make a mode of its own.
            each = max(
                min(abs(E[0, 0]), abs(E[1, 1])),
                min(abs(E[0, 1]), abs(E[1, 0])),
            )
            if each < _MAKES or abs(np.linalg.det(E)) < _MAKES * each:
                continue
            z = np.zeros(q)
            z[[a, b]] = np.linalg.solve(E, target)
            if np.max(np.abs(z)) < _REACH:
                starts.append((each, z))
    starts.sort(key=lambda one: -one[0])
    return [z for _, z in starts[:_CANDIDATES]]


def _slope(family: _Family, here: np.ndarray, step: np.ndarray) -> np.ndarray:
    """(n,) change of the logarithm of each pole by a coordinate, complex ones by their real part;
    which pole is which is told by nearness, as the step is small."""
    there = family.poles(step)
    if not np.isfinite(there).all():
        return np.zeros(len(here))
    near = there[np.argmin(np.abs(here[:, None] - there[None, :]), axis=1)]
    ratio = np.where(here != 0, near / np.where(here != 0, here, 1.0), 1.0)
    return np.real(ratio - 1.0) / float(np.sum(step))


def _same_responses(family: _Family, start: np.ndarray) -> np.ndarray | None:
    """Coordinates near a start at which the responses are those at zero; None where there are none,
    or where the way led back."""
    z = _least(family.differences, start)
    if z is None or not family.apart(z) < _ALIKE:
        return None
    moved = np.max(np.abs(z[family.log]), initial=0.0)
    return z if moved > _CHANGED else None


def _least(rows: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> np.ndarray | None:
    """By Levenberg and Marquardt; None where rows are not finite."""
    z, r, damping, q = start, rows(start), 1e-2, len(start)
    if not np.isfinite(r).all():
        return None
    for _ in range(_STEPS):
        J = np.stack([(rows(z + h) - r) / _DIFFERENCE for h in _DIFFERENCE * np.eye(q)], axis=1)
        if not np.isfinite(J).all():
            return None
        before = float(r @ r)
        for _ in range(8):
            scale = damping * np.maximum(np.sum(J**2, axis=0), 1e-12)
            step = np.linalg.solve(J.T @ J + np.diag(scale), -J.T @ r)
            then = rows(z + np.clip(step, -1.0, 1.0))
            # Negated: what is not finite is no step.
            if float(then @ then) < before:
                break
            damping *= 8.0
        else:
            return z
        z, r, damping = z + np.clip(step, -1.0, 1.0), then, 0.2 * damping
        if before < 1e-14 or before - float(r @ r) < 1e-4 * before < 1e-8:
            break
    return z


def _as_good(
    valley: Valley, family: _Family, z: np.ndarray, optimum: bool
) -> SecondSolution | None:
    """The solution there, if the residuals are as small and it is another than here."""
    if optimum or valley.at.layout.estimator.rows_are_samples:
        # At the start values nothing has been fitted: any step would make the other the better one.
        point = valley.visit({}, family.by_name(z), same=not optimum, priors=True)
        if point is None or not point.excess <= SAME:
            return None
        values = {n: point.values[n] for n in family.names}
    else:
        # Of rows that are sums over frequencies none stays: there the responses have to be the same
        # to rounding, with nothing else that could tell.
        values = family.by_name(z)
        free = family.problem.free
        if not family.apart(z) < _EQUAL or not all(
            transforms.inside(free[n], v) and (free[n].prior is None or z[i] == 0.0)
            for i, (n, v) in enumerate(values.items())
        ):
            return None
    here = family.values
    changed = tuple(
        n
        for i, (n, v) in enumerate(values.items())
        if abs(v - here[n])
        > _CHANGED * (max(abs(here[n]), abs(v)) + family.size[i] * ~family.log[i])
    )
    # Along a valley other values are as good anyhow, and it is said what goes together there.
    if not changed or family.open_along(changed) or not _expected(valley, values) > _APART:
        return None
    return SecondSolution(values, changed)


def _expected(valley: Valley, values: dict[str, float]) -> float:
    """Squares that the slopes here let expect of so much of a change, the nuisances following: with
    few of them the other values are within the interval of these."""
    e, names = valley.e, valley.at.layout.of_interest
    J = np.asarray(e.J, np.float64)
    slopes = np.where(e.slopes != 0, e.slopes, np.inf)
    here = np.asarray(e.named, np.float64)
    there = np.array([values.get(n, v) for n, v in zip(names, here, strict=True)])
    q = len(names)
    moved = J[:, :q] @ ((there - here) / slopes)
    others = J[:, q:]
    if not others.size:
        return float(moved @ moved)
    others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    rest = moved - others @ np.linalg.lstsq(others, moved, rcond=None)[0]
    return float(rest @ rest)
