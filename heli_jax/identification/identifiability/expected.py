"""What parts of a record say of the parameters, at the start values: expected standard deviations.

Rows of the whitened Jacobian are samples, so the information of a part of the record (some outputs,
a window) is that of its rows, with what belongs to the part alone (initial states, biases, input
offsets) projected out. Information is carried as a triangle R, where R'R is Fisher's matrix: that
of two parts together is the triangle of both, one above the other.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import deviations
from heli_jax.identification.identifiability.directions import projected
from heli_jax.identification.identifiability.sensitivity import relative_rows
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Layout


class Sensitivity(NamedTuple):
    """The rows of the data at one point, columns in relative coordinates."""

    unknowns: tuple[Unknown, ...]
    """the parameters of interest"""
    shared: Float[np.ndarray, "n s"]
    """by the parameters of interest, and what filter error estimates of the noise after them"""
    own: Float[np.ndarray, "n k"]
    """by initial states, biases and input offsets, in sds of their weak priors"""


def sensitivity_at(problem: Problem, layout: Layout, e: Evaluation) -> Sensitivity:
    """The rows of the data of an evaluation.

    Args:
        problem: bounds, priors and starts.
        layout: what stands where in the Jacobian's columns.
        e: the whitened residuals' Jacobian and the values there.
    """
    unknowns, rows = relative_rows(problem, layout, e)
    # Of the unknowns that are no parameter of interest the first are shared by all flights.
    count = layout.first_nuisance - len(unknowns)
    shared = np.hstack([rows.sensitivity, rows.nuisances[:, :count]])
    return Sensitivity(unknowns, shared, rows.nuisances[:, count:])


def triangle(
    s: Sensitivity, rows: Sequence[int] | np.ndarray | slice = slice(None)
) -> Float[np.ndarray, "s s"]:
    """What some rows say of the shared unknowns, where all else is free but for its weak prior.

    Args:
        s: all rows.
        rows: which of them.
    """
    shared, own = s.shared[rows], s.own[rows]
    # What these rows do not feel is no unknown of theirs: in long records that is nearly all.
    own = own[:, np.any(own != 0.0, axis=0)]
    count = own.shape[1]
    if not count:
        return together(shared)
    stacked = np.vstack([shared, np.zeros((count, shared.shape[1]))])
    return projected(stacked, np.vstack([own, np.eye(count)]))


def together(*triangles: np.ndarray) -> Float[np.ndarray, "s s"]:
    """The triangle of several parts of the data, whose shared unknowns are the same."""
    R = np.linalg.qr(np.vstack(triangles), mode="r")
    return _square(R, R.shape[1])


def repeated(R: Float[np.ndarray, "s s"], times: float) -> Float[np.ndarray, "s s"]:
    """The triangle of the same data taken several times, each time with new noise."""
    return np.sqrt(times) * R


def expected_sd(
    unknowns: tuple[Unknown, ...], R: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, " q"]:
    """Expected standard deviations of the parameters of interest, in relative coordinates (of log
    |value| where they have a sign); infinite where the data and the priors say nothing.

    Args:
        unknowns: the parameters, with their priors.
        R: triangle of the data.
    """
    q = len(unknowns)
    # A parameter's prior is a measurement of itself.
    prior = np.hstack([np.diag([u.prior for u in unknowns]), np.zeros((q, R.shape[1] - q))])
    rows = np.vstack([R, prior])
    # What filter error estimates of the noise may leave no trace: it is then no unknown.
    felt = np.any(rows != 0.0, axis=0) | (np.arange(R.shape[1]) < q)
    return deviations(rows[:, felt])[:q]


def _square(R: np.ndarray, size: int) -> np.ndarray:
    return np.vstack([R, np.zeros((max(size - R.shape[0], 0), R.shape[1]))])
