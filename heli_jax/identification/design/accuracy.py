"""Expected standard deviations before a fit, by parts of a record at the start values.

Rows of the whitened Jacobian are samples. The information of a window is that of its rows, with its
own initial states, biases and input offsets projected out. It is carried as a factor R of Fisher's
matrix R'R; the factor of two parts together is that of both, one above the other.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.identifiability.analysis import NO_EFFECT, projected, relative_rows
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.identification.unknowns.transforms import scale


class Sensitivity(NamedTuple):
    """The rows of the data at one point, columns in relative coordinates."""

    unknowns: tuple[Unknown, ...]
    """the parameters of interest"""
    shared: Float[np.ndarray, "n s"]
    """by the parameters of interest, then by the noise's parameters of filter error"""
    own: Float[np.ndarray, "n k"]
    """by initial states, biases and input offsets, in sds of their weak priors"""

    def part(self, rows: np.ndarray) -> "Sensitivity":
        """Return some of the rows."""
        return self._replace(shared=self.shared[rows], own=self.own[rows])


def sensitivity_at(problem: Problem, layout: Layout, e: Evaluation) -> Sensitivity:
    """Return the rows of the data of an evaluation."""
    unknowns, sensitivity, others = relative_rows(problem, layout, e)
    # The first of the other unknowns are shared by all flights.
    count = layout.first_nuisance - len(unknowns)
    shared = np.hstack([sensitivity, others[:, :count]])
    return Sensitivity(unknowns, shared, others[:, count:])


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
