r"""The rows that frequency error makes small: as many as unknowns, and one for what is left.

With whitened errors $e$, their derivatives $J$ by the unknowns and instruments $Z$, the estimate
solves $Z^T e = 0$. The rows $r = R^{-T} Z^T e$ with $R^T R = Z^T Z$ have the identity as their
covariance, and their derivative $R^{-T} Z^T J$ the information of the estimate,
$M^T (Z^T Z)^{-1} M$ with $M = Z^T J$. Directly $Z = J$, and with the row $|e - J J^+ e|$ beside
them the sum of squares is that of all errors: maximum likelihood, in a few rows. By instrument $Z$
are the derivatives of the response to what of the inputs follows the instruments.

Sources: Söderström and Stoica (1983) for estimates by instrument and their covariance; Pintelon and
Schoukens (2012), chapter 9.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.estimation.frequency_slopes import Products, products_of_lines
from heli_jax.identification.estimation.shared_unknowns import shared_of, with_shared
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns

_NOTHING = 100.0
"""times the machine's precision: what of the information, of columns of one size, is rounding"""


def rows_of_lines(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Float[Array, " r"]:
    """Those rows, with the derivative that a step of Gauss and Newton needs.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: with the whitening of each record, and whether instruments are used.
        u: the unknowns, in the units of the model.
    """
    v = shared_of(layout, u)
    at, rest = jax.lax.stop_gradient((v, u))
    made = products_of_lines(layout, data, noise, at, lambda v: with_shared(layout, rest, v))
    r, M = _weighed(made)
    left = jnp.sqrt(jnp.maximum(made.ee - jnp.sum(r**2), 0.0))
    left = jnp.where(noise.by_instrument > 0.5, 0.0, left)
    r, M, left = jax.lax.stop_gradient((r, M, left))
    # The derivative is exactly M, whatever else moves with the unknowns.
    return jnp.append(r + M @ (v - at), left)


def _weighed(of: Products) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """R^-T Z e and R^-T Z J^T, with R^T R = Z Z^T; zero along what is no direction of Z."""
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(of.ZZ), 0.0))
    # Of one size: units do not decide what is rounding.
    over = jnp.where(sizes > 0, 1.0 / jnp.where(sizes > 0, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(of.ZZ * over[:, None] * over[None, :])
    kept = values > _NOTHING * jnp.finfo(values.dtype).eps * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    along = root[:, None] * vectors.T * over[None, :]
    return along @ of.Ze, along @ of.ZJ
