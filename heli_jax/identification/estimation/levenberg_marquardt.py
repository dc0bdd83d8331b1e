"""Levenberg-Marquardt by optimistix on the one residual, from one start or many.

Each step goes by a triangle of the residuals and their Jacobian, so that its program is the same
for records of any length. Around optimistix's solver stand the units of the unknowns, a trust
region with a radius, and a test of convergence in standard deviations of the estimates
(`experiments/benchmarks/optimiser.py` compares with the plain solver).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from heli_jax import stages
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.unknowns.layout import Data, Layout, Noise

# Units in which Levenberg-Marquardt sees the unknowns, and which unknowns may move at all.


COLUMN = 300.0
"""Column norm of the scaled Jacobian at the start: optimistix begins with damping 1, which is
then a hundred-thousandth of J'J; a step that fails raises it tenfold."""

_SMALL = 1e-12
"""part of the largest column norm below which a column may be what rounding leaves of none"""
_TRIAL = 1e-3
"""part of the residuals' norm by which a small column should change them when it is tried"""


class Scaling(NamedTuple):
    """Units in which the optimiser sees a start: z = z0 + unit * xi, residuals / residual_norm."""

    unit: Float[Array, " q"]
    """0 for an unknown that stays put"""
    residual_norm: Float[Array, ""]


@jax.jit
def scaling(r0: Float[Array, " n"], J0: Float[Array, "n q"], trusted: Bool[Array, " q"]) -> Scaling:
    """Columns of equal norm and a cost of order one; an unknown without effect stays put.

    Args:
        trusted: the unknowns whose column counts however small it is beside the others.
    """
    norms = jnp.linalg.norm(J0, axis=0)
    # A column that overflowed has no size: its unknown stays put too.
    norms = jnp.where(jnp.isfinite(norms), norms, 0.0)
    usable = (norms > _SMALL * jnp.max(norms)) | (trusted & (norms > 0))
    # Zero at the truth of a simulated record without noise.
    size = jnp.maximum(jnp.linalg.norm(r0), 1e-300)
    return Scaling(jnp.where(usable, COLUMN * size / jnp.where(usable, norms, 1.0), 0.0), size)


def without_size(layout: Layout) -> np.ndarray:
    """(q,) the unknowns that are no logarithms and so have no size of their own."""
    linear = [kind == "linear" for kind in layout.kinds] + [True] * len(layout.gains)
    return np.array(linear + [False] * (layout.size - len(linear)), bool)


def trusted_columns(
    layout: Layout,
    evaluate: Callable[[Array], tuple[Array, Array]],
    z: Float[Array, " q"],
    r: Float[Array, " n"],
    J: Float[Array, "n q"],
) -> np.ndarray:
    """(q,) the unknowns without a size of their own whose columns are small beside the largest, and
    yet say what the residuals do.
    """
    # Of parameters of 1e6 and 1e-8 the columns differ by 1e14 for their units alone. Rounding may
    # leave as little of a column that is zero; it does not predict what the residuals do.
    trusted = np.zeros(layout.size, bool)
    norms = np.linalg.norm(np.asarray(J), axis=0)
    small = (norms > 0) & (norms <= _SMALL * np.max(norms, initial=0.0)) & without_size(layout)
    for i in np.flatnonzero(small):
        step = _TRIAL * max(float(jnp.linalg.norm(r)), 1.0) / norms[i]
        predicted = np.asarray(J)[:, i] * step
        with np.errstate(all="ignore"):  # so small a column that the step overflows
            change = np.asarray(evaluate(z.at[i].add(step))[0]) - np.asarray(r)
            missed = np.linalg.norm(change - predicted)
        trusted[i] = bool(missed < 0.5 * np.linalg.norm(predicted))
    return trusted


# optimistix's Levenberg-Marquardt, with a radius for refused steps and an end of its own.

# Annotated Any: what optimistix hands from step to step, records of its own without public names.

_ROUNDING = 1e-12
"""part of the sum of squares below which a change is rounding"""
_GROWTH = 3.0
"""times the change of the residuals by a step that did as predicted may the next one make"""
_LEAST_DAMPED = 1e7
"""at most one over the damping: along a direction that the data leave open rounding over no damping
at all is a step of any length; beside the square of `COLUMN` this damping is 1e-12"""
ARRIVED = 1e-4
"""of joint standard deviations, squared: no interval shows a hundredth of one, and steps that
shrink by a fifth each take ten more to come to a thousandth"""


