"""Runs that are reduced to a value while they go on, and never kept: for large batches."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from heli_jax import naming
from heli_jax.dynamics.check_model import explained
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.simulation.blocks import without_next
from heli_jax.simulation.discretize import product, scalars
from heli_jax.simulation.hoist import hoisted
from heli_jax.simulation.hold import Hold, linear_inputs
from heli_jax.simulation.simulate import field_term, held_inputs, per_sample, start_state
from heli_jax.simulation.solvers import Accumulating, Held, advance, at, dot


class Accumulated(NamedTuple):
    """What is left of a run."""

    value: Any
    state: Any
    """the model's State at the last sample"""
    outside: dict[str, Bool[Array, ""]]
    """by name of a limit of the model, whether it was left; empty for a model without limits"""
    result: dfx.RESULTS


@explained
def accumulate(
    model: Model,
    params: Any,
    flight: Any,
    update: Callable[[Any, Any, Any], Any],
    start: Any,
    **options: Any,
) -> tuple[Any, dfx.RESULTS]:
    """Reduce a run to a value without keeping it: for large batches.

    At every sample value = update(value, outputs, data at that sample), from `start`. Options as
    `accumulated`.

    Returns:
        The final value and diffrax's result.
    """
    found = accumulated(model, params, flight, update, start, **options)
    return found.value, found.result


def accumulated(
    model: Model,
    params: Any,
    flight: Any,
    update: Callable[[Any, Any, Any], Any],
    start: Any,
    *,
    data: Any = (),
    dt: Any = None,
    initial_state: Any = None,
    solver: str | dfx.AbstractSolver | None = None,
    substeps: int = 4,
    block: int = 1,
    adjoint: dfx.AbstractAdjoint | None = None,
    limits: bool = False,
    hold: Hold = None,
) -> Accumulated:
    """As `accumulate`, with the last state and, if `limits`, whether the model's range was left.

    `data` is a pytree of arrays (N,) such as the measured outputs. `block` is the number of samples
    a step of solver "exact" (4 is fastest in batches of 64 on a CPU). Other arguments as
    `simulate`.

    Raises:
        ValueError: as `simulate`; a block below 1, or above 1 for a solver that is not exact.
    """
    linear = linear_inputs(model, flight, hold)
    inputs, dt = held_inputs(model, flight, dt)
    x0 = start_state(model, params, initial_state, inputs, dt)
    method, held, term = per_sample(model, params, inputs, dt, solver, substeps, None, None, linear)
    if block != 1 and (held.discrete is None or block < 1):
        raise ValueError(f"block is {block}, wanted is 1, or more with solver='exact'")
    n = jax.tree.leaves(inputs)[0].shape[0]
    watched = model.limits if limits else None

    def one(carried: Any, state: Any, inputs_now: Any, data_now: Any) -> Any:
        value, outside = carried
        if watched is not None:
            now = watched(params, state, inputs_now)
            outside = {name: jnp.where(now[name], 1.0, was) for name, was in outside.items()}
        return update(value, model.output(params, state, inputs_now), data_now), outside

    if block > 1 and watched is None:
        value, state = _in_blocks(model, held, block, x0, update, start, data)
        return Accumulated(value, state, {}, dfx.RESULTS.successful)
    held = held.in_scalars()
    if held.discrete is None:
        values, field = hoisted(model.vector_field, params, x0, at(inputs, 0))
        term = field_term(model, field)
        held = held._replace(params=values)
    outside, dtype = {}, jax.tree.leaves(x0)[0].dtype
    if watched is not None:
        # Numbers, since diffrax counts with all that it carries: 1 from where the range is left on.
        outside = dict.fromkeys(watched(params, x0, at(inputs, 0)), jnp.zeros((), dtype))
    sol = dfx.diffeqsolve(
        term,
        Accumulating(method, one),
        t0=jnp.zeros((), dtype),
        t1=jnp.asarray(n - 1, dtype),
        dt0=jnp.ones((), dtype),
        y0=(x0, (start, outside)),
        args=(held, data),
        saveat=dfx.SaveAt(t1=True),
        max_steps=n - 1,
        adjoint=dfx.DirectAdjoint() if adjoint is None else adjoint,
        throw=False,
    )
    state, carried = jax.tree.map(lambda v: v[0], sol.ys)
    value, outside = one(carried, state, at(inputs, n - 1), at(data, n - 1))
    return Accumulated(value, state, {n: v > 0 for n, v in outside.items()}, sol.result)


