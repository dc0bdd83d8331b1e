"""What expected standard deviations rest on, in words: on the noise, which may be guessed."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import deviations
from heli_jax.identification.identifiability.directions import projected
from heli_jax.identification.identifiability.sensitivity import relative_rows
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.identification.unknowns.transforms import scale

# What parts of a record say of the parameters, at the start values: expected standard deviations.
#
# Rows of the whitened Jacobian are samples, so the information of a part of the record (some
# outputs, a window) is that of its rows, with what belongs to the part alone (initial states,
# biases, input offsets) projected out. Information is carried as a triangle R, where R'R is
# Fisher's matrix: that of two parts together is the triangle of both, one above the other.


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


GUESSED = "guessed: too small where the log was smoothed; state the output's sd"
"""of a noise that nobody stated"""
_TOO_GOOD = 1e-3
"""relative sd below which no parameter of a helicopter is known: models and sensors are worse"""
_WORTH_DOUBT = 0.1
"""relative sd above which nobody takes an expectation for a promise"""


def too_good(
    sds: Sequence[float] | np.ndarray, guessed: bool, *, nothing_follows: bool = False
) -> str:
    """A sentence where expected sds are too small to be true; empty where they are not.

    Args:
        sds: relative.
        guessed: whether noise was guessed.
        nothing_follows: whether no output was found to follow any input.
    """
    if nothing_follows and len(sds) and float(np.min(sds)) < _WORTH_DOUBT:
        return (
            f"An expected sd of {100 * float(np.min(sds)):.2g} % is no promise: it takes for "
            "granted that the outputs answer the inputs as the model has it, and no output "
            "follows any input in this record."
        )
    if not guessed or not len(sds) or float(np.min(sds)) >= _TOO_GOOD:
        return ""
    return (
        f"An expected sd of {100 * float(np.min(sds)):.2g} % is no promise: the noise was guessed "
        "from differences between samples, and is far too small where the log was smoothed or "
        "simulated; state the outputs' sd. Compare such numbers with one another alone."
    )


def starting_at_zero(problem: Problem) -> dict[str, tuple[float, str]]:
    """By free parameter that starts at zero the size [SI] that its expected sd is relative to, and
    its unit: of zero itself nothing is a part.

    Args:
        problem: what is to be fitted.
    """
    return {
        n: (scale(f), naming.unit(problem.model.Params, n) or "1")
        for n, f in problem.free.items()
        if f.start == 0
    }


def unstated_gusts(problem: Problem) -> list[str]:
    """The names of the sizes of disturbances that nobody stated; none without process noise.

    Args:
        problem: with its vehicle, where a size may be stated.
    """
    if not estimator_of(problem.method).process_noise:
        return []
    sizes = [d.sigma for d in disturbances_of(problem.model)]
    return [n for n in sizes if not _is_stated(float(getattr(problem.vehicle, n)))]


def _is_stated(value: float) -> bool:
    return math.isfinite(value) and value > 0.0
