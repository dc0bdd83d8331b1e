"""Estimates with standard deviations and intervals: by Cramér-Rao's bound, or wider."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.typing import ArrayLike
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import sensor_noise
from heli_jax.flights.flight import labels
from heli_jax.identification.estimation.evaluation import (
    Evaluation,
    combined_deviations,
    deviations,
    evaluate,
)
from heli_jax.identification.estimation.filter_error import innovation_sums
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.identifiability.analysis import Around, unknowns_of, verdict_of
from heli_jax.identification.identifiability.equivalents import Valley
from heli_jax.identification.identifiability.profile import beyond_slopes
from heli_jax.identification.identifiability.through_inputs import (
    by_disturbance,
    remarks,
    through_inputs,
)
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

    def slopes(e: Evaluation, around: Around) -> StandardErrors:
        return _by_slopes(problem, at, e, before, around, white=white)

    errors = slopes(e, around)
    if not optimum:
        return errors
    reaches = errors.wider * errors.quantiles
    inputs = through_inputs(at, e)
    if inputs is None:
        beyond = beyond_slopes(problem, at, e, errors.verdict, reaches, around)
        return errors if beyond is around else slopes(e, beyond)._replace(limits=beyond.limits)
    # Neither names combinations, which take time to look for.
    by_all, by_inputs = (
        verdict_of(problem, at.layout, told, around._replace(valley=None)) for told in (e, inputs)
    )
    told = by_disturbance(by_all, by_inputs)
    # Of several outputs a pushed one moves the others, which is a response to a measured motion. A
    # disturbance of one output has its spectrum alone, which only adds to what the inputs tell.
    spectrum_alone = all(len(outputs) == 1 for outputs in at.layout.outputs)
    counts = white and not (spectrum_alone and (told.resting or told.mostly))
    asked, names = errors.verdict, told.resting
    if not counts:
        lacking = dict.fromkeys((*asked.undetermined, *by_inputs.undetermined))
        asked = replace(asked, undetermined=tuple(lacking))
    beyond = beyond_slopes(problem, at, e, asked, reaches, around)
    if not counts:
        # The likelihood has the colour in it: its ends hold where parameters rest on responses.
        limits = {n: ends for n, ends in beyond.limits.items() if n not in told.wider}
        beyond = beyond._replace(limits=limits)
        if names or len(by_inputs.null_directions) > len(by_all.null_directions):
            # Along directions that no input shows the colour has placed the optimum.
            beyond = beyond._replace(valley=None)
            names = names or by_inputs.undetermined
    if beyond is not around:
        errors = slopes(e if counts else inputs, beyond)
    said = (*errors.verdict.sentences, *remarks(told, names, counts=counts, white=white))
    verdict = replace(errors.verdict, sentences=said)
    return errors._replace(verdict=verdict, limits=beyond.limits, by=None if counts else inputs)


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
    errors = sandwich(layout, at.data, e, residual_curvature(layout, at.data, at.noise, at.z))
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


_STEP = 1e-3
"""of a coordinate, for a difference"""
_NO_EFFECT = 1e-5
"""of the largest singular value, below which a direction is that of the common scale"""
_TAKES_PART = 0.02
"""part of a direction without effect from which on a size is lost with it"""


def size_deviations(at: Solution, e: Evaluation) -> dict[str, float]:
    """Return by size of a noise the standard deviation of its logarithm, in its own unit; {} where
    the sizes are not relative to the noise of one output, which may be next to nothing.

    In its own unit a size is its coordinate plus the logarithm of the common scale, which moves by
    -1/2 of the mean of log s (the variances of the innovations).
    """
    layout = at.layout
    if not (layout.filtered and layout.concentrated and np.isfinite(e.J).all()):
        return {}
    n, shared = measured_count(at.data), layout.first_nuisance
    _, here = innovation_sums(e, at.noise)
    mean = np.zeros(layout.size)
    for j in range(shared):
        moved = evaluate(layout, at.data, at.noise, jnp.asarray(at.z).at[j].add(_STEP))
        mean[j] = (innovation_sums(moved, at.noise)[1] - here) / (n * _STEP)
    rows = np.tile(-0.5 * mean, (len(layout.sizes), 1))
    rows[range(len(layout.sizes)), [layout.disturbance_at(name) for name in layout.sizes]] += 1.0
    # The scale itself is known to 1/(2 n) from the innovations' squares.
    sds = combined_deviations(e.J, rows, _NO_EFFECT, _TAKES_PART)
    sds = np.sqrt(sds**2 + 0.5 / n)
    return dict(zip(layout.sizes, map(float, sds), strict=True))


_SAYS_NOTHING = 1e3
"""A disturbance's standard deviation or correlation time whose interval reaches by this factor to
either side is not identifiable."""
_LARGEST = 700.0
"""log of a factor by which an interval reaches at most: the largest float64 is exp(709)"""


def estimates_of(
    problem: Problem, at: Solution, e: Evaluation, errors: StandardErrors
) -> dict[str, Estimate]:
    """Return the unknowns of interest: free parameters, gains, time shift."""
    e = errors.by or e
    alone = _insensitivity(e)
    estimates = {}
    for i, u in enumerate(unknowns_of(problem, at.layout, e)):
        # Relative to its reference: the size of the value, or a sample for the time shift.
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
    """Return the standard deviation of each unknown if all others were known, over that which it
    has; 1 where it is not identifiable."""
    norms = np.linalg.norm(np.asarray(e.J, np.float64), axis=0)
    sds = deviations(e.J)
    known = (norms > 0) & np.isfinite(sds)
    product = norms * np.where(known, sds, 1.0)
    return np.minimum(1.0, np.divide(1.0, product, where=known, out=np.ones_like(norms)))


def _interval95(u: Unknown, relative: float, quantile: float) -> tuple[float, float]:
    # Symmetric in the coordinate of the search: in the parameter of one sign, by equal factors.
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
    """Return the disturbance, then initial states, biases and input offsets."""
    layout = at.layout
    if layout.size == len(layout.of_interest):
        return {}
    whites, wider = deviations(e.J), errors.wider
    sds = np.multiply(whites, wider, where=np.isfinite(whites), out=whites.copy())
    for name, relative in size_deviations(at, e).items():
        sds[layout.disturbance_at(name)] = relative * wider[layout.disturbance_at(name)]
    reaches = errors.quantiles * sds
    estimates = {}
    # The parameters of process noise, searched in their logarithms: intervals by factors.
    starts = problem.noise | {sensor_noise(n): f for n, f in problem.filtered_noise.items()}
    disturbance = unpack(layout, at.data, at.z).noise
    for i, name in enumerate(layout.noises, len(layout.of_interest)):
        value, factor = float(disturbance[name]), float(np.exp(min(reaches[i], _LARGEST)))
        numbers = (value * float(sds[i]), value / factor, value * factor)
        if factor >= _SAYS_NOTHING:
            numbers = (None, None, None)
        unit = naming.unit(layout.model.Params, name) or ""
        estimates[name] = Estimate(value, *numbers, unit, starts[name].start, 0.0, False)
    unknowns = flight_unknowns(layout, labels(problem.training))
    for i, u in enumerate(unknowns, layout.first_nuisance):
        scale = u.scale(at.data)
        value, sd, reach = (float(v * scale) for v in (at.z[i], sds[i], reaches[i]))
        # Scaled so that the sd of each weak prior is one: its precision is the prior's share.
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
    # An offset is in the log's plain numbers where the estimated gain carries the unit.
    plain = problem.gain_units.get(u.of, "1") != "1"
    return "1" if plain else naming.unit(problem.model.Inputs, u.of) or ""


def without_disturbance(estimate: Estimate, *, size: bool) -> Estimate:
    """Return the estimate of a disturbance's parameter where no disturbance shows: a size is zero
    then, at its bound; a time means nothing."""
    value = 0.0 if size else estimate.value
    return estimate._replace(value=value, sd=None, lower95=None, upper95=None, at_bound=size)


def noise_by_name(
    problem: Problem, noise: Noise, scales: Mapping[str, ArrayLike]
) -> dict[str, float]:
    """Return the sd of the measurement noise as 'flight/output', in the output's SI unit; `scales`
    are factors by output that are unknowns themselves, 1 unless named."""
    return {
        f"{label}/{n}": float(np.asarray(sd)) * float(np.asarray(scales.get(n, 1.0)))
        for label, by_name in zip(labels(problem.training), noise.sd, strict=True)
        for n, sd in by_name.items()
    }
