"""Kalman filters: what each measurement says beyond the ones before it.

Linear models get the exact discrete filter. Others get the extended one: the model is linearised
anew in every step and the linearised one is followed exactly (Ozaki's local linearisation), so
that on a linear model both are the same. The process noise is the exact discrete one, the
measurement noise white and independent between outputs; outputs of one sample are taken one after
another, so nothing is inverted. A measurement that is NaN is skipped.
"""

import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model, correlation_of, initial_sd_of
from heli_jax.numerics.matrix_exponential import product, van_loan
from heli_jax.simulation.discretize import process_noise
from heli_jax.simulation.hold import Hold, linear_inputs, segments
from heli_jax.simulation.solvers import at
from heli_jax.simulation.stepping import acting_inputs, held_columns, split_delay

_SMALL = 8
"""States up to which the filter of a linear model is written out in rows"""


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
    hold: Hold = None,
) -> Innovations:
    """Run the (extended) Kalman filter of a model over one record.

    Args:
        inputs: the model's Inputs, arrays (N,).
        measured: outputs (N,); NaN where there is none.
        sd: standard deviation of the white measurement noise, by output, SI.
        initial_state: the model's State at the first sample; the states that `model.initial_sd`
            names are uncertain about it by that standard deviation (and `model.correlation`), the
            others not at all.
        delay: as in `simulate`.
        substeps: linearisations a sample, for models that are not linear.
        hold: as in `simulate`.

    Source: Kalman (1960); the covariance's integral in Van Loan (1978); local linearisation by
    Ozaki (1985).
    """
    linear = linear_inputs(model, inputs, hold)
    x0 = model.initial_state(params) if initial_state is None else initial_state
    dtype = jax.tree.leaves(inputs)[0].dtype
    x = naming.ravel(x0, dtype)
    sds = initial_sd_of(model, params, dtype)
    P = correlation_of(model, params, dtype) * sds[:, None] * sds[None, :]
    names = list(measured)
    rows = jnp.asarray([naming.names(model.Outputs).index(n) for n in names])
    y = jnp.stack(list(measured.values()), axis=1)
    R = jnp.stack([jnp.asarray(sd[n], dtype) ** 2 for n in names])
    if model.linear:
        system = _linear(model, params, inputs, rows, dt, delay, linear)
        e, s = (_by_rows if x.shape[0] <= _SMALL else _by_arrays)(system, x, P, y, R)
    else:
        filter_ = _local(model, params, inputs, rows, dt, delay, substeps, linear)
        e, s = _run(filter_, x, P, y, R)
    return Innovations(dict(zip(names, e.T, strict=True)), dict(zip(names, s.T, strict=True)))


class _Linear(NamedTuple):
    """x[k+1] = Ad x[k] + drive[k] + noise, y[k] = C x[k] + feed[k] + noise."""

    Ad: Float[Array, "n n"]
    Q: Float[Array, "n n"]
    C: Float[Array, "p n"]
    drive: Float[Array, "N n"]
    feed: Float[Array, "N p"]


def _linear(
    model: Model,
    params: Any,
    inputs: Any,
    rows: Array,
    dt: Any,
    delay: Any,
    linear: tuple[bool, ...],
) -> _Linear:
    _, _, C, D = jacobians(model, params)
    Ad, drive, acting = held_columns(model, params, inputs, dt, delay, linear)
    return _Linear(Ad, process_noise(model, params, dt), C[rows], drive, acting @ D[rows].T)


