"""Estimates with standard errors and intervals, by name and in their units.

The standard errors at an optimum are the Cramér-Rao bound, or the sandwich estimate if residuals
are autocorrelated.

Innovations of a filter depend on the vehicle's parameters by the response and by the gain. The
information by the gain is valid only if the innovations are white, so that the model of disturbance
and noise is right. Otherwise the response alone gives the standard errors.

The information of the response is the Jacobian on a record that the model simulates: its
innovations are zero there, and the gain has no effect.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.special
from jax.typing import ArrayLike
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import sensor_noise
from heli_jax.flights.flight import labels
from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.identifiability.analysis import Around, unknowns_of, verdict_of
from heli_jax.identification.identifiability.equivalents import Valley, own_record
from heli_jax.identification.identifiability.profile import profile_wide_intervals
from heli_jax.identification.identifiability.verdict import Z95, SecondSolution, Unknown, Verdict
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.result import Estimate
from heli_jax.identification.uncertainty.autocorrelated_residuals import (
    residual_curvature,
    sandwich,
)
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import (
    FlightUnknown,
    Noise,
    Solution,
    flight_unknowns,
    unpack,
)
from heli_jax.identification.validation.metrics import diverges, metrics
from heli_jax.messages import sentence

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
    for flight, simulated in zip(at.data.flights, e.simulated, strict=True):
        measured = {n: np.asarray(y) for n, y in flight.outputs.items() if np.nanstd(y) > 0}
        if any(diverges(metrics(y, np.asarray(simulated[n]))) for n, y in measured.items()):
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


# Estimates by name and in their units.


_UNBOUNDED = 1e3
"""factor to either side of an interval from which on a disturbance's parameter is not
identifiable"""
_LARGEST = 700.0
"""largest log of an interval's factor: exp overflows at 709"""


def estimates_of(
    problem: Problem, at: Solution, e: Evaluation, errors: StandardErrors
) -> dict[str, Estimate]:
    """Return the estimates of the free parameters, gains and time shift."""
    e = errors.by or e
    alone = _insensitivity(e)
    estimates = {}
    for i, u in enumerate(unknowns_of(problem, at.layout, e.named)):
        white = float(np.sqrt(errors.verdict.covariance[i, i]))
        relative = white * float(errors.wider[i])
        ends = errors.limits.get(u.name) or _interval95(u, relative, float(errors.quantiles[i]))
        free = problem.free.get(u.name)
        searched, start = (-np.inf, np.inf), 1.0
        if u.name == "time_shift":
            searched, start = (-MAX_TIME_SHIFT, MAX_TIME_SHIFT), 0.0
        elif free is not None:
            start = free.start
            if u.at_bound or u.name in problem.model.delay_parameters:
                searched = transforms.limits(free)
        low, high = (float(v) for v in np.clip(ends, *searched))
        numbers = (relative * u.reference, low, high)
        whites = (white * u.reference, float(white * u.reference * alone[i]))
        if u.name in errors.verdict.not_identifiable:
            numbers, whites = (None, None, None), (None, None)
        estimates[u.name] = Estimate(
            u.value,
            *numbers,
            _unit(problem, u.name),
            start,
            errors.verdict.prior_share[u.name],
            u.at_bound,
            *whites,
        )
    return estimates


def _insensitivity(e: Evaluation) -> Float[np.ndarray, " q"]:
    """Return the sd of each unknown if all others were known, over its sd; 1 where it is not
    identifiable."""
    norms = np.linalg.norm(np.asarray(e.J, np.float64), axis=0)
    sds = deviations(e.J)
    known = (norms > 0) & np.isfinite(sds)
    product = norms * np.where(known, sds, 1.0)
    return np.minimum(1.0, np.divide(1.0, product, where=known, out=np.ones_like(norms)))


def _interval95(u: Unknown, relative: float, quantile: float) -> tuple[float, float]:
    # A parameter of one sign has equal factors to either side.
    if u.symmetric or not u.logarithmic:
        reach = quantile * relative * u.reference
        return u.value - reach, u.value + reach
    factor = float(np.exp(min(quantile * relative, _LARGEST)))
    low, high = sorted((u.value / factor, u.value * factor))
    return low, high


def _unit(problem: Problem, name: str) -> str:
    if name == "time_shift":
        return "s"
    if name.startswith("gain "):
        return problem.gain_units.get(name.removeprefix("gain "), "1")
    return naming.unit(problem.model.Params, name) or ""


def flight_nuisances(
    problem: Problem, at: Solution, e: Evaluation, errors: StandardErrors
) -> dict[str, Estimate]:
    """Return the estimates of the disturbance, initial states, biases and input offsets."""
    layout = at.layout
    if layout.size == len(layout.of_interest):
        return {}
    whites, wider = deviations(e.J), errors.wider
    sds = np.multiply(whites, wider, where=np.isfinite(whites), out=whites.copy())
    reaches = errors.quantiles * sds
    estimates = {}
    # The parameters of process noise are searched in their logarithms.
    starts = problem.noise | {sensor_noise(n): f for n, f in problem.filtered_noise.items()}
    disturbance = unpack(layout, at.data, at.z).noise
    for i, name in enumerate(layout.noises, len(layout.of_interest)):
        value, factor = float(disturbance[name]), float(np.exp(min(reaches[i], _LARGEST)))
        numbers = (value * float(sds[i]), value / factor, value * factor)
        if factor >= _UNBOUNDED:
            numbers = (None, None, None)
        unit = naming.unit(layout.model.Params, name) or ""
        estimates[name] = Estimate(value, *numbers, unit, starts[name].start, 0.0, False)
    unknowns = flight_unknowns(layout, labels(problem.training))
    for i, u in enumerate(unknowns, layout.first_nuisance):
        scale = u.scale(at.data)
        value, sd, reach = (float(v * scale) for v in (at.z[i], sds[i], reaches[i]))
        # In sds of the weak prior the variance is the prior's share.
        share = min(1.0, float(whites[i]) ** 2)
        estimates[u.label] = Estimate(
            value, sd, value - reach, value + reach, _unit_of(problem, u), 0.0, share, False
        )
    return estimates


def _unit_of(problem: Problem, u: FlightUnknown) -> str:
    if u.kind == "initial_state":
        return naming.unit(problem.model.State, u.of) or ""
    if u.kind == "bias":
        return naming.unit(problem.model.Outputs, u.of) or ""
    # With an estimated gain that has a unit, the offset is a plain number.
    plain = problem.gain_units.get(u.of, "1") != "1"
    return "1" if plain else naming.unit(problem.model.Inputs, u.of) or ""


def without_disturbance(estimate: Estimate, *, size: bool) -> Estimate:
    """Return the estimate of a parameter of an insignificant disturbance: a size is zero, at its
    bound; a time has no interval."""
    value = 0.0 if size else estimate.value
    return estimate._replace(value=value, sd=None, lower95=None, upper95=None, at_bound=size)


def noise_by_name(
    problem: Problem, noise: Noise, scales: Mapping[str, ArrayLike]
) -> dict[str, float]:
    """Return the sd of the measurement noise by 'flight/output' [SI], with estimated factors
    `scales` by output."""
    return {
        f"{label}/{n}": float(np.asarray(sd)) * float(np.asarray(scales.get(n, 1.0)))
        for label, by_name in zip(labels(problem.training), noise.sd, strict=True)
        for n, sd in by_name.items()
    }
