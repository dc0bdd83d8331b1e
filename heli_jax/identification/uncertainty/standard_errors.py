"""Standard errors at an optimum: Cramér-Rao's bound, or the sandwich for autocorrelated residuals.

The innovations of a filter have information on the vehicle's parameters by the response, and by
their correlation, since the gain depends on the parameters too. The second part holds only if the
model of disturbance and noise is right. If the innovations are not white it is not, and then the
standard errors are those of the response alone.

The innovations of the record that the model itself simulates are zero, so the Jacobian there is
that of the response, weighed as the filter weighs it.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.identifiability.analysis import Around, verdict_of
from heli_jax.identification.identifiability.equivalents import Valley, own_record
from heli_jax.identification.identifiability.profile import profile_wide_intervals
from heli_jax.identification.identifiability.verdict import Z95, SecondSolution, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.autocorrelated_residuals import (
    residual_curvature,
    sandwich,
)
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.messages import sentence

_DIVERGES = 10.0
"""variance of a simulation's error over that of the signal from which on it diverges"""
_MORE = 1.5
"""sd by the inputs alone over that by all rows from which on the disturbance has information"""
_NOISE_ONLY = 1e-6
"""part of a parameter's effect on the innovations below which it has none on the response"""


class StandardErrors(NamedTuple):
    """Standard deviations and identifiability at an optimum."""

    verdict: Verdict
    wider: Float[np.ndarray, " q"]
    """factor of autocorrelated residuals on the standard deviations of the unknowns"""
    quantiles: Float[np.ndarray, " q"]
    """standard deviations that a 95 % interval reaches to either side"""
    coloured: bool
    """True if the intervals allow for residuals that are not white"""
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """95 % interval by the profile likelihood of parameters for which it is not quadratic"""
    by: Evaluation | None = None
    """with the Jacobian of the response alone, if the standard errors are by that"""


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
    """Return standard errors by the Jacobian, and profile intervals of the parameters that it
    leaves wide.

    Args:
        before: analysis at the start values, for an optimum without a finite Jacobian.
        white: True if the residuals (innovations) are white and independent between outputs.
        aliased: the parameters that move a mode whose aliases fit as well.
        optimum: False if the search did not converge.
    """
    around = Around(frozenset(aliased), second, Valley(problem, at, e))
    inputs = through_inputs(at, e) if optimum else None
    by, more, remarks = e, (), ()
    if inputs is not None:
        plain = around._replace(valley=None)
        by_all, by_inputs = (verdict_of(problem, at.layout, rows, plain) for rows in (e, inputs))
        resting, more = resting_on_disturbance(by_all, by_inputs)
        # A disturbance of one output moves the others, which respond to a measured motion. With one
        # output only its spectrum is known.
        spectrum_alone = all(len(outputs) == 1 for outputs in at.layout.outputs)
        counts = white and not (spectrum_alone and (resting or more))
        by = e if counts else inputs
        if resting and not counts:
            # The optimum is arbitrary along the null directions of the response.
            around = plain
        if resting:
            numbers = {"names": resting, "counts": counts, "ignored": not counts}
            remarks = (sentence("verdict.rests-on-disturbance", **numbers),)
    errors = _by_slopes(problem, at, by, before, around, white=white)
    if optimum:
        reaches = errors.wider * errors.quantiles
        limits, one_sided = profile_wide_intervals(problem, at, e, errors.verdict, reaches)
        if by is not e:
            # The likelihood has the information of the disturbance too.
            limits = {n: ends for n, ends in limits.items() if n not in more}
        if one_sided:
            around = around._replace(one_sided=one_sided)
            errors = _by_slopes(problem, at, by, before, around, white=white)
        errors = errors._replace(limits=limits)
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
    """Return Cramér-Rao's bound, or the sandwich for output error with residuals that are not
    white; arguments as in `standard_errors`."""
    layout, objective = at.layout, at.layout.objective
    usable = bool(np.all(np.isfinite(e.J)) and np.all(np.isfinite(e.r)))
    freedom = max(objective.numbers(layout, at.data, at.noise) - layout.determined, 1)
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
    quantiles = np.full(layout.size, quantile)
    if white or not (usable and objective.noise_model == "white"):
        verdict = verdict_of(problem, layout, e, around) if usable else before
        # Rows that are weighed by the noise's spectrum allow for its colour.
        allowed = usable and not white and objective.noise_model == "spectrum"
        return StandardErrors(verdict, np.ones(layout.size), quantiles, allowed)
    errors = sandwich(layout, at.data, e, residual_curvature(at, np.asarray(e.J, np.float64)))
    quantiles = np.maximum(errors.quantile, quantile)
    # The analysis takes 1.96 standard deviations for a 95 % interval.
    k = len(layout.of_interest)
    factor = quantiles[:k] / Z95
    around = around._replace(reported=errors.covariance[:k, :k] * np.outer(factor, factor))
    return StandardErrors(verdict_of(problem, layout, e, around), errors.inflation, quantiles, True)


def through_inputs(at: Solution, e: Evaluation) -> Evaluation | None:
    """Return the optimum with the Jacobian of the response to inputs and initial states.

    It has a row for each free parameter that only affects the noise, as if that were known as well
    as by the innovations.

    None without innovations, or if the simulation diverges, as of an unstable vehicle.
    """
    if not e.innovations or not (np.isfinite(e.J).all() and np.isfinite(e.r).all()):
        return None
    pairs = list(zip(at.data.flights, e.simulated, strict=True))
    if any(
        _diverges(np.asarray(y), np.asarray(simulated[n]))
        for flight, simulated in pairs
        for n, y in flight.outputs.items()
        if np.nanstd(np.asarray(y)) > 0
    ):
        return None
    J = np.array(own_record(at, e)[1].J)
    # The rows of the innovations' variances, before those of the priors, are zero.
    priors = len(at.layout.free) + at.layout.size - at.layout.first_nuisance
    tags = at.layout.objective.tags(at.layout, at.data, len(J) - priors)
    J[: len(J) - priors][~tags.residual] = 0.0
    if not np.isfinite(J).all():
        return None
    # A column of rounding would be scaled to unit length.
    noise_only = np.linalg.norm(J, axis=0) < _NOISE_ONLY * np.linalg.norm(e.J, axis=0)
    J[:, noise_only] = 0.0
    sds = deviations(e.J)
    alone = [
        np.eye(at.layout.size)[i] / sds[i]
        for i in range(len(at.layout.free))
        if noise_only[i] and np.isfinite(sds[i])
    ]
    return e._replace(J=np.vstack([*alone, J]))


def resting_on_disturbance(by_all: Verdict, by_inputs: Verdict) -> tuple[list[str], list[str]]:
    """Return the parameters that only all rows determine, and those with a far larger sd by the
    inputs alone."""
    known, alone = by_all.not_identifiable, by_inputs.not_identifiable
    sds, wider = (np.sqrt(np.maximum(np.diag(v.covariance), 0.0)) for v in (by_all, by_inputs))
    resting = [n for n in by_all.names if n in alone - known]
    more = [n for n, far in zip(by_all.names, wider > _MORE * sds, strict=True) if far]
    return resting, [n for n in more if n not in known | alone]


@np.errstate(over="ignore", invalid="ignore")
def _diverges(measured: np.ndarray, simulated: np.ndarray) -> bool:
    """True if a simulation (N,) diverges from the measurement (N,), NaN where missing."""
    seen = ~np.isnan(measured)
    error = (measured - simulated)[seen]
    return not float(np.var(error)) <= _DIVERGES * float(np.var(measured[seen]))
