"""The information in inputs and initial states, without that in the colour of a disturbance.

The gain of a filter depends on the vehicle's parameters, so that innovations inform on these in two
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

from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.messages import sentence

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

    None without innovations, and where a simulation leaves its record (an unstable vehicle), so
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
    # The simulated outputs in place of the measured ones, missing where these are.
    flights = tuple(
        flight._replace(
            outputs={
                n: jnp.where(jnp.isfinite(y), jnp.asarray(run[n], jnp.asarray(y).dtype), jnp.nan)
                for n, y in flight.outputs.items()
            }
        )
        for flight, run in pairs
    )
    J = np.array(evaluate(at.layout, at.data._replace(flights=flights), at.noise, at.z).J)
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


class ByDisturbance(NamedTuple):
    """Parameters on which a disturbance has more information than the inputs."""

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
        lines.append(sentence("verdict.colour-does-not-count", names=list(names)))
    elif names:
        numbers = {"names": list(names), "counts": counts, "ignored": not counts}
        lines.append(sentence("verdict.rests-on-disturbance", **numbers))
    if white and not counts and told.mostly:
        times = max(told.mostly.values())
        lines.append(
            sentence("verdict.disturbance-tells-more", names=list(told.mostly), times=times)
        )
    return lines


@np.errstate(over="ignore", invalid="ignore")
def _left(measured: np.ndarray, simulated: np.ndarray) -> bool:
    """True if a simulation (N,) left the measurement (N,), NaN where nothing was measured."""
    seen = ~np.isnan(measured)
    error = (measured - simulated)[seen]
    return not float(np.var(error)) <= _LEFT * float(np.var(measured[seen]))
