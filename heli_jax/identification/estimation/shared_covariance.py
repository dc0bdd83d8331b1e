"""Kalman filters of several flights of one linear model, which share their covariances."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.kalman import Innovations, first_covariance
from heli_jax.identification.estimation.simulated_flights import Drive, driven, measurement_sd
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns
from heli_jax.simulation.discretize import process_noise
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.stepping import held_columns

# Without missing samples the covariances depend only on the model, so its records share them. They
# converge (Kalman, 1960); then the gain is constant, and the filter is a linear recurrence. Both
# have custom derivatives. Those of the Riccati equation are a Lyapunov recursion with the
# closed-loop matrix, which all unknowns share. Those of the state are the same recurrence with
# another forcing.
#
# If the covariance does not converge (an unstable mode invisible in the outputs, a short record)
# the gain never freezes. The filter is exact in any case.


_CHUNK = 64
"""Samples between convergence checks of the covariance."""
_CONVERGED = 1e-10
"""Change of a covariance within a chunk, in units of the two standard deviations, below which it
has converged. Derivatives converge later than values, by a factor of about the samples it took."""


class Records(NamedTuple):
    """m records of N samples, side by side."""

    U: Float[Array, "N m r"]
    """Inputs of `Gaussian.B`."""
    acting: Float[Array, "N m i"]
    """Inputs that act at the samples."""
    y: Float[Array, "N m p"]
    """Measurements, without NaN."""
    x0: Float[Array, "m n"]
    """Mean of the state at the first sample."""


class Gaussian(NamedTuple):
    """x[k+1] = Ad x[k] + B U[k] + noise, y[k] = C x[k] + D u[k] + noise."""

    Ad: Float[Array, "n n"]
    B: Float[Array, "n r"]
    C: Float[Array, "p n"]
    D: Float[Array, "p i"]
    Q: Float[Array, "n n"]
    """Covariance of the process noise of a step."""
    R: Float[Array, " p"]
    """Variances of the measurement noise."""
    P0: Float[Array, "n n"]
    """Covariance of the state at the first sample."""


class _Gain(NamedTuple):
    """Gains of a sample."""

    G: Float[Array, "n p"]
    """Ad times the Kalman gain."""
    white: Float[Array, "p p"]
    """Inverse of the Cholesky factor of the innovations' covariance."""


class _State(NamedTuple):
    """State of the filter between two chunks."""

    x: Float[Array, "m n"]
    P: Float[Array, "n n"]
    gain: _Gain
    steady: Bool[Array, ""]


