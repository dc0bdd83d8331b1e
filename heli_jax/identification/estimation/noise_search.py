"""A first guess of the disturbances: the greatest likelihood on a coarse grid."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.dynamics.model import Disturbance
from heli_jax.identification.estimation.residual import rows_of
from heli_jax.identification.unknowns.layout import Data, Layout, Noise
from heli_jax.numerics.jitted import jitted

_DECADES = np.log(10.0) * np.arange(-3.0, 2.5)
"""by which the coarse search moves sigma_w"""
_FINER, _ROUNDS = 0.2, 3
"""decades between the points of a finer search, and how often it is done: a round reaches 0.4
decades up and 0.6 down"""
_TAUS = 3
"""correlation times between a few samples and a part of the record, from which a search that ran
to an end is begun again; with the decades as many points as the coarse search has"""


def noise_guess_at(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z0 with sigma_w and tau_w of the greatest likelihood on a coarse grid about it; of several
    disturbances first all together, then each by itself.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where the grid has its middle.
    """
    z = one_noise_guess(layout, data, noise, z0, layout.disturbance)
    # A grid over all at once would have 18 to the power of their number.
    several = [d for d in disturbances_of(layout.model) if d.sigma in layout.disturbance]
    for d in several if len(several) > 1 else []:
        z = one_noise_guess(layout, data, noise, z, (d.sigma, d.tau))
    return z


def one_noise_guess(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    names: tuple[str, ...],
    width: float = 1.0,
) -> Float[Array, " q"]:
    """z0 with the named parameters of disturbances moved together, by the same factors of every
    sigma and of every tau, to the greatest likelihood on a coarse grid about it.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where the grid has its middle.
        names: of the parameters; those that are no unknowns stay.
        width: of the grid, in decades between its points.
    """
    # Decades: from a disturbance far too faint the likelihood has no slope that leads back.
    steps = {
        "sigma": _DECADES,
        "tau": np.log(10.0) * np.arange(-1, 2),
    }
    # One factor for all sigmas and one for all taus: the grid stays two-dimensional however many
    # disturbances there are.
    kinds = {n: "sigma" if n in layout.sigmas else "tau" for n in layout.disturbance if n in names}
    used = [k for k in steps if k in kinds.values()]
    grid = np.stack(np.meshgrid(*(steps[k] for k in used), indexing="ij"), axis=-1)
    grid = grid.reshape(-1, len(used))
    points = np.tile(np.asarray(z0), (grid.shape[0], 1))
    for name, kind in kinds.items():
        points[:, layout.disturbance_at(name)] += width * grid[:, used.index(kind)]
    costs = np.asarray(costs_at(layout, data, noise, jnp.asarray(points, z0.dtype)))
    # A filter may overflow at the ends of the grid: such a point is no candidate, and no failure.
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    return jnp.asarray(points[best], z0.dtype)


def finer_noise_guess(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z with each disturbance of the greatest likelihood about it, to a tenth of a decade or so.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z: of the coarse search.
    """
    # As many points as the coarse search has: what was compiled for it serves here too.
    for _ in range(_ROUNDS):
        for d in disturbances_of(layout.model):
            if {d.sigma, d.tau} & set(layout.disturbance):
                z = one_noise_guess(layout, data, noise, z, (d.sigma, d.tau), _FINER)
    return z


def noise_guesses_by_tau(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"], d: Disturbance
) -> list[Float[Array, " q"]]:
    """z0 with one disturbance at correlation times from five samples to a fifth of the longest
    record, sigma_w of the greatest likelihood on a coarse grid for each; the most likely first.

    Args:
        layout: what the unknowns are, d.tau among them.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where the grid of sigma_w has its middle.
        d: the disturbance.
    """
    dt = min(float(f.dt) for f in data.flights)
    longest = max(float(f.dt) * next(iter(f.outputs.values())).shape[0] for f in data.flights)
    first, last = sorted((5.0 * dt, 0.2 * longest))
    decades = _DECADES if d.sigma in layout.disturbance else np.zeros(1)
    points = np.tile(np.asarray(z0), (_TAUS, decades.size, 1))
    points[..., layout.disturbance_at(d.tau)] = np.log(np.geomspace(first, last, _TAUS))[:, None]
    if d.sigma in layout.disturbance:
        points[..., layout.disturbance_at(d.sigma)] += decades
    flat = jnp.asarray(points.reshape(-1, points.shape[-1]), z0.dtype)
    costs = np.asarray(costs_at(layout, data, noise, flat)).reshape(points.shape[:2])
    costs = np.where(np.isfinite(costs), costs, np.inf)
    best = points[np.arange(_TAUS), np.argmin(costs, axis=1)]
    return [jnp.asarray(best[i], z0.dtype) for i in np.argsort(costs.min(axis=1))]


@jitted
def costs_at(
    layout: Layout, data: Data, noise: Noise, points: Float[Array, "s q"]
) -> Float[Array, " s"]:
    """The mean of the squared rows at each of some points.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        points: in the layout's coordinates.
    """
    # One point after another: side by side they would need the memory of as many filters, for a
    # search of a few points.
    return jax.lax.map(lambda z: jnp.mean(jnp.square(rows_of(layout, data, noise, z))), points)
