"""Exact discretisation of a linear model with held inputs, or inputs linear between samples."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.naming import Number, Record
from heli_jax.numerics.matrix_exponential import expm, van_loan
from heli_jax.simulation.hold import Delays


class Discrete(NamedTuple):
    """Recurrence x[k+1] = Ad x[k] + Bd u[k], as matrices or nested tuples of scalars
    (`in_scalars`).

    With a delayed input, `Bp` multiplies the previous sample u[k-1]; otherwise it is None. With
    inputs linear between samples, `Bn` multiplies the next sample u[k+1]. Its columns for held
    inputs are zero; without linear inputs it is None.
    """

    Ad: Any
    Bd: Any
    Bp: Any
    Bn: Any = None

    def in_scalars(self) -> "Discrete":
        """Return the matrices as nested tuples."""
        return _once(Discrete(*(None if M is None else scalars(M) for M in self)))


def discretize(
    model: Model,
    params: Record,
    dt: Number,
    delays: Delays | None = None,
    linear: tuple[bool, ...] = (),
) -> Discrete:
    """Return the exact discrete equivalent of a linear model for steps of `dt` [s], as matrices.

    Args:
        dt: sample time [s].
        delays: delays of the inputs; whole samples are handled where the arrays are read. `late`
            [s] is the time in each interval before the delayed sample u[k] acts. A zero-order hold
            then gives x[k+1] = Ad x[k] + (G(dt) - G(dt-late)) u[k-1] + G(dt-late) u[k].
    """
    A, B, _, _ = jacobians(model, params)
    dt = jnp.asarray(dt, A.dtype)
    Ad, whole = _over(A, B, dt, dt, linear)
    # u[k] + (u[k+1] - u[k]) t/dt: the ramp moves weight from this sample to the next.
    Bd, Bp, Bn = whole.held - whole.rising, jnp.zeros_like(B), whole.rising
    # Effects of inputs superpose, so each group has its own columns.
    groups = () if delays is None else {g for g in delays.groups if g is not None}
    for group in sorted(groups):
        assert delays is not None
        i = np.asarray(delays.members(group))
        # Only the remainder, since whole samples shift the index of an input.
        late = jnp.asarray(delays.rest[group], A.dtype)
        moving = tuple(linear[j] for j in i) if linear else ()
        _, after = _over(A, B[:, i], dt - late * dt, dt, moving)
        of_group = _late(_Added(*(v[:, i] for v in whole)), after, late, moving)
        Bd, Bp, Bn = (M.at[:, i].set(v) for M, v in zip((Bd, Bp, Bn), of_group, strict=True))
    return _once(Discrete(Ad, Bd, None if delays is None else Bp, Bn if linear else None))


class _Added(NamedTuple):
    """Effect of inputs on the state over a time."""

    held: Float[Array, "n m"]
    """Effect of constant inputs of 1."""
    rising: Float[Array, "n m"]
    """Effect of inputs that rise from 0 by 1 every sample; zero for held inputs."""


def _over(
    A: Array, B: Array, h: Array, dt: Array, linear: tuple[bool, ...]
) -> tuple[Array, _Added]:
    """Return e^{A h} and the effect of inputs over h [s]; some may be linear between samples."""
    if any(linear):
        Ad, *added = _first_order_hold(A, B, h, dt, linear)
        return Ad, _Added(*added)
    Ad, held = _zero_order_hold(A, B, h)
    return Ad, _Added(held, jnp.zeros_like(held))


def _late(
    whole: _Added, after: _Added, late: Array, linear: tuple[bool, ...]
) -> tuple[Array, Array, Array]:
    """Return the columns Bd, Bp and Bn of inputs with a fractional delay.

    Args:
        whole: their effect over the whole sample.
        after: their effect over the remaining time after u[k] acts.
        linear: True for each input that is linear between samples; () holds all.
    """
    # The effect before u[k] is the whole effect minus that after it. The ramp is at `late` by then,
    # and that value is held.
    held = whole.held - after.held
    if not any(linear):
        return after.held, held, whole.rising
    ramps = jnp.asarray(linear, held.dtype)[None, :]
    rising = whole.rising - after.rising - ramps * late * after.held
    # The interval starts on the line from u[k-1] to u[k], `late` before its end; a held input is
    # still u[k-1].
    arrived = ramps * (1.0 - late)
    now = held * arrived + rising + after.held - after.rising
    return now, held * (1.0 - arrived) - rising, after.rising


def _once(discrete: Discrete) -> Discrete:
    """Use a barrier, so that XLA does not compute it in every step and for every use."""
    return jax.lax.optimization_barrier(discrete)


def process_noise(model: Model, params: Record, dt: Number) -> Float[Array, "n n"]:
    """Covariance of the noise that a linear model's white-noise drive adds in one step.

    Args:
        dt: sample time [s].
    """
    A = jacobians(model, params).A
    if model.noise_intensity is None:
        return jnp.zeros(A.shape, A.dtype)
    g = naming.ravel(model.noise_intensity(params), A.dtype)
    # The integral over the step, since noise on a rate becomes correlated noise on its angle within
    # one sample. Intensity times dt would miss it.
    return van_loan(A, jnp.zeros_like(g), g, jnp.asarray(dt, A.dtype)).Q


def square_root(Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return a factor L with L L^T = Q for a covariance that may be singular."""
    # Cholesky fails: noise on one of many states gives Q of low rank, with slightly negative
    # eigenvalues.
    values, vectors = jnp.linalg.eigh(Q)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]


def _zero_order_hold(A: Array, B: Array, dt: Array) -> tuple[Array, Array]:
    """Return e^{A dt} and its integral times B, from one exponential of [[A, B], [0, 0]] dt."""
    # A^-1 (e^{A dt} - I) B would fail, since a free axis has a singular A.
    n, m = B.shape
    M = jnp.zeros((n + m, n + m), A.dtype).at[:n, :n].set(A).at[:n, n:].set(B)
    E = expm(M * dt)
    return E[:n, :n], E[:n, n:]


def _first_order_hold(
    A: Array, B: Array, h: Array, dt: Array, linear: tuple[bool, ...]
) -> tuple[Array, Array, Array]:
    """Return e^{A h} and the effects over h [s] of inputs of 1, and of inputs that rise by 1 every
    dt [s].

    One exponential of [[A, B, 0], [0, 0, I/dt], [0, 0, 0]] h (Franklin, Powell and Workman, 1998,
    section 6.3.2); the last effect is zero for inputs that are not linear.
    """
    # Two integrators in series for each moving input: the ramp drives the input, the input the
    # state.
    n, m = B.shape
    moving = np.flatnonzero(linear)
    q = n + m + moving.size
    M = jnp.zeros((q, q), A.dtype).at[:n, :n].set(A).at[:n, n : n + m].set(B)
    M = M.at[n + moving, n + m + np.arange(moving.size)].set(1.0 / dt)
    E = expm(M * h)
    ramps = jnp.zeros((n, m), A.dtype).at[:, moving].set(E[:n, n + m :])
    return E[:n, :n], E[:n, n : n + m], ramps


# Nested tuples are pytrees of scalars. Under vmap each coefficient is a vector over the batch.
def scalars(M: Float[Array, "n m"]) -> tuple[tuple[Any, ...], ...]:
    """Return a matrix row by row as nested tuples of scalars."""
    return tuple(tuple(M[i, j] for j in range(M.shape[1])) for i in range(M.shape[0]))
