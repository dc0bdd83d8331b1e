"""Everything that one point tells, for what is not compiled."""

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
"""part of the largest singular value, of columns of one size, below which the data do not determine
a direction: the square of that is rounding in float64"""
_TAKES_PART = 1e-3
"""part of a unit direction without effect from which on a coordinate is lost with it"""


class Evaluation(NamedTuple):
    """Everything that one point tells, as NumPy arrays."""

    simulated: tuple[dict[str, np.ndarray], ...]
    """with the bias, SI, by flight and output (N,)"""
    raw: tuple[dict[str, np.ndarray], ...]
    """measured - simulated, SI, by flight and output (N,); NaN where nothing is measured"""
    state_rms: np.ndarray
    """(flights, states) root mean square of each simulated state"""
    innovations: tuple[Innovations, ...]
    r: np.ndarray
    """(n,) whitened residuals with the rows of the priors"""
    J: np.ndarray
    """(n, q) derivative of r by z"""
    named: np.ndarray
    """values of the named unknowns, in their units"""
    slopes: np.ndarray
    """their derivatives by their own coordinates"""
    z: np.ndarray
    """(q,) where it is"""


def evaluate(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Evaluation:
    """Residuals and their Jacobian, the simulation, and the named unknowns."""
    at = residual_and_jacobian(layout, data, noise, z)
    # Output error has simulated on its way; a filter predicts one step ahead, which is no run.
    outputs = simulated_at(layout, data, z) if at.simulated is None else at.simulated
    # Fetched all at once: every fetch by itself would wait for the device.
    outputs, innovations, r, J, values, slopes = jax.device_get(
        (outputs, at.innovations, at.r, at.J, *named(layout, data, z))
    )
    simulated = by_output(layout, outputs)
    raw = tuple(
        {n: np.asarray(flight.outputs[n]) - v for n, v in run.items()}
        for flight, run in zip(data.flights, simulated, strict=True)
    )
    rms = outputs.state_rms
    return Evaluation(simulated, raw, rms, innovations, r, J, values, slopes, np.asarray(z))


def simulated_outputs(
    layout: Layout, data: Data, z: Float[Array, " q"]
) -> tuple[dict[str, np.ndarray], ...]:
    """By flight and output the simulation (N,) with the bias, SI."""
    return by_output(layout, jax.device_get(simulated_at(layout, data, z)))


@jitted
def named(layout: Layout, data: Data, z: Float[Array, " q"]) -> tuple[Array, Array]:
    """Values of parameters, gains and time shift [SI], and their slopes by the coordinates."""

    def values(z: Array) -> Array:
        u = unpack(layout, data, z)
        shift = () if u.shift is None else (u.shift,)
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    # Each depends on its own coordinate alone: the rest of the Jacobian is zero.
    return values(z), jnp.diagonal(jax.jacfwd(values)(z))


def deviations(J: np.ndarray) -> np.ndarray:
    """Standard deviations (q,) of all coordinates from whitened rows (n, q).

    Infinite for a coordinate without effect, and for those that take part in a direction without:
    what leaves no trace in the rows is not known, rather than known exactly.
    """
    return combined_deviations(J, np.eye(J.shape[1]), NULL, _TAKES_PART)


def combined_deviations(
    J: np.ndarray, combinations: np.ndarray, no_effect: float, takes_part: float
) -> np.ndarray:
    """Standard deviations (k,) of combinations of coordinates from whitened rows.

    Args:
        J: the rows (n, q).
        combinations: (k, q).
        no_effect: part of the largest singular value below which a direction has no effect.
        takes_part: part of such a direction from which on a combination is lost with it.
    """
    J = np.asarray(J, dtype=np.float64)
    # A simulation that diverged tells nothing.
    if not np.isfinite(J).all():
        return np.full(len(combinations), np.inf)
    # Columns of one size, so that what counts as no effect does not hang on units.
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    # Singular values of J itself and not of J'J, whose small ones, their squares, are rounding.
    # Those of its triangle are the same, and it has q rows instead of n.
    _, sizes, right = np.linalg.svd(np.linalg.qr(J / norms, mode="r"))
    # Fewer rows than unknowns: what is missing are directions without effect.
    sizes = np.concatenate([sizes, np.zeros(J.shape[1] - sizes.size)])
    kept = sizes > no_effect * sizes[0]
    along = (combinations / norms) @ right.T
    lengths = np.linalg.norm(combinations / norms, axis=1)
    lost = np.abs(along[:, ~kept]) > takes_part * lengths[:, None]
    sds = np.linalg.norm(along[:, kept] / sizes[kept], axis=1)
    return np.where(lost.any(axis=1), np.inf, sds)


def directions(J: np.ndarray, least: float = NULL) -> np.ndarray:
    """Orthonormal directions (n, k) in which the unknowns move finite rows (n, q).

    Args:
        least: part of the largest singular value of columns of one size, below which a direction is
            rounding, or says nothing that the others do not.
    """
    norms = np.linalg.norm(J, axis=0)
    J = np.asarray(J, np.float64) / np.where(norms > 0, norms, 1.0)
    # Singular values of J's triangle are those of J, and it has q rows instead of n.
    _, sizes, right = np.linalg.svd(np.linalg.qr(J, mode="r"), full_matrices=False)
    seen = sizes > least * max(sizes[0], 1e-300)
    return J @ (right[seen].T / sizes[seen])


def pseudoinverse(J: np.ndarray) -> np.ndarray:
    """Return the pseudoinverse (q, n) of rows (n, q), with columns brought to one size first."""
    # The cut is on singular values, and units of the unknowns must not decide what it takes.
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    # The triangle has the same singular values, and q rows instead of n.
    Q, R = np.linalg.qr(np.asarray(J, np.float64) / norms)
    return np.linalg.pinv(R, rcond=NULL) @ Q.T / norms[:, None]
