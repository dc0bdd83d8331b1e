"""Profile likelihood: what a parameter may be when all others adapt to it."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.many_runs import optimise_many
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.identification.result import Fit
from heli_jax.identification.unknowns.layout import Solution, value_of

_REACHES = (3.0, 9.0)
"""standard deviations to either side; the second only where the first holds no whole interval"""


class Profile(NamedTuple):
    """The likelihood along one parameter, everything else at its best there."""

    values: np.ndarray
    """(k,) in the parameter's unit, rising in size"""
    deviance: np.ndarray
    """(k,) twice the log-likelihood lost (priors included); NaN where the optimiser failed"""
    lower95: float
    upper95: float
    """where the deviance passes 3.84; NaN where it does not within nine standard deviations"""


def profile(
    fit: Fit, names: Sequence[str] | None = None, *, points: int = 13
) -> dict[str, Profile]:
    """Profiles of the chosen free parameters (all that the data determine, unless given).

    White residuals are taken for granted. All points of a parameter are optimised together.

    Args:
        fit: with the optimum that the profiles go through.
        names: of free parameters.
        points: of each profile; odd, so that the optimum is one of them.

    Raises:
        ValueError: a name is not free, or the data do not determine it.
    """
    for name in names or ():
        if name not in fit.estimates:
            raise ValueError(f"profile: expected one of {', '.join(fit.estimates)}, got {name}")
        if name in fit.not_identifiable:
            raise ValueError(f"profile of {name}: the data do not determine it")
    chosen = names or [n for n in fit.estimates if n not in fit.not_identifiable]
    return {name: _profile(fit.reached, name, points) for name in chosen}


def _profile(at: Solution, name: str, points: int) -> Profile:
    i = at.layout.free.index(name)
    e = evaluate(at.layout, at.data, at.noise, at.z)
    # Where the others go to first order as this one moves: the column of the covariance.
    inverse = np.linalg.pinv(np.asarray(e.J, np.float64), rcond=1e-10)
    along = inverse @ inverse[i]
    sd = float(np.sqrt(along[i]))
    first = float(np.sum(np.asarray(e.r) ** 2)) / measured_count(at.data)
    result = Profile(np.array([]), np.array([]), np.nan, np.nan)
    for reach in _REACHES:
        t = np.linspace(-reach, reach, points)
        # Where the quadratic approximation has them, so that few steps are left.
        starts = np.asarray(at.z) + t[:, None] * along[None, :] / sd
        ends = optimise_many(
            at, lambda _: at.data, jnp.asarray(starts, at.z.dtype), jnp.zeros(points), hold=i
        )
        cost = np.where(ends.converged, ends.cost, np.nan)
        n = measured_count(at.data)
        # Filter error has the noise at its best too, output error keeps it: the method says which.
        drop = at.layout.estimator.deviance(at.layout, cost, first, n)
        # A point may lie below the optimum, which converged to its own tolerance only.
        deviance = np.maximum(drop - min(0.0, np.nanmin(drop, initial=0.0)), 0.0)
        root = np.sign(t) * np.sqrt(deviance)
        low, high = (_crossing(root, starts[:, i], side * Z95) for side in (-1, 1))
        z = jnp.asarray([low, high, *starts[:, i]], at.z.dtype)
        values = np.asarray(value_of(at.layout, at.data, i, z))
        # Negative parameters fall as their logarithm rises; what is missing comes last.
        bounds = sorted((float(v) for v in values[:2]), key=lambda v: (np.isnan(v), v))
        result = Profile(values[2:], deviance, *bounds)
        if np.isfinite(bounds).all():
            break
    return result


def _crossing(root: np.ndarray, z: np.ndarray, limit: float) -> float:
    """z where the signed root of the deviance, nearly a straight line, passes the limit."""
    # Of a quadratic likelihood it is a straight line, and interpolation between points is exact.
    seen = np.isfinite(root)
    root, z = root[seen], z[seen]
    order = np.argsort(root)
    if not root.size or not root[order[0]] <= limit <= root[order[-1]]:
        return float("nan")
    return float(np.interp(limit, root[order], z[order]))
