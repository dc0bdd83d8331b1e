"""Levenberg-Marquardt: the least squares of the residual vector, from one start.

A step d minimises |r + J d|^2 + mu |D d|^2, with the sizes of J's columns in D (Marquardt, 1963).
The damping mu falls after a step that did as predicted and grows after one that is refused. A
refused step also sets a radius (More, 1978), which limits the next changes of the residuals.

A step takes of r and J only the triangle of the QR decomposition of [r J]: as many rows as
unknowns, and one.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from heli_jax import stages
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, Noise

CONVERGED = 1e-4
"""squared distance from the optimum in joint standard deviations: a hundredth of one shows in no
interval, and steps that shrink by a fifth each take ten more to come to a thousandth"""
_SHORT = 1e-3
"""change of the residuals by a step, for each unknown, below which no further step is tried"""
_RELATIVE = 1e-9
"""the same in proportion to the way from the start"""
_STUCK = 0.1
"""part of the sum of squares which a short step may leave to be gained: more is no optimum"""
_ROUNDING = 1e-12
"""part of the sum of squares below which a change is rounding, and part of the largest column below
which the column of a logarithm is"""
_RANK = 1e-10
"""part of a column of size 1 that the other columns leave, below which it depends on them"""

_DAMPING, _LEAST_DAMPING = 1.1e-5, 1.1e-12
"""mu of the first step, and the least: along a direction without effect rounding over less would be
a step of any length"""
_ACCEPTED, _AS_PREDICTED = 0.1, 0.75
"""parts of the predicted gain from which on a step is accepted, and is said to do as predicted"""
_LESS, _MORE = 0.01, 10.0
"""factors of mu after a step that did as predicted, and after one that was refused"""
_GROWTH = 3.0
"""times the change of the residuals by a step that did as predicted may the next one make"""

_NUISANCE_STEPS = 60
"""at most, to initial states and biases"""
_TIE_SD = 100.0
"""sd, in logarithms or logits of the free parameters, of their tie to the start: a factor of e^100
is no prior, but it gives an end to a parameter that runs to its bound or to zero"""


class Optimum(NamedTuple):
    """Optimum of one run."""

    z: Float[Array, " q"]
    cost: float
    """sum of squares of all rows, priors included, over the number of measured numbers"""
    steps: int
    """evaluations of the residuals"""
    converged: bool
    moved: float = np.inf
    """squared distance from the start in joint standard deviations"""


class Point(NamedTuple):
    """Unknowns, and the residuals r + J d about them: the rows of the triangle, then the ties."""

    z: Float[np.ndarray, " q"]
    r: Float[np.ndarray, " k"]
    J: Float[np.ndarray, "k q"]

    @property
    def squares(self) -> float:
        return float(self.r @ self.r)


class Region(NamedTuple):
    """Limits of the next step."""

    damping: float
    radius: float
    """of the change of the residuals; inf until a step is refused"""


def without_size(layout: Layout) -> np.ndarray:
    """Return (q,) True for the unknowns that are no logarithms and so have no size of their own."""
    linear = [kind == "linear" for kind in layout.kinds] + [True] * len(layout.gains)
    return np.array(linear + [False] * (layout.size - len(linear)), bool)


def optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array | np.ndarray, " q"],
    max_steps: int = 200,
    *,
    held: np.ndarray | None = None,
    damping: float = _DAMPING,
    known: tuple[Array | np.ndarray, Array | np.ndarray] | None = None,
) -> Optimum:
    """Return the least-squares optimum from z0.

    Args:
        held: (q,) True for an unknown that stays at its start; none unless given.
        damping: of the first step.
        known: residuals and Jacobian at z0, where they are at hand.
    """
    start, logarithms = np.asarray(z0, np.float64), ~without_size(layout)
    moving = np.ones(layout.size, bool) if held is None else ~held
    free = np.arange(layout.size) < len(layout.free)
    ties = np.eye(layout.size)[free & logarithms & moving] / _TIE_SD
    low, high = _bounds(layout, data)

    def linearise(z: np.ndarray, rows: Any = None) -> Point:
        r, J = rows or residual_and_jacobian(layout, data, noise, jnp.asarray(z))[:2]
        # A derivative that overflowed shows no direction.
        J = np.where(moving & np.isfinite(J).all(axis=0), J, 0.0)
        R = np.linalg.qr(np.column_stack([r, J]), mode="r")
        return Point(z, np.append(R[:, 0], ties @ (z - start)), np.vstack([R[:, 1:], ties]))

    with np.errstate(all="ignore"):  # simulations overflow on the way
        at, region = linearise(start, known), Region(damping, np.inf)
        sizes, count = np.zeros(layout.size), measured_count(data)
        short, steps = not np.isfinite(at.squares), 1
        while True:
            # An unknown that has no effect stays put until it has one: the time constant behind a
            # gain that begins at zero.
            columns = np.linalg.norm(at.J, axis=0)
            least = np.where(logarithms, _ROUNDING * columns.max(initial=0.0), 0.0)
            sizes = np.where((sizes == 0) & (columns > least), columns, sizes)
            # An unknown at a bound stays while the misfit falls beyond it.
            slope = at.J.T @ at.r
            outwards = ((at.z <= low) & (slope > 0)) | ((at.z >= high) & (slope < 0))
            units = np.where(outwards, 0.0, sizes)
            ahead = gain_ahead(at.r, at.J, units)
            if short or not CONVERGED <= ahead < np.inf or steps >= max_steps:
                break
            trial = linearise(np.clip(at.z + _step(at, units, region), low, high))
            steps += 1
            accepted, region = judge_step(at, trial, region)
            if accepted:
                short = _is_short(at, trial, sizes, start)
                at = trial
            if stages.watched():
                stages.advance(detail=f"cost {at.squares / count:.4g}")
        converged = ahead < CONVERGED or (short and ahead < _STUCK * at.squares)
        moved = float(np.sum(np.square(at.J @ (at.z - start))))
    cost = at.squares / count
    converged = bool(converged and np.isfinite(cost))
    return Optimum(jnp.asarray(at.z, jnp.asarray(z0).dtype), cost, steps, converged, moved)


def _bounds(layout: Layout, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Return (q,) the lowest and the highest coordinates; infinite where there is no bound."""
    bounds = np.tile([-np.inf, np.inf], (layout.size, 1))
    # Fetched once: entry by entry each would be a program of its own.
    limits = zip(layout.kinds, *map(np.asarray, (data.sign, data.low, data.high)), strict=True)
    for i, of_one in enumerate(limits):
        bounds[i] = transforms.coordinate_limits(*of_one)
    return bounds[:, 0], bounds[:, 1]


