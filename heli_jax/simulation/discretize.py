"""Exact discretisation of a linear model whose inputs are held, or linear between samples."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model

_DEGREE = 12
_THETA = 0.3  # (0.3)^13 / 13! is below half an ulp of 1
_SQUARINGS = 24
_SMALL = 8


@jax.custom_jvp
def expm(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The matrix exponential by scaling and squaring of a Taylor polynomial of degree 12.

    A diagonal change of units first brings the norm down (a flybar has Omega^2 beside 1), so few
    squarings are needed; their number comes from a bound on the norm. Works in forward and
    reverse mode; compiles in half the time of `jax.scipy.linalg.expm`. Valid for norms up to
    0.3 * 2^24 after balancing; beyond that the result is NaN.
    """
    return _side_by_side(M)


@jax.custom_batching.custom_vmap
def _side_by_side(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The exponential where no derivative is wanted, as in sweeps."""
    return _many(M[:, :, None])[:, :, 0]


@_side_by_side.def_vmap
def _side_by_side_batched(size: int, batched: Any, M: Any) -> Any:
    # Matrices last beside each other, so that the processor takes several of them at a time.
    return jnp.moveaxis(_many(jnp.moveaxis(M, 0, 2)), 2, 0), True


def _many(M: Float[Array, "n n L"]) -> Float[Array, "n n L"]:
    """The exponentials of L matrices, with no more squarings than one of them needs."""
    d = _balance(M)
    X = M * (d[None, :] / d[:, None])
    s = _halvings(X)[None, None]
    E = _taylor(X * jnp.exp2(-s))
    count = jnp.max(jnp.where(s <= _SQUARINGS, s, 0.0)).astype(int)
    E = jax.lax.fori_loop(0, count, lambda i, E: jnp.where(i < s, product(E, E), E), E)
    E = jnp.where(s <= _SQUARINGS, E, jnp.nan)
    return E * (d[:, None] / d[None, :])


@expm.defjvp
def _expm_jvp(primals: Any, tangents: Any) -> Any:
    return jax.jvp(_expm_in_loops, primals, tangents)


def _expm_in_loops(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The same in loops of fixed length, which have derivatives of both modes."""
    d = _balance(jax.lax.stop_gradient(M))
    X = M * (d[None, :] / d[:, None])
    s = _halvings(X)
    E = _doubled(s, lambda E: product(E, E), _taylor(X * jnp.exp2(-s)))
    return E * (d[:, None] / d[None, :])


def _taylor(X: Float[Array, "n n *L"]) -> Float[Array, "n n *L"]:
    eye = _eye(X)
    # Loops rather than unrolled sums: they run as fast and compile in half the time.
    degrees = jnp.arange(_DEGREE, 0, -1, dtype=X.dtype)
    begin = jnp.broadcast_to(eye, X.shape)
    return jax.lax.scan(lambda E, k: (eye + product(X, E) / k, None), begin, degrees)[0]


def _eye(X: Float[Array, "n n *L"]) -> Float[Array, "n n *one"]:
    """The identity, with the axes of X."""
    n = X.shape[0]
    return jnp.eye(n, dtype=X.dtype).reshape(n, n, *(1,) * (X.ndim - 2))


def _halvings(X: Float[Array, "n n *L"]) -> Float[Array, "*L"]:
    """How often to halve X for the polynomial to be exact."""
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(X), axis=0), axis=0))
    return jnp.ceil(jnp.log2(jnp.maximum(norm, _THETA) / _THETA))


def _doubled(s: Float[Array, ""], double: Callable[[Any], Any], first: Any) -> Any:
    """`double` applied s times; NaN where that is too often."""

    def step(i: Array, value: Any) -> Any:
        return jax.lax.cond(i < s, double, lambda value: value, value)

    last = jax.lax.fori_loop(0, _SQUARINGS, step, first)
    return jax.tree.map(lambda v: jnp.where(s <= _SQUARINGS, v, jnp.nan), last)


