"""Levenberg-Marquardt by optimistix on the one residual, from one start or many."""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import stages
from heli_jax.identification.estimation.optimiser_step import (
    SINGLE,
    Compiled,
    Constants,
    Nearing,
    Scaling,
    State,
    advance,
    awakened,
    begin,
    compressed,
    constants_of,
    nothing_trusted,
    point,
    scaling,
    trusted_columns,
)
from heli_jax.identification.estimation.residual import ResidualAndJacobian, differentiate
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.unknowns.layout import Data, Layout, Noise
from heli_jax.numerics.jitted import jitted


class Optimum(NamedTuple):
    """Where one run of the optimiser ended."""

    z: Float[Array, " q"]
    cost: Float[Array, ""]
    """sum of squares of all rows, priors included, over the number of measured numbers"""
    # Numbers, or by run (k,) where there were several; from the device or not.
    steps: Array | np.ndarray
    converged: Array | np.ndarray
    """the optimiser's own word, and everything finite"""
    moved: Array | np.ndarray = np.asarray(np.inf)
    """squared distance from the start in joint standard deviations; inf where it was not asked"""


_SHOWN = 0.3
"""s between two words of how far a run is: what that costs is then a few thousandths of it"""


def descend(
    evaluate: Callable[[Array], tuple[Array, Array]],
    constants: Constants,
    first: tuple[Array, Array],
    count: np.ndarray | int,
    max_steps: int,
    compiled: Compiled,
) -> "_Run":
    """Step until arrived, from `first`, residuals and Jacobian at the start.

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


class _Run(NamedTuple):
    """A run that ended, or several side by side."""

    optimum: Optimum
    unit: Array
    """of the unknowns, 0 for one that stayed put"""
    r: Array
    """the residuals at the last point that was tried"""
    J: Array


class _Standing(NamedTuple):
    """How far a run is that evaluates its residuals itself; what it goes on from."""

    k: Array
    """steps done; of none the rest means nothing"""
    scaling: Scaling
    state: State


class _Loop(NamedTuple):
    """Such a run while it goes on."""

    standing: _Standing
    last: ResidualAndJacobian
    """of the last point that was tried"""


class _End(NamedTuple):
    """Where it ended, or was interrupted."""

    z: Float[Array, " q"]
    standing: _Standing
    last: ResidualAndJacobian


@jitted
def _optimise_in_one_program(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    begun: _Standing,
    until: np.ndarray,
    trusted: np.ndarray,
) -> _End:
    """`descend` from one start as one program, up to `until` steps in all; with none it evaluates
    z0 and nothing else."""

    def more(now: _Loop) -> Array:
        return (now.standing.k < jnp.maximum(until, 1)) & ~now.standing.state.done

    def step(now: _Loop) -> _Loop:
        k, units, state = now.standing
        tried = point(constants_of(layout, z0, units), state.solver.y_eval)
        e = differentiate(layout, data, noise, tried)
        units = jax.tree.map(
            lambda new, old: jnp.where(k == 0, new, old), scaling(e.r, e.J, trusted), units
        )

        def advanced() -> State:
            constants = constants_of(layout, z0, units)
            return advance(constants, state, compressed(constants, e.r, e.J))

        # Where nobody steps the triangle of J, which takes longer than J, is not needed.
        state = jax.lax.cond(until > 0, advanced, lambda: state)
        return _Loop(_Standing(k + 1, units, state), e)

    end = jax.lax.while_loop(more, step, _before_the_loop(layout, data, noise, z0, begun))
    constants = constants_of(layout, z0, end.standing.scaling)
    return _End(point(constants, end.standing.state.xi), end.standing, end.last)


def _before_the_loop(
    layout: Layout, data: Data, noise: Noise, z0: Array, begun: _Standing
) -> _Loop:
    # The first point is z0: until its Jacobian is known, a unit of zero goes nowhere. Evaluated
    # before the loop it would be compiled twice, the residuals being most of the program.
    units = Scaling(jnp.zeros_like(z0), jnp.ones((), z0.dtype))
    fresh = _Standing(jnp.asarray(0), units, begin(constants_of(layout, z0, units)))
    standing = jax.tree.map(lambda new, old: jnp.where(begun.k == 0, new, old), fresh, begun)
    shapes = jax.eval_shape(lambda: differentiate(layout, data, noise, z0))
    last = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
    return _Loop(standing, last)


@functools.cache
def _not_begun(q: int, dtype: np.dtype) -> _Standing:
    """What a run of q unknowns goes on from before its first step: of the shapes of what it will.

    An argument like any other, so that going on takes the program that began.
    """

    def shapes() -> _Standing:
        zeros = jnp.zeros(q, dtype)
        units, none = Scaling(zeros, jnp.ones((), dtype)), jnp.zeros(q, bool)
        one = jnp.ones((), dtype)
        constants = Constants(zeros, units, zeros, none, zeros, jnp.asarray(True), one, one)
        return _Standing(jnp.asarray(0), units, begin(constants))

    # Of NumPy: nothing is compiled for it.
    return jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), jax.eval_shape(shapes))


def _in_blocks(
    problem: tuple[Layout, Data, Noise],
    z0: Float[Array, " q"],
    max_steps: int,
    trusted: np.ndarray,
    count: np.ndarray | int,
) -> _End:
    """A run by `_optimise_in_one_program`; where somebody looks, interrupted now and then to say
    how far it is.

    The same program with the same numbers goes on, so that the end is the same to the last bit.
    """
    standing, steps = _not_begun(z0.shape[0], z0.dtype), 1
    if not stages.watched():
        return _optimise_in_one_program(*problem, z0, standing, np.asarray(max_steps), trusted)
    done, over = 0, False
    while True:
        began = time.perf_counter()
        until = min(done + steps, max_steps)
        end = _optimise_in_one_program(*problem, z0, standing, np.asarray(until), trusted)
        standing, before = end.standing, done
        done, over = int(standing.k), bool(standing.state.done)
        cost = _optimum(standing.scaling.residual_norm, standing.state, end.z, count).cost
        stages.advance(done - before, f"cost {float(cost):.4g}")
        if over or done >= max_steps:
            return end
        # As many as take that long: the first one may have been compiled, and says nothing.
        spent = time.perf_counter() - began
        steps = max(1, int(_SHOWN * (done - before) / spent))


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
        # An array and not a number, which would be compiled in: without steps the program of a
        # whole run would then be another.
        begun, none = _not_begun(z.shape[0], z.dtype), nothing_trusted(layout)
        return _optimise_in_one_program(layout, data, noise, z, begun, np.asarray(0), none).last
    return differentiate(layout, data, noise, z)


@jax.jit
def _optimum(residual_norm: Array, state: State, z: Array, count: np.ndarray | int) -> Optimum:
    rows = state.solver.f_info.residual
    cost = (jnp.sum(jnp.square(rows), axis=-1) - state.ahead) * residual_norm**2
    cost = cost / jnp.asarray(count, cost.dtype)
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
    nearing: Nearing | None = None,
    known: tuple[Array, Array] | None = None,
) -> Optimum:
    """The least-squares optimum from z0.

    Args:
        layout: what stands where in z.
        data: the numbers of the problem.
        noise: of the measurements, by which the rows are divided.
        z0: where to begin.
        max_steps: after which it is given up.
        held: (q,) whether an unknown stays at its start; none unless given.
        nearing: how to end where another search follows; as near as it gets unless given.
        known: residuals and Jacobian at z0, where they are at hand.
    """
    free = np.ones(layout.size, bool) if held is None else ~held

    def evaluate(z: Array) -> tuple[Array, Array]:
        e = (differentiate if held is not None else residual_and_jacobian)(layout, data, noise, z)
        return e.r, e.J

    at: Any = z0  # of NumPy or JAX, which what is compiled takes alike
    trusted, steps, stayed = nothing_trusted(layout), 0, layout.size + 1
    while True:
        limits = _Limits(max_steps - steps, trusted, held, nearing)
        run = _run(layout, data, noise, at, limits, known)
        known = None
        steps, at = steps + int(run.optimum.steps), run.optimum.z
        stay = (np.asarray(run.unit) == 0) & free
        # Each further run has to move an unknown more, so that there are few of them.
        if not (0 < stay.sum() < stayed and steps < max_steps and bool(run.optimum.converged)):
            break
        # An unknown without effect at the start may have one here, such as the time constant
        # behind a gain that began at zero; the units of a run are those of its start.
        stayed = int(stay.sum())
        trusted = trusted | trusted_columns(layout, evaluate, at, run.r, run.J)
        if not (awakened(np.asarray(run.unit), np.asarray(run.J), trusted) & free).any():
            break
    optimum = run.optimum._replace(steps=np.asarray(steps))
    if nearing is None:
        return optimum
    way = np.asarray(at) - np.asarray(z0)
    return optimum._replace(moved=np.sum((np.asarray(run.J) @ way) ** 2))


class _Limits(NamedTuple):
    """Of one run."""

    steps: int
    """that are left"""
    trusted: np.ndarray
    """(q,) the unknowns that may move however small their column is"""
    held: np.ndarray | None
    """(q,) those that stay"""
    nearing: Nearing | None


def _run(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    limits: _Limits,
    known: tuple[Array, Array] | None = None,
) -> _Run:
    """One run, in the units of its start.

    Args:
        layout: what stands where in z.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where to begin.
        limits: how far it may go.
        known: residuals and Jacobian at z0, where they are at hand.
    """
    (max_steps, trusted, held, nearing), count = (
        limits,
        measured_count(data) * np.asarray(noise.part_used),
    )
    if layout.estimator.one_program(layout) and held is None:
        end = _in_blocks((layout, data, noise), z0, max_steps, trusted, count)
        _, units, state = end.standing
        optimum = _optimum(units.residual_norm, state, end.z, count)
        return _Run(optimum, units.unit, end.last.r, end.last.J)

    def evaluate(z: Array) -> tuple[Array, Array]:
        e = differentiate(layout, data, noise, z)
        return e.r, e.J

    first = known or evaluate(z0)
    r0, J0 = first
    if held is not None:
        # A column of zeros has no unit, and what has none stays.
        J0 = jnp.where(held[None, :], jnp.zeros_like(J0), J0)
    constants = constants_of(layout, z0, scaling(r0, J0, trusted))
    if nearing is not None:
        unchecked, damping = (np.asarray(v, z0.dtype) for v in nearing)
        constants = constants._replace(unchecked=unchecked, damping=damping)
    if held is not None:
        # Initial states alone, from far off: steps that are shortened end in the next valley (a
        # pendulum near the top of its swing).
        constants = constants._replace(with_radius=jnp.asarray(False))
    return descend(evaluate, constants, first, count, max_steps, SINGLE)