def _by_rows(system: _Linear, x0: Array, P0: Array, y: Array, R: Array) -> tuple[Array, Array]:
    """The filter on rows and scalars: two to three times as fast as on small matrices.

    Written out in scalars alone it is faster once more, and takes twice as long to compile.
    """
    n, p = x0.shape[0], y.shape[1]
    # Behind barriers every number is computed once: XLA would compute each for every use.
    once = jax.lax.optimization_barrier
    Ad, Q, C, R = once((system.Ad, system.Q, system.C, R))

    def step(carry: tuple[Array, Any], sample: tuple[Any, Array]) -> tuple[Any, Any]:
        x, P = carry
        y, w = sample
        a = [[Ad[i, j] for j in range(n)] for i in range(n)]
        c = [[C[k, j] for j in range(n)] for k in range(p)]
        errors, variances = [], []
        for k in range(p):
            h = _sum(P[i] * c[k][i] for i in range(n))
            s = _sum(h[i] * c[k][i] for i in range(n)) + R[k]
            seen = jnp.isfinite(y[k])
            e = jnp.where(seen, y[k], 0.0) - _sum(x[i] * c[k][i] for i in range(n))
            g = jnp.where(seen, 1.0 / s, 0.0)
            h, s, e, g = once((h, s, e, g))
            x, scaled = x + h * (g * e), g * h
            P = [P[i] - h[i] * scaled for i in range(n)]
            x, P = once((x, P))
            errors.append(jnp.where(seen, e, jnp.nan))
            variances.append(jnp.where(seen, s, jnp.nan))
        x = _sum(Ad[:, i] * x[i] for i in range(n)) + w
        M = once([_sum(P[k] * a[i][k] for k in range(n)) for i in range(n)])
        P = [_sum(Ad[:, k] * M[i][k] for k in range(n)) + Q[i] for i in range(n)]
        return (x, P), (errors, variances)

    samples = (list((y - system.feed).T), system.drive)
    _, (e, s) = jax.lax.scan(step, (x0, list(P0)), samples)
    return jnp.stack(e, axis=1), jnp.stack(s, axis=1)


def _sum(terms: Iterable[Any]) -> Any:
    return functools.reduce(operator.add, terms)


