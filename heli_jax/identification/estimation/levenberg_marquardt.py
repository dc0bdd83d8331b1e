"""Levenberg-Marquardt: the least squares of the residual vector, from one start.

A step d minimises |r + J d|^2 + mu |D d|^2, with the norms of J's columns in D (Marquardt, 1963).
The damping mu decreases after a step that did as predicted and increases after a rejected one. A
rejected step also sets a radius (More, 1978), which limits the next changes of the residuals.

A step uses only the triangle of the QR decomposition of [r J], with one row more than unknowns.
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
"""Squared distance from the optimum in joint standard deviations. A hundredth of one is invisible
in intervals, and steps that shrink by a fifth need ten more for a thousandth."""
_SHORT = 1e-3
"""Change of the residuals by a step, for each unknown, below which the search ends."""
_RELATIVE = 1e-9
"""The same limit relative to the distance from the start."""
_STUCK = 0.1
"""Fraction of the sum of squares that a short step may leave as predicted gain; more is no
optimum."""
_ROUNDING = 1e-12
"""Fraction of the sum of squares below which a change is rounding, and of the largest column below
which a logarithm's column is rounding."""
_RANK = 1e-10
"""Remainder of a unit column, after projection on the others, below which it depends on them."""

_DAMPING, _LEAST_DAMPING = 1.1e-5, 1.1e-12
"""mu of the first step, and its least value: below it, rounding in a direction without effect would
cause steps of any length."""
_ACCEPTED, _AS_PREDICTED = 0.1, 0.75
"""Fractions of the predicted gain above which a step is accepted, and above which it did as
predicted."""
_LESS, _MORE = 0.3, 10.0
"""Factors of mu after a step that did as predicted, and after a rejected one."""
_GROWTH = 3.0
"""Largest ratio of the residuals' change in the next step to that of a step that did as
predicted."""

_NUISANCE_STEPS = 60
"""Most steps for initial states and biases."""
_BEGINS = 0.05, 0.25, 1.0
"""Parts of a record from which they are estimated in turn."""
_TIE_SD = 100.0
"""sd that ties free parameters to the start, in logarithms or logits. A factor of e^100 is no
prior, but stops a parameter that runs to its bound or to zero."""


class Optimum(NamedTuple):
    """Optimum of one run."""

    z: Float[Array, " q"]
    cost: float
    """Sum of squares of all rows, priors included, and what the method adds to it, over the number
    of measured values."""
    steps: int
    """Evaluations of the residuals."""
    converged: bool
    moved: float = np.inf
    """Squared distance from the start in joint standard deviations."""


class Point(NamedTuple):
    """Unknowns, and the residuals r + J d around them: the rows of the triangle, then the ties."""

    z: Float[np.ndarray, " q"]
    r: Float[np.ndarray, " k"]
    J: Float[np.ndarray, "k q"]
    cost: float
    """The squares of r, and what the method adds to them."""

    @property
    def squares(self) -> float:
        return float(self.r @ self.r)


class Region(NamedTuple):
    """Limits of the next step."""

    damping: float
    radius: float
    """Limit on the change of the residuals; inf until a step is rejected."""


def without_size(layout: Layout) -> np.ndarray:
    """Return (q,) True for the unknowns that are no logarithms and so have no natural size."""
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
) -> Optimum:
    """Return the least-squares optimum from z0.

    Args:
        held: (q,) True for an unknown fixed at its start; default none.
    """
    start, logarithms = np.asarray(z0, np.float64), ~without_size(layout)
    moving = np.ones(layout.size, bool) if held is None else ~held
    free = np.arange(layout.size) < len(layout.free)
    ties = np.eye(layout.size)[free & logarithms & moving] / _TIE_SD
    low, high = _bounds(layout, data)

    def linearise(z: np.ndarray) -> Point:
        r, J, *_, cost = residual_and_jacobian(layout, data, noise, jnp.asarray(z))
        # An overflowed derivative gives no direction.
        J = np.where(moving & np.isfinite(J).all(axis=0), J, 0.0)
        R = np.linalg.qr(np.column_stack([r, J]), mode="r")
        tied = ties @ (z - start)
        r, J = np.append(R[:, 0], tied), np.vstack([R[:, 1:], ties])
        return Point(z, r, J, float(cost) + float(tied @ tied))

    with np.errstate(all="ignore"):  # simulations may overflow on the way
        at, region = linearise(start), Region(_DAMPING, np.inf)
        sizes, count = np.zeros(layout.size), measured_count(data)
        short, steps = not np.isfinite(at.cost), 1
        while True:
            # An unknown without effect stays until it has one, like a time constant behind a gain
            # of zero.
            columns = np.linalg.norm(at.J, axis=0)
            least = np.where(logarithms, _ROUNDING * columns.max(initial=0.0), 0.0)
            sizes = np.where((sizes == 0) & (columns > least), columns, sizes)
            # An unknown at a bound stays if the misfit decreases beyond it.
            slope = at.J.T @ at.r
            outwards = ((at.z <= low) & (slope > 0)) | ((at.z >= high) & (slope < 0))
            units = np.where(outwards, 0.0, sizes)
            gain = predicted_gain(at.r, at.J, units)
            if short or not CONVERGED <= gain < np.inf or steps >= max_steps:
                break
            trial = linearise(np.clip(at.z + _step(at, units, region), low, high))
            steps += 1
            accepted, region = assess_step(at, trial, region)
            if accepted:
                short = _is_short(at, trial, sizes, start)
                at = trial
            if stages.is_watched():
                stages.advance(detail=f"cost {at.cost / count:.4g}")
        converged = gain < CONVERGED or (short and gain < _STUCK * at.squares)
        moved = float(np.sum(np.square(at.J @ (at.z - start))))
    cost = at.cost / count
    converged = bool(converged and np.isfinite(cost))
    return Optimum(jnp.asarray(at.z, jnp.asarray(z0).dtype), cost, steps, converged, moved)


