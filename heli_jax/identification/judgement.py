"""From the residual's Jacobian to the verdict: relative coordinates, priors, nuisances."""

import numpy as np

from heli_jax import naming
from heli_jax.identification import coordinates
from heli_jax.identification.evaluation import Evaluation
from heli_jax.identification.identifiability import NULL, Unknown, Verdict, judge, projected
from heli_jax.identification.layout import Layout
from heli_jax.identification.problem import Problem


_NEAR_ZERO = 1e-2
"""part of a parameter's size below which it takes no part in products of powers"""


def unknowns_of(problem: Problem, layout: Layout, e: Evaluation) -> tuple[Unknown, ...]:
    """The named unknowns for the verdict, with their size and prior in relative coordinates."""
    found = []
    for i, name in enumerate(layout.named):
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


def _split(
    problem: Problem, layout: Layout, e: Evaluation, unknowns: tuple[Unknown, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Data rows of the Jacobian: named unknowns in relative coordinates, and the nuisances."""
    J = np.asarray(e.J, dtype=np.float64)
    q, p = len(layout.named), len(layout.free)
    weak = layout.size - layout.weak
    data_rows = np.r_[0 : J.shape[0] - p - weak, J.shape[0] - weak : J.shape[0]]
    references = references_of(problem, layout, unknowns)
    slopes = np.asarray(e.slopes, dtype=np.float64)
    factor = np.divide(references, slopes, out=np.zeros_like(slopes), where=slopes != 0)
    # A parameter of negative sign falls as its logarithm rises; the size is what counts.
    sensitivity = J[data_rows][:, :q] * np.abs(factor) * np.sign(slopes) * _signs(unknowns)
    nuisances = J[data_rows][:, q:]
    # A nuisance without effect, such as the memory of a disturbance that is not there, has no
    # direction to be projected out.
    return sensitivity, nuisances[:, np.linalg.norm(nuisances, axis=0) > 1e-6]


def _signs(unknowns: tuple[Unknown, ...]) -> np.ndarray:
    return np.array([np.sign(u.value) or 1.0 if u.logarithmic else 1.0 for u in unknowns])


def _remedy(problem: Problem) -> str:
    added = [
        f"{n}_added" for n in problem.free if f"{n}_added" in naming.names(problem.model.Params)
    ]
    return ", or add a run with a known inertia" if added else ""


def verdict_of(problem: Problem, layout: Layout, e: Evaluation) -> Verdict:
    if not bool(np.all(np.isfinite(e.J))):
        raise ValueError(
            "the simulation is not finite at the given values: the model is unstable there over "
            "the length of this record; start elsewhere or use a shorter window"
        )
    unknowns = unknowns_of(problem, layout, e)
    sensitivity, nuisances = _split(problem, layout, e, unknowns)
    # In float32 rounding alone reaches a part in 1e6 of the largest singular value.
    null_below = max(NULL, 100.0 * float(np.finfo(e.J.dtype).eps))
    return judge(projected(sensitivity, nuisances), unknowns, _remedy(problem), null_below)
