"""Estimates with standard deviations and intervals, by name and in their units."""

from collections.abc import Mapping

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import sensor_noise
from heli_jax.flights.flight import labels
from heli_jax.identification.estimation.evaluation import (
    Evaluation,
    deviations,
)
from heli_jax.identification.identifiability.analysis import unknowns_of
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.result import Estimate
from heli_jax.identification.uncertainty.standard_errors import StandardErrors
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import (
    FlightUnknown,
    Noise,
    Solution,
    flight_unknowns,
    unpack,
)

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
    for i, u in enumerate(unknowns_of(problem, at.layout, e)):
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
