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

from heli_jax.identification.layout import Data, Layout, Noise, Reached
from heli_jax.identification.residual import differentiate


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
    slopes: Callable[[Array], tuple[Array, Array]],
    terms: _Terms,
    first: tuple[Array, Array],
    count: np.ndarray | int,
    max_steps: int,
    how: tuple[Any, ...],
) -> Optimum:
    """Step until arrived, from residuals and Jacobian at the start; `slopes` gives them elsewhere.

    The residuals are evaluated by the one program that evaluates them for everything else: it
    takes longer to compile than to run.
    """
    compressed, begin, advance, point = how
    state, (r, J) = begin(terms), first
    for k in range(max_steps):
        state = advance(terms, state, compressed(terms, r, J))
        if k + 1 == max_steps or bool(np.all(state.done)):
            break
        r, J = slopes(point(terms, state.solver.y_eval))
    return _optimum(terms, state, point(terms, state.xi), count)


@eqx.filter_jit
def _at_once(
    layout: Layout,
    data: Data,
    noise: Noise,
    terms: _Terms,
    first: tuple[Array, Array],
    max_steps: Array,
) -> tuple[_State, Array]:
    """`_descend` from one start in a program of its own, and the point where it ended."""

    def advanced(state: _State, r: Array, J: Array) -> _State:
        return _advance(terms, state, _compressed(terms, r, J))

    def more(carry: tuple[Array, _State]) -> Array:
        return (carry[0] < max_steps) & ~carry[1].done

    def step(carry: tuple[Array, _State]) -> tuple[Array, _State]:
        k, state = carry
        e = differentiate(layout, data, noise, _point(terms, state.solver.y_eval))
        return k + 1, advanced(state, e.r, e.J)

    state = advanced(_begin(terms), *first)
    _, state = jax.lax.while_loop(more, step, (jnp.ones_like(max_steps), state))
    return state, _point(terms, state.xi)


def _optimum(terms: _Terms, state: _State, z: Array, count: np.ndarray | int) -> Optimum:
    rows = state.solver.f_info.residual
    cost = jnp.sum(jnp.square(rows), axis=-1) * terms.units.level**2
    cost = cost / jnp.asarray(count, cost.dtype)
    fine = jnp.isfinite(cost) & jnp.all(jnp.isfinite(z), axis=-1)
    return Optimum(z, cost, state.solver.num_steps, state.fine & fine)


def optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    max_steps: int = 200,
) -> Optimum:
    """The least-squares optimum from z0."""
    first = differentiate(layout, data, noise, z0)
    terms = _terms(layout, z0, _scaling(first.r, first.J))
    count = residuals_count(data)
    if layout.model.linear and not layout.filtered:
        # Such residuals take no longer to evaluate than a step takes to be called for, and compile
        # in two seconds.
        steps = jnp.asarray(max_steps)
        state, z = _at_once(layout, data, noise, terms, (first.r, first.J), steps)
        return _optimum(terms, state, z, count)

    def slopes(z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    return _descend(slopes, terms, (first.r, first.J), count, max_steps, _one)


@eqx.filter_jit
def _slopes(layout: Layout, data: Data, noise: Noise, z: Float[Array, "b q"]) -> Any:
    def one(data: Data, z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    return jax.vmap(one)(data, z)


def optimise_many(
    reached: Reached,
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
    first = differentiate(layout, reached.data, noise, reached.z)
    units = _scaling(first.r, first.J)
    if hold is not None:
        units = units._replace(unit=units.unit.at[hold].set(0.0))
    k, batch = starts.shape[0], min(batch, starts.shape[0])
    found = []
    for i in range(0, k, batch):
        # The last ones again where the batch is not full.
        at = np.minimum(np.arange(i, i + batch), k - 1)
        z0 = starts[at]
        numbers = jax.vmap(data)(jax.tree.map(lambda v, at=at: v[at], each))
        terms = jax.vmap(lambda z: _terms(layout, z, units))(z0)

        def slopes(z: Array, numbers: Data = numbers) -> tuple[Array, Array]:
            return _slopes(layout, numbers, noise, z)

        count = residuals_count(numbers) // batch
        ends = _descend(slopes, terms, slopes(z0), count, max_steps, _many)
        found.append(jax.tree.map(lambda v, n=min(batch, k - i): np.asarray(v)[:n], ends))
    return jax.tree.map(lambda *v: np.concatenate(v), *found)


def _terms(layout: Layout, z0: Array, units: _Scaling) -> _Terms:
    at = np.arange(layout.size)
    anchor = np.where(at < len(layout.free), 1.0 / _ANCHOR, 0.0)
    # The unknowns whose steps say whether the optimiser has arrived.
    watched = (at < len(layout.named)) | (at >= layout.weak)
    return _Terms(z0, units, jnp.asarray(anchor, z0.dtype), jnp.asarray(watched))


def residuals_count(data: Data) -> int:
    """How many measured numbers there are."""
    return sum(
        int(np.isfinite(np.asarray(y)).sum())
        for flight in data.flights
        for y in flight.outputs.values()
    )