class Moved(NamedTuple):
    """What a step of x' = A x + f + g w does to x."""

    Phi: Float[Array, "n n"]
    """e^{A h}"""
    shift: Float[Array, " n"]
    """what f adds"""
    Q: Float[Array, "n n"]
    """covariance that w adds"""


def moved(A: Float[Array, "n n"], f: Float[Array, " n"], g: Float[Array, " n"], h: Any) -> Moved:
    """A step of h [s] of x' = A x + f + g w, with a white noise w of unit intensity a state.

    The series of a fraction of the step, doubled until it is whole. The integrals are those that
    Van Loan (1978) takes from exponentials of larger matrices; these hold e^{-A h}, and no digit
    of them is left where a mode decays fast. Where the norm is past what `expm` takes the result
    is NaN.
    """
    d = _balance(jax.lax.stop_gradient(A))
    X = A * (d[None, :] / d[:, None]) * h
    s = _halvings(X)
    X, h = X * jnp.exp2(-s), h * jnp.exp2(-s)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)

    def term(carry: Any, k: Array) -> Any:
        (P, m, M), total = carry
        XM = product(X, M)
        new = (
            product(X, P) / k,
            jnp.sum(X * m[None, :], axis=1) / (k + 1.0),
            (XM + XM.T) / (k + 1.0),
        )
        return (new, jax.tree.map(jnp.add, total, new)), None

    first = (eye, h * f / d, jnp.diag(h * jnp.square(g / d)))
    degrees = jnp.arange(1, _DEGREE + 1, dtype=A.dtype)
    (_, total), _ = jax.lax.scan(term, (first, first), degrees)

    def double(whole: Any) -> Any:
        P, m, M = whole
        through = product(product(P, M), P.T)
        return product(P, P), m + jnp.sum(P * m[None, :], axis=1), M + 0.5 * (through + through.T)

    P, m, M = _doubled(s, double, total)
    return Moved(P * (d[:, None] / d[None, :]), d * m, M * (d[:, None] * d[None, :]))


def product(X: Float[Array, "n k *L"], Y: Float[Array, "k m *L"]) -> Float[Array, "n m *L"]:
    """X Y; for small k as a sum of outer products, which takes a batch of them 5 times faster."""
    inner = X.shape[1]
    if inner > _SMALL:
        return X @ Y if X.ndim == 2 else jnp.einsum("ijl,jkl->ikl", X, Y)
    total = X[:, 0, None] * Y[0, None]
    for k in range(1, inner):
        total = total + X[:, k, None] * Y[k, None]
    return total


def _balance(M: Float[Array, "n n *L"]) -> Float[Array, "n *L"]:
    """Powers of two d such that M[i, j] d[j] / d[i] has rows and columns of like size (Osborne)."""
    n = M.shape[0]
    off = jnp.abs(M) * (1.0 - _eye(M))
    places = jnp.arange(n).reshape(n, *(1,) * (M.ndim - 2))

    def sweep(k: Array, d: Array) -> Array:
        i = k % n
        column = jnp.sum(off[:, i] * (d[i][None] / d), axis=0)
        row = jnp.sum(off[i, :] * (d / d[i][None]), axis=0)
        both = (column > 0) & (row > 0)
        ratio = jnp.where(both, row, 1.0) / jnp.where(both, column, 1.0)
        change = jnp.exp2(jnp.round(0.5 * jnp.log2(ratio)))
        # Not by index: many small vectors side by side are changed element by element faster.
        return jnp.where(places == i, d * change[None], d)

    return jax.lax.fori_loop(0, 3 * n, sweep, jnp.ones(M.shape[1:], M.dtype))


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
        """As nested tuples."""
        return _once(Discrete(*(None if M is None else scalars(M) for M in self)))


