"""Units in which Levenberg-Marquardt sees the unknowns, and which unknowns may move at all."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from heli_jax.identification.unknowns.layout import Layout

COLUMN = 300.0
"""Column norm of the scaled Jacobian at the start: optimistix begins with damping 1, which is
then a hundred-thousandth of J'J; a step that fails raises it tenfold."""

_SMALL = 1e-12
"""part of the largest column norm below which a column may be what rounding leaves of none"""
_TRIAL = 1e-3
"""part of the residuals' norm by which a small column should change them when it is tried"""


class Scaling(NamedTuple):
    """Units in which the optimiser sees a start: z = z0 + unit * xi, residuals / residual_norm."""

    unit: Float[Array, " q"]
    """0 for an unknown that stays put"""
    residual_norm: Float[Array, ""]


@jax.jit
def scaling(r0: Float[Array, " n"], J0: Float[Array, "n q"], trusted: Bool[Array, " q"]) -> Scaling:
    """Columns of equal norm and a cost of order one; an unknown without effect stays put.

    Args:
        r0: residuals at the start.
        J0: their Jacobian.
        trusted: the unknowns whose column counts however small it is beside the others.
    """
    norms = jnp.linalg.norm(J0, axis=0)
    # A column that overflowed has no size: its unknown stays put too.
    norms = jnp.where(jnp.isfinite(norms), norms, 0.0)
    usable = (norms > _SMALL * jnp.max(norms)) | (trusted & (norms > 0))
    # Zero at the truth of a simulated record without noise.
    size = jnp.maximum(jnp.linalg.norm(r0), 1e-300)
    return Scaling(jnp.where(usable, COLUMN * size / jnp.where(usable, norms, 1.0), 0.0), size)


def without_size(layout: Layout) -> np.ndarray:
    """(q,) the unknowns that are no logarithms and so have no size of their own."""
    linear = [kind == "linear" for kind in layout.kinds] + [True] * len(layout.gains)
    return np.array(linear + [False] * (layout.size - len(linear)), bool)


def nothing_trusted(layout: Layout) -> np.ndarray:
    """(q,) of False."""
    return np.zeros(layout.size, bool)


def trusted_columns(
    layout: Layout,
    evaluate: Callable[[Array], tuple[Array, Array]],
    z: Float[Array, " q"],
    r: Float[Array, " n"],
    J: Float[Array, "n q"],
) -> np.ndarray:
    """(q,) the unknowns without a size of their own whose columns are small beside the largest, and
    yet say what the residuals do.

    Args:
        layout: what stands where in z.
        evaluate: residuals and Jacobian at a point.
        z: where.
        r: the residuals there.
        J: their Jacobian.
    """
    # Of parameters of 1e6 and 1e-8 the columns differ by 1e14 for their units alone. Rounding may
    # leave as little of a column that is zero; it does not foretell what the residuals do.
    trusted = nothing_trusted(layout)
    norms = np.linalg.norm(np.asarray(J), axis=0)
    small = (norms > 0) & (norms <= _SMALL * np.max(norms, initial=0.0)) & without_size(layout)
    for i in np.flatnonzero(small):
        step = _TRIAL * max(float(jnp.linalg.norm(r)), 1.0) / norms[i]
        foretold = np.asarray(J)[:, i] * step
        with np.errstate(all="ignore"):  # so small a column that the step overflows
            change = np.asarray(evaluate(z.at[i].add(step))[0]) - np.asarray(r)
            missed = np.linalg.norm(change - foretold)
        trusted[i] = bool(missed < 0.5 * np.linalg.norm(foretold))
    return trusted


def awakened(unit: np.ndarray, J: np.ndarray, trusted: np.ndarray) -> np.ndarray:
    """(q,) the unknowns that stayed put in a run and have an effect where it ended.

    Args:
        unit: (q,) of the run, 0 for what stayed put.
        J: (n, q) the Jacobian at its end.
        trusted: (q,) whose column there counts however small it is.
    """
    norms = np.linalg.norm(J, axis=0)
    usable = (norms > _SMALL * np.max(norms, initial=0.0)) | trusted
    return (unit == 0) & usable & np.isfinite(norms)
