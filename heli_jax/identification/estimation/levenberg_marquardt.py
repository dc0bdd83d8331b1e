"""Levenberg-Marquardt by optimistix on the one residual, from one start or many."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from heli_jax.identification.estimation import trust_region
from heli_jax.identification.estimation.estimator import measured_count
from heli_jax.identification.estimation.residual import ResidualAndJacobian, differentiate
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution


class Optimum(NamedTuple):
    """Where one run of the optimiser ended."""

    z: Float[Array, " q"]
    cost: Float[Array, ""]
    """sum of squares of all rows, priors included, over the number of measured numbers"""
    # Numbers, or by run (k,) where there were several; from the device or not.
    steps: Array | np.ndarray
    converged: Array | np.ndarray
    """the optimiser's own word, and everything finite"""


_COLUMN = 300.0
"""Column norm of the scaled Jacobian at the start: optimistix begins with damping 1, which is
then a hundred-thousandth of J'J; a step that fails raises it tenfold."""

_TIKHONOV_SD = 100.0
"""sd, in the free parameters' coordinates (logarithms), of the Tikhonov regularisation that ties
them to the start: a factor of e^100 is no prior, but tells one end of a valley from the other"""

_TIKHONOV_SDS_LINEAR = 1e6
"""the same for a coordinate that is no logarithm and so has no size of its own, in units of the sd
that the data would give it at the start if all else were known"""
_REACH = 3.0
"""of the logarithm of a disturbance's sigma or tau, where there are several: a factor of 20"""
_MANY_STEPS = 60
"""steps after which a run among many, which began near its optimum, is given up"""


class _Scaling(NamedTuple):
    """Units in which the optimiser sees a start: z = z0 + unit * xi, residuals / residual_norm."""

    unit: Float[Array, " q"]
    residual_norm: Float[Array, ""]


@jax.jit
def _scaling(r0: Float[Array, " n"], J0: Float[Array, "n q"]) -> _Scaling:
    """Columns of equal norm and a cost of order one; an unknown without effect stays put."""
    norms = jnp.linalg.norm(J0, axis=0)
    # A column that overflowed has no size: its unknown stays put too.
    norms = jnp.where(jnp.isfinite(norms), norms, 0.0)
    usable = norms > 1e-12 * jnp.max(norms)
    # Zero at the truth of a simulated record without noise.
    size = jnp.maximum(jnp.linalg.norm(r0), 1e-300)
    return _Scaling(jnp.where(usable, _COLUMN * size / jnp.where(usable, norms, 1.0), 0.0), size)


class _Constants(NamedTuple):
    """What stays the same throughout one run."""

    z0: Float[Array, " q"]
    scaling: _Scaling
    tikhonov: Float[Array, " q"]
    """one over the sd of the tie to the start, 0 without"""
    convergence_mask: Bool[Array, " q"]
    """the unknowns whose steps say whether the optimiser has arrived"""
    reach: Float[Array, " q"]
    """how far one step may go, by unknown"""


class _Rows(NamedTuple):
    """The residuals about one point, as the optimiser sees them: r + J (xi - at)."""

    at: Float[Array, " q"]
    r: Float[Array, " k"]
    J: Float[Array, "k q"]


class _State(NamedTuple):
    """Where a run stands."""

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


def _solver(constants: _Constants) -> trust_region.LevenbergMarquardt:
    # A step below a thousandth of a standard deviation, 1 / (column norm * residual norm), is the
    # last: smaller gains drown in the rounding of the sum of squares.
    atol = 1e-3 / (_COLUMN * constants.scaling.residual_norm)
    return trust_region.LevenbergMarquardt(1e-9, atol, constants.convergence_mask)


