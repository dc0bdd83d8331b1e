"""Exponentials of batches of small matrices, and related integrals.

One polynomial serves three functions. `expm` without derivatives takes a whole batch, with the
squarings that its worst matrix needs. With derivatives it runs in loops of fixed length, which both
modes can differentiate. `van_loan` also computes the integrals of drift and noise.
"""

# `experiments/benchmarks/sweeps.py` discretises a model for each element, and
# `experiments/benchmarks/identification.py` for each evaluation of a fit. There the Pade form of
# jax.scipy.linalg.expm takes twice as long to compile, and its linear solve is not vectorised over
# small matrices.

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from heli_jax.naming import Scalar

_DEGREE = 12
"""Degree of Taylor's polynomial."""
_THETA = 0.3
"""Norm up to which the polynomial is exact: (0.3)^13 / 13! is below half an ulp of 1."""
_SQUARINGS = 24
"""Most squarings; more would mean modes too fast for any sample time."""
_SMALL = 8
"""Inner dimension up to which a product is unrolled."""


@jax.custom_jvp
def expm(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the matrix exponential by scaling and squaring of a Taylor polynomial of degree 12.

    A diagonal scaling first reduces the norm (a flybar has Omega^2 beside 1), so few squarings are
    needed. Their number follows from a bound on the norm. Works in forward and reverse mode;
    compiles in half the time of `jax.scipy.linalg.expm`. Valid for norms up to 0.3 * 2^24 after
    balancing; beyond that the result is NaN.
    """
    return _side_by_side(M)


@jax.custom_batching.custom_vmap
def _side_by_side(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the exponential without derivatives, as in sweeps."""
    return _many(M[:, :, None])[:, :, 0]


@_side_by_side.def_vmap
def _side_by_side_batched(
    size: int, batched: list[bool], M: Float[Array, "L n n"]
) -> tuple[Float[Array, "L n n"], bool]:
    # The batch axis is last, so that the processor vectorises over matrices.
    return jnp.moveaxis(_many(jnp.moveaxis(M, 0, 2)), 2, 0), True


def _many(M: Float[Array, "n n L"]) -> Float[Array, "n n L"]:
    """Return the exponentials of L matrices, with no more squarings than any of them needs."""
    # A flybar's A has Omega^2 = 2e4 beside 1. Balancing reduces the norm to about Omega and saves
    # seven squarings. Powers of two cause no rounding.
    d = _balance(M)
    X = M * (d[None, :] / d[:, None])
    s = _halvings(X)[None, None]
    E = _taylor(X * jnp.exp2(-s))
    count = jnp.max(jnp.where(s <= _SQUARINGS, s, 0.0)).astype(int)
    # Each matrix has its own number of squarings, since one more would change the rounding.
    E = jax.lax.fori_loop(0, count, lambda i, E: jnp.where(i < s, product(E, E), E), E)
    E = jnp.where(s <= _SQUARINGS, E, jnp.nan)
    return E * (d[:, None] / d[None, :])


@expm.defjvp
def _expm_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # A loop with variable length has no reverse mode, so derivatives use the other form. Its value
    # differs at most in the last digit.
    return jax.jvp(_expm_in_loops, primals, tangents)


def _expm_in_loops(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the same in loops of fixed length, with derivatives in both modes."""
    # Apart from rounding, the result does not depend on d and s, so they need no derivative.
    d = _balance(jax.lax.stop_gradient(M))
    X = M * (d[None, :] / d[:, None])
    s = _halvings(X)
    E = _doubled(s, lambda E: product(E, E), _taylor(X * jnp.exp2(-s)))
    return E * (d[:, None] / d[None, :])


def _taylor(X: Float[Array, "n n *L"]) -> Float[Array, "n n *L"]:
    eye = _eye(X)
    # Loops run as fast as unrolled sums and compile in half the time. Horner's scheme, from the
    # highest term.
    degrees = jnp.arange(_DEGREE, 0, -1, dtype=X.dtype)
    begin = jnp.broadcast_to(eye, X.shape)
    return jax.lax.scan(lambda E, k: (eye + product(X, E) / k, None), begin, degrees)[0]


def _eye(X: Float[Array, "n n *L"]) -> Float[Array, "n n *one"]:
    """Return the identity, with the axes of X."""
    n = X.shape[0]
    return jnp.eye(n, dtype=X.dtype).reshape(n, n, *(1,) * (X.ndim - 2))


def _halvings(X: Float[Array, "n n *L"]) -> Float[Array, "*L"]:
    """Return the number of halvings of X for the polynomial to be exact."""
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(X), axis=0), axis=0))
    return jnp.ceil(jnp.log2(jnp.maximum(norm, _THETA) / _THETA))


def _doubled(s: Float[Array, ""], double: Callable[[Any], Any], first: PyTree) -> PyTree:
    """Apply `double` s times; NaN if s is too large."""

    # A fixed number of passes with a branch, since a loop of s passes has no reverse mode.
    def step(i: Array | int, value: PyTree) -> PyTree:
        return jax.lax.cond(i < s, double, lambda value: value, value)

    last = jax.lax.fori_loop(0, _SQUARINGS, step, first)
    return jax.tree.map(lambda v: jnp.where(s <= _SQUARINGS, v, jnp.nan), last)


class VanLoan(NamedTuple):
    """Step of x' = A x + f + g w."""

    Phi: Float[Array, "n n"]
    """Transition matrix e^{A h}."""
    shift: Float[Array, " n"]
    """Contribution of f."""
    Q: Float[Array, "n n"]
    """Covariance contributed by w."""


def van_loan(
    A: Float[Array, "n n"], f: Float[Array, " n"], g: Float[Array, " n"], h: Scalar
) -> VanLoan:
    """Return a step of h [s] of x' = A x + f + g w, with unit white noise w for each state.

    Args:
        A: system matrix of scaled states [1/s].
        g: noise intensity [states per second times sqrt(s)].
        h: step [s], a number.

    The result is NaN if the norm exceeds the limit of `expm`.
    """
    # Series for a fraction of the step, then doubled. Van Loan (1978) uses exponentials of larger
    # matrices, but these contain e^{-A h}, which loses all digits for fast modes.
    d = _balance(jax.lax.stop_gradient(A))
    X = A * (d[None, :] / d[:, None]) * h
    s = _halvings(X)
    X, h = X * jnp.exp2(-s), h * jnp.exp2(-s)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)

    # Terms of degree k of e^{A h} and of the integrals of e^{A s} f and e^{A s} g g^T e^{A^T s}.
    # Each follows from the previous one.
    def term(carry: PyTree, k: Array) -> tuple[PyTree, None]:
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

    def double(whole: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        P, m, M = whole
        # Symmetrise, since rounding would grow with each doubling and Q would have no square root.
        through = product(product(P, M), P.T)
        return product(P, P), m + jnp.sum(P * m[None, :], axis=1), M + 0.5 * (through + through.T)

    P, m, M = _doubled(s, double, total)
    return VanLoan(P * (d[:, None] / d[None, :]), d * m, M * (d[:, None] * d[None, :]))


def product(X: Float[Array, "n k *L"], Y: Float[Array, "k m *L"]) -> Float[Array, "n m *L"]:
    """Return X Y; for small k as a sum of outer products, which is 5 times faster for a batch."""
    # A matrix product calls a routine for large matrices, while sums fuse with other operations.
    inner = X.shape[1]
    if inner > _SMALL:
        return X @ Y if X.ndim == 2 else jnp.einsum("ijl,jkl->ikl", X, Y)
    total = X[:, 0, None] * Y[0, None]
    for k in range(1, inner):
        total = total + X[:, k, None] * Y[k, None]
    return total


def _balance(M: Float[Array, "n n *L"]) -> Float[Array, "n *L"]:
    """Return powers of two d that balance M[i, j] d[j] / d[i] (Osborne)."""
    n = M.shape[0]
    off = jnp.abs(M) * (1.0 - _eye(M))
    places = jnp.arange(n).reshape(n, *(1,) * (M.ndim - 2))

    def balanced(k: Array, d: Array) -> Array:
        i = k % n
        column = jnp.sum(off[:, i] * (d[i][None] / d), axis=0)
        row = jnp.sum(off[i, :] * (d / d[i][None]), axis=0)
        both = (column > 0) & (row > 0)
        ratio = jnp.where(both, row, 1.0) / jnp.where(both, column, 1.0)
        change = jnp.exp2(jnp.round(0.5 * jnp.log2(ratio)))
        # Element-wise selection is faster than indexing for many small vectors.
        return jnp.where(places == i, d * change[None], d)

    return jax.lax.fori_loop(0, 3 * n, balanced, jnp.ones(M.shape[1:], M.dtype))
