"""What a flight held out says of the parameters by itself, against the estimates of a fit.

Whether the two differ is asked of one step of Gauss and Newton from the fit's (Chow's test). Where
they do, that step may end elsewhere: the flight's own noise, estimated before it, holds what the
estimates lack. So steps are repeated until they stay, first in the noise of the fitted flights,
then each in what is left.

Source: Chow (1960).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Array, Float

from heli_jax.identification.validation.held_out_agreement import LEVEL, Furthest

_NO_EFFECT = 1e-10
"""part of the largest size below which a direction has no effect"""
_STEPS = 20
_ARRIVED, _AROUND = 0.1, 2.0
"""the largest move in standard deviations of the last step, and where steps go to and fro"""
_LEAST_SHARE = 0.25
"""of a step, where steps went to and fro"""
_ROUNDING = 1e-8
"""part of an estimate below which a difference is one of rounding, of records without noise"""


class Fitted(NamedTuple):
    """What a fit knows of its parameters."""

    information: Float[np.ndarray, "q q"]
    """of the coordinates that the optimiser has"""
    sd: Float[np.ndarray, " q"]
    """of the coordinates; infinite where the fitted flights tell nothing"""
    names: tuple[str, ...]
    values: Float[np.ndarray, " q"]


class Rows(NamedTuple):
    """A flight's errors, in units of its own noise."""

    r: Float[np.ndarray, " r"]
    J: Float[np.ndarray, "r q"]
    """their derivative by the coordinates"""


class _Step(NamedTuple):
    statistic: float
    freedom: int
    step: Float[np.ndarray, " q"]
    """to the flight's own estimates"""
    own_sd: Float[np.ndarray, " q"]
    joint_sd: Float[np.ndarray, " q"]
    """of the difference of both; zero where they are not compared"""


def explained_by_estimates(
    r: Float[np.ndarray, " r"],
    J: Float[np.ndarray, "r q"],
    information: Float[np.ndarray, "q q"],
) -> float:
    """Of the sum of squares what errors of the estimates may have added.

    Args:
        r: the flight's rows, in units of the fitted flights' noise.
    """
    A, b = information + J.T @ J, J.T @ r
    sizes = np.sqrt(np.diag(A))
    sizes = np.where(sizes > 0, sizes, 1.0)
    # Directions of which neither tells anything add nothing.
    values, vectors = np.linalg.eigh(A / np.outer(sizes, sizes))
    kept = values > _NO_EFFECT * values[-1]
    return float(np.sum((vectors[:, kept].T @ (b / sizes)) ** 2 / values[kept]))


def own_estimates(
    rows: Callable[[Array], Rows],
    before: Callable[[Array], Rows],
    values: Callable[[Array], tuple[Array, Array]],
    z: Array,
    fit: Fitted,
) -> tuple[float | None, Furthest | None]:
    """How likely the flight's own estimates lie as far from the fit's, and which are the furthest;
    None where they cannot be compared, or do not settle.

    Args:
        rows: the flight's, at some unknowns, in the noise that is left there.
        before: the same in a noise that knows nothing of how far the estimates are off.
        values: of the parameters [SI] there, and their slopes.
    """
    at = _step(rows(z), fit)
    if at is None:
        return None, None
    steps = np.asarray(values(z)[1]) * at.step
    if np.all(np.abs(steps) <= _ROUNDING * np.abs(fit.values)):
        return None, None
    p = float(scipy.special.chdtrc(at.freedom, at.statistic))
    if p >= LEVEL:
        return p, _furthest(at, at.step, fit.values + steps, fit)
    begun = _settled(before, z, np.zeros_like(at.step), fit)
    found = _settled(rows, z, np.zeros_like(at.step) if begun is None else begun[1], fit)
    if found is None:
        return p, None
    at, moved = found
    own, _ = values(z.at[: len(moved)].add(moved))
    return p, _furthest(at, moved, np.asarray(own), fit)


def _settled(
    rows: Callable[[Array], Rows], z: Array, moved: Float[np.ndarray, " q"], fit: Fitted
) -> tuple[_Step, Float[np.ndarray, " q"]] | None:
    """The last step and all of them together; None where they do not end."""
    share, last, at = 1.0, np.zeros_like(moved), None
    for _ in range(_STEPS):
        at = _step(rows(z.at[: len(moved)].add(moved)), fit)
        if at is None or not np.isfinite(at.step).all():
            return None
        if np.all(np.abs(at.step) <= _ARRIVED * at.own_sd):
            return at, moved + at.step
        # The noise follows the estimates, and may lead them to and fro.
        over = np.where(at.own_sd > 0, at.own_sd, 1.0)
        if float(np.dot(last, at.step / over**2)) < 0.0:
            share = max(0.5 * share, _LEAST_SHARE)
        last = share * at.step
        moved = moved + last
    # At a whole number of samples the slope by a delay leaps: steps stay around there.
    assert at is not None
    return (at, moved) if np.all(np.abs(at.step) <= _AROUND * at.own_sd) else None


def _step(of: Rows, fit: Fitted) -> _Step | None:
    """Towards the flight's own estimates, along what both tell of; None where that is nothing."""
    own, known = of.J.T @ of.J, fit.information
    if not np.isfinite(own).all():
        return None
    sizes = np.sqrt(np.diag(own + known))
    sizes = np.where(sizes > 0, sizes, 1.0)
    b, (own, known) = of.J.T @ of.r / sizes, (v / np.outer(sizes, sizes) for v in (own, known))
    values, vectors = np.linalg.eigh(own + known)
    kept = values > _NO_EFFECT * values[-1]
    root = vectors[:, kept] / np.sqrt(values[kept])
    shares, turned = np.linalg.eigh(root.T @ own @ root)
    # Both have to tell of a direction for anything to be compared along it.
    both = (shares > _NO_EFFECT) & (shares < 1.0 - _NO_EFFECT)
    if not both.any():
        return None
    directions, shares = root @ turned[:, both], shares[both]
    along = directions.T @ b
    # What lies along other directions is the same in both, as far as anybody knows.
    step = -(directions @ (along / shares)) / sizes
    of_own = np.sum(directions**2 / shares, axis=1) / sizes**2
    of_both = of_own + np.sum(directions**2 / (1.0 - shares), axis=1) / sizes**2
    statistic = float(np.sum(along**2 * (1.0 / shares - 1.0)))
    return _Step(statistic, int(both.sum()), step, np.sqrt(of_own), np.sqrt(of_both))


def _furthest(
    at: _Step, moved: Float[np.ndarray, " q"], own: Float[np.ndarray, " q"], fit: Fitted
) -> Furthest | None:
    """The parameter whose two values are the furthest apart, of those that the fit knows."""
    known = np.isfinite(fit.sd) & (at.joint_sd > 0)
    if not known.any():
        return None
    sds = np.where(known, np.abs(moved) / np.where(known, at.joint_sd, 1.0), 0.0)
    k = int(np.argmax(sds))
    return Furthest(fit.names[k], float(own[k]), float(fit.values[k]), float(sds[k]))
