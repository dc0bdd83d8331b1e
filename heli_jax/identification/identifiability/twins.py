"""Parameters whose values may be exchanged: two lags in series answer alike in either order.

No slope at an optimum tells of its twin, and several starts find it only where one of them begins
on its side. So for each pair of one unit the responses with both values exchanged are compared,
which simulates nothing, and where they are the same the residuals are.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import OperatingPoint, operating_point
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.valley import SAME, Valley
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution

_FREQUENCIES = 9
"""at which responses are compared, from the record's length to the samples'"""
_ALIKE = 1e-3
"""relative difference of responses, up to a gain, that is none"""
APART = 9.0
"""squares that the slopes let expect of the exchange: below, the two values are the same"""

# params is Any: a record of a model's Params, whose class may be a user's own.


def twins_of(
    problem: Problem, at: Solution, e: Evaluation, *, optimum: bool = True
) -> tuple[tuple[str, str], ...]:
    """Pairs of free parameters that the data do not tell from each other.

    Args:
        problem: with units, bounds and priors.
        at: the point.
        e: what it tells.
        optimum: whether it is one, about which the other unknowns may follow the exchange.
    """
    values = {n: float(v) for n, v in zip(at.layout.of_interest, e.named, strict=True)}
    pairs = _candidates(problem, values)
    # The slopes first: they cost nothing, and leave those out whose values are nearly the same.
    pairs = [pair for pair in pairs if _expected(at, e, pair) > APART]
    if not pairs or not (np.isfinite(e.r).all() and np.isfinite(e.J).all()):
        return ()
    pairs = _alike(problem, values, pairs)
    valley = Valley(problem, at, e)
    return tuple(pair for pair in pairs if _as_good(valley, values, pair, optimum))


def _candidates(problem: Problem, values: dict[str, float]) -> list[tuple[str, str]]:
    names = [n for n in problem.free if n in values]
    units = {n: naming.unit(problem.model.Params, n) for n in names}
    known = {n for flight in problem.training for n in flight.known}
    return [
        (a, b)
        for i, a in enumerate(names)
        for b in names[i + 1 :]
        if units[a] == units[b] and values[a] * values[b] > 0 and not {a, b} & known
    ]


def _expected(at: Solution, e: Evaluation, pair: tuple[str, str]) -> float:
    """Squares that the exchange costs by the slopes, the other unknowns following."""
    names = at.layout.of_interest
    i, j = (names.index(n) for n in pair)
    J = np.asarray(e.J, np.float64)
    apart = float(e.named[j] - e.named[i])
    slopes = np.where(e.slopes != 0, e.slopes, np.inf)
    moved = J[:, i] * apart / slopes[i] - J[:, j] * apart / slopes[j]
    others = np.delete(J, [i, j], axis=1)
    others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    rest = moved - others @ np.linalg.lstsq(others, moved, rcond=None)[0]
    return float(rest @ rest)


def _alike(
    problem: Problem, values: dict[str, float], pairs: list[tuple[str, str]]
) -> list[tuple[str, str]]:
    """Of the pairs those whose exchange leaves all linearised responses alike, up to gains."""
    flight = problem.training[0]
    free = {n: jnp.asarray(values[n], jnp.result_type(float)) for n in problem.free}
    known = {n: jnp.asarray(v, jnp.result_type(float)) for n, v in flight.known.items()}
    params = naming.replace(problem.vehicle, **(free | known))
    about = operating_point(
        problem.model, params, flight.inputs, flight.outputs, flight.dt, substeps=problem.substeps
    )
    omega = np.geomspace(
        2.0 * np.pi / (flight.n_samples * flight.dt), np.pi / flight.dt, _FREQUENCIES
    )
    rows = [naming.names(problem.model.Outputs).index(n) for n in flight.outputs]
    one = responses_of(problem, params, about, omega)[:, rows]
    same = []
    for a, b in pairs:
        changed = naming.replace(params, **{a: free[b], b: free[a]})
        other = responses_of(problem, changed, about, omega)[:, rows]
        power = np.sum(np.abs(one) ** 2, axis=0)
        gains = np.real(np.sum(np.conj(one) * other, axis=0)) / np.maximum(power, 1e-300)
        difference = np.linalg.norm(other - gains * one, axis=0)
        if np.all(difference <= _ALIKE * np.linalg.norm(other, axis=0)):
            same.append((a, b))
    return same


def responses_of(
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


def _as_good(
    valley: Valley, values: dict[str, float], pair: tuple[str, str], optimum: bool
) -> bool:
    a, b = pair
    # At the start values nothing has been fitted: any step would make the exchange the better one.
    held = {a: values[b], b: values[a]}
    point = valley.visit(held, {}, same=not optimum, priors=True)
    return point is not None and point.excess <= SAME
