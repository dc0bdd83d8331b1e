"""Levenberg-Marquardt by optimistix on the one residual, from one start or many."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from heli_jax.identification.estimation.estimator import measured_count
from heli_jax.identification.estimation.residual import ResidualAndJacobian, differentiate
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution


class Optimum(NamedTuple):
    """Where one run of the optimiser ended."""

    z: Float[Array, " q"]
    cost: Float[Array, ""]
    """sum of squares of all rows, priors included, over the number of measured numbers"""
    steps: Any
    converged: Any
    """the optimiser's own word, and everything finite"""


_ROUNDING = 1e-12
"""Part of the sum of squares below which a change is rounding."""


class _Search(optx.ClassicalTrustRegion):
    """optimistix's trust region, but a step whose gain would drown in rounding is accepted.

    Otherwise such a step, which is the last, is rejected at random and the search lingers.
    """

    def step(
        self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: Any
    ) -> Any:
        size, accept, result, new = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        cost = f_info.as_min()
        gain = self.predict_reduction(y_eval - y, f_info)
        change = f_eval_info.as_min() - cost
        nothing = (gain > -_ROUNDING * cost) & (change < _ROUNDING * cost)
        return size, accept | nothing, result, new


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's Levenberg-Marquardt with a trust region that opens faster.

    The default waits for an all but perfect model (ratio 0.99) before it lowers the damping.
    """

    rtol: Any
    atol: Any
    norm: Any
    descent: Any
    search: Any
    verbose: Any

    def __init__(self, rtol: Any, atol: Any, watched: Array):
        self.rtol, self.atol = rtol, atol

        def norm(x: Array) -> Array:
            # Of the unknowns those watched; of the rows the first, the size of the residuals.
            return optx.max_norm(jnp.where(watched, x, 0.0) if x.shape == watched.shape else x[0])

        self.norm = norm
        self.descent = optx.DampedNewtonDescent(linear_solver=lx.QR())
        self.search = _Search(
            high_cutoff=0.75, low_cutoff=0.1, high_constant=100.0, low_constant=0.1
        )
        self.verbose = lambda **_: None


_COLUMN = 300.0
"""Column norm of the scaled Jacobian at the start: optimistix begins with damping 1, which is
then a hundred-thousandth of J'J; a step that fails raises it tenfold."""


_ANCHOR = 100.0
"""sd, in the coordinates of the free parameters (logarithms), by which they are tied to the start:
a factor of e^100 is no prior, but it tells one end of a valley from the other"""


_LINEAR_ANCHOR = 1e6
"""the same for a coordinate that is no logarithm and so has no size of its own, in units of the sd
that the data would give it at the start if all else were known"""


class _Scaling(NamedTuple):
    """Units in which the optimiser sees a start: z = z0 + unit * xi, residuals / level."""

    unit: Float[Array, " q"]
    level: Float[Array, ""]


@jax.jit
def _scaling(r0: Float[Array, " n"], J0: Float[Array, "n q"]) -> _Scaling:
    """Columns of equal norm and a cost of order one; an unknown without effect stays put."""
    norms = jnp.linalg.norm(J0, axis=0)
    norms = jnp.where(jnp.isfinite(norms), norms, 0.0)
    usable = norms > 1e-12 * jnp.max(norms)
    level = jnp.maximum(jnp.linalg.norm(r0), 1e-300)
    return _Scaling(jnp.where(usable, _COLUMN * level / jnp.where(usable, norms, 1.0), 0.0), level)


class _Terms(NamedTuple):
    """What stays the same throughout one run."""

    z0: Float[Array, " q"]
    units: _Scaling
    anchor: Float[Array, " q"]
    """one over the sd of the tie to the start, 0 without"""
    watched: Bool[Array, " q"]


class _Rows(NamedTuple):
    """The residuals about one point, as the optimiser sees them: r + J (xi - at)."""

    at: Float[Array, " q"]
    r: Float[Array, " k"]
    J: Float[Array, "k q"]


class _State(NamedTuple):
    """Where a run stands."""

    xi: Float[Array, " q"]
    solver: Any
    done: Any
    fine: Any
    """whether it is done because it arrived"""


def _linear(xi: Array, rows: _Rows) -> tuple[Array, None]:
    return rows.r + jnp.sum(rows.J * (xi - rows.at)[None, :], axis=1), None


_HOW: dict[str, Any] = {"jac": "bwd"}
"""a Jacobian of numbers, which can be handed from step to step"""


def _solver(terms: _Terms) -> _LevenbergMarquardt:
    # A step below a thousandth of a standard deviation is the last: what it leaves is far less,
    # and smaller gains drown in the rounding of the sum of squares.
    # A disturbance that is hardly there may wander on where it changes nothing else.
    return _LevenbergMarquardt(1e-9, 1e-3 / (_COLUMN * terms.units.level), terms.watched)


