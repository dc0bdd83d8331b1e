"""What the data determine of the disturbances' own parameters, all other unknowns being free."""

import numpy as np
from jaxtyping import Float

from heli_jax.finding import Finding, note
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.directions import projected
from heli_jax.identification.unknowns.layout import Layout

_EXCHANGEABLE = "identifiability.disturbances-exchangeable"
_NULL = 1e-4
"""part of the largest singular value of columns of equal size below which a direction is open: a
factor of e changes the likelihood by less than a hundred-millionth of what one parameter would"""
_NO_EFFECT = 1e-6
"""norm of a whitened column of a parameter that changes nothing"""
_TAKES_PART = 0.2
"""share of an open direction from which on a parameter is named with it"""
_TOGETHER = 0.95
"""correlation beyond which two parameters are named together"""
_VAGUE = 0.7
"""sd of a logarithm, a factor of two, below which a correlated parameter is known all the same"""


def of_disturbances(layout: Layout, e: Evaluation, skip: tuple[str, ...] = ()) -> list[Finding]:
    """Sentences about those parameters of several disturbances that the data do not determine.

    Args:
        layout: what the unknowns are.
        e: residuals and their Jacobian at the point that is asked about.
        skip: parameters of which nothing is to be said, such as those of absent disturbances.
    """
    names = [n for n in layout.disturbance if n not in skip]
    if len(layout.sigmas) < 2 or not names or not np.all(np.isfinite(e.J)):
        return []
    J = np.asarray(e.J, dtype=np.float64)
    at = [layout.disturbance_at(n) for n in names]
    # Those that are skipped have no column to project out, and neither has what changes nothing.
    others = [i for i in range(J.shape[1]) if i not in at and np.linalg.norm(J[:, i]) > _NO_EFFECT]
    # What the parameters of interest can take the place of is no information about a disturbance:
    # it goes away with their columns.
    rows = projected(J[:, at], J[:, others], _NULL)
    norms = np.linalg.norm(J[:, at], axis=0)
    shown = norms > _NO_EFFECT
    notes = [
        note(
            "identifiability.disturbance-without-effect",
            f"{n} changes nothing in these data and cannot be estimated.",
            n,
        )
        for n, seen in zip(names, shown, strict=True)
        if not seen
    ]
    kept = [n for n, seen in zip(names, shown, strict=True) if seen]
    return notes + _of_columns(kept, rows[:, shown], norms[shown])


def _of_columns(
    names: list[str], rows: Float[np.ndarray, "n k"], norms: Float[np.ndarray, " k"]
) -> list[Finding]:
    """The same where every parameter has an effect.

    Args:
        names: of the parameters.
        rows: whitened, the other unknowns projected out.
        norms: of the columns before that.
    """
    if not names:
        return []
    # Over the norms before the projection: a direction is open where little is left of its columns,
    # not where they were small to begin with.
    _, sizes, right = np.linalg.svd(rows / norms)
    open_ = sizes < _NULL * max(sizes[0], 1e-300)
    if open_.any():
        together = [
            tuple(n for n, w in zip(names, v, strict=True) if abs(w) > _TAKES_PART)
            for v in right[open_]
        ]
        return [
            note(
                _EXCHANGEABLE,
                f"{' and '.join(those)} are exchangeable in these data. Disturb one place less, or "
                "fix one of them.",
                *those,
            )
            for those in together
        ]
    # The unknowns are logarithms, so these sds are relative and one limit serves sizes and times.
    covariance = (right.T / sizes**2) @ right / np.outer(norms, norms)
    sds = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sds, sds)
    return [
        note(
            _EXCHANGEABLE,
            f"{a} and {b} are hardly told apart (correlation {correlation[i, j]:+.2f}): disturb "
            "one place less, or fix one of them.",
            a,
            b,
        )
        for i, a in enumerate(names)
        for j, b in enumerate(names[:i])
        if abs(correlation[i, j]) > _TOGETHER and min(sds[i], sds[j]) > _VAGUE
    ]
