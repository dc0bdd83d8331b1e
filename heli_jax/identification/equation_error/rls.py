"""Recursive least squares, eqs 25-33, in Potter's square-root form.

P = S S^T is kept as its factor S, so it stays symmetric and positive whatever the rounding; the
covariance form of the textbooks drifts away within thousands of samples when old data are
forgotten. Functions follow the shape init, step -> (state, info).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class RLSState(NamedTuple):
    """What the next step needs."""

    theta: Float[Array, " q"]
    S: Float[Array, "q q"]
    """square root of the covariance matrix: P = S S^T"""


class RLSInfo(NamedTuple):
    """What a step tells."""

    theta: Float[Array, " q"]
    error: Float[Array, ""]
    """y(k) - Phi(k)^T Theta(k-1), eq. 29"""
    largest: Float[Array, ""]
    """largest variance on the diagonal of P"""


class RLSResult(NamedTuple):
    """A whole run."""

    theta: Float[Array, " q"]
    """final estimate"""
    history: Float[Array, "N q"]
    error: Float[Array, " N"]
    largest: Float[Array, " N"]


def rls_init(size: int, p0: float | Float[Array, ""] = 1e6) -> RLSState:
    """Theta(0) = 0 and P(0) = p0 I: a large p0 lets the first samples decide alone."""
    scale = jnp.sqrt(jnp.asarray(p0, jnp.result_type(float)))
    return RLSState(jnp.zeros(size, scale.dtype), scale * jnp.eye(size, dtype=scale.dtype))


def rls_step(
    state: RLSState,
    phi: Float[Array, " q"],
    y: Float[Array, ""],
    forgetting: Float[Array, ""],
    bound: Float[Array, ""],
) -> tuple[RLSState, RLSInfo]:
    """One sample, eqs 29-33 with the gain of eq. 33 (which eq. 31 equals with the new P).

    Args:
        state: Theta (q,) and the square root of P (q, q).
        phi: regressor (q,).
        y: what it should give.
        forgetting: in (0, 1]; a sample j steps ago weighs forgetting^j.
        bound: largest variance that a parameter may have.
    """
    theta, S = state
    f = jnp.sum(S * phi[:, None], axis=0)
    power = jnp.sum(f * f)
    alpha = forgetting + power
    gain = jnp.sum(S * f[None, :], axis=1) / alpha
    error = y - jnp.sum(phi * theta)
    theta = theta + gain * error
    # Potter's update of the factor: this part of the gain takes S S^T to (1 - gain phi^T) P.
    shrink = 1.0 / (1.0 + jnp.sqrt(forgetting / alpha))
    S = (S - shrink * gain[:, None] * f[None, :]) / jnp.sqrt(forgetting)
    variances = jnp.sum(S * S, axis=1)
    largest = jnp.max(variances)
    # Directions that the regressor does not excite are forgotten without being learnt again, so P
    # grows there without end (wind-up): a variance beyond the bound is taken back to it, as a
    # measurement without news would, which leaves Theta and the excited directions alone.
    S = jax.lax.cond(largest > bound, _bounded, lambda S, *_: S, S, variances, bound)
    return RLSState(theta, S), RLSInfo(theta, error, largest)


def _bounded(
    S: Float[Array, "q q"], variances: Float[Array, " q"], bound: Float[Array, ""]
) -> Float[Array, "q q"]:
    """The largest variance brought down to the bound by a pseudo-measurement of that parameter."""
    i = jnp.argmax(variances)
    f, p = S[i], variances[i]
    # A measurement of variance r leaves p r / (p + r), which is the bound for this r. Both branches
    # of a batched cond are computed: below the bound the divisor must not vanish.
    r = p * bound / jnp.maximum(p - bound, jnp.finfo(S.dtype).tiny)
    alpha = p + r
    gain = jnp.sum(S * f[None, :], axis=1) / alpha
    return S - gain[:, None] * f[None, :] / (1.0 + jnp.sqrt(r / alpha))


def regressors(
    u: Float[Array, " N"], y: Float[Array, " N"], order: int
) -> Float[Array, "N 2*order+1"]:
    """Phi(k) = [y(k-1) ... y(k-n), u(k) ... u(k-n)], eq. 25, with zeros before the first sample.

    Args:
        u: input, (N,).
        y: output, (N,).
        order: n.
    """

    def delayed(s: Array, j: int) -> Array:
        return jnp.concatenate([jnp.zeros(j, s.dtype), s[: s.shape[0] - j]])

    past = [delayed(y, j) for j in range(1, order + 1)]
    return jnp.stack(past + [delayed(u, j) for j in range(order + 1)], axis=1)


# Forgetting, p0 and bound as arrays share one compiled program; as numbers each value has its own.
@eqx.filter_jit
def rls(
    u: Float[Array, " N"],
    y: Float[Array, " N"],
    *,
    order: int = 4,
    forgetting: float | Float[Array, ""] = 1.0,
    p0: float | Float[Array, ""] = 1e6,
    bound: float | Float[Array, ""] | None = None,
) -> RLSResult:
    """RLS over a record: Theta = [-a1 ... -an, b0 ... bn] of Hd(z), eqs 25-33.

    The first n samples have no recorded past: they serve as past only, and the histories hold
    zeros there.

    Args:
        u: input, (N,).
        y: output, (N,).
        order: n of Hd(z); the paper's is 4.
        forgetting: in (0, 1].
        p0: initial variance of every parameter.
        bound: largest variance that P may reach, against wind-up; 100 p0 unless given.

    Raises:
        ValueError: order below 1, fewer than 2 order + 1 samples, or u and y of unequal length.
    """
    if order < 1:
        raise ValueError(f"order must be at least 1, got {order}")
    if u.shape != y.shape or u.ndim != 1:
        raise ValueError(f"u and y: expected shape (N,) for both, got {u.shape} and {y.shape}")
    if u.shape[0] < 2 * order + 1:
        raise ValueError(
            f"expected at least {2 * order + 1} samples for order {order}, got {u.shape[0]}"
        )
    phi = regressors(u, y, order)
    # The zeros that stand for what was not recorded would be learnt as if the machine had rested.
    run = rls_regression(phi[order:], y[order:], forgetting, p0, bound)

    def padded(values: Array) -> Array:
        return jnp.concatenate([jnp.zeros((order, *values.shape[1:]), values.dtype), values])

    return RLSResult(run.theta, padded(run.history), padded(run.error), padded(run.largest))


def rls_regression(
    phi: Float[Array, "N q"],
    y: Float[Array, " N"],
    forgetting: float | Float[Array, ""] = 1.0,
    p0: float | Float[Array, ""] = 1e6,
    bound: float | Float[Array, ""] | None = None,
) -> RLSResult:
    """RLS with any regressors: y(k) = phi(k)^T theta.

    Args:
        phi: regressors (N, q).
        y: (N,).
        forgetting: in (0, 1].
        p0: initial variance of every parameter.
        bound: largest variance that P may reach, against wind-up; 100 p0 unless given.
    """
    dtype = phi.dtype
    p0 = jnp.asarray(p0, dtype)
    factor = jnp.asarray(forgetting, dtype)
    # Far enough above p0 not to touch what the record tells; without one P would overflow.
    limit = jnp.asarray(100.0 * p0 if bound is None else bound, dtype)

    def step(state: RLSState, sample: tuple[Array, Array]) -> tuple[RLSState, RLSInfo]:
        return rls_step(state, *sample, factor, limit)

    initial = rls_init(phi.shape[1], p0)
    # A scan keeps the types of what it carries: float32 records stay so beside a float64 p0.
    initial = jax.tree.map(lambda v: v.astype(dtype), initial)
    state, info = jax.lax.scan(step, initial, (phi, y))
    return RLSResult(state.theta, info.theta, info.error, info.largest)


def transfer_function(
    theta: Float[Array, "2*order+1"],
) -> tuple[Float[Array, " order+1"], Float[Array, " order+1"]]:
    """num and den of Hd(z), highest power first, from Theta, eqs 24 and 26."""
    n = (theta.shape[0] - 1) // 2
    # Theta holds -a: eq. 25 has the past outputs on the side of the inputs.
    return theta[n:], jnp.concatenate([jnp.ones(1, theta.dtype), -theta[:n]])