def _compressed(terms: _Terms, r: Float[Array, " n"], J: Float[Array, "n q"]) -> Array:
    # What a step needs of the residuals r and their Jacobian J is in the triangle of the QR
    # decomposition of [r J]: as many rows as unknowns, and one. The optimiser sees these rows; the
    # first is the size of r, the others are zero but for their derivatives.
    columns = jnp.concatenate([r[:, None], J * terms.units.unit[None, :]], axis=1)
    R = jnp.linalg.qr(columns / terms.units.level, mode="r")
    return R * jnp.where(R[0, 0] < 0, -1.0, 1.0).astype(R.dtype)


def _rows(terms: _Terms, R: Float[Array, "k k"], xi: Float[Array, " q"]) -> _Rows:
    # Where the data leave a direction of the parameters open, the weakest of anchors keeps them
    # from drifting along it.
    held = -terms.units.unit * xi * terms.anchor / terms.units.level
    pull = -jnp.diag(terms.anchor * terms.units.unit) / terms.units.level
    return _Rows(xi, jnp.concatenate([R[:, 0], held]), jnp.concatenate([R[:, 1:], pull]))


def _begin(terms: _Terms) -> _State:
    q = terms.z0.shape[0]
    xi = jnp.zeros_like(terms.z0)
    rows = _rows(terms, jnp.zeros((q + 1, q + 1), xi.dtype), xi)
    seen = jax.eval_shape(lambda: _linear(xi, rows)[0])
    solver = _solver(terms).init(_linear, xi, rows, _HOW, seen, None, frozenset())
    return _State(xi, solver, jnp.asarray(False), jnp.asarray(False))


def _advance(terms: _Terms, state: _State, R: Float[Array, "k k"]) -> _State:
    """One step of optimistix's solver, whose next point is `state.solver.y_eval`."""
    rows, solver = _rows(terms, R, state.solver.y_eval), _solver(terms)
    xi, new, _ = solver.step(_linear, state.xi, rows, _HOW, state.solver, frozenset())
    done, result = solver.terminate(_linear, xi, rows, _HOW, new, frozenset())
    fine = result == optx.RESULTS.successful
    moved = _State(xi, new, done | ~fine, done & fine)
    return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), moved, state)


def _point(terms: _Terms, xi: Array) -> Array:
    return terms.z0 + terms.units.unit * xi


# Compiled apart from the residuals: the same for all problems of as many unknowns and rows.
_one = tuple(jax.jit(f) for f in (_compressed, _begin, _advance, _point))
_many = tuple(jax.jit(jax.vmap(f)) for f in (_compressed, _begin, _advance, _point))


def _descend(
    at: Callable[[Array], tuple[Array, Array]],
    terms: _Terms,
    first: tuple[Array, Array],
    count: np.ndarray | int,
    max_steps: int,
    how: tuple[Any, ...],
) -> Optimum:
    """Step until arrived, from residuals and Jacobian at the start; `at` gives them elsewhere.

    The residuals are evaluated by the one program that evaluates them for everything else: it
    takes longer to compile than to run.
    """
    compressed, begin, advance, point = how
    state, (r, J) = begin(terms), first
    for k in range(max_steps):
        state = advance(terms, state, compressed(terms, r, J))
        if k + 1 == max_steps or bool(np.all(state.done)):
            break
        r, J = at(point(terms, state.solver.y_eval))
    return _optimum(terms.units.level, state, point(terms, state.xi), count)


class _Loop(NamedTuple):
    """A run that evaluates its residuals itself."""

    k: Array
    units: _Scaling
    state: _State
    last: ResidualAndJacobian
    """of the last point that was tried"""


class _End(NamedTuple):
    """Where such a run ended."""

    z: Float[Array, " q"]
    level: Float[Array, ""]
    state: _State
    last: ResidualAndJacobian


@eqx.filter_jit
def _at_once(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"], max_steps: Any
) -> _End:
    """`_descend` from one start as one program; with one step it evaluates z0 and nothing else."""

    def more(now: _Loop) -> Array:
        return (now.k < max_steps) & ~now.state.done

    def step(now: _Loop) -> _Loop:
        point = _point(_terms(layout, z0, now.units), now.state.solver.y_eval)
        e = differentiate(layout, data, noise, point)
        units = jax.tree.map(
            lambda new, old: jnp.where(now.k == 0, new, old), _scaling(e.r, e.J), now.units
        )
        terms = _terms(layout, z0, units)
        state = _advance(terms, now.state, _compressed(terms, e.r, e.J))
        return _Loop(now.k + 1, units, state, e)

    # The first point is z0: until its Jacobian is known, a unit of zero goes nowhere.
    units = _Scaling(jnp.zeros_like(z0), jnp.ones((), z0.dtype))
    shapes = jax.eval_shape(lambda: differentiate(layout, data, noise, z0))
    last = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
    begin = _Loop(jnp.asarray(0), units, _begin(_terms(layout, z0, units)), last)
    end = jax.lax.while_loop(more, step, begin)
    terms = _terms(layout, z0, end.units)
    return _End(_point(terms, end.state.xi), end.units.level, end.state, end.last)


