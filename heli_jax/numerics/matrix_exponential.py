"""Matrix exponentials of small matrices, many side by side, and the integrals beside them.

Three ways through the same polynomial. `expm` without derivatives takes a whole batch with as many
squarings as its worst matrix needs; with derivatives it runs in loops of fixed length, which both
modes can go through; `van_loan` carries the integrals of drift and noise along.
"""

# Why not jax.scipy.linalg.expm: `experiments/benchmarks/sweeps.py` discretises a model for each of
# its elements and `experiments/benchmarks/identification.py` for each evaluation of a fit. There
# jax.scipy's Pade form takes twice as long to compile, and its linear solve does not run side by
# side over a batch of small matrices.

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from heli_jax.naming import Scalar

_DEGREE = 12
"""of Taylor's polynomial"""
_THETA = 0.3
"""norm up to which the polynomial is exact: (0.3)^13 / 13! is below half an ulp of 1"""
_SQUARINGS = 24
"""at most: what needs more holds modes too fast for any sample time"""
_SMALL = 8
"""inner dimension up to which a product is written out"""


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
    """The exponential without derivatives, as in sweeps."""
    return _many(M[:, :, None])[:, :, 0]


@_side_by_side.def_vmap
def _side_by_side_batched(
    size: int, batched: list[bool], M: Float[Array, "L n n"]
) -> tuple[Float[Array, "L n n"], bool]:
    # Matrices last beside each other, so that the processor takes several of them at a time.
    return jnp.moveaxis(_many(jnp.moveaxis(M, 0, 2)), 2, 0), True


def _many(M: Float[Array, "n n L"]) -> Float[Array, "n n L"]:
    """The exponentials of L matrices, with no more squarings than one of them needs."""
    # A flybar has Omega^2 = 2e4 beside 1 in its A: balanced, the norm falls to about Omega, and
    # with it seven squarings. Powers of two, so that nothing is rounded.
    d = _balance(M)
    X = M * (d[None, :] / d[:, None])
    s = _halvings(X)[None, None]
    E = _taylor(X * jnp.exp2(-s))
    count = jnp.max(jnp.where(s <= _SQUARINGS, s, 0.0)).astype(int)
    # Each matrix is squared as often as itself needs: one more squaring would be another number.
    E = jax.lax.fori_loop(0, count, lambda i, E: jnp.where(i < s, product(E, E), E), E)
    E = jnp.where(s <= _SQUARINGS, E, jnp.nan)
    return E * (d[:, None] / d[None, :])


@expm.defjvp
def _expm_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # A loop whose length depends on its input has no reverse mode, so derivatives go through the
    # other form; the value comes from there too, and differs in the last digit at most.
    return jax.jvp(_expm_in_loops, primals, tangents)


def _expm_in_loops(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The same in loops of fixed length, which have derivatives of both modes."""
    # The result does not depend on d and s but for rounding: no derivative goes through them.
    d = _balance(jax.lax.stop_gradient(M))
    X = M * (d[None, :] / d[:, None])
    s = _halvings(X)
    E = _doubled(s, lambda E: product(E, E), _taylor(X * jnp.exp2(-s)))
    return E * (d[:, None] / d[None, :])


def _taylor(X: Float[Array, "n n *L"]) -> Float[Array, "n n *L"]:
    eye = _eye(X)
    # Loops rather than unrolled sums: they run as fast and compile in half the time.
    # Horner's scheme, from the highest term.
    degrees = jnp.arange(_DEGREE, 0, -1, dtype=X.dtype)
    begin = jnp.broadcast_to(eye, X.shape)
    return jax.lax.scan(lambda E, k: (eye + product(X, E) / k, None), begin, degrees)[0]


def _eye(X: Float[Array, "n n *L"]) -> Float[Array, "n n *one"]:
    """The identity, with the axes of X."""
    n = X.shape[0]
    return jnp.eye(n, dtype=X.dtype).reshape(n, n, *(1,) * (X.ndim - 2))


def _halvings(X: Float[Array, "n n *L"]) -> Float[Array, "*L"]:
    """Return how often to halve X for the polynomial to be exact."""
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(X), axis=0), axis=0))
    return jnp.ceil(jnp.log2(jnp.maximum(norm, _THETA) / _THETA))


def _doubled(s: Float[Array, ""], double: Callable[[Any], Any], first: PyTree) -> PyTree:
    """`double` applied s times; NaN where that is too often."""

    # A fixed number of passes with a branch in each, not a loop of s: that has no reverse mode.
    def step(i: Array | int, value: PyTree) -> PyTree:
        return jax.lax.cond(i < s, double, lambda value: value, value)

    last = jax.lax.fori_loop(0, _SQUARINGS, step, first)
    return jax.tree.map(lambda v: jnp.where(s <= _SQUARINGS, v, jnp.nan), last)


class VanLoan(NamedTuple):
    """Step of x' = A x + f + g w."""

    Phi: Float[Array, "n n"]
    """e^{A h}"""
    shift: Float[Array, " n"]
    """what f adds"""
    Q: Float[Array, "n n"]
    """covariance that w adds"""


def van_loan(
    A: Float[Array, "n n"], f: Float[Array, " n"], g: Float[Array, " n"], h: Scalar
) -> VanLoan:
    """A step of h [s] of x' = A x + f + g w, with a white noise w of unit intensity a state.

    Args:
        A: 1/s, of scaled states.
        g: the noise intensity, states per second times sqrt(s).
        h: the step [s], a number.

    Where the norm is past what `expm` takes the result is NaN.
    """
    # The series of a fraction of the step, doubled until it is whole. Van Loan (1978) takes the
    # same integrals from exponentials of larger matrices; these hold e^{-A h}, and no digit of them
    # is left where a mode decays fast.
    d = _balance(jax.lax.stop_gradient(A))
    X = A * (d[None, :] / d[:, None]) * h
    s = _halvings(X)
    X, h = X * jnp.exp2(-s), h * jnp.exp2(-s)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)

    # Terms of degree k of e^{A h}, of the integral of e^{A s} f and of that of e^{A s} g g^T e^{A^T
    # s}, each from the one before.
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
        # Symmetric by force: else rounding grows with each doubling, and Q has no root.
        through = product(product(P, M), P.T)
        return product(P, P), m + jnp.sum(P * m[None, :], axis=1), M + 0.5 * (through + through.T)

    P, m, M = _doubled(s, double, total)
    return VanLoan(P * (d[:, None] / d[None, :]), d * m, M * (d[:, None] * d[None, :]))


def product(X: Float[Array, "n k *L"], Y: Float[Array, "k m *L"]) -> Float[Array, "n m *L"]:
    """X Y; for small k as a sum of outer products, which takes a batch of them 5 times faster."""
    # A matrix product calls a routine that is made for large matrices; sums fuse with what is
    # around them.
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

    def balanced(k: Array, d: Array) -> Array:
        i = k % n
        column = jnp.sum(off[:, i] * (d[i][None] / d), axis=0)
        row = jnp.sum(off[i, :] * (d / d[i][None]), axis=0)
        both = (column > 0) & (row > 0)
        ratio = jnp.where(both, row, 1.0) / jnp.where(both, column, 1.0)
        change = jnp.exp2(jnp.round(0.5 * jnp.log2(ratio)))
        # Not by index: many small vectors side by side are changed element by element faster.
        return jnp.where(places == i, d * change[None], d)

    return jax.lax.fori_loop(0, 3 * n, balanced, jnp.ones(M.shape[1:], M.dtype))