def _in_blocks(
    model: Model, held: Held, m: int, x0: Any, update: Any, start: Any, data: Any
) -> tuple[Any, Any]:
    """The exact recurrence m samples a step: x[k+m] = A^m x[k] + ..., and each output between
    from x[k] directly, C A^j x[k] + ..., with coefficients of the vehicle's own.

    Nothing depends on the result before it within a step, so XLA makes one loop over the vehicles
    of it; written out sample by sample it would compute every sample from x[k] again.
    """
    assert held.discrete is not None
    A, B, _, Bn = discrete = held.discrete
    space = jacobians(model, held.params)
    C, D = space.C.astype(A.dtype), space.D.astype(A.dtype)
    ahead = None if Bn is None else scalars(Bn)
    if Bn is not None:
        # Inputs that are linear between samples: another state, x - Bn u, has the recurrence of
        # held ones.
        discrete, D = without_next(discrete), D + product(C, Bn)
        x0, B = _plus(x0, ahead, at(held.inputs, 0), -1.0), discrete.Bd
    rows, columns, power = [C], [B], A
    for _ in range(m - 1):
        rows.append(product(rows[-1], A))
        columns.append(product(A, columns[-1]))
        power = product(A, power)
    free = [scalars(row) for row in rows[1:]]
    forced = [scalars(D)] + [scalars(product(C, column)) for column in columns[:-1]]
    onward, driven = scalars(power), [scalars(column) for column in reversed(columns)]
    once = jax.lax.optimization_barrier((free, forced, onward, driven, ahead))
    free, forced, onward, driven, ahead = once

    names = naming.names(model.Outputs)
    structure, inputs = jax.tree.structure(x0), jax.tree.structure(held.inputs)
    U = jax.tree.leaves(held.inputs)
    n = U[0].shape[0]
    steps = (n - 1) // m

    def outputs(x: Any, u: Any, j: int) -> Any:
        """The outputs of the j-th sample of a step that begins at x with the inputs u[0..j]."""
        if j == 0:
            now = jax.tree.unflatten(inputs, u[0])
            state = _plus(jax.tree.unflatten(structure, x), ahead, now)
            return model.output(held.params, state, now)
        found = {}
        for i, name in enumerate(names):
            total = dot(free[j - 1][i], x)
            for back in range(j + 1):
                total = total + dot(forced[back][i], u[j - back])
            found[name] = total
        return model.Outputs(**found)

    def samples(x: Any, value: Any, u: Any, now: Any, count: int) -> Any:
        for j in range(count):
            value = update(value, outputs(x, u, j), jax.tree.map(lambda v, j=j: v[j], now))
        return value

    def step(carried: Any, given: Any) -> tuple[Any, None]:
        x, value = carried
        rows, now = given
        u = [[v[j] for v in rows] for j in range(m)]
        value = samples(x, value, u, now, m)
        new = [dot(row, x) for row in onward]
        for j in range(m):
            new = [v + dot(row, u[j]) for v, row in zip(new, driven[j], strict=True)]
        return (new, value), None

    def cut(v: Array) -> Array:
        return v[: steps * m].reshape(steps, m, *v.shape[1:])

    first = jax.tree.leaves(x0)
    given = jax.tree.map(cut, (U, data))
    (x, value), _ = jax.lax.scan(step, (first, start), given)
    # The samples that are left, at least one, and the state at the last of them.
    rest = n - steps * m
    u = [[v[steps * m + j] for v in U] for j in range(rest)]
    value = samples(x, value, u, jax.tree.map(lambda v: v[steps * m :], data), rest)
    last, discrete = list(x), discrete.in_scalars()
    for j in range(rest - 1):
        last = advance(discrete, last, u[j])
    end = jax.tree.unflatten(structure, last)
    return value, _plus(end, ahead, jax.tree.unflatten(inputs, u[rest - 1]))


def _plus(state: Any, rows: Any, inputs: Any, sign: float = 1.0) -> Any:
    """A State plus (or minus) a matrix, row by row in scalars, times the inputs; None adds none."""
    if rows is None:
        return state
    u = jax.tree.leaves(inputs)
    new = [x + sign * dot(row, u) for x, row in zip(jax.tree.leaves(state), rows, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(state), new)