def _bounds(layout: Layout, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates (q,); infinite without a bound."""
    bounds = np.tile([-np.inf, np.inf], (layout.size, 1))
    # All entries are fetched at once, because each would be a separate program.
    limits = zip(layout.kinds, *map(np.asarray, (data.sign, data.low, data.high)), strict=True)
    for i, of_one in enumerate(limits):
        bounds[i] = transforms.coordinate_limits(*of_one)
    return bounds[:, 0], bounds[:, 1]


def fit_nuisances(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> Float[Array, " q"]:
    """Return z with initial states, biases and offsets by least squares, all else unchanged.

    Return z itself if the simulation is not finite.
    """
    held = np.arange(layout.size) < layout.first_nuisance
    if held.all():
        return z
    # The begin of a record determines its initial state; over many periods of a nonlinear motion
    # the cost has other minima.
    for share in (1.0,) if layout.model.linear else _BEGINS:
        part = data if share == 1.0 else _begin_of(layout, data, share)
        z = optimise(layout, part, noise, z, _NUISANCE_STEPS, held=held).z
    return z


def _begin_of(layout: Layout, data: Data, share: float) -> Data:
    """Return the data with only the first samples of each window."""
    flights = []
    for flight, (_, m) in zip(data.flights, layout.windows, strict=True):
        outputs = {
            n: jnp.where(np.arange(y.shape[0]) % m < share * m, y, jnp.nan)
            for n, y in flight.outputs.items()
        }
        flights.append(flight._replace(outputs=outputs))
    return data._replace(flights=tuple(flights))


def predicted_gain(
    r: Float[np.ndarray, " k"], J: Float[np.ndarray, "k q"], sizes: Float[np.ndarray, " q"]
) -> float:
    """Return the decrease of the sum of squares that a full Gauss-Newton step predicts.

    This gain, g' F^-1 g, is the squared distance from the optimum in joint standard deviations. It
    is independent of units, and ignores directions that the data hardly determine.

    Args:
        sizes: norms of J's columns; 0 for a fixed unknown.
    """
    moves = sizes > 0
    J = J[:, moves] / sizes[moves]
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return np.inf
    if not moves.any():
        return 0.0
    # Any: the type stubs lack economic factors.
    factors: Any = scipy.linalg.qr(J, mode="economic", pivoting=True)
    Q, R, _ = factors
    sizes = np.abs(np.diag(R))
    return float(np.sum(np.square(Q[:, : sizes.size][:, sizes > _RANK].T @ r)))


def _step(at: Point, sizes: np.ndarray, region: Region) -> np.ndarray:
    """Return the damped step, within the radius."""
    units = np.where(sizes > 0, 1.0 / np.where(sizes > 0, sizes, 1.0), 0.0)
    damped = np.vstack([at.J * units, np.sqrt(region.damping) * np.eye(units.size)])
    # J'J would square the condition number.
    Q, R = np.linalg.qr(damped)
    step = -units * scipy.linalg.solve_triangular(R, Q[: at.r.size].T @ at.r)
    change = float(np.linalg.norm(at.J @ step))
    return step * (region.radius / change) if change > region.radius else step


def assess_step(at: Point, trial: Point, region: Region) -> tuple[bool, Region]:
    """Return True if a step is accepted, and the region of the next one."""
    along = at.J @ (trial.z - at.z)
    predicted = 0.5 * float(np.sum(np.square(at.r + along)) - at.squares)
    change, rest = 0.5 * (trial.cost - at.cost), 0.5 * _ROUNDING * at.squares
    # The gain of the last step is rounding, so it would be rejected at random.
    if change <= _ACCEPTED * predicted < 0.0 or (predicted > -rest and change < rest):
        if not change < _AS_PREDICTED * predicted:
            return True, region
        damping = max(_LESS * region.damping, _LEAST_DAMPING)
        return True, Region(damping, max(region.radius, _GROWTH * float(np.linalg.norm(along))))
    # The radius goes to the minimum of the parabola through slope and cost, within a tenth and a
    # half.
    slope = float(at.r @ along)
    part = -slope / (2.0 * (change - slope))
    part = float(np.clip(part, 0.1, 0.5)) if np.isfinite(part) else 0.1
    return False, Region(_MORE * region.damping, part * float(np.linalg.norm(along)))


def _is_short(at: Point, trial: Point, sizes: np.ndarray, start: np.ndarray) -> bool:
    """True if the step had no visible effect.

    An unknown that runs off, like the size of an absent disturbance, always predicts a further
    gain.
    """
    steps = sizes * np.abs(trial.z - at.z)
    near = steps < _SHORT + _RELATIVE * sizes * np.abs(trial.z - start)
    size = at.squares**0.5
    change = 0.5 * abs(trial.cost - at.cost) / max(size, 1e-300)
    return bool(near.all() and change < 3e-3 * _SHORT + _RELATIVE * size)