def _by_arrays(system: _Linear, x0: Array, P0: Array, y: Array, R: Array) -> tuple[Array, Array]:
    def move(x: Array, P: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        x = jnp.sum(system.Ad * x[None, :], axis=1) + now[0]
        return x, product(product(system.Ad, P), system.Ad.T) + system.Q

    samples = (system.drive, system.feed)
    return _run(_Filter(samples, lambda x, now: (system.C, now[1]), move), x0, P0, y, R)


class _Filter(NamedTuple):
    """What a step of the filter needs of a model; `samples` is a pytree of arrays (N, ...)."""

    samples: Any
    measure: Callable[[Array, Any], tuple[Array, Array]]
    """(state, sample) -> C (p, n) and what C x leaves of the predicted outputs (p,)"""
    move: Callable[[Array, Array, Any], tuple[Array, Array]]
    """(state, its covariance, sample) -> both at the next sample"""


def _run(filter_: _Filter, x: Array, P: Array, y: Array, R: Array) -> tuple[Array, Array]:
    """Errors and variances (N, p)."""

    def correct(carry: tuple[Array, Array], measured: tuple[Array, ...]) -> tuple[Any, Any]:
        """The state and its covariance after one output."""
        (x, P), (c, rest, r, y) = carry, measured
        p = jnp.sum(P * c[None, :], axis=1)
        s = jnp.sum(c * p) + r
        seen = jnp.isfinite(y)
        e = jnp.where(seen, y, 0.0) - rest - jnp.sum(c * x)
        gain = jnp.where(seen, 1.0 / s, 0.0)
        x, P = x + p * (gain * e), P - p[:, None] * (gain * p)[None, :]
        return (x, P), (jnp.where(seen, e, jnp.nan), jnp.where(seen, s, jnp.nan))

    def step(carry: tuple[Array, Array], sample: tuple[Array, Any]) -> tuple[Any, Any]:
        x, P = carry
        y, now = sample
        C, rest = filter_.measure(x, now)
        (x, P), found = jax.lax.scan(correct, (x, P), (C, rest, R, y))
        x, P = filter_.move(x, P, now)
        return (x, 0.5 * (P + P.T)), found

    _, (e, s) = jax.lax.scan(step, (x, P), (y, filter_.samples))
    return e, s


def _local(
    model: Model,
    params: Any,
    inputs: Any,
    rows: Array,
    dt: Any,
    delay: Any,
    substeps: int,
    linear: tuple[bool, ...],
) -> _Filter:
    names = naming.names(model.State)
    dtype = jax.tree.leaves(inputs)[0].dtype
    dt = jnp.asarray(dt, dtype)

    g = (
        jnp.zeros(len(names), dtype)
        if model.noise_intensity is None
        else naming.ravel(model.noise_intensity(params), dtype)
    )

    def rates(x: Array, u: Any) -> Array:
        return naming.ravel(model.vector_field(params, naming.unravel(model.State, x), u), dtype)

    def outputs(x: Array, u: Any) -> Array:
        return naming.ravel(model.output(params, naming.unravel(model.State, x), u), dtype)[rows]

    n = jax.tree.leaves(inputs)[0].shape[0]
    parts, held, acting, slopes = (dt,), (inputs,), inputs, None
    if delay is not None:
        acting = acting_inputs(inputs, dt, delay, n, linear)
    if linear:
        late = None if delay is None else split_delay(delay, dt)
        parts, held, slopes = zip(*segments(inputs, dt, late, jnp.arange(n), linear), strict=True)
    elif delay is not None:
        whole, late = split_delay(delay, dt)
        k = jnp.arange(n) - whole
        parts, held = (late * dt, (1.0 - late) * dt), (at(inputs, k - 1), at(inputs, k))

    def measure(x: Array, sample: Any) -> tuple[Array, Array]:
        u = sample[1]
        C = jax.jacfwd(outputs)(x, u)
        return C, outputs(x, u) - jnp.sum(C * x[None, :], axis=1)

    def along(carry: tuple[Array, Array], h: Array, u: Any) -> tuple[Array, Array]:
        x, P = carry
        step = van_loan(jax.jacfwd(rates)(x, u), rates(x, u), g, h)
        return x + step.shift, product(product(step.Phi, P), step.Phi.T) + step.Q

    def ramped(carry: tuple[Array, Array], h: Array, u: Any, slope: Any) -> tuple[Array, Array]:
        """`along` where the inputs move: time is a state more, so that a linear model's step is
        exact (local linearisation of an equation that depends on time)."""
        x, P = carry
        m = len(names)
        _, b = jax.jvp(lambda u: rates(x, u), (u,), (slope,))
        one, none = jnp.ones(1, dtype), jnp.zeros(1, dtype)
        A = jnp.zeros((m + 1, m + 1), dtype).at[:m, :m].set(jax.jacfwd(rates)(x, u))
        step = van_loan(
            A.at[:m, m].set(b), jnp.concatenate([rates(x, u), one]), jnp.concatenate([g, none]), h
        )
        Phi = step.Phi[:m, :m]
        return x + step.shift[:m], product(product(Phi, P), Phi.T) + step.Q[:m, :m]

    def follow(carry: tuple[Array, Array], length: Array, u: Any, slope: Any) -> Any:
        h = length / substeps

        def one(carry: tuple[Array, Array], j: Array) -> tuple[Any, None]:
            here = jax.tree.map(lambda u, slope: u + slope * (j * h), u, slope)
            return ramped(carry, h, here, slope), None

        return jax.lax.scan(one, carry, jnp.arange(substeps, dtype=dtype))[0]

    def move(x: Array, P: Array, sample: Any) -> tuple[Array, Array]:
        carry = (x, P)
        if slopes is not None:
            for length, u, slope in zip(parts, sample[0], sample[2], strict=True):
                carry = follow(carry, length, u, slope)
            return carry
        for length, u in zip(parts, sample[0], strict=True):
            carry, _ = jax.lax.scan(
                lambda c, _, h=length / substeps, u=u: (along(c, h, u), None),
                carry,
                None,
                length=substeps,
            )
        return carry

    return _Filter((held, acting, slopes), measure, move)
