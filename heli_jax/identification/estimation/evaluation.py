"""Residuals, Jacobian and simulation at one point as NumPy arrays, and their linear algebra."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.estimation.simulated_flights import by_output, simulated_at
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.numerics.jitted import jitted

NULL = 1e-8
"""Fraction of the largest singular value, with columns of equal size, below which a direction is
not determined; its square is rounding in float64."""
_TAKES_PART = 1e-3
"""Component in a direction without effect above which a coordinate is not determined either."""


class Evaluation(NamedTuple):
    """Residuals, Jacobian and simulation at one point."""

    simulated: tuple[dict[str, np.ndarray], ...]
    """Simulation with the bias, SI, by flight and output (N,)."""
    raw: tuple[dict[str, np.ndarray], ...]
    """Measured less simulated, SI, by flight and output (N,); NaN without measurement."""
    innovations: tuple[Innovations, ...]
    r: np.ndarray
    """Whitened residuals with the rows of the priors (n,)."""
    J: np.ndarray
    """Derivative of r by z (n, q)."""
    named: np.ndarray
    """Values of the named unknowns, in their units."""
    slopes: np.ndarray
    """Derivatives of the named values by their coordinates."""
    z: np.ndarray
    """Unknowns (q,)."""
    cost: float
    """See `ResidualAndJacobian`."""


def evaluate(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Evaluation:
    """Evaluate residuals, Jacobian, simulation and named unknowns at a point."""
    at = residual_and_jacobian(layout, data, noise, z)
    # Output-error residuals already contain a simulation; filter innovations do not.
    runs = simulated_at(layout, data, z) if at.simulated is None else at.simulated
    # Everything is fetched at once, with one wait for the device.
    runs, innovations, r, J, cost, values, slopes = jax.device_get(
        (runs, at.innovations, at.r, at.J, at.cost, *named(layout, data, z))
    )
    simulated = by_output(layout, runs)
    raw = tuple(
        {n: np.asarray(flight.outputs[n]) - v for n, v in run.items()}
        for flight, run in zip(data.flights, simulated, strict=True)
    )
    return Evaluation(simulated, raw, innovations, r, J, values, slopes, np.asarray(z), float(cost))


def simulated_outputs(
    layout: Layout, data: Data, z: Float[Array, " q"]
) -> tuple[dict[str, np.ndarray], ...]:
    """Return the simulation with the bias by flight and output (N,), SI."""
    return by_output(layout, jax.device_get(simulated_at(layout, data, z)))


@jitted
def named(layout: Layout, data: Data, z: Float[Array, " q"]) -> tuple[Array, Array]:
    """Return parameters, gains and time shift [SI], and their derivatives by the coordinates."""

    def values(z: Array) -> Array:
        u = unpack(layout, data, z)
        shift = () if u.shift is None else (u.shift,)
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    # Each value depends on its own coordinate alone, so the rest of the Jacobian is zero.
    return values(z), jnp.diagonal(jax.jacfwd(values)(z))


def deviations(J: np.ndarray) -> np.ndarray:
    """Return the standard deviations (q,) of all coordinates from whitened rows (n, q).

    They are infinite for a coordinate without effect or with a component in a direction without
    effect.
    """
    # A diverged simulation determines nothing.
    if not np.isfinite(J).all():
        return np.full(J.shape[1], np.inf)
    norms, sizes, right = _svd(J)
    kept = sizes > NULL * sizes[0]
    lost = np.abs(right[~kept]) > _TAKES_PART
    sds = np.linalg.norm(right[kept] / sizes[kept, None], axis=0) / norms
    return np.where(lost.any(axis=0), np.inf, sds)


def directions(J: np.ndarray, least: float = NULL) -> np.ndarray:
    """Return orthonormal directions (n, k) in which the unknowns move finite rows (n, q).

    Args:
        least: fraction of the largest singular value, with columns of equal size, below which a
            direction is rounding or dependent.
    """
    norms, sizes, right = _svd(J)
    seen = sizes > least * max(sizes[0], 1e-300)
    return J / norms @ (right[seen].T / sizes[seen])


def pseudoinverse(J: np.ndarray) -> np.ndarray:
    """Return the pseudoinverse (q, n) of rows (n, q), computed with columns of equal size."""
    norms, sizes, right = _svd(J)
    kept = sizes > NULL * sizes[0]
    V = right[kept].T / sizes[kept]
    return V @ (J / norms @ V).T / norms[:, None]


def _svd(J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return column norms of J (n, q), and singular values (q,) and right singular vectors (q, q)
    of J with unit columns.

    Unit columns make the result independent of units.
    """
    J = np.asarray(J, np.float64)
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    # J'J is avoided because its small eigenvalues are rounding. The triangular factor has the same
    # singular values with q rows instead of n.
    _, sizes, right = np.linalg.svd(np.linalg.qr(J / norms, mode="r"))
    # With fewer rows than unknowns some directions have no effect.
    return norms, np.concatenate([sizes, np.zeros(J.shape[1] - sizes.size)]), right