class _Region(NamedTuple):
    """Trust region of the next step."""

    step_size: Float[Array, ""]
    """one over the damping"""
    radius: Float[Array, ""]
    """by how much the residuals may change; inf until a step is refused"""


class _TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's trust region, with a radius beside the damping after a step that is refused.

    A search that goes well has next to no damping, and tenfold of that would try a refused step
    again, time after time. The radius limits the change of the residuals, which directions that the
    data leave open do not make.
    """

    def init(self, y: Float[Array, " q"], f_info_struct: Any) -> Any:
        """Return a `_Region` without a radius (interface of optimistix)."""
        begin = super().init(y, f_info_struct)
        return _Region(begin.step_size, jnp.asarray(jnp.inf, y.dtype))

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Float[Array, " q"],
        y_eval: Float[Array, " q"],
        f_info: Any,
        f_eval_info: Any,
        state: Any,
    ) -> Any:
        """Return the next step size, whether the step is accepted, and two records of its own
        (interface of optimistix)."""
        size, accept, result, _ = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        cost, gain = f_info.as_min(), self.predict_reduction(y_eval - y, f_info)
        change = f_eval_info.as_min() - cost
        # A step whose gain drowns in rounding, which is the last, would be refused at random.
        accept |= (gain > -_ROUNDING * cost) & (change < _ROUNDING * cost)
        moved = f_info.jac.mv(y_eval - y)
        slope = jnp.sum(f_info.residual * moved)
        # Where the parabola by slope and cost is lowest, within a tenth and a half (More, 1978).
        part = -slope / (2.0 * (change - slope))
        part = jnp.where(jnp.isfinite(part), jnp.clip(part, 0.1, 0.5), 0.1)
        as_predicted = change < self.high_cutoff * gain
        grown = jnp.where(as_predicted, _GROWTH * _norm2(moved), 0.0)
        radius = jnp.where(accept, jnp.maximum(state.radius, grown), part * _norm2(moved))
        size = jnp.minimum(size, _LEAST_DAMPED)
        return size, accept, result, _Region(size, radius)


# A hundred times the region where three quarters of the gain came that was predicted (optimistix:
# 3.5 times): the damping of 1 to begin with is gone within a few steps.
REGION = _TrustRegion(high_cutoff=0.75, low_cutoff=0.1, high_constant=100.0, low_constant=0.1)


def within_radius(state: Any, y: Float[Array, " q"], limited: Bool[Array, ""] | bool = True) -> Any:
    """The solver's state, its next point no further from y than its radius, if that is limited."""
    step = state.y_eval - y
    size = _norm2(state.f_info.jac.mv(step))
    radius = jnp.where(limited, state.search_state.radius, jnp.inf)
    nearer = y + step * jnp.minimum(1.0, radius / jnp.where(size > 0, size, 1.0))
    # Without a radius the point is the solver's own, to the last digit.
    return eqx.tree_at(lambda s: s.y_eval, state, jnp.where(size > radius, nearer, state.y_eval))


