"""Whether a search that says so has arrived at an optimum."""

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Float

from heli_jax.finding import Finding
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.multistart import gauss_newton_gain
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.free import Free
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.numbers import percent

_SHARE = 0.1
"""of the sum of squares that a modest step would take away, at most, at an optimum"""
_PER_UNKNOWN = 4.0
"""times what an unknown takes of white noise by chance: few samples explain much by nothing"""
_MODEST = 0.5
"""of a coordinate, most of them logarithms: a step for which the linear model still holds"""


def gain_left(
    r: Float[np.ndarray, " n"],
    J: Float[np.ndarray, "n q"],
    parameters: int,
    at_bound: Collection[int] = (),
) -> float | None:
    """The share of the sum of squares that a modest step would take away, where that is so much
    that no optimiser can have arrived; None where it is not.

    An optimiser calls its last step short and itself arrived also where every longer one failed,
    as among the roundings of a simulation that grows by orders of magnitude. What the data
    determine is then no question to ask of that point.

    Args:
        r: residuals with the rows of the priors, whitened.
        J: their derivatives by the unknowns.
        parameters: how many of these, the first, are parameters, of which a step has a size.
        at_bound: those of them that the optimiser may move no further.
    """
    if at_bound:
        J = np.delete(J, list(at_bound), axis=1)
        parameters -= len(at_bound)
    squares = float(np.sum(np.square(r)))
    least = squares * max(_SHARE, _PER_UNKNOWN * J.shape[1] / r.size)
    # Negated: also what is not finite is none of this function's business.
    if not gauss_newton_gain(r, J) > least:
        return None
    norms = np.linalg.norm(J, axis=0)
    units = np.where(norms > 0, norms, 1.0)
    left, singular, right = np.linalg.svd(J / units, full_matrices=False)
    along = left.T @ r
    with np.errstate(divide="ignore", over="ignore"):
        steps = np.abs(along / singular)[:, None] * np.abs(right / units)[:, :parameters]
        # What the linear model promises for a step to far beyond where it holds is worth nothing:
        # a time constant on its way to zero has such a slope, and no optimum to come to.
        part = np.minimum(1.0, _MODEST / np.maximum(steps.max(axis=1, initial=0.0), 1e-300))
    gain = float(np.sum((2.0 * part - part**2) * along**2))
    return gain / squares if gain > least else None


def unless_stuck(
    layout: Layout, optimum: RelaxedOptimum, e: Evaluation, free: Mapping[str, Free]
) -> RelaxedOptimum:
    """The optimum, no longer taken for one where its own slopes say that it is none.

    Args:
        layout: what the unknowns are.
        optimum: where the search ended.
        e: at that optimum.
        free: the bounds of the free parameters, by name.
    """
    # A filter's rows hold the level of its variances too, and have no squares to take a share of.
    if not (bool(optimum.best.converged) and layout.estimator.least_squares):
        return optimum
    # What lies beyond a bound is a gain that no optimiser may take.
    at_bound = [
        i
        for i, name in enumerate(layout.free)
        if transforms.at_bound(free[name], float(e.named[i]))
    ]
    r, J = np.asarray(e.r, np.float64), np.asarray(e.J, np.float64)
    share = gain_left(r, J, len(layout.free), at_bound)
    if share is None:
        return optimum
    words = (
        "The optimiser is stuck: by their slopes a modest step of the unknowns would take away "
        f"{percent(share, 0)} of the squares, and it went no further. So it is where a simulation "
        "grows by orders of magnitude, or parameters have a wrong sign. Remedy: windows (multiple "
        "shooting), a shorter record, or other starts. What the data determine is not known there."
    )
    best = optimum.best._replace(converged=np.asarray(False))
    stuck = Finding("search.stuck", "doubt", words, share, "part of the squares")
    return optimum._replace(best=best, notes=(stuck, *optimum.notes))