def slopes(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> ResidualAndJacobian:
    """`differentiate` by the program that the optimiser compiles as well."""
    if layout.estimator.one_program(layout):
        return _at_once(layout, data, noise, z, np.asarray(1)).last
    return differentiate(layout, data, noise, z)


def _optimum(level: Array, state: _State, z: Array, count: np.ndarray | int) -> Optimum:
    rows = state.solver.f_info.residual
    cost = jnp.sum(jnp.square(rows), axis=-1) * level**2
    cost = cost / jnp.asarray(count, cost.dtype)
    fine = jnp.isfinite(cost) & jnp.all(jnp.isfinite(z), axis=-1)
    return Optimum(z, cost, state.solver.num_steps, state.fine & fine)


def optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    max_steps: int = 200,
    *,
    held: np.ndarray | None = None,
) -> Optimum:
    """The least-squares optimum from z0; unknowns that are `held` (q,) stay there."""
    count = measured_count(data)
    if layout.estimator.one_program(layout) and held is None:
        end = _at_once(layout, data, noise, z0, np.asarray(max_steps))
        return _optimum(end.level, end.state, end.z, count)

    def at(z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    first = at(z0)
    r0, J0 = first
    if held is not None:
        # A column of zeros has no unit, and what has none stays.
        J0 = jnp.where(held[None, :], jnp.zeros_like(J0), J0)
    terms = _terms(layout, z0, _scaling(r0, J0))
    return _descend(at, terms, first, count, max_steps, _one)


@eqx.filter_jit
def _slopes(layout: Layout, data: Data, noise: Noise, z: Float[Array, "b q"]) -> Any:
    def one(data: Data, z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    return jax.vmap(one)(data, z)


def optimise_many(
    reached: Solution,
    data: Callable[[Any], Data],
    starts: Float[Array, "k q"],
    each: Any,
    *,
    hold: int | None = None,
    max_steps: int = 60,
    batch: int = 8,
) -> Optimum:
    """Optima (k, ...) for many starts or records near an optimum, `batch` at a time by vmap.

    `data` makes the numbers of one run out of its slice of `each`; the unknown at `hold` stays at
    its start.
    """
    layout, noise = reached.layout, reached.noise
    first = slopes(layout, reached.data, noise, reached.z)
    units = _scaling(first.r, first.J)
    if hold is not None:
        units = units._replace(unit=units.unit.at[hold].set(0.0))
    k, batch = starts.shape[0], min(batch, starts.shape[0])
    found = []
    for i in range(0, k, batch):
        # The last ones again where the batch is not full.
        chosen = np.minimum(np.arange(i, i + batch), k - 1)
        z0 = starts[chosen]
        numbers = jax.vmap(data)(jax.tree.map(lambda v, chosen=chosen: v[chosen], each))
        terms = jax.vmap(lambda z: _terms(layout, z, units))(z0)

        def at(z: Array, numbers: Data = numbers) -> tuple[Array, Array]:
            return _slopes(layout, numbers, noise, z)

        count = measured_count(numbers) // batch
        ends = _descend(at, terms, at(z0), count, max_steps, _many)
        found.append(jax.tree.map(lambda v, n=min(batch, k - i): np.asarray(v)[:n], ends))
    return jax.tree.map(lambda *v: np.concatenate(v), *found)


def _terms(layout: Layout, z0: Array, units: _Scaling) -> _Terms:
    at = np.arange(layout.size)
    anchor = np.where(at < len(layout.free), 1.0 / _ANCHOR, 0.0)
    # The unknowns whose steps say whether the optimiser has arrived.
    watched = (at < len(layout.of_interest)) | (at >= layout.first_nuisance)
    ties = jnp.asarray(anchor, z0.dtype)
    # A gain is tied as well: with the effectiveness free it runs along a curved valley without end.
    linear = np.array([how == "linear" for how in layout.kinds] + [True] * len(layout.gains))
    if linear.any():
        linear = np.concatenate([linear, np.zeros(layout.size - linear.size, bool)])
        usable = units.unit > 0
        norms = _COLUMN * units.level / jnp.where(usable, units.unit, 1.0)
        ties = jnp.where(linear, jnp.where(usable, norms / _LINEAR_ANCHOR, 0.0), ties)
    return _Terms(z0, units, ties, jnp.asarray(watched))
