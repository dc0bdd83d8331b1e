"""One step of Levenberg-Marquardt, by optimistix on a triangle of the residuals."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from heli_jax.identification.estimation.scaling import COLUMN, Scaling, without_size
from heli_jax.identification.estimation.trust_region import (
    ARRIVED,
    LevenbergMarquardt,
    gain_ahead,
    within_radius,
    within_reach,
)
from heli_jax.identification.unknowns.layout import Layout

_TIKHONOV_SD = 100.0
"""sd, in the coordinates of the free parameters (logarithms), of the Tikhonov regularisation that
ties them to the start: a factor of e^100 is no prior, but it tells one end of a valley from the
other"""

_TIKHONOV_SDS_LINEAR = 1e6
"""the same for a coordinate that is no logarithm and so has no size of its own, in units of the sd
that the data would give it at the start if all else were known"""

_REACH = 3.0
"""of the logarithm of a disturbance's sigma or tau, where there are several: a factor of 20"""


_WHOLE = 0.9
"""part of the gain that a whole step of Gauss and Newton makes at least"""


class Constants(NamedTuple):
    """What stays the same throughout one run."""

    z0: Float[Array, " q"]
    scaling: Scaling
    tikhonov: Float[Array, " q"]
    """one over the sd of the tie to the start, 0 without"""
    convergence_mask: Bool[Array, " q"]
    """the unknowns whose steps say whether the optimiser has arrived"""
    reach: Float[Array, " q"]
    """how far one step may go, by unknown"""
    with_radius: Bool[Array, ""]
    """whether a refused step shortens the next ones, beside what damping does"""
    damping: Float[Array, ""]
    """of the first step, in the optimiser's units"""
    unchecked: Float[Array, ""]
    """gain, in joint standard deviations squared, of a step that is taken as the last one without
    an evaluation of where it leads"""


class _Rows(NamedTuple):
    """The residuals about one point, as the optimiser sees them: r + J (xi - at)."""

    at: Float[Array, " q"]
    r: Float[Array, " k"]
    J: Float[Array, "k q"]


class State(NamedTuple):
    """Where a run stands."""

    xi: Float[Array, " q"]
    """the last point that was accepted, in the optimiser's units"""
    solver: Any
    """optimistix's own"""
    done: Bool[Array, ""]
    arrived: Bool[Array, ""]
    """whether it is done because it arrived"""
    ahead: Float[Array, ""]
    """what the last step, not evaluated, took off the sum of squares in the optimiser's units"""


def _linear(xi: Array, rows: _Rows) -> tuple[Array, None]:
    return rows.r + jnp.sum(rows.J * (xi - rows.at)[None, :], axis=1), None


_OPTIONS: dict[str, Any] = {"jac": "bwd"}
"""a Jacobian of numbers, which can be handed from step to step"""


def _solver(constants: Constants) -> LevenbergMarquardt:
    # A step below a thousandth of a standard deviation is the last: what it leaves is far less,
    # and smaller gains drown in the rounding of the sum of squares. In the optimiser's units a
    # standard deviation is 1 / (column norm * residual norm).
    atol = 1e-3 / (COLUMN * constants.scaling.residual_norm)
    return LevenbergMarquardt(1e-9, atol, constants.convergence_mask)


def compressed(
    constants: Constants, r: Float[Array, " n"], J: Float[Array, "n q"]
) -> Float[Array, "k k"]:
    # What a step needs of the residuals r and their Jacobian J is in the triangle of the QR
    # decomposition of [r J]: as many rows as unknowns, and one. The optimiser sees these rows; the
    # first is the size of r, the others are zero but for their derivatives. Its program is then
    # the same for records of any length.
    columns = jnp.concatenate([r[:, None], J * constants.scaling.unit[None, :]], axis=1)
    R = jnp.linalg.qr(columns / constants.scaling.residual_norm, mode="r")
    # QR leaves the sign open; a size that changed it would look like a change of the residuals.
    return R * jnp.where(R[0, 0] < 0, -1.0, 1.0).astype(R.dtype)


def _rows(constants: Constants, R: Float[Array, "k k"], xi: Float[Array, " q"]) -> _Rows:
    # Where the data leave a direction of the parameters open, the weakest of regularisations keeps
    # them from drifting along it.
    (unit, norm), tikhonov = constants.scaling, constants.tikhonov
    tie = -unit * xi * tikhonov / norm
    pull = -jnp.diag(tikhonov * unit) / norm
    return _Rows(xi, jnp.concatenate([R[:, 0], tie]), jnp.concatenate([R[:, 1:], pull]))


def begin(constants: Constants) -> State:
    q = constants.z0.shape[0]
    xi = jnp.zeros_like(constants.z0)
    # The first step accepts whatever is at z0, so that of these rows only the shapes count.
    rows = _rows(constants, jnp.zeros((q + 1, q + 1), xi.dtype), xi)
    shapes = jax.eval_shape(lambda: _linear(xi, rows)[0])
    solver = _solver(constants).init(_linear, xi, rows, _OPTIONS, shapes, None, frozenset())
    size = (1.0 / constants.damping).astype(xi.dtype)
    solver = eqx.tree_at(lambda s: s.search_state.step_size, solver, size)
    return State(xi, solver, jnp.asarray(False), jnp.asarray(False), jnp.zeros((), xi.dtype))