def _norm2(v: Float[Array, " k"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(jnp.square(v)))


def gain_ahead(f_info: Any, residual_norm: Float[Array, ""]) -> Float[Array, ""]:
    """Return the decrease of the sum of squares that a full Gauss-Newton step predicts.

    That gain, g' F^-1 g, is the squared distance from the optimum in joint standard deviations.
    Unlike the length of a step it asks for no unit, and a direction that the data leave all but
    open is not polished. An unknown that runs off, as the size of a disturbance that is none, has
    such a gain for ever: then the length of the others' steps has to tell.

    Args:
        f_info: residuals and Jacobian at the last point that was accepted.
        residual_norm: by which the residuals are divided, those of a variance of 1.
    """
    J = f_info.jac.as_matrix()
    # A column of zeros, that of an unknown that stays put, has no direction: behind the others in
    # the triangle it takes nothing from them.
    moves = jnp.any(J != 0, axis=0)
    order = jnp.argsort(~moves)
    R = jnp.linalg.qr(jnp.concatenate([J[:, order], f_info.residual[:, None]], axis=1), mode="r")
    gain = jnp.sum(jnp.where(moves[order], jnp.square(R[:-1, -1]), 0.0))
    return gain * residual_norm**2


class Constants(NamedTuple):
    """Constants of one run."""

    z0: Float[Array, " q"]
    scaling: Scaling
    ties: Float[Array | np.ndarray, " q"]
    """one over the sd that ties an unknown to its start; 0 without"""
    with_radius: Bool[Array, ""] | bool = True
    """True if a refused step shortens the next ones, beside what damping does"""


class _Rows(NamedTuple):
    """The residuals about one point, as the optimiser sees them: r + J (xi - at)."""

    at: Float[Array, " q"]
    r: Float[Array, " k"]
    J: Float[Array, "k q"]


class State(NamedTuple):
    """State of a run."""

    xi: Float[Array, " q"]
    """the last point that was accepted, in the optimiser's units"""
    solver: Any
    """optimistix's own"""
    done: Bool[Array, ""]
    arrived: Bool[Array, ""]
    """whether it is done because it arrived"""


def _linear(xi: Array, rows: _Rows) -> tuple[Array, None]:
    return rows.r + jnp.sum(rows.J * (xi - rows.at)[None, :], axis=1), None


_OPTIONS: dict[str, Any] = {"jac": "bwd"}
"""a Jacobian of numbers, which can be handed from step to step"""


def _solver(constants: Constants) -> optx.LevenbergMarquardt:
    # A step below a thousandth of a standard deviation is the last: what it leaves is far less,
    # and smaller gains drown in the rounding of the sum of squares. In the optimiser's units a
    # standard deviation is 1 / (column norm * residual norm).
    atol = 1e-3 / (COLUMN * constants.scaling.residual_norm)
    # QR of the rows: Cholesky of J'J would square their condition number.
    solver = optx.LevenbergMarquardt(1e-9, cast(float, atol), linear_solver=lx.QR())
    return eqx.tree_at(lambda s: s.search, solver, REGION)


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
    ties = constants.ties * constants.scaling.unit / constants.scaling.residual_norm
    r, J = jnp.concatenate([R[:, 0], -ties * xi]), jnp.concatenate([R[:, 1:], -jnp.diag(ties)])
    return _Rows(xi, r, J)


def begin(constants: Constants) -> State:
    q = constants.z0.shape[0]
    xi = jnp.zeros_like(constants.z0)
    # The first step accepts whatever is at z0, so that of these rows only the shapes count.
    rows = _rows(constants, jnp.zeros((q + 1, q + 1), xi.dtype), xi)
    shapes = jax.eval_shape(lambda: _linear(xi, rows)[0])
    solver = _solver(constants).init(_linear, xi, rows, _OPTIONS, shapes, None, frozenset())
    return State(xi, solver, jnp.asarray(False), jnp.asarray(False))


def advance(constants: Constants, state: State, R: Float[Array, "k k"]) -> State:
    """One step of optimistix's solver, whose next point is `state.solver.y_eval`."""
    rows, solver = _rows(constants, R, state.solver.y_eval), _solver(constants)
    xi, new, _ = solver.step(_linear, state.xi, rows, _OPTIONS, state.solver, frozenset())
    new = within_radius(new, xi, constants.with_radius)
    done, result = solver.terminate(_linear, xi, rows, _OPTIONS, new, frozenset())
    fine = result == optx.RESULTS.successful
    gain = gain_ahead(new.f_info, constants.scaling.residual_norm)
    done |= gain < ARRIVED
    stepped = State(xi, new, done | ~fine, done & fine)
    # Side by side a run that is done stays, while the slowest goes on.
    return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), stepped, state)


def point(constants: Constants, xi: Array) -> Array:
    return constants.z0 + constants.scaling.unit * xi


_TIE_SD = 100.0
"""sd, in logarithms or logits of the free parameters, of their tie to the start: a factor of e^100
is no prior, but it gives an end to a parameter that runs to its bound or to zero"""


def ties_of(layout: Layout) -> np.ndarray:
    """(q,) for `Constants`; a coordinate that is no logarithm has no size of its own to tie it."""
    free = np.arange(layout.size) < len(layout.free)
    return np.where(free & ~without_size(layout), 1.0 / _TIE_SD, 0.0)


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


# A whole run.


class Optimum(NamedTuple):
    """Optimum of one run."""

    z: Float[Array, " q"]
    cost: Float[Array, ""]
    """sum of squares of all rows, priors included, over the number of measured numbers"""
    # Numbers, or by run (k,) where there were several; from the device or not.
    steps: Array | np.ndarray
    converged: Array | np.ndarray
    """the optimiser's own word, and everything finite"""
    moved: Array | np.ndarray = np.asarray(np.inf)
    """squared distance from the start in joint standard deviations; inf of several runs"""


