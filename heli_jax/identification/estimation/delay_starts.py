"""Starts where a delay is free: a misfit has a valley for each period of the motion by which a
delay is wrong, and in a loop a narrow one about the truth alone.

The misfit is scanned over each delay with the other unknowns solved for at each of its values by a
Gauss-Newton step (variable projection: Golub and Pereyra, 1973); the deepest valleys are starts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.estimation.scaling import without_size
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, Noise

_EARLIEST, _LATEST = -0.1, 0.2
"""s: range of a delay without bounds; to twice its start at least"""
_SHIFTS = 0.8
"""of the largest time shift: at the bounds themselves the coordinate is infinite"""
_OFF_BOUNDS = 0.02
"""of the range between two bounds, for the same reason"""
_FIRST = 0.2
"""of a step: the least value of a delay that is positive"""
_STEP = 1.4
"""rad: of the motion that a delay shifts, between two values of it; a valley is a half turn wide"""
_FEWEST, _MOST = 5, 64
"""values of a delay"""
_DAMPING = 1e-3
"""of the Gauss-Newton step, in columns of norm 1"""
_FACTOR = 2.0
"""of a logarithm: the farthest that one step takes it"""
_PARTS = (1.0, 0.25, 0.06)
"""of the step, of which the first that leads down is taken"""
_DEEP = 0.5
"""of the depth of the deepest valley, from which on another one is a start too"""
_VALLEYS = 3
"""starts at most"""


class _Tried(NamedTuple):
    """A point with its sum of squares."""

    cost: float
    z: np.ndarray


def delay_starts(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    known: tuple[Any, Any],
) -> Float[Array, "s q"]:
    """Starts (s, q): z0 alone, or where a delay or the time shift is free the deepest valleys.

    Args:
        problem: with the free parameters and the model that says which are delays.
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: the first start.
        known: residuals and Jacobian there.
    """

    def evaluate(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = residual_and_jacobian(layout, data, noise, jnp.asarray(z, z0.dtype))
        return np.asarray(at.r, np.float64), np.asarray(at.J, np.float64)

    first = np.asarray(z0, np.float64)
    base, valleys = first, []
    for i, values in _grids(problem, layout, data, np.asarray(known[1])).items():
        tried = [_solved(layout, evaluate, base, i, value) for value in values]
        found = _valleys(tried)
        valleys = [*found, *valleys]
        base = found[0].z if found else base
    # Valleys of a delay that was scanned before others lack what these found.
    valleys = sorted(valleys, key=lambda v: v.cost)[:_VALLEYS]
    points = np.stack([v.z for v in valleys]) if valleys else first[None, :]
    return jnp.asarray(points, z0.dtype)


def _grids(problem: Problem, layout: Layout, data: Data, J: np.ndarray) -> dict[int, np.ndarray]:
    """The coordinates to try by number of the unknown, in increasing order."""
    grids = {}
    for name in problem.model.delay_parameters:
        if name not in problem.free:
            continue
        free, i = problem.free[name], layout.free.index(name)
        low, high = transforms.limits(free)
        step = _step(layout, data, J, i)
        if np.isfinite(low) and np.isfinite(high):
            low, high = low + _OFF_BOUNDS * (high - low), high - _OFF_BOUNDS * (high - low)
        else:
            early = _EARLIEST if transforms.changes_sign(free) else _FIRST * step
            low, high = max(low, min(early, free.start)), min(high, max(_LATEST, 2.0 * free.start))
        values = np.unique([free.start, *_between(low, high, step)])
        values = values[[transforms.inside(free, float(v)) for v in values]]
        limits = transforms.sign_or_scale(free), *transforms.limits(free)
        grids[i] = np.asarray(transforms.to_coordinate(layout.kinds[i], values, *limits))
    if layout.shift:
        i = len(layout.free) + len(layout.gains)
        ends = -_SHIFTS * MAX_TIME_SHIFT, _SHIFTS * MAX_TIME_SHIFT
        values = _between(*ends, _step(layout, data, J, i))
        grids[i] = np.arctanh(values / MAX_TIME_SHIFT)
    return grids


def _between(low: float, high: float, step: float) -> np.ndarray:
    return np.linspace(low, high, int(np.clip(np.ceil((high - low) / step) + 1, _FEWEST, _MOST)))


def _step(layout: Layout, data: Data, J: np.ndarray, i: int) -> float:
    """The step between values of a delay [s], by how fast its effect on the rows changes."""
    dt = min(float(f.dt) for f in data.flights)
    if not layout.estimator.rows_are_samples:
        return dt
    signal = layout.estimator.row_signals(layout, data)
    effect = np.asarray(J[: signal.size, i], np.float64)
    moves = np.diff(effect)[np.diff(signal) == 0]
    with np.errstate(all="ignore"):
        step = _STEP * dt * np.linalg.norm(effect) / np.linalg.norm(moves)
    return max(dt, float(step)) if np.isfinite(step) else dt


def _solved(
    layout: Layout,
    evaluate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    z0: np.ndarray,
    i: int,
    value: float,
) -> _Tried:
    """The point with the i-th unknown at a value and the others one Gauss-Newton step on."""
    z = z0.copy()
    z[i] = value
    r, J = evaluate(z)
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return _Tried(np.inf, z)
    begun = _Tried(float(r @ r), z)
    J = J * (np.arange(z.size) != i)
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    A = J / norms
    step = -np.linalg.solve(A.T @ A + _DAMPING * np.eye(z.size), A.T @ r) / norms
    logarithm = (np.arange(z.size) < layout.first_nuisance) & ~without_size(layout)
    step = np.where(logarithm, np.clip(step, -_FACTOR, _FACTOR), step)
    for part in _PARTS:
        r, _ = evaluate(z + part * step)
        if np.isfinite(r).all() and r @ r < begun.cost:
            return _Tried(float(r @ r), z + part * step)
    return begun


def _valleys(tried: list[_Tried]) -> list[_Tried]:
    """The valleys among points along one line, the deepest first."""
    costs = np.array([t.cost for t in tried])
    beside = np.minimum(np.r_[np.inf, costs[:-1]], np.r_[costs[1:], np.inf])
    lowest = [t for t, b in zip(tried, beside, strict=True) if np.isfinite(t.cost) and t.cost <= b]
    lowest = sorted(lowest, key=lambda t: t.cost)
    if not lowest:
        return []
    top = float(np.median(costs[np.isfinite(costs)]))
    least = top - _DEEP * (top - lowest[0].cost)
    return [t for t in lowest if t.cost <= least][:_VALLEYS]
