"""Kalman filters: what each measurement says beyond the ones before it.

Linear models get the exact discrete filter. Others get the extended one: the model is linearised
anew in every step and the linearised one is followed exactly (Ozaki's local linearisation), so
that on a linear model both are the same. The process noise is the exact discrete one, the
measurement noise white and independent between outputs; outputs of one sample are taken one after
another, so nothing is inverted. A measurement that is NaN is skipped.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model, spread_of
from heli_jax.simulation.discretize import expm, process_noise, product, van_loan
from heli_jax.simulation.simulate import acting_inputs, held_columns, split_delay
from heli_jax.simulation.solvers import at


class Innovations(NamedTuple):
    """One-step predictions against measurements, by output; arrays (N,), NaN where none is."""

    error: dict[str, Any]
    """measured - predicted from all samples before, SI"""
    variance: dict[str, Any]
    """of that error, as the filter has it"""


def innovations(
    model: Model,
    params: Any,
    inputs: Any,
    measured: dict[str, Float[Array, " N"]],
    sd: dict[str, Any],
    *,
    dt: Any,
    initial_state: Any = None,
    delay: Any = None,
    substeps: int = 4,
) -> Innovations:
    """Run the (extended) Kalman filter of a model over one record.

    Args:
        inputs: the model's Inputs, arrays (N,), each sample held until the next.
        measured: outputs (N,); NaN where there is none.
        sd: standard deviation of the white measurement noise, by output, SI.
        initial_state: the model's State at the first sample; the states that `model.spread`
            names are uncertain about it by that standard deviation, the others not at all.
        delay: as in `simulate`.
        substeps: linearisations a sample, for models that are not linear.

    Source: Kalman (1960); the discretisation by Van Loan (1978); local linearisation by
    Ozaki (1985).
    """
    x0 = model.initial_state(params) if initial_state is None else initial_state
    dtype = jax.tree.leaves(inputs)[0].dtype
    x = _vector(x0, dtype)
    P = jnp.diag(spread_of(model, params, dtype) ** 2)
    names = list(measured)
    rows = jnp.asarray([naming.names(model.Outputs).index(n) for n in names])
    y = jnp.stack(list(measured.values()), axis=1)
    R = jnp.stack([jnp.asarray(sd[n], dtype) ** 2 for n in names])
    make = _linear if model.linear else _local
    filter_ = make(model, params, inputs, rows, dt, delay, substeps)

    def step(carry: tuple[Array, Array], sample: tuple[Array, Any]) -> tuple[Any, Any]:
        x, P = carry
        y, now = sample
        C, rest = filter_.measure(x, now)
        errors, variances = [], []
        for j in range(len(names)):
            c = C[j]
            p = jnp.sum(P * c[None, :], axis=1)
            s = jnp.sum(c * p) + R[j]
            seen = jnp.isfinite(y[j])
            e = jnp.where(seen, y[j], 0.0) - rest[j] - jnp.sum(c * x)
            gain = jnp.where(seen, 1.0 / s, 0.0)
            x = x + p * (gain * e)
            P = P - p[:, None] * (gain * p)[None, :]
            errors.append(jnp.where(seen, e, jnp.nan))
            variances.append(jnp.where(seen, s, jnp.nan))
        x, P = filter_.move(x, P, now)
        return (x, 0.5 * (P + P.T)), (jnp.stack(errors), jnp.stack(variances))

    _, (e, s) = jax.lax.scan(step, (x, P), (y, filter_.samples))
    return Innovations(dict(zip(names, e.T, strict=True)), dict(zip(names, s.T, strict=True)))


class _Filter(NamedTuple):
    """What a step of the filter needs of a model; `samples` is a pytree of arrays (N, ...)."""

    samples: Any
    measure: Callable[[Array, Any], tuple[Array, Array]]
    """(state, sample) -> C (p, n) and what C x leaves of the predicted outputs (p,)"""
    move: Callable[[Array, Array, Any], tuple[Array, Array]]
    """(state, its covariance, sample) -> both at the next sample"""


def _linear(
    model: Model, params: Any, inputs: Any, rows: Array, dt: Any, delay: Any, substeps: int
) -> _Filter:
    _, _, C, D = jacobians(model, params)
    C, D = C[rows], D[rows]
    Ad, drive, acting = held_columns(model, params, inputs, dt, delay)
    Q = process_noise(model, params, dt)

    def move(x: Array, P: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        x = jnp.sum(Ad * x[None, :], axis=1) + now[0]
        return x, product(product(Ad, P), Ad.T) + Q

    return _Filter((drive, acting @ D.T), lambda x, now: (C, now[1]), move)


def _local(
    model: Model, params: Any, inputs: Any, rows: Array, dt: Any, delay: Any, substeps: int
) -> _Filter:
    names = naming.names(model.State)
    dtype = jax.tree.leaves(inputs)[0].dtype
    dt = jnp.asarray(dt, dtype)

    g = jnp.zeros(len(names), dtype) if model.noise is None else _vector(model.noise(params), dtype)

    def state(x: Array) -> Any:
        return model.State(**{n: x[i] for i, n in enumerate(names)})

    def rates(x: Array, u: Any) -> Array:
        return _vector(model.vector_field(params, state(x), u), dtype)

    def outputs(x: Array, u: Any) -> Array:
        return _vector(model.output(params, state(x), u), dtype)[rows]

    parts, held, acting = (dt,), (inputs,), inputs
    if delay is not None:
        n = jax.tree.leaves(inputs)[0].shape[0]
        whole, late = split_delay(delay, dt)
        k = jnp.arange(n) - whole
        parts, held = (late * dt, (1.0 - late) * dt), (at(inputs, k - 1), at(inputs, k))
        acting = acting_inputs(inputs, dt, delay, n)

    def measure(x: Array, sample: Any) -> tuple[Array, Array]:
        u = sample[1]
        C = jax.jacfwd(outputs)(x, u)
        return C, outputs(x, u) - jnp.sum(C * x[None, :], axis=1)

    def along(carry: tuple[Array, Array], h: Array, u: Any) -> tuple[Array, Array]:
        x, P = carry
        A = jax.jacfwd(rates)(x, u)
        n = A.shape[0]
        M = jnp.zeros((n + 1, n + 1), dtype).at[:n, :n].set(A).at[:n, n].set(rates(x, u))
        E = expm(M * h)
        Phi = E[:n, :n]
        return x + E[:n, n], product(product(Phi, P), Phi.T) + van_loan(A, g, h)

    def move(x: Array, P: Array, sample: Any) -> tuple[Array, Array]:
        carry = (x, P)
        for length, u in zip(parts, sample[0], strict=True):
            carry, _ = jax.lax.scan(
                lambda c, _, h=length / substeps, u=u: (along(c, h, u), None),
                carry,
                None,
                length=substeps,
            )
        return carry

    return _Filter((held, acting), measure, move)


def _vector(record: Any, dtype: Any) -> Array:
    return jnp.stack([jnp.asarray(v, dtype) for v in naming.asdict(record).values()])