def _compressed(
    constants: _Constants, r: Float[Array, " n"], J: Float[Array, "n q"]
) -> Float[Array, "k k"]:
    # What a step needs of the residuals r and their Jacobian J is in the triangle of the QR
    # decomposition of [r J]: as many rows as unknowns, and one. The optimiser sees these rows; the
    # first is the size of r, the others are zero but for their derivatives. Its program is then
    # the same for records of any length.
    columns = jnp.concatenate([r[:, None], J * constants.scaling.unit[None, :]], axis=1)
    R = jnp.linalg.qr(columns / constants.scaling.residual_norm, mode="r")
    # QR leaves the sign open; a size that changed it would look like a change of the residuals.
    return R * jnp.where(R[0, 0] < 0, -1.0, 1.0).astype(R.dtype)


def _rows(constants: _Constants, R: Float[Array, "k k"], xi: Float[Array, " q"]) -> _Rows:
    # Where the data leave a direction of the parameters open, the weakest of regularisations keeps
    # them from drifting along it.
    (unit, norm), tikhonov = constants.scaling, constants.tikhonov
    tie = -unit * xi * tikhonov / norm
    pull = -jnp.diag(tikhonov * unit) / norm
    return _Rows(xi, jnp.concatenate([R[:, 0], tie]), jnp.concatenate([R[:, 1:], pull]))


def _begin(constants: _Constants) -> _State:
    q = constants.z0.shape[0]
    xi = jnp.zeros_like(constants.z0)
    # The first step accepts whatever is at z0, so that of these rows only the shapes count.
    rows = _rows(constants, jnp.zeros((q + 1, q + 1), xi.dtype), xi)
    shapes = jax.eval_shape(lambda: _linear(xi, rows)[0])
    solver = _solver(constants).init(_linear, xi, rows, _OPTIONS, shapes, None, frozenset())
    return _State(xi, solver, jnp.asarray(False), jnp.asarray(False))


def _advance(constants: _Constants, state: _State, R: Float[Array, "k k"]) -> _State:
    """One step of optimistix's solver, whose next point is `state.solver.y_eval`."""
    rows, solver = _rows(constants, R, state.solver.y_eval), _solver(constants)
    xi, new, _ = solver.step(_linear, state.xi, rows, _OPTIONS, state.solver, frozenset())
    new = trust_region.within_radius(new, xi)
    new = trust_region.within_reach(new, xi, constants.reach, constants.scaling.unit)
    done, result = solver.terminate(_linear, xi, rows, _OPTIONS, new, frozenset())
    done |= trust_region.arrived(new.f_info, constants.scaling.residual_norm)
    fine = result == optx.RESULTS.successful
    stepped = _State(xi, new, done | ~fine, done & fine)
    # Side by side a run that is done stays, while the slowest goes on.
    return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), stepped, state)


def _point(constants: _Constants, xi: Array) -> Array:
    return constants.z0 + constants.scaling.unit * xi


class _Compiled(NamedTuple):
    """The optimiser's own arithmetic, for one run or for many side by side."""

    compressed: Callable[..., Array]
    begin: Callable[..., _State]
    advance: Callable[..., _State]
    point: Callable[..., Array]


# Compiled apart from the residuals: the same for all problems of as many unknowns and rows.
_ARITHMETIC = (_compressed, _begin, _advance, _point)
_SINGLE = _Compiled(*(jax.jit(f) for f in _ARITHMETIC))
_BATCHED = _Compiled(*(jax.jit(jax.vmap(f)) for f in _ARITHMETIC))


def _descend(
    evaluate: Callable[[Array], tuple[Array, Array]],
    constants: _Constants,
    first: tuple[Array, Array],
    count: np.ndarray | int,
    max_steps: int,
    compiled: _Compiled,
) -> Optimum:
    """Step until arrived, from `first`, residuals and Jacobian at the start.

    The residuals are evaluated by the one program that evaluates them for everything else: it
    takes longer to compile than to run. With `_BATCHED` all has a leading axis, the runs'.
    """
    state, (r, J) = compiled.begin(constants), first
    for k in range(max_steps):
        state = compiled.advance(constants, state, compiled.compressed(constants, r, J))
        # Asked before the residuals: those at a point that nobody steps to would cost the most.
        if k + 1 == max_steps or bool(np.all(state.done)):
            break
        r, J = evaluate(compiled.point(constants, state.solver.y_eval))
    z = compiled.point(constants, state.xi)
    return _optimum(constants.scaling.residual_norm, state, z, count)