def filtered_records(system: Gaussian, records: Records) -> tuple[Array, Array]:
    """Return errors (N, m, p) and variances (N, p) of the innovations.

    Outputs of one sample are processed one after another, as in `kalman.innovations`.
    """
    N, m, p = records.y.shape
    n, count = records.x0.shape[1], -(-N // _CHUNK)

    def chunk(state: _State, part: Any) -> tuple[_State, Any]:
        # Chunks keep the branch out of the inner loop.
        return jax.lax.cond(state.steady, _frozen, _transient, system, state, *part)

    # The last chunk is padded after the record; the padding is removed afterwards.
    samples = (records.U, records.acting, records.y)
    parts = jax.tree.map(
        lambda v: jnp.pad(v, ((0, count * _CHUNK - N), (0, 0), (0, 0))).reshape(
            count, _CHUNK, *v.shape[1:]
        ),
        samples,
    )
    dtype = records.y.dtype
    none = _Gain(jnp.zeros((n, p), dtype), jnp.zeros((p, p), dtype))
    begin = _State(records.x0, system.P0, none, jnp.asarray(False))
    _, (error, sd) = jax.lax.scan(chunk, begin, parts)
    error, sd = error.reshape(-1, m, p)[:N], sd.reshape(-1, p)[:N]
    return error, jnp.square(sd)


def _transient(
    system: Gaussian, state: _State, U: Array, acting: Array, y: Array
) -> tuple[_State, tuple[Array, Array]]:
    """Filter a chunk with a gain for each sample."""
    Ad, B, C, D, Q, R, _ = system

    def step(carry: tuple[Array, Array, _Gain], now: Any) -> tuple[Any, Any]:
        x, P, _ = carry
        U, acting, y = now
        # All records share one covariance; each has its own state.
        P, gain = riccati(Ad, C, Q, R, P)
        nu = y - acting @ D.T - x @ C.T
        x = x @ Ad.T + nu @ gain.G.T + U @ B.T
        return (x, P, gain), (nu @ gain.white.T, jnp.diagonal(gain.white))

    carry = (state.x, state.P, state.gain)
    (x, P, gain), (white, scale) = jax.lax.scan(step, carry, (U, acting, y))
    sd = 1.0 / scale
    return _State(x, P, gain, _converged(state.P, P)), (white * sd[:, None, :], sd)


def _frozen(
    system: Gaussian, state: _State, U: Array, acting: Array, y: Array
) -> tuple[_State, tuple[Array, Array]]:
    """Filter a chunk with a constant gain."""
    G, white = state.gain
    v = y - acting @ system.D.T
    # Prediction and correction form one matrix, the closed loop of the filter.
    x, X = recurrence(system.Ad - G @ system.C, v @ G.T + U @ system.B.T, state.x)
    sd = 1.0 / jnp.diagonal(white)
    error = (v - X @ system.C.T) @ (white * sd[:, None]).T
    return state._replace(x=x), (error, jnp.broadcast_to(sd, (U.shape[0], sd.shape[0])))


def _converged(before: Array, after: Array) -> Array:
    before, after = jax.lax.stop_gradient((before, after))
    sd = jnp.sqrt(jnp.maximum(jnp.diagonal(after), 0.0))
    # Dividing by both standard deviations makes the test independent of units and valid for nearly
    # exact states.
    return _in_all(jnp.all(jnp.abs(after - before) <= _CONVERGED * sd[:, None] * sd[None, :]))


# In a batch the gain freezes only if it may in all members: separate conditions would make JAX
# compute both branches.
@jax.custom_batching.custom_vmap
def _in_all(flag: Array) -> Array:
    return flag


@_in_all.def_vmap
def _(size: int, batched: list[bool], flag: Array) -> tuple[Array, bool]:
    return jnp.all(flag), False


@jax.custom_jvp
def riccati(Ad: Array, C: Array, Q: Array, R: Array, P: Array) -> tuple[Array, _Gain]:
    """Return the covariance of the state one sample later, and the gains of the sample.

    Args:
        Q: (n, n), covariance of the process noise of the step.
        R: (p,), variances of the measurement noise.
        P: (n, n), covariance of the state predicted for the sample.
    """
    following, gain, _ = _riccati(Ad, C, Q, R, P)
    return following, gain


def _riccati(
    Ad: Array, C: Array, Q: Array, R: Array, P: Array
) -> tuple[Array, _Gain, tuple[Array, Array]]:
    """Return `riccati`, the Kalman gain, and Ad times the covariance of the corrected state."""
    H = P @ C.T
    # The Cholesky factor subtracts from each innovation its prediction from the outputs before it.
    # This gives the same values as processing outputs one after another.
    L = jnp.linalg.cholesky(C @ H + jnp.diag(R))
    white = jax.scipy.linalg.solve_triangular(L, jnp.eye(R.shape[0], dtype=R.dtype), lower=True)
    whitened = H @ white.T
    K = whitened @ white
    corrected = Ad @ (P - whitened @ whitened.T)
    following = corrected @ Ad.T + Q
    # The matrix is made symmetric, because rounding would grow with each step.
    return 0.5 * (following + following.T), _Gain(Ad @ K, white), (K, corrected)


@riccati.defjvp
def _riccati_jvp(primals: Any, tangents: Any) -> Any:
    """Differentiate the Riccati step.

    With G = Ad K and F = Ad - G C, dP+ = F dP F' + dQ + G dR G' + W + W', where W = dAd (P
    corrected) Ad' - G dC P F'. The gain is optimal, so dK does not enter.
    """
    Ad, C, _, _, P = primals
    dAd, dC, dQ, dR, dP = tangents
    following, gain, (K, corrected) = _riccati(*primals)
    F, H = Ad - gain.G @ C, P @ C.T
    W = dAd @ corrected.T - gain.G @ dC @ (P @ F.T)
    d_following = F @ dP @ F.T + dQ + (gain.G * dR[None, :]) @ gain.G.T + W + W.T
    dCH = dC @ H
    dS = C @ dP @ C.T + dCH + dCH.T + jnp.diag(dR)
    # L^-1 dS L^-T = Phi + Phi' gives dL = L Phi, with lower triangular Phi.
    whitened = gain.white @ dS @ gain.white.T
    half = jnp.tril(whitened) - 0.5 * jnp.diag(jnp.diagonal(whitened))
    d_white = -half @ gain.white
    # The states depend on the derivative of the gain, although the covariance does not.
    dK = (dP @ C.T + P @ dC.T - K @ dS) @ (gain.white.T @ gain.white)
    return (following, gain), (d_following, _Gain(dAd @ K + Ad @ dK, d_white))


@jax.custom_jvp
def recurrence(F: Array, forcing: Array, x0: Array) -> tuple[Array, Array]:
    """Return the last x, and all x (K, m, n), of the recurrence x[k+1] = F x[k] + forcing[k]."""
    return jax.lax.scan(lambda x, f: (x @ F.T + f, x), x0, forcing)


@recurrence.defjvp
def _recurrence_jvp(primals: Any, tangents: Any) -> Any:
    (F, _, _), (dF, d_forcing, dx0) = primals, tangents
    x, X = recurrence(*primals)
    # dF x is computed for all samples at once, which saves one product in every step.
    driven = X @ dF.T + d_forcing
    return (x, X), recurrence(F, driven, dx0)


def innovations_together(
    layout: Layout, data: Data, noise: Noise, u: Unknowns, group: tuple[int, ...]
) -> list[Innovations]:
    """Return the innovations of flights that share their covariances."""
    names = layout.outputs[group[0]]
    measured = [{n: data.flights[i].outputs[n] - u.biases[i][n] for n in names} for i in group]
    drives = [driven(layout, data, u, i) for i in group]
    system, U, acting = _system(layout, drives, noise, u, group)
    dtype = U.dtype
    y = jnp.stack([_columns([by_name[n] for by_name in measured]) for n in names], axis=2)
    starts = [layout.model.initial_state(d.params) if d.state is None else d.state for d in drives]
    x0 = jnp.stack([naming.ravel(start, dtype) for start in starts])
    error, variance = filtered_records(system, Records(U, acting, y, x0))
    # Shorter records are padded after their end, which earlier samples do not depend on.
    lengths = [by_name[names[0]].shape[0] for by_name in measured]
    return [
        Innovations(
            {n: error[:N, j, k] for k, n in enumerate(names)},
            {n: variance[:N, k] for k, n in enumerate(names)},
        )
        for j, N in enumerate(lengths)
    ]


def _system(
    layout: Layout, drives: list[Drive], noise: Noise, u: Unknowns, group: tuple[int, ...]
) -> tuple[Gaussian, Array, Array]:
    """Return the model, the inputs of its B, and the inputs that act at the samples, (N, m, .)."""
    # The whole group shares parameters, sample time and holds.
    model, params, dt = layout.model, drives[0].params, drives[0].dt
    names = layout.outputs[group[0]]
    inputs = jax.tree.map(lambda *v: _columns(v), *(drive.inputs for drive in drives))
    first, hold = drives[0].inputs, layout.hold(group[0])
    model = between_samples(layout.model, first, first, hold).model

    def held(inputs: Any) -> Any:
        _, inputs, linear = between_samples(layout.model, inputs, inputs, hold)
        return held_columns(model, params, inputs, dt, u.shift, linear)

    # The matrices do not depend on the inputs, so vmap returns them once.
    Ad, B, U, acting = jax.vmap(held, -1, (None, None, 1, 1))(inputs)
    _, _, C, D = jacobians(model, params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in names])
    Q = process_noise(model, params, dt)
    by_flight = jnp.stack([jnp.stack([noise.sd[i][n] for n in names]) for i in group])
    # NaN is better than the noise of another flight.
    sd = jnp.where(jnp.all(by_flight == by_flight[:1]), by_flight[0], jnp.nan)
    # The scales are unknowns that all flights share.
    R = jnp.square(jnp.stack([measurement_sd(u, n, s) for n, s in zip(names, sd, strict=True)]))
    P0 = first_covariance(model, params, Ad.dtype)
    return Gaussian(Ad, B, C[rows], D[rows], Q, R, P0), U, acting


def _columns(records: Any) -> Float[Array, "N m"]:
    """Return signals (N,) as columns, shorter ones padded after their end."""
    N = max(v.shape[0] for v in records)
    return jnp.stack([jnp.pad(v, (0, N - v.shape[0])) for v in records], axis=1)
