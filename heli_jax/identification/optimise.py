"""Levenberg-Marquardt by optimistix on the one residual, from one start or many."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from heli_jax.identification.layout import Data, Layout, Noise, Reached
from heli_jax.identification.residual import evaluate


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


def _scaling(r0: Float[Array, " n"], J0: Float[Array, "n q"]) -> _Scaling:
    """Columns of equal norm and a cost of order one; an unknown without effect stays put."""
    norms = jnp.linalg.norm(J0, axis=0)
    norms = jnp.where(jnp.isfinite(norms), norms, 0.0)
    usable = norms > 1e-12 * jnp.max(norms)
    level = jnp.maximum(jnp.linalg.norm(r0), 1e-300)
    return _Scaling(jnp.where(usable, _COLUMN * level / jnp.where(usable, norms, 1.0), 0.0), level)


def optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    max_steps: int = 200,
) -> Optimum:
    """The least-squares optimum from z0; compiled once per layout and shapes."""
    first = evaluate(layout, data, noise, z0)
    return _optimise(layout, data, noise, z0, _scaling(first.r, first.J), max_steps)


@eqx.filter_jit
def _optimise(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    units: _Scaling,
    max_steps: int,
) -> Optimum:
    # What a step needs of the residuals r and their Jacobian J is in the triangle of the QR
    # decomposition of [r J]: as many rows as unknowns, and one. The optimiser sees these rows; the
    # first is the size of r, the others are zero but for their derivatives.
    # Where the data leave a direction of the parameters open, the weakest of anchors keeps them
    # from drifting along it.
    free = jnp.arange(layout.size) < len(layout.free)
    anchor = jnp.where(free, 1.0 / _ANCHOR, 0.0).astype(z0.dtype)

    def reached(xi: Array) -> Array:
        return z0 + units.unit * xi

    def triangle(xi: Array) -> tuple[Array, Array]:
        e = evaluate(layout, data, noise, reached(xi))
        columns = jnp.concatenate([e.r[:, None], e.J * units.unit[None, :]], axis=1) / units.level
        R = jnp.linalg.qr(columns, mode="r")
        R = R * jnp.where(R[0, 0] < 0, -1.0, 1.0).astype(R.dtype)
        held = (z0 - reached(xi)) * anchor, -jnp.diag(anchor * units.unit)
        return (
            jnp.concatenate([R[:, 0], held[0] / units.level]),
            jnp.concatenate([R[:, 1:], held[1] / units.level]),
        )

    @jax.custom_jvp
    def rows(xi: Array) -> Array:
        return triangle(xi)[0]

    @rows.defjvp
    def rows_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        r, J = triangle(primals[0])
        return r, J @ tangents[0]

    def fn(xi: Array, _: Any) -> Array:
        return rows(xi)

    solution = optx.least_squares(
        fn,
        # A step below a thousandth of a standard deviation is the last: what it leaves is far less,
        # and smaller gains drown in the rounding of the sum of squares.
        # A disturbance that is hardly there may wander on where it changes nothing else.
        _LevenbergMarquardt(1e-9, 1e-3 / (_COLUMN * units.level), _watched(layout)),
        jnp.zeros_like(z0),
        max_steps=max_steps,
        throw=False,
        options={"jac": "fwd"},
    )
    z = reached(solution.value)
    seen = [jnp.isfinite(y) for flight in data.flights for y in flight.outputs.values()]
    count = jnp.sum(jnp.concatenate(seen)).astype(z.dtype)
    cost = 2.0 * solution.state.f_info.as_min() * units.level**2 / count
    fine = jnp.isfinite(cost) & jnp.all(jnp.isfinite(z))
    converged = (solution.result == optx.RESULTS.successful) & fine
    return Optimum(z, cost, solution.stats["num_steps"], converged)


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
    first = evaluate(reached.layout, reached.data, reached.noise, reached.z)
    units = _scaling(first.r, first.J)
    if hold is not None:
        units = units._replace(unit=units.unit.at[hold].set(0.0))
    layout, noise = reached.layout, reached.noise

    @eqx.filter_jit
    def run(starts: Array, each: Any, noise: Noise, units: _Scaling) -> Optimum:
        def one(pair: tuple[Array, Any]) -> Optimum:
            return _optimise(layout, data(pair[1]), noise, pair[0], units, max_steps)

        return jax.lax.map(one, (starts, each), batch_size=min(batch, starts.shape[0]))

    return jax.device_get(run(starts, each, noise, units))


def _watched(layout: Layout) -> Array:
    """The unknowns whose steps say whether the optimiser has arrived."""
    at = jnp.arange(layout.size)
    return (at < len(layout.named)) | (at >= layout.weak)


def residuals_count(data: Data) -> int:
    """How many measured numbers there are."""
    return sum(
        int(np.isfinite(np.asarray(y)).sum())
        for flight in data.flights
        for y in flight.outputs.values()
    )