def advance(constants: Constants, state: State, R: Float[Array, "k k"]) -> State:
    """One step of optimistix's solver, whose next point is `state.solver.y_eval`."""
    rows, solver = _rows(constants, R, state.solver.y_eval), _solver(constants)
    xi, new, _ = solver.step(_linear, state.xi, rows, _OPTIONS, state.solver, frozenset())
    new = within_radius(new, xi, constants.with_radius)
    new = within_reach(new, xi, constants.reach, constants.scaling.unit)
    done, result = solver.terminate(_linear, xi, rows, _OPTIONS, new, frozenset())
    fine = result == optx.RESULTS.successful
    gain = gain_ahead(new.f_info, constants.scaling.residual_norm)
    foreseen = _fall(new.f_info, new.y_eval - xi)
    # Damped or shortened, a step says that the parabola is not to be relied on.
    whole = foreseen * constants.scaling.residual_norm**2 > _WHOLE * gain
    last = (gain < constants.unchecked) & whole & fine
    done |= (gain < ARRIVED) | last
    xi = jnp.where(last, new.y_eval, xi)
    stepped = State(xi, new, done | ~fine, done & fine, jnp.where(last, foreseen, 0.0))
    # Side by side a run that is done stays, while the slowest goes on.
    return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), stepped, state)


def _fall(f_info: Any, step: Float[Array, " q"]) -> Float[Array, ""]:
    """What a step takes off the sum of squares, as the linear residuals have it."""
    moved = f_info.jac.mv(step)
    return -jnp.sum((2.0 * f_info.residual + moved) * moved)


def point(constants: Constants, xi: Array) -> Array:
    return constants.z0 + constants.scaling.unit * xi


class Compiled(NamedTuple):
    """The optimiser's own arithmetic, for one run or for many side by side."""

    compressed: Callable[..., Array]
    begin: Callable[..., State]
    advance: Callable[..., State]
    point: Callable[..., Array]


# Compiled apart from the residuals: the same for all problems of as many unknowns and rows.
_ARITHMETIC = (compressed, begin, advance, point)
SINGLE = Compiled(*(jax.jit(f) for f in _ARITHMETIC))
BATCHED = Compiled(*(jax.jit(jax.vmap(f)) for f in _ARITHMETIC))


class _Kinds(NamedTuple):
    """What the optimiser has to know of each unknown, (q,)."""

    tikhonov: Float[np.ndarray, " q"]
    """one over the sd of the tie to the start, where a coordinate has a size of its own"""
    linear: Bool[np.ndarray, " q"]
    """those without one"""
    mask: Bool[np.ndarray, " q"]
    """as `Constants.convergence_mask`"""
    reach: Float[np.ndarray, " q"]


def constants_of(layout: Layout, z0: Array, units: Scaling) -> Constants:
    return _constants(z0, units, _kinds_of(layout, z0.dtype))


@jax.jit
def _constants(z0: Array, units: Scaling, kinds: _Kinds) -> Constants:
    # A gain is tied as well: with the effectiveness free it runs along a curved valley without end.
    usable = units.unit > 0
    # The norms of the columns at the start, that is one over the sd of each unknown alone.
    norms = COLUMN * units.residual_norm / jnp.where(usable, units.unit, 1.0)
    ties = jnp.where(usable, norms / _TIKHONOV_SDS_LINEAR, 0.0)
    tikhonov = jnp.where(kinds.linear, ties, kinds.tikhonov)
    mask, reach = jnp.asarray(kinds.mask), jnp.asarray(kinds.reach)
    one, none = jnp.ones((), z0.dtype), jnp.zeros((), z0.dtype)
    return Constants(z0, units, tikhonov, mask, reach, jnp.asarray(True), one, none)


def _kinds_of(layout: Layout, dtype: np.dtype) -> _Kinds:
    at = np.arange(layout.size)
    # Nuisances have weak priors of their own; time shift and disturbance have limits.
    logarithmic = np.where(at < len(layout.free), 1.0 / _TIKHONOV_SD, 0.0)
    # Not the noise's: a disturbance that is hardly there may wander on where it changes nothing
    # else, since no likelihood has a maximum there.
    mask = (at < len(layout.of_interest)) | (at >= layout.first_nuisance)
    # Of several noises one may vanish, where its logarithm runs off: each by itself.
    last = layout.first_nuisance - (0 if layout.filtered else len(layout.scaled))
    noises = (at >= len(layout.of_interest)) & (at < last)
    reach = np.where(noises & (len(layout.sizes) > 1), _REACH, np.inf)
    return _Kinds(logarithmic.astype(dtype), without_size(layout), mask, reach.astype(dtype))