def fit_nuisances(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> Float[Array, " q"]:
    """Return z with the initial states, biases and offsets of the least squares, all else as it
    is; z itself where the simulation is not finite."""
    held = np.arange(layout.size) < layout.first_nuisance
    if held.all():
        return z
    # A nonlinear simulation may leave the record's motion by a long first step.
    first = (_DAMPING,) if layout.model.linear else (_DAMPING, 0.01, 1.0)
    runs = [optimise(layout, data, noise, z, _NUISANCE_STEPS, held=held, damping=d) for d in first]
    return min(runs, key=lambda run: run.cost).z


def gain_ahead(
    r: Float[np.ndarray, " k"], J: Float[np.ndarray, "k q"], sizes: Float[np.ndarray, " q"]
) -> float:
    """Return the decrease of the sum of squares that a full Gauss-Newton step predicts.

    This gain, g' F^-1 g, is the squared distance from the optimum in joint standard deviations. It
    needs no unit of the unknowns, and a direction that the data leave all but open is not polished.

    Args:
        sizes: of J's columns; 0 for an unknown that stays put.
    """
    moves = sizes > 0
    J = J[:, moves] / sizes[moves]
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return np.inf
    if not moves.any():
        return 0.0
    # Any: the stubs know no economic factors.
    factors: Any = scipy.linalg.qr(J, mode="economic", pivoting=True)
    Q, R, _ = factors
    sizes = np.abs(np.diag(R))
    return float(np.sum(np.square(Q[:, : sizes.size][:, sizes > _RANK].T @ r)))


def _step(at: Point, sizes: np.ndarray, region: Region) -> np.ndarray:
    """Return the damped step, within the radius."""
    units = np.where(sizes > 0, 1.0 / np.where(sizes > 0, sizes, 1.0), 0.0)
    damped = np.vstack([at.J * units, np.sqrt(region.damping) * np.eye(units.size)])
    # Not by J'J, which would square the condition number.
    Q, R = np.linalg.qr(damped)
    step = -units * scipy.linalg.solve_triangular(R, Q[: at.r.size].T @ at.r)
    change = float(np.linalg.norm(at.J @ step))
    return step * (region.radius / change) if change > region.radius else step


def judge_step(at: Point, trial: Point, region: Region) -> tuple[bool, Region]:
    """Return True if a step is accepted, and the region of the next one."""
    along = at.J @ (trial.z - at.z)
    predicted = 0.5 * float(np.sum(np.square(at.r + along)) - at.squares)
    change, rest = 0.5 * (trial.squares - at.squares), 0.5 * _ROUNDING * at.squares
    # A step whose gain is rounding, which is the last, would be refused at random.
    if change <= _ACCEPTED * predicted < 0.0 or (predicted > -rest and change < rest):
        if not change < _AS_PREDICTED * predicted:
            return True, region
        damping = max(_LESS * region.damping, _LEAST_DAMPING)
        return True, Region(damping, max(region.radius, _GROWTH * float(np.linalg.norm(along))))
    # To where the parabola by slope and cost is lowest, within a tenth and a half.
    slope = float(at.r @ along)
    part = -slope / (2.0 * (change - slope))
    part = float(np.clip(part, 0.1, 0.5)) if np.isfinite(part) else 0.1
    return False, Region(_MORE * region.damping, part * float(np.linalg.norm(along)))


def _is_short(at: Point, trial: Point, sizes: np.ndarray, start: np.ndarray) -> bool:
    """Return True if a step moved nothing that shows.

    An unknown that runs off, as the size of a disturbance that is none, has a gain ahead for ever.
    """
    steps = sizes * np.abs(trial.z - at.z)
    before, after = at.squares**0.5, trial.squares**0.5
    near = steps < _SHORT + _RELATIVE * sizes * np.abs(trial.z - start)
    return bool(near.all() and abs(after - before) < 3e-3 * _SHORT + _RELATIVE * after)
