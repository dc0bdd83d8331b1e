"""Expected standard deviations before a fit, from what parts of a record tell at the start values.

Rows of the whitened Jacobian are samples, so the information of a part of the record (some outputs,
a window) is that of its rows, with what belongs to the part alone (initial states, biases, input
offsets) projected out. Information is carried as a triangle R, where R'R is Fisher's matrix: that
of two parts together is the triangle of both, one above the other.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.finding import Finding, found
from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.identifiability.analysis import relative_rows
from heli_jax.identification.identifiability.directions import projected
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.identification.unknowns.transforms import scale

FREE = 1e-3
"""weight of a weak prior that holds nothing up; not zero, where directions would be rounding"""


class Sensitivity(NamedTuple):
    """The rows of the data at one point, columns in relative coordinates."""

    unknowns: tuple[Unknown, ...]
    """the parameters of interest"""
    shared: Float[np.ndarray, "n s"]
    """by the parameters of interest, and what filter error estimates of the noise after them"""
    own: Float[np.ndarray, "n k"]
    """by initial states, biases and input offsets, in sds of their weak priors"""

    def part(self, rows: np.ndarray) -> "Sensitivity":
        """Return some of the rows."""
        return self._replace(shared=self.shared[rows], own=self.own[rows])


def sensitivity_at(problem: Problem, layout: Layout, e: Evaluation) -> Sensitivity:
    """Return the rows of the data of an evaluation."""
    unknowns, rows = relative_rows(problem, layout, e)
    # Of the unknowns that are no parameter of interest the first are shared by all flights.
    count = layout.first_nuisance - len(unknowns)
    shared = np.hstack([rows.sensitivity, rows.nuisances[:, :count]])
    return Sensitivity(unknowns, shared, rows.nuisances[:, count:])


def triangle(s: Sensitivity) -> Float[np.ndarray, "s s"]:
    """Return what the rows say of the shared unknowns, where all else is free but for its weak
    prior."""
    # What these rows do not feel is no unknown of theirs: in long records that is nearly all.
    own = s.own[:, np.any(s.own != 0.0, axis=0)]
    priors = np.eye(own.shape[1])
    nothing = np.zeros((len(priors), s.shared.shape[1]))
    return projected(np.vstack([s.shared, nothing]), np.vstack([own, priors]))


def together(*triangles: np.ndarray) -> Float[np.ndarray, "s s"]:
    """Return the triangle of several parts of the data, whose shared unknowns are the same."""
    return np.linalg.qr(np.vstack(triangles), mode="r")


def expected_sd(
    unknowns: tuple[Unknown, ...], R: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, " q"]:
    """Return expected standard deviations of the parameters of interest, in relative coordinates
    (of log |value| where they have a sign); infinite where the data and the priors say nothing.
    """
    q = len(unknowns)
    # A parameter's prior is a measurement of itself.
    prior = np.hstack([np.diag([u.prior for u in unknowns]), np.zeros((q, R.shape[1] - q))])
    rows = np.vstack([R, prior])
    # What filter error estimates of the noise may leave no trace: it is then no unknown.
    felt = np.any(rows != 0.0, axis=0) | (np.arange(R.shape[1]) < q)
    return deviations(rows[:, felt])[:q]


GUESSED = "guessed: too small where the log was smoothed; state the output's sd"
"""of a noise that nobody stated"""
_TOO_GOOD = 1e-3
"""relative sd below which no parameter of a helicopter is known: models and sensors are worse"""


def too_good(sds: Sequence[float] | np.ndarray) -> Finding | None:
    """Return a finding if expected sds, relative ones, are too small to be true."""
    least = float(np.min(sds, initial=np.inf))
    if not least < _TOO_GOOD:
        return None
    return found("accuracy.guessed-noise", value=least, percent=100.0 * least)


def starting_at_zero(problem: Problem) -> dict[str, tuple[float, str]]:
    """Return, by free parameter that starts at zero, the size [SI] that its expected sd is relative
    to, and its unit.
    """
    return {
        n: (scale(f), naming.unit(problem.model.Params, n) or "1")
        for n, f in problem.free.items()
        if f.start == 0
    }


def unstated_gusts(problem: Problem) -> list[str]:
    """Return the sizes of disturbances that nobody stated; none without process noise."""
    if problem.noise_model != "disturbance":
        return []
    sizes = [d.sigma for d in disturbances_of(problem.model)]
    stated = {n: float(getattr(problem.vehicle, n)) for n in sizes}
    return [n for n, size in stated.items() if not (math.isfinite(size) and size > 0.0)]
