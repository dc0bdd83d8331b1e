"""The Kalman filter of a linear model: what each measurement says beyond the ones before it.

The process noise is the exact discrete one, the measurement noise white and independent between
outputs; outputs of one sample are taken one after another, so nothing is inverted. A measurement
that is NaN is skipped.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model, spread_of
from heli_jax.simulation.discretize import process_noise, product
from heli_jax.simulation.simulate import held_columns


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
) -> Innovations:
    """Run the Kalman filter of a linear model over one record.

    Args:
        inputs: the model's Inputs, arrays (N,), each sample held until the next.
        measured: outputs (N,); NaN where there is none.
        sd: standard deviation of the white measurement noise, by output, SI.
        initial_state: the model's State at the first sample; the states that `model.spread`
            names are uncertain about it by that standard deviation, the others not at all.
        delay: as in `simulate`.

    Source: Kalman (1960); the discretisation by Van Loan (1978).
    """
    x0 = model.initial_state(params) if initial_state is None else initial_state
    A, _, C, D = jacobians(model, params)
    discrete, drive, now = held_columns(model, params, inputs, dt, delay)
    Q = process_noise(model, params, dt)
    order = naming.names(model.Outputs)
    rows = [(order.index(n), n) for n in measured]
    y = jnp.stack([measured[n] - now @ D[i] for i, n in rows], axis=1)
    R = jnp.stack([jnp.asarray(sd[n], A.dtype) ** 2 for _, n in rows])
    Cs = jnp.stack([C[i] for i, _ in rows])
    x = jnp.stack([jnp.asarray(v, A.dtype) for v in naming.asdict(x0).values()])
    P = jnp.diag(spread_of(model, params, A.dtype) ** 2)

    def step(carry: tuple[Array, Array], sample: tuple[Array, Array]) -> tuple[Any, Any]:
        x, P = carry
        y, w = sample
        errors, variances = [], []
        for j in range(len(rows)):
            c = Cs[j]
            p = jnp.sum(P * c[None, :], axis=1)
            s = jnp.sum(c * p) + R[j]
            seen = jnp.isfinite(y[j])
            e = jnp.where(seen, y[j], 0.0) - jnp.sum(c * x)
            gain = jnp.where(seen, 1.0 / s, 0.0)
            x = x + p * (gain * e)
            P = P - p[:, None] * (gain * p)[None, :]
            errors.append(jnp.where(seen, e, jnp.nan))
            variances.append(jnp.where(seen, s, jnp.nan))
        x = jnp.sum(discrete * x[None, :], axis=1) + w
        P = product(product(discrete, P), discrete.T) + Q
        return (x, 0.5 * (P + P.T)), (jnp.stack(errors), jnp.stack(variances))

    _, (e, s) = jax.lax.scan(step, (x, P), (y, drive))
    names = [n for _, n in rows]
    return Innovations(dict(zip(names, e.T, strict=True)), dict(zip(names, s.T, strict=True)))
