"""Standard errors at an optimum: Cramér-Rao's bound, the sandwich, or the response to inputs alone.

The gain of a filter depends on the vehicle's parameters, so that innovations inform on these in two
ways: by the response, and by the correlation of what the response does not explain. The second
part is information only as far as disturbance and measurement noise are what the model says. Where
the innovations are not white they are not, and it then fixes combinations that no input shows, at
values of the noise's making and with narrow intervals.

On the record that the model itself simulates the innovations are zero, and so is the second part:
the Jacobian of the innovations there is that of the response, weighed as the filter weighs it.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.identifiability.analysis import Around, verdict_of
from heli_jax.identification.identifiability.equivalents import Valley
from heli_jax.identification.identifiability.profile import beyond_slopes
from heli_jax.identification.identifiability.verdict import Z95, SecondSolution, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.autocorrelated_residuals import (
    residual_curvature,
    sandwich,
)
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.messages import sentence

_LEFT = 10.0
"""of a signal's variance, from which on the error of its simulation says that it left the record"""
_MORE = 1.5
"""factor between standard deviations by the inputs alone and by all, above which a disturbance
tells more than the inputs do"""
_NOISE_ONLY = 1e-6
"""part of a parameter's effect on the innovations below which its effect on the response is none"""


class StandardErrors(NamedTuple):
    """Standard deviations and verdict at an optimum."""

    verdict: Verdict
    wider: Float[np.ndarray, " q"]
    """by how much autocorrelated residuals widen the standard deviations of the unknowns"""
    quantiles: Float[np.ndarray, " q"]
    """standard deviations that a 95 % interval reaches to either side"""
    coloured: bool
    """whether the intervals allow for residuals that are not white"""
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """by parameter the ends of its 95 % interval by the likelihood, in its unit, where the slopes
    have others"""
    by: Evaluation | None = None
    """what the standard deviations go by where it is not the optimum's own Jacobian"""


def standard_errors(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    before: Verdict,
    *,
    white: bool,
    aliased: Collection[str] = (),
    second: tuple[SecondSolution, ...] = (),
    optimum: bool = True,
) -> StandardErrors:
    """Return standard errors by the slopes, and by the likelihood where the slopes leave wide
    intervals.

    With process noise they are Cramér-Rao's bound of the innovations; where these are not white, or
    the spectrum of a disturbance tells more of a parameter than the inputs do, that of the
    responses to the inputs alone.

    Args:
        before: the verdict at the first guess, which stands where the optimum has no Jacobian.
        white: whether the residuals are white and independent between outputs; of a method with
            process noise whether the innovations are.
        aliased: the parameters that move a mode which the samples do not tell from its aliases.
        optimum: whether the point is one, about which the likelihood may be asked.
    """
    around = Around(frozenset(aliased), second, Valley(problem, at, e))
    inputs = through_inputs(at, e) if optimum else None
    by, more, remarks = e, (), ()
    if inputs is not None:
        # Neither names combinations, which take time to look for.
        plain = around._replace(valley=None)
        by_all, by_inputs = (verdict_of(problem, at.layout, one, plain) for one in (e, inputs))
        resting, more = by_disturbance(by_all, by_inputs)
        # A disturbance of one of several outputs moves the others, which respond to a measured
        # motion. With one output nothing but its spectrum is known.
        spectrum_alone = all(len(outputs) == 1 for outputs in at.layout.outputs)
        counts = white and not (spectrum_alone and (resting or more))
        by = e if counts else inputs
        if resting and not counts:
            # Along directions that no input shows the colour has placed the optimum.
            around = plain
        if resting:
            numbers = {"names": resting, "counts": counts, "ignored": not counts}
            remarks = (sentence("verdict.rests-on-disturbance", **numbers),)
    errors = _by_slopes(problem, at, by, before, around, white=white)
    if optimum:
        reaches = errors.wider * errors.quantiles
        beyond = beyond_slopes(problem, at, e, errors.verdict, reaches, around)
        if by is not e:
            # The likelihood has the colour in it: its ends hold where parameters rest on responses.
            limits = {n: ends for n, ends in beyond.limits.items() if n not in more}
            beyond = beyond._replace(limits=limits)
        if beyond is not around:
            errors = _by_slopes(problem, at, by, before, beyond, white=white)
            errors = errors._replace(limits=beyond.limits)
    verdict = replace(errors.verdict, remarks=remarks)
    return errors._replace(verdict=verdict, by=None if by is e else by)


def _by_slopes(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    before: Verdict,
    around: Around,
    *,
    white: bool,
) -> StandardErrors:
    """Return Cramér-Rao's bound, or where the residuals are not white and their autocorrelation can
    be estimated, the sandwich; the arguments are those of `standard_errors`."""
    layout, objective = at.layout, at.layout.objective
    usable = bool(np.all(np.isfinite(e.J)) and np.all(np.isfinite(e.r)))
    freedom = max(objective.numbers(layout, at.data, at.noise) - layout.determined, 1)
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
    quantiles = np.full(layout.size, quantile)
    if white or not (usable and objective.noise_model == "white"):
        verdict = verdict_of(problem, layout, e, around) if usable else before
        # Weighed by the noise's own spectrum, the bound allows for it as it stands.
        allowed = usable and not white and objective.noise_model == "spectrum"
        return StandardErrors(verdict, np.ones(layout.size), quantiles, allowed)
    errors = sandwich(layout, at.data, e, residual_curvature(at))
    quantiles = np.maximum(errors.quantile(), quantile)
    # The verdict, which takes 1.96 standard deviations, has to see the reported intervals.
    k = len(layout.of_interest)
    factor = quantiles[:k] / Z95
    reported = errors.covariance()[:k, :k] * np.outer(factor, factor)

    def widening(along: np.ndarray) -> tuple[float, float]:
        of_all = np.pad(along, (0, layout.size - k))[None]
        return float(errors.inflation(of_all)[0]), float(errors.quantile(of_all)[0])

    around = around._replace(reported=reported, widening=widening)
    return StandardErrors(
        verdict_of(problem, layout, e, around), errors.inflation(), quantiles, True
    )


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


def by_disturbance(by_all: Verdict, by_inputs: Verdict) -> tuple[list[str], list[str]]:
    """Return the parameters that the data determine, and the inputs alone do not; and those of
    which both tell, the inputs far less."""
    known, alone = by_all.not_identifiable, by_inputs.not_identifiable
    sds, wider = (np.sqrt(np.maximum(np.diag(v.covariance), 0.0)) for v in (by_all, by_inputs))
    resting = [n for n in by_all.names if n in alone - known]
    more = [n for n, far in zip(by_all.names, wider > _MORE * sds, strict=True) if far]
    return resting, [n for n in more if n not in known | alone]


@np.errstate(over="ignore", invalid="ignore")
def _left(measured: np.ndarray, simulated: np.ndarray) -> bool:
    """True if a simulation (N,) left the measurement (N,), NaN where nothing was measured."""
    seen = ~np.isnan(measured)
    error = (measured - simulated)[seen]
    return not float(np.var(error)) <= _LEFT * float(np.var(measured[seen]))
