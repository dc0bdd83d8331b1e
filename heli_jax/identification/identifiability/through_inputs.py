"""What the inputs and the initial states tell, apart from what the colour of a disturbance tells.

The gain of a filter depends on the machine's parameters, so that innovations inform on these in two
ways: by the response, and by the correlation of what the response does not explain. The second
part is information only as far as disturbance and measurement noise are what the model says. Where
the innovations are not white they are not, and it then fixes combinations that no input shows, at
values of the noise's making and with narrow intervals.

On the record that the model itself simulates the innovations are zero, and so is the second part:
the Jacobian of the innovations there is that of the response, weighed as the filter weighs it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax.finding import Finding, found
from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.identifiability.directions import projected
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.unknowns.layout import FlightData, Layout, Solution
from heli_jax.messages import listed

_LEFT = 10.0
"""of a signal's variance, from which on the error of its simulation says that it left the record"""
_MOSTLY = 1.5
"""factor between standard deviations by the inputs alone and by all, above which a disturbance
tells more than the inputs do"""
_NOISE_ONLY = 1e-6
"""part of a parameter's effect on the innovations below which its effect on the response is none"""


def through_inputs(at: Solution, e: Evaluation) -> Evaluation | None:
    """The optimum with the Jacobian of what inputs and initial states alone tell.

    With a row for each free parameter that only noise has, such as a process noise of the model's
    own: that is no question to the inputs.

    None without innovations, and where a simulation leaves its record (an unstable machine), so
    that what of it the inputs make is not known.
    """
    if not e.innovations or not (np.isfinite(e.J).all() and np.isfinite(e.r).all()):
        return None
    pairs = list(zip(at.data.flights, e.simulated, strict=True))
    if any(
        _left(np.asarray(y), np.asarray(simulated[n]))
        for flight, simulated in pairs
        for n, y in flight.outputs.items()
        if np.nanstd(np.asarray(y)) > 0
    ):
        return None
    simulated = at.data._replace(flights=tuple(_simulated(*pair) for pair in pairs))
    J = np.array(evaluate(at.layout, simulated, at.noise, at.z).J)
    # Between the samples' rows and the priors' stand those of the innovations' variances, which
    # are noise too.
    priors = len(at.layout.free) + at.layout.size - at.layout.first_nuisance
    tags = at.layout.objective.tags(at.layout, at.data, len(J) - priors)
    J[: len(J) - priors][~tags.residual] = 0.0
    if not np.isfinite(J).all():
        return None
    # Rounding of a column that is none, as that of a disturbance's size, would be scaled to one.
    noise_only = np.linalg.norm(J, axis=0) < _NOISE_ONLY * np.linalg.norm(e.J, axis=0)
    J[:, noise_only] = 0.0
    sds = deviations(e.J)
    alone = [
        np.eye(at.layout.size)[i] / sds[i]
        for i in range(len(at.layout.free))
        if noise_only[i] and np.isfinite(sds[i])
    ]
    return e._replace(J=np.vstack([*alone, J]))


def _simulated(flight: FlightData, simulated: dict[str, np.ndarray]) -> FlightData:
    """The flight with its simulated outputs, missing where the measured ones are."""
    return flight._replace(
        outputs={
            n: jnp.where(jnp.isfinite(y), jnp.asarray(simulated[n], jnp.asarray(y).dtype), jnp.nan)
            for n, y in flight.outputs.items()
        }
    )


class ByDisturbance(NamedTuple):
    """What a disturbance tells of the parameters beside what the inputs do."""

    resting: tuple[str, ...]
    """parameters that are determined, and are not by the inputs alone"""
    mostly: dict[str, float]
    """by parameter that both determine, and of which the disturbance tells more, the standard
    deviation by the inputs alone over that by all"""
    wider: tuple[str, ...]
    """parameters whose standard deviation by the inputs alone is larger by as much"""


def by_disturbance(verdict: Verdict, by_inputs: Verdict) -> ByDisturbance:
    """Return what the disturbance tells of the parameters."""
    known, alone = verdict.not_identifiable, by_inputs.not_identifiable
    sds = (np.sqrt(np.maximum(np.diag(v.covariance), 0.0)) for v in (verdict, by_inputs))
    each = list(zip(verdict.names, *map(np.ndarray.tolist, sds), strict=True))
    wider = tuple(n for n, all_, inputs in each if inputs > _MOSTLY * all_)
    return ByDisturbance(
        tuple(n for n in verdict.names if n in alone and n not in known),
        {n: b / a for n, a, b in each if n in wider and n not in known | alone},
        wider,
    )


def remarks(told: ByDisturbance, names: Sequence[str], *, counts: bool, white: bool) -> list[str]:
    """Return sentences on parameters that rest on the model of the disturbance."""
    lines = []
    if names and not white:
        lines.append(
            f"What the colour of the innovations tells of {listed(tuple(names))} does not count, "
            "since they are not white: disturbance or noise are not what the model says."
        )
    elif names:
        they = "it" if len(names) == 1 else "they"
        rest = f"rest{'s' * (len(names) == 1)}" if counts else "would rest"
        lines.append(
            f"By the inputs alone the data do not determine {listed(tuple(names), 'or')}: {they} "
            f"{rest} on the model of the disturbance{'' if counts else ', which does not count'}."
        )
    if white and not counts and told.mostly:
        lines.append(
            "How the disturbance goes through the machine would tell more of "
            f"{listed(tuple(told.mostly))} than the inputs do (intervals "
            f"{max(told.mostly.values()):.2g} times as narrow), but only as far as the model of "
            "the disturbance is right: the intervals are those of the inputs alone."
        )
    return lines


@np.errstate(over="ignore", invalid="ignore")
def _left(measured: np.ndarray, simulated: np.ndarray) -> bool:
    """Whether a simulation (N,) left what was measured (N,), NaN where nothing was."""
    seen = ~np.isnan(measured)
    error = (measured - simulated)[seen]
    return not float(np.var(error)) <= _LEFT * float(np.var(measured[seen]))


# What the data determine of the disturbances' own parameters, all other unknowns being free.


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
        found("identifiability.disturbance-without-effect", "note", n)
        for n, seen in zip(names, shown, strict=True)
        if not seen
    ]
    kept = [n for n, seen in zip(names, shown, strict=True) if seen]
    return notes + _of_columns(kept, rows[:, shown], norms[shown])


def _of_columns(
    names: list[str], rows: Float[np.ndarray, "n k"], norms: Float[np.ndarray, " k"]
) -> list[Finding]:
    """The same where every parameter has an effect."""
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
        return [found(_EXCHANGEABLE, "note", *those, correlation="") for those in together]
    # The unknowns are logarithms, so these sds are relative and one limit serves sizes and times.
    covariance = (right.T / sizes**2) @ right / np.outer(norms, norms)
    sds = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sds, sds)
    return [
        found(_EXCHANGEABLE, "note", a, b, correlation=f"{correlation[i, j]:+.2f}")
        for i, a in enumerate(names)
        for j, b in enumerate(names[:i])
        if abs(correlation[i, j]) > _TOGETHER and min(sds[i], sds[j]) > _VAGUE
    ]
