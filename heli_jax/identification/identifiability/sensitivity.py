"""From the residual's Jacobian to the verdict: relative coordinates, priors, nuisances."""

from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.analysis import NULL, Unknown, Verdict, judge
from heli_jax.identification.identifiability.directions import Held, projected
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms as coordinates
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.identification.unknowns.nuisances import can_be_off, weak_unknowns

_NEAR_ZERO = 1e-2
"""part of a parameter's size below which it takes no part in products of powers"""


def unknowns_of(problem: Problem, layout: Layout, e: Evaluation) -> tuple[Unknown, ...]:
    """The named unknowns for the verdict, with their size and prior in relative coordinates."""
    found = []
    for i, name in enumerate(layout.of_interest):
        value = float(e.named[i])
        free = problem.free.get(name)
        if name == "time_shift":
            found.append(Unknown(name, value, False, 1.0, 0.0, is_parameter=False))
        elif free is None:
            found.append(Unknown(name, value, True, 1.0, 0.0, is_parameter=False))
        else:
            reference, log = _reference(problem, name, value)
            prior = reference / free.prior.sd if free.prior else 0.0
            scale = 1.0 / prior if prior else _interval(free.lower, free.upper, log)
            symmetric = coordinates.changes_sign(free)
            per_log = reference / abs(value) if symmetric and log else 1.0
            found.append(
                Unknown(name, value, log, scale, prior, per_log=per_log, symmetric=symmetric)
            )
    return tuple(found)


def _interval(lower: float | None, upper: float | None, log: bool) -> float:
    if log and lower and upper:
        return max(0.5 * float(np.log(upper / lower)), 1e-3)
    return 1.0


def _reference(problem: Problem, name: str, value: float) -> tuple[float, bool]:
    """What one unit of a parameter's relative coordinate is, and whether it is log |value|."""
    free = problem.free[name]
    low, high = free.lower, free.upper
    if low is not None and high is not None and low < 0 < high:
        return 0.5 * (high - low), False
    if coordinates.changes_sign(free):
        # A value near zero is known as soon as it is known to be small beside the start.
        size = max(abs(value), coordinates.scale(free))
        return size, abs(value) > _NEAR_ZERO * size
    return abs(value), True


def references_of(problem: Problem, layout: Layout, unknowns: tuple[Unknown, ...]) -> np.ndarray:
    dt = problem.training[0].dt
    out = []
    for u in unknowns:
        if u.name == "time_shift":
            out.append(dt)
        elif u.name in problem.free:
            out.append(_reference(problem, u.name, u.value)[0])
        else:
            out.append(abs(u.value))
    return np.array(out)


class _Rows(NamedTuple):
    """The Jacobian without the priors of the parameters, taken apart."""

    sensitivity: np.ndarray
    """(n, q) of the rows of data, named unknowns in relative coordinates"""
    nuisances: np.ndarray
    """(n, k) of the same rows, all other unknowns"""
    weak: np.ndarray
    """(w, k) the weak priors' rows, which only nuisances have"""


def _split(layout: Layout, e: Evaluation, references: np.ndarray, signs: np.ndarray) -> _Rows:
    J = np.asarray(e.J, dtype=np.float64)
    q, p = len(layout.of_interest), len(layout.free)
    count = layout.size - layout.first_nuisance
    # Last come the weak priors (all that stands in z from `layout.first_nuisance` on), before them
    # the parameters' own; the defects between windows count as data.
    data = J[: J.shape[0] - count - p]
    slopes = np.asarray(e.slopes, dtype=np.float64)
    factor = np.divide(references, slopes, out=np.zeros_like(slopes), where=slopes != 0)
    # A parameter of negative sign falls as its logarithm rises; the size is what counts.
    sensitivity = data[:, :q] * np.abs(factor) * np.sign(slopes) * signs
    return _Rows(sensitivity, data[:, q:], J[J.shape[0] - count :, q:])


_NO_EFFECT = 1e-6
"""A nuisance whose whole effect is below this part of the noise, such as the memory of a
disturbance that is not there, has no direction to be projected out."""


def _held(problem: Problem, layout: Layout, rows: _Rows, smallest: float) -> tuple[Any, Held]:
    """The sensitivity with the weak priors, and what is left of it without them.

    Args:
        smallest: part of the largest singular value below which a direction of the nuisances has
            no effect.
    """
    q = rows.sensitivity.shape[1]
    # All further work is on the triangle, which holds what the data say.
    R = np.linalg.qr(np.hstack([rows.sensitivity, rows.nuisances]), mode="r")
    S, N = R[:, :q], R[:, q:]
    seen = np.linalg.norm(N, axis=0) > _NO_EFFECT
    with_weak = np.vstack([S, np.zeros((rows.weak.shape[0], q))])
    all_nuisances = np.vstack([N, rows.weak])
    # What neither the data nor a prior of its own sees is no unknown.
    shown = np.linalg.norm(all_nuisances, axis=0) > _NO_EFFECT
    sensitivity = projected(with_weak, all_nuisances[:, shown])
    named = weak_unknowns(problem, layout)
    kinds = np.array([""] * (N.shape[1] - len(named)) + [one.kind for one in named])
    off = {
        f"nuisance.{kind}": projected(S, N[:, seen & (kinds != kind)], smallest)
        for kind in dict.fromkeys(one.kind for one in named)
        if can_be_off(problem, kind)
    }
    weak = kinds != ""
    moves = -np.linalg.lstsq(N[:, seen], S, rcond=smallest)[0]
    compensation = np.zeros((N.shape[1], q))
    compensation[seen] = moves
    held = Held(
        projected(S, N[:, seen], smallest),
        compensation[weak],
        tuple(one.words for one in named),
        tuple(one.label for one in named),
        off,
    )
    return sensitivity, held


def _signs(unknowns: tuple[Unknown, ...]) -> np.ndarray:
    return np.array([np.sign(u.value) or 1.0 if u.logarithmic else 1.0 for u in unknowns])


def _remedies(problem: Problem) -> dict[str, str]:
    """By parameter, what determines it beside a known value or a prior."""
    known = naming.names(problem.model.Params)
    return {n: "add a run with a known inertia" for n in problem.free if f"{n}_added" in known}


def verdict_of(
    problem: Problem, layout: Layout, e: Evaluation, reported: np.ndarray | None = None
) -> Verdict:
    """What the data determine at one point.

    Args:
        reported: covariance (k, k) of the named unknowns, in the optimiser's coordinates, that the
            reported intervals have where it is not that of white residuals.

    Raises:
        ValueError: the simulation is not finite there.
    """
    if not bool(np.all(np.isfinite(e.J))):
        raise ValueError(
            "the simulation is not finite at the given values: the model is unstable there over "
            "the length of this record; start elsewhere or use a shorter window"
        )
    unknowns = unknowns_of(problem, layout, e)
    rows = _split(layout, e, references_of(problem, layout, unknowns), _signs(unknowns))
    # In float32 rounding alone reaches a part in 1e6 of the largest singular value.
    null_below = max(NULL, 100.0 * float(np.finfo(e.J.dtype).eps))
    sensitivity, held = _held(problem, layout, rows, null_below)
    relative = None
    if reported is not None:
        slopes = np.asarray(e.slopes, np.float64)
        to_relative = slopes / references_of(problem, layout, unknowns) * _signs(unknowns)
        relative = reported * np.outer(to_relative, to_relative)
    return judge(sensitivity, unknowns, _remedies(problem), null_below, held, relative)