class _Run(NamedTuple):
    """A run that ended, or several side by side."""

    optimum: Optimum
    unit: Array
    """of the unknowns, 0 for one that stayed put"""
    r: Array
    """the residuals at the last point that was tried"""
    J: Array


def descend(
    evaluate: Callable[[Array], tuple[Array, Array]],
    constants: Constants,
    first: tuple[Array, Array],
    count: np.ndarray | int,
    max_steps: int,
    compiled: Compiled,
) -> _Run:
    """Step until converged, from `first`, residuals and Jacobian at the start.

    The residuals are evaluated by the one program that evaluates them for everything else: it
    takes longer to compile than to run. With `BATCHED` all has a leading axis, the runs'.
    """
    state, (r, J) = compiled.begin(constants), first
    for k in range(max_steps):
        state = compiled.advance(constants, state, compiled.compressed(constants, r, J))
        if compiled is SINGLE and stages.watched():
            now = _optimum(constants.scaling.residual_norm, state, state.xi, count)
            stages.advance(detail=f"cost {float(now.cost):.4g}")
        elif stages.watched():
            arrived = int(np.sum(state.done))
            stages.note(f"{arrived} of {np.size(state.done)} side by side arrived, step {k + 1}")
        # Asked before the residuals: those at a point that nobody steps to would cost the most.
        if k + 1 == max_steps or bool(np.all(state.done)):
            break
        r, J = evaluate(compiled.point(constants, state.solver.y_eval))
    z = compiled.point(constants, state.xi)
    optimum = _optimum(constants.scaling.residual_norm, state, z, count)
    return _Run(optimum, constants.scaling.unit, r, J)


@jax.jit
def _optimum(residual_norm: Array, state: State, z: Array, count: np.ndarray | int) -> Optimum:
    rows = state.solver.f_info.residual
    cost = jnp.sum(jnp.square(rows), axis=-1) * residual_norm**2 / jnp.asarray(count, rows.dtype)
    finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(z), axis=-1)
    moved = jnp.full_like(cost, jnp.inf)
    return Optimum(z, cost, state.solver.num_steps, state.arrived & finite, moved)


def optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array | np.ndarray, " q"],
    max_steps: int = 200,
    *,
    held: np.ndarray | None = None,
    known: tuple[Array, Array] | None = None,
) -> Optimum:
    """The least-squares optimum from z0.

    Args:
        held: (q,) whether an unknown stays at its start; none unless given.
        known: residuals and Jacobian at z0, where they are at hand.
    """

    def evaluate(z: Array) -> tuple[Array, Array]:
        return residual_and_jacobian(layout, data, noise, z)[:2]

    free = np.ones(layout.size, bool) if held is None else ~held
    count, ties = measured_count(data), ties_of(layout)
    z = jnp.asarray(z0)
    trusted, steps, stayed = np.zeros(layout.size, bool), 0, layout.size + 1
    while True:
        first = known or evaluate(z)
        known, (r, J) = None, first
        # A column of zeros has no unit, and what has none stays.
        units = scaling(r, jnp.where(free[None, :], J, 0.0), trusted)
        # Initial states alone, from far off: shortened steps end in the next valley (as of a
        # pendulum near the top of its swing).
        constants = Constants(z, units, ties, jnp.asarray(held is None))
        run = descend(evaluate, constants, first, count, max_steps - steps, SINGLE)
        steps, z = steps + int(run.optimum.steps), run.optimum.z
        stay = (np.asarray(run.unit) == 0) & free
        # Each further run has to move an unknown more, so that there are few of them.
        if not (0 < stay.sum() < stayed and steps < max_steps and bool(run.optimum.converged)):
            break
        # An unknown without effect at the start may have one here, such as the time constant
        # behind a gain that began at zero; the units of a run are those of its start.
        stayed = int(stay.sum())
        trusted = trusted | trusted_columns(layout, evaluate, z, run.r, run.J)
        norms = np.linalg.norm(np.asarray(run.J), axis=0)
        usable = (norms > _SMALL * np.max(norms, initial=0.0)) | trusted
        if not (stay & usable & np.isfinite(norms)).any():
            break
    with np.errstate(all="ignore"):  # a run that diverged moved by no number
        moved = np.sum((np.asarray(run.J) @ (np.asarray(z) - np.asarray(z0))) ** 2)
    return run.optimum._replace(steps=np.asarray(steps), moved=moved)
