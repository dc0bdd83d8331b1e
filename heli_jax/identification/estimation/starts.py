"""Points to start a search from: drawn, over the delays, and from short windows."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.finding import note
from heli_jax.identification.estimation import multistart as starting
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import (
    Optimum,
    residual_and_jacobian,
)
from heli_jax.identification.estimation.optimiser_step import without_size
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import MAX_TIME_SHIFT, Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns import transforms as coordinates
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, layout_of

# Starts about the given one, drawn within the bounds.


def draw(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], starts: int, seed: int
) -> Float[Array, "s q"]:
    """Starts (s, q): the first is z0, the others differ in the free parameters.

    Between two bounds of one sign the draw is uniform in log, between two of different sign
    uniform; elsewhere log-normal about the start, a factor of three wide or as wide as the prior,
    and of either sign where that may be any.

    Args:
        layout: what the unknowns are.
        problem: with the free parameters' bounds and priors.
        z0: the first start.
        starts: how many, the first included.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    rows = np.tile(np.asarray(z0, dtype=np.float64), (max(starts, 1), 1))
    dtype = z0.dtype
    for i, (free, kind) in enumerate(zip(problem.free.values(), layout.kinds, strict=True)):
        values = jnp.asarray(_draw_values(free, rows.shape[0] - 1, rng), dtype)
        sign = jnp.asarray(coordinates.sign_or_scale(free), dtype)
        low, high = (jnp.asarray(b, dtype) for b in coordinates.limits(free))
        rows[1:, i] = np.asarray(coordinates.to_coordinate(kind, values, sign, low, high))
    return jnp.asarray(rows, dtype)


def _draw_values(free: Free, size: int, rng: np.random.Generator) -> np.ndarray:
    # Off the bounds, where a bounded coordinate has no slope left.
    share = rng.uniform(0.02, 0.98, size)
    low, high = free.lower, free.upper
    if low is not None and high is not None:
        if low * high > 0:
            return low * (high / low) ** share
        return low + (high - low) * share
    width = 1.1  # e^1.1 is a factor of three
    if free.prior is not None and free.prior.mean:
        # Twice the prior: a start beyond would only be pulled back.
        width = min(width, 2.0 * free.prior.sd / abs(free.prior.mean))
    # Log-normal: a parameter of physics is more likely wrong by a factor than by an amount, and
    # keeps its sign.
    values = free.start * np.exp(width * rng.standard_normal(size))
    if coordinates.changes_sign(free):
        values = _either_sign(free, width, rng.standard_normal((2, size)))
    # A single bound does not shape the draw: what lies beyond it begins at the start value instead.
    return np.where([coordinates.inside(free, float(v)) for v in values], values, free.start)


def _either_sign(free: Free, width: float, drawn: np.ndarray) -> np.ndarray:
    """Values of the start's size; about the prior's mean where there is one, which knows more."""
    if free.prior is not None:
        return free.prior.mean + 2.0 * free.prior.sd * drawn[0]
    return coordinates.scale(free) * np.exp(width * drawn[0]) * np.sign(drawn[1])


# Starts where a delay is free: a misfit has a valley for each period of the motion by which a delay
# is wrong, and in a loop a narrow one about the truth alone.
#
# The misfit is scanned over each delay with the other unknowns solved for at each of its values by
# a Gauss-Newton step (variable projection: Golub and Pereyra, 1973); the deepest valleys are
# starts.


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


# A start where the model's simulation diverges: parameters from short windows first.
#
# Where a damping begins with the wrong sign, a simulation over the whole record grows by many
# powers of ten, and least squares finds no way back: the gradient is all in the growth. Over short
# windows, each from an initial state of its own, nothing has the time to grow (multiple shooting;
# Bock, 1983).


FAR_WORSE = 10.0
"""times the misfit of no model at all from which a start is taken for one that diverges"""
_WINDOWS = 16
"""of the shortest flight, unless they had too few samples each"""
_PER_STATE = 5
"""samples that a window has at least for each initial state that it brings"""
_STEPS = 60
"""of the optimiser over the windows: what has not arrived by then is only a start"""

BY_WINDOWS = note(
    "search.by-windows",
    "The simulation diverges at the start values, so the parameters were first fitted to short "
    "windows of the record (multiple shooting), and the fit began from there.",
)


def by_windows(
    problem: Problem, search: starting.Search, noise: Noise, e: Evaluation, z0: Array, best: Optimum
) -> Optimum | None:
    """The optimum from the parameters that short windows give, where the search from z0 failed
    and the simulation diverges there; None where that is not so or windows do not help.

    Args:
        problem: what is fitted.
        search: the optimiser over the whole record.
        noise: that it searches with.
        e: at z0.
        z0: the start.
        best: the best optimum so far.
    """
    # Only where the ordinary way failed: windows bring unknowns of their own and a program to
    # compile.
    if bool(best.converged) or not _applies(problem) or not _diverges(search, noise, e):
        return None
    cut = _cut(problem)
    short = None if cut is None else _fit_of_windows(cut, search.layout, noise, z0)
    if short is None:
        return None
    # The windows' initial states stay behind: they were free to take up what the parameters missed.
    [run] = search.run(noise, z0.at[: short.size].set(short)[None, :])
    return run if starting.rank(run) < starting.rank(best) else None


def _fit_of_windows(cut: Problem, whole: Layout, noise: Noise, z0: Array) -> Array | None:
    """What the flights share, fitted to the windows; None where that is not finite."""
    layout = layout_of(cut, cut.training)
    data = data_of(cut, cut.training, layout)
    # It stands first in z in either layout; behind it windows have more.
    z = start_vector(layout, data, cut)
    z = z.at[: whole.first_nuisance].set(z0[: whole.first_nuisance])
    [short] = starting.Search(cut, layout, data, _STEPS).run(noise, z[None, :])
    # Not whether it converged: half a way out of the growth is enough to begin from.
    finite = np.isfinite(short.cost) and bool(jnp.all(jnp.isfinite(short.z)))
    return short.z[: whole.first_nuisance] if finite else None


def _applies(problem: Problem) -> bool:
    # What `Problem` accepts with windows, and has none yet.
    return (
        estimator_of(problem.method).windows
        and problem.window is None
        and problem.nuisance.initial_state
    )


def _diverges(search: starting.Search, noise: Noise, e: Evaluation) -> bool:
    """Whether the misfit is far larger than that of no model at all."""
    # Squares of a run that diverged may overflow: infinity is past the limit too.
    with np.errstate(all="ignore"):
        misfit = float(np.sum(np.square(np.asarray(e.r, np.float64))))
    return misfit > FAR_WORSE * search.misfit_of_nothing(noise)


def _cut(problem: Problem) -> Problem | None:
    """The problem in windows; None where the record is too short for them."""
    states = len(naming.names(problem.model.State))
    flights = problem.training
    dt = max(f.dt for f in flights)
    shortest = min(f.n_samples * f.dt for f in flights)
    # Short enough that nothing grows, long enough that a window's samples outnumber its unknowns.
    window = max(shortest / _WINDOWS, max(8, _PER_STATE * states) * dt)
    return replace(problem, window=window) if window < 0.5 * shortest else None
