"""Exact discretisation of a linear model whose inputs are held, or linear between samples."""

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
    """x[k+1] = Ad x[k] + Bd u[k], in matrices, or in nested tuples of scalars (`in_scalars`).

    With a delayed input, `Bp` multiplies the sample before, u[k-1]; otherwise it is None. With
    inputs that are linear between samples, `Bn` multiplies the next one, u[k+1]; its columns of
    inputs that are held are zero, and without such inputs it is None.
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
    """The exact equivalent of a linear model for steps of `dt` [s], in matrices.

    Args:
        dt: [s].
        delays: how late the inputs are; whole samples are left to who reads the arrays. With
            `late` [s] the part of each interval before the delayed sample u[k] acts, under a
            zero-order hold x[k+1] = Ad x[k] + (G(dt) - G(dt-late)) u[k-1] + G(dt-late) u[k].
    """
    A, B, _, _ = jacobians(model, params)
    dt = jnp.asarray(dt, A.dtype)
    Ad, whole = _over(A, B, dt, dt, linear)
    # u[k] + (u[k+1] - u[k]) t/dt: the ramp takes from this sample what it gives to the next.
    Bd, Bp, Bn = whole.held - whole.rising, jnp.zeros_like(B), whole.rising
    # What inputs add is superposed, so that each group's columns are its own.
    groups = () if delays is None else {g for g in delays.groups if g is not None}
    for group in sorted(groups):
        assert delays is not None
        i = np.asarray(delays.members(group))
        # The rest alone: whole samples are in the index by which an input is read.
        late = jnp.asarray(delays.rest[group], A.dtype)
        moving = tuple(linear[j] for j in i) if linear else ()
        _, after = _over(A, B[:, i], dt - late * dt, dt, moving)
        of_group = _late(_Added(*(v[:, i] for v in whole)), after, late, moving)
        Bd, Bp, Bn = (M.at[:, i].set(v) for M, v in zip((Bd, Bp, Bn), of_group, strict=True))
    return _once(Discrete(Ad, Bd, None if delays is None else Bp, Bn if linear else None))


class _Added(NamedTuple):
    """Effect of inputs on the state over a time."""

    held: Float[Array, "n m"]
    """those of 1"""
    rising: Float[Array, "n m"]
    """those that rise from 0 by 1 every sample; zero for inputs that are held"""


def _over(
    A: Array, B: Array, h: Array, dt: Array, linear: tuple[bool, ...]
) -> tuple[Array, _Added]:
    """Over h [s] e^{A h} and what inputs add, of which some are linear between samples."""
    if any(linear):
        Ad, *added = _first_order_hold(A, B, h, dt, linear)
        return Ad, _Added(*added)
    Ad, held = _zero_order_hold(A, B, h)
    return Ad, _Added(held, jnp.zeros_like(held))


def _late(
    whole: _Added, after: _Added, late: Array, linear: tuple[bool, ...]
) -> tuple[Array, Array, Array]:
    """The columns Bd, Bp and Bn of inputs that are late by a part of a sample.

    Args:
        whole: what they would add over the whole sample at once.
        after: over what is left of it when the sample u[k] arrives.
        linear: of each whether it is linear between samples; () holds all.
    """
    # What is added before, at the end of the sample: all of it less what is added after. A ramp
    # stands at `late` by then, and that is held from there on.
    held = whole.held - after.held
    if not any(linear):
        return after.held, held, whole.rising
    ramps = jnp.asarray(linear, held.dtype)[None, :]
    rising = whole.rising - after.rising - ramps * late * after.held
    # The interval begins on the line from u[k-1] to u[k], `late` before its end: what is held is
    # still u[k-1] there.
    arrived = ramps * (1.0 - late)
    now = held * arrived + rising + after.held - after.rising
    return now, held * (1.0 - arrived) - rising, after.rising


def _once(discrete: Discrete) -> Discrete:
    """Behind a barrier, so that XLA does not compute it at every step, nor for every use."""
    return jax.lax.optimization_barrier(discrete)


def process_noise(model: Model, params: Record, dt: Number) -> Float[Array, "n n"]:
    """Covariance of the noise that a linear model's white-noise drive adds in one step.

    Args:
        dt: [s].
    """
    A = jacobians(model, params).A
    if model.noise_intensity is None:
        return jnp.zeros(A.shape, A.dtype)
    g = naming.ravel(model.noise_intensity(params), A.dtype)
    # The integral over the step, not intensity times dt: noise on a rate is, within one sample
    # already, noise on its angle, correlated with it.
    return van_loan(A, jnp.zeros_like(g), g, jnp.asarray(dt, A.dtype)).Q


def square_root(Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A factor L with L L^T = Q for a covariance that may be singular."""
    # Not Cholesky: noise that drives one state of many has a Q of low rank, with eigenvalues of
    # minus a rounding error.
    values, vectors = jnp.linalg.eigh(Q)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]


def _zero_order_hold(A: Array, B: Array, dt: Array) -> tuple[Array, Array]:
    """e^{A dt} and its integral times B: one exponential of [[A, B], [0, 0]] dt."""
    # In place of A^-1 (e^{A dt} - I) B: a free axis integrates, and its A has no inverse.
    n, m = B.shape
    M = jnp.zeros((n + m, n + m), A.dtype).at[:n, :n].set(A).at[:n, n:].set(B)
    E = expm(M * dt)
    return E[:n, :n], E[:n, n:]


def _first_order_hold(
    A: Array, B: Array, h: Array, dt: Array, linear: tuple[bool, ...]
) -> tuple[Array, Array, Array]:
    """Over h [s]: e^{A h}, what inputs of 1 add, and what inputs that rise by 1 every dt [s] add.

    One exponential of [[A, B, 0], [0, 0, I/dt], [0, 0, 0]] h (Franklin, Powell and Workman, 1998,
    section 6.3.2); the last is zero for inputs that are not linear.
    """
    # A chain of two integrators per moving input: the ramp drives the input, the input the state.
    n, m = B.shape
    moving = np.flatnonzero(linear)
    q = n + m + moving.size
    M = jnp.zeros((q, q), A.dtype).at[:n, :n].set(A).at[:n, n : n + m].set(B)
    M = M.at[n + moving, n + m + np.arange(moving.size)].set(1.0 / dt)
    E = expm(M * h)
    ramps = jnp.zeros((n, m), A.dtype).at[:, moving].set(E[:n, n + m :])
    return E[:n, :n], E[:n, n : n + m], ramps


# Nested tuples are pytrees of scalars: under vmap each coefficient is a vector over the batch.
def scalars(M: Float[Array, "n m"]) -> tuple[tuple[Any, ...], ...]:
    """A matrix row by row as nested tuples of scalars."""
    return tuple(tuple(M[i, j] for j in range(M.shape[1])) for i in range(M.shape[0]))