def discretize(
    model: Model, params: Any, dt: Any, late: Any = None, linear: tuple[bool, ...] = ()
) -> Discrete:
    """The exact equivalent of a linear model for steps of `dt` [s], in matrices.

    Args:
        late: [s], within [0, dt]: the part of each interval before the delayed sample u[k] acts.
            Under a zero-order hold x[k+1] = Ad x[k] + e^{A (dt-late)} G(late) u[k-1] +
            G(dt-late) u[k].
        linear: of each input whether it is linear between samples; () holds all.
    """
    A, B, _, _ = jacobians(model, params)
    dt = jnp.asarray(dt, A.dtype)
    if linear:
        return _once(_first_order(A, B, dt, late, linear))
    if late is None:
        return _once(Discrete(*_held(A, B, dt), None))
    late = jnp.asarray(late, A.dtype)
    first, second = _held(A, B, late), _held(A, B, dt - late)
    return _once(Discrete(second[0] @ first[0], second[1], second[0] @ first[1]))


def _first_order(A: Array, B: Array, dt: Array, late: Any, linear: tuple[bool, ...]) -> Discrete:
    """`discretize` with some inputs on straight lines between samples (first-order hold)."""
    if late is None:
        Ad, G, R = _ramped(A, B, dt, dt, linear)
        return Discrete(Ad, G - R, None, R)
    late = jnp.asarray(late, A.dtype)
    first, second = _ramped(A, B, late, dt, linear), _ramped(A, B, dt - late, dt, linear)
    # The interval begins on the line from u[k-1] to u[k], `late` before its end: what is held is
    # still u[k-1] there.
    arrived = jnp.asarray(linear, A.dtype)[None, :] * (1.0 - late / dt)
    before = first[1] * (1.0 - arrived) - first[2]
    now = first[1] * arrived + first[2]
    return Discrete(
        product(second[0], first[0]),
        product(second[0], now) + second[1] - second[2],
        product(second[0], before),
        second[2],
    )


def _once(discrete: Discrete) -> Discrete:
    """Behind a barrier, so that XLA does not compute it at every step, nor for every use."""
    return jax.lax.optimization_barrier(discrete)


def process_noise(model: Model, params: Any, dt: Any) -> Float[Array, "n n"]:
    """Covariance of the noise that a linear model's white-noise drive adds in one step."""
    A = jacobians(model, params).A
    if model.noise_intensity is None:
        return jnp.zeros(A.shape, A.dtype)
    g = naming.ravel(model.noise_intensity(params), A.dtype)
    return moved(A, jnp.zeros_like(g), g, jnp.asarray(dt, A.dtype)).Q


def square_root(Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A factor L with L L^T = Q for a covariance that may be singular."""
    values, vectors = jnp.linalg.eigh(Q)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]


def _held(A: Array, B: Array, dt: Array) -> tuple[Array, Array]:
    """e^{A dt} and its integral times B: one exponential of [[A, B], [0, 0]] dt."""
    n, m = B.shape
    M = jnp.zeros((n + m, n + m), A.dtype).at[:n, :n].set(A).at[:n, n:].set(B)
    E = expm(M * dt)
    return E[:n, :n], E[:n, n:]


def _ramped(
    A: Array, B: Array, h: Array, dt: Array, linear: tuple[bool, ...]
) -> tuple[Array, Array, Array]:
    """Over h [s]: e^{A h}, what inputs of 1 add, and what inputs that rise by 1 every dt [s] add.

    One exponential of [[A, B, 0], [0, 0, I/dt], [0, 0, 0]] h (Franklin, Powell and Workman, 1998,
    section 6.3.2); the last is zero for inputs that are not linear.
    """
    n, m = B.shape
    moving = np.flatnonzero(linear)
    q = n + m + moving.size
    M = jnp.zeros((q, q), A.dtype).at[:n, :n].set(A).at[:n, n : n + m].set(B)
    M = M.at[n + moving, n + m + np.arange(moving.size)].set(1.0 / dt)
    E = expm(M * h)
    ramps = jnp.zeros((n, m), A.dtype).at[:, moving].set(E[:n, n + m :])
    return E[:n, :n], E[:n, n : n + m], ramps


def scalars(M: Float[Array, "n m"]) -> tuple[tuple[Any, ...], ...]:
    """A matrix row by row as nested tuples of scalars."""
    return tuple(tuple(M[i, j] for j in range(M.shape[1])) for i in range(M.shape[0]))
