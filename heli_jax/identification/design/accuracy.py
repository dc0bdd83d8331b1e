"""Expected standard deviations before a fit.

Rows of the whitened Jacobian at the start values are samples. The information of a part of a record
is that of its rows, with its own initial states, biases and input offsets projected out. It is
carried as a factor R of Fisher's matrix R'R; the factor of two parts together is that of both, one
above the other.
"""

import math

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation.evaluation import deviations
from heli_jax.identification.identifiability.analysis import NO_EFFECT, Sensitivity, projected
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.transforms import scale


def triangle(s: Sensitivity) -> Float[np.ndarray, "s s"]:
    """Return the factor of the information on the shared unknowns, with all others free."""
    # Without the unknowns that have no effect on these rows: nearly all of a long record.
    return projected(s.shared, s.own[:, np.linalg.norm(s.own, axis=0) > NO_EFFECT])


def together(*triangles: np.ndarray) -> Float[np.ndarray, "s s"]:
    """Return the factor of several parts of the data with the same shared unknowns."""
    return np.linalg.qr(np.vstack(triangles), mode="r")


def expected_sd(
    unknowns: tuple[Unknown, ...], R: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, " q"]:
    """Return expected standard deviations of the parameters of interest in relative coordinates;
    infinite for those that data and priors do not determine."""
    q = len(unknowns)
    prior = np.hstack([np.diag([u.prior for u in unknowns]), np.zeros((q, R.shape[1] - q))])
    rows = np.vstack([R, prior])
    # Parameters of the noise without effect are no unknowns.
    felt = np.any(rows != 0.0, axis=0) | (np.arange(R.shape[1]) < q)
    return deviations(rows[:, felt])[:q]


DETERMINES = 1.0
"""relative sd below which a parameter is determined"""
GUESSED = "guessed: too small if the log was smoothed; state the output's sd"
"""remark on a noise that nobody stated"""


def starting_at_zero(problem: Problem) -> dict[str, tuple[float, str]]:
    """Return the unit of the relative coordinate [SI], and its name, of each free parameter that
    starts at zero."""
    return {
        n: (scale(f), naming.unit(problem.model.Params, n) or "1")
        for n, f in problem.free.items()
        if f.start == 0
    }


def unstated_gusts(problem: Problem) -> list[str]:
    """Return the sizes of disturbances that are not stated; none without process noise."""
    if problem.noise_model != "disturbance":
        return []
    sizes = [d.sigma for d in disturbances_of(problem.model)]
    stated = {n: float(getattr(problem.vehicle, n)) for n in sizes}
    return [n for n, size in stated.items() if not (math.isfinite(size) and size > 0.0)]