class _Loop(NamedTuple):
    """A run that evaluates its residuals itself."""

    k: Array
    scaling: _Scaling
    state: _State
    last: ResidualAndJacobian
    """of the last point that was tried"""


class _End(NamedTuple):
    """Where such a run ended."""

    z: Float[Array, " q"]
    residual_norm: Float[Array, ""]
    """at its start"""
    state: _State
    last: ResidualAndJacobian


@eqx.filter_jit
def _optimise_in_one_program(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"], max_steps: np.ndarray
) -> _End:
    """`_descend` from one start as one program; with one step it evaluates z0 and nothing else."""

    def more(now: _Loop) -> Array:
        return (now.k < max_steps) & ~now.state.done

    def step(now: _Loop) -> _Loop:
        point = _point(_constants(layout, z0, now.scaling), now.state.solver.y_eval)
        e = differentiate(layout, data, noise, point)
        scaling = jax.tree.map(
            lambda new, old: jnp.where(now.k == 0, new, old), _scaling(e.r, e.J), now.scaling
        )
        constants = _constants(layout, z0, scaling)
        state = _advance(constants, now.state, _compressed(constants, e.r, e.J))
        return _Loop(now.k + 1, scaling, state, e)

    begin = _before_the_loop(layout, data, noise, z0)
    end = jax.lax.while_loop(more, step, begin)
    constants = _constants(layout, z0, end.scaling)
    return _End(_point(constants, end.state.xi), end.scaling.residual_norm, end.state, end.last)


def _before_the_loop(layout: Layout, data: Data, noise: Noise, z0: Array) -> _Loop:
    # The first point is z0: until its Jacobian is known, a unit of zero goes nowhere. Evaluated
    # before the loop it would be compiled twice, the residuals being most of the program.
    scaling = _Scaling(jnp.zeros_like(z0), jnp.ones((), z0.dtype))
    shapes = jax.eval_shape(lambda: differentiate(layout, data, noise, z0))
    last = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
    return _Loop(jnp.asarray(0), scaling, _begin(_constants(layout, z0, scaling)), last)


def residual_and_jacobian(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> ResidualAndJacobian:
    """`differentiate` by the program that the optimiser compiles as well.

    Args:
        layout: what stands where in z.
        data: the numbers of the problem.
        noise: of the measurements, by which the rows are divided.
        z: the unknowns.
    """
    if layout.estimator.one_program(layout):
        # An array and not a number, which would be compiled in: with one step alone the program
        # of a whole run would then be another.
        return _optimise_in_one_program(layout, data, noise, z, np.asarray(1)).last
    return differentiate(layout, data, noise, z)


def _optimum(residual_norm: Array, state: _State, z: Array, count: np.ndarray | int) -> Optimum:
    rows = state.solver.f_info.residual
    cost = jnp.sum(jnp.square(rows), axis=-1) * residual_norm**2
    cost = cost / jnp.asarray(count, cost.dtype)
    finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(z), axis=-1)
    return Optimum(z, cost, state.solver.num_steps, state.arrived & finite)


def optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    max_steps: int = 200,
    *,
    held: np.ndarray | None = None,
) -> Optimum:
    """The least-squares optimum from z0.

    Args:
        layout: what stands where in z.
        data: the numbers of the problem.
        noise: of the measurements, by which the rows are divided.
        z0: where to begin.
        max_steps: after which it is given up.
        held: (q,) whether an unknown stays at its start; none unless given.
    """
    count = measured_count(data)
    if layout.estimator.one_program(layout) and held is None:
        end = _optimise_in_one_program(layout, data, noise, z0, np.asarray(max_steps))
        return _optimum(end.residual_norm, end.state, end.z, count)

    def evaluate(z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    first = evaluate(z0)
    r0, J0 = first
    if held is not None:
        # A column of zeros has no unit, and what has none stays.
        J0 = jnp.where(held[None, :], jnp.zeros_like(J0), J0)
    constants = _constants(layout, z0, _scaling(r0, J0))
    return _descend(evaluate, constants, first, count, max_steps, _SINGLE)


@eqx.filter_jit
def _batch(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, "b q"]
) -> tuple[Float[Array, "b n"], Float[Array, "b n q"]]:
    """Residuals and Jacobians of a batch; all of `data` has a leading axis too."""

    def single(data: Data, z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    return jax.vmap(single)(data, z)


def optimise_many(
    reached: Solution,
    data: Callable[[Any], Data],
    starts: Float[Array, "k q"],
    each: Any,
    *,
    hold: int | None = None,
    batch: int = 8,
) -> Optimum:
    """Optima (k, ...) for many starts or records near an optimum.

    Args:
        reached: that optimum; its Jacobian gives the units of all runs.
        data: makes the numbers of one run out of its slice of `each`.
        starts: where each run begins.
        each: what differs between the runs, a pytree of arrays (k, ...).
        hold: the unknown that stays at its start, by its number.
        batch: runs side by side, by vmap.
    """
    layout, noise = reached.layout, reached.noise
    first = residual_and_jacobian(layout, reached.data, noise, reached.z)
    scaling = _scaling(first.r, first.J)
    if hold is not None:
        # What has no unit stays, see `_scaling`.
        scaling = scaling._replace(unit=scaling.unit.at[hold].set(0.0))
    k, batch = starts.shape[0], min(batch, starts.shape[0])
    optima = []
    for i in range(0, k, batch):
        # The last ones again where the batch is not full: another shape would compile anew.
        chosen = np.minimum(np.arange(i, i + batch), k - 1)
        z0 = starts[chosen]
        numbers = jax.vmap(data)(jax.tree.map(lambda v, chosen=chosen: v[chosen], each))
        constants = jax.vmap(lambda z: _constants(layout, z, scaling))(z0)

        def evaluate(z: Array, numbers: Data = numbers) -> tuple[Array, Array]:
            return _batch(layout, numbers, noise, z)

        count = measured_count(numbers) // batch
        ends = _descend(evaluate, constants, evaluate(z0), count, _MANY_STEPS, _BATCHED)
        optima.append(jax.tree.map(lambda v, n=min(batch, k - i): np.asarray(v)[:n], ends))
    return jax.tree.map(lambda *v: np.concatenate(v), *optima)


def _constants(layout: Layout, z0: Array, scaling: _Scaling) -> _Constants:
    at = np.arange(layout.size)
    # Nuisances have weak priors of their own; time shift and disturbance have limits.
    logarithmic = np.where(at < len(layout.free), 1.0 / _TIKHONOV_SD, 0.0)
    tikhonov = jnp.asarray(logarithmic, z0.dtype)
    # Not the noise's: a disturbance that is hardly there may wander on where it changes nothing
    # else, since no likelihood has a maximum there.
    mask = (at < len(layout.of_interest)) | (at >= layout.first_nuisance)
    # A gain is tied as well: with the effectiveness free it runs along a curved valley without end.
    linear = np.array([kind == "linear" for kind in layout.kinds] + [True] * len(layout.gains))
    if linear.any():
        linear = np.concatenate([linear, np.zeros(layout.size - linear.size, bool)])
        usable = scaling.unit > 0
        # The norms of the columns at the start, that is one over the sd of each unknown alone.
        norms = _COLUMN * scaling.residual_norm / jnp.where(usable, scaling.unit, 1.0)
        ties = jnp.where(usable, norms / _TIKHONOV_SDS_LINEAR, 0.0)
        tikhonov = jnp.where(linear, ties, tikhonov)
    # Of several disturbances one may vanish, where its logarithm runs off: each by itself.
    noises = (at >= len(layout.of_interest)) & (
        at < len(layout.of_interest) + len(layout.disturbance)
    )
    reach = np.where(noises & (len(layout.sigmas) > 1), _REACH, np.inf)
    return _Constants(z0, scaling, tikhonov, jnp.asarray(mask), jnp.asarray(reach, z0.dtype))
