"""Estimates with standard deviations and intervals, from an optimum and its verdict."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
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
from heli_jax.identification.identifiability.sensitivity import unknowns_of
from heli_jax.identification.identifiability.verdict import Unknown, Verdict
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.result import Estimate
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import (
    FlightUnknown,
    Layout,
    Noise,
    Solution,
    flight_unknowns,
    unpack,
)

# How well the sizes of noises are known, where all are told relative to a small one.
#
# With the common scale of all noise concentrated out of the likelihood, the sizes among the
# unknowns are relative to the measurement noise of one output. Behind an on-board filter that may
# be next to nothing, and all that is relative to it is as uncertain as it is. In its own unit a
# size is its coordinate plus the logarithm of the common scale, which moves by -1/2 of the mean of
# log s (the variances of the innovations): large sizes beside a small reference stay where they
# are.


_STEP = 1e-3
"""of a coordinate, for a difference"""
_NO_EFFECT = 1e-5
"""of the largest singular value, below which a direction is that of the common scale"""
_TAKES_PART = 0.02
"""part of a direction without effect from which on a size is lost with it"""


def size_deviations(at: Solution, e: Evaluation) -> dict[str, float]:
    """By size of a noise the standard deviation of its logarithm, in its own unit; {} where the
    sizes are not relative to one that may vanish.
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
    problem: Problem,
    layout: Layout,
    e: Evaluation,
    verdict: Verdict,
    quantiles: Float[np.ndarray, " q"],
    wider: Float[np.ndarray, " q"],
) -> dict[str, Estimate]:
    """The unknowns of interest: free parameters, gains, time shift.

    Args:
        problem: with units, bounds and priors.
        verdict: what is identifiable, with the covariance as if residuals were white.
        quantiles: (q,) standard deviations that an interval reaches to either side.
        wider: (q,) by which the standard deviations of white residuals are multiplied.
    """
    unknowns = unknowns_of(problem, layout, e)
    insensitivity = _insensitivity(e)
    estimates = {}
    for i, u in enumerate(unknowns):
        free = problem.free.get(u.name)
        # Relative to its reference: the size of the value, or a sample for the time shift.
        white = float(np.sqrt(verdict.covariance[i, i]))
        relative = white * float(wider[i])
        sd, low, high = _interval95(u, relative, float(quantiles[i]))
        if free is not None and u.name in problem.model.delay_parameters:
            # Symmetric, as that of what may be zero; what it was not searched for it cannot be.
            low, high = (float(v) for v in np.clip((low, high), *transforms.limits(free)))
        if u.at_bound and free is not None:
            low, high = (float(v) for v in np.clip((low, high), *transforms.limits(free)))
        low, high = _searched(u.name, (low, high))
        not_identifiable = u.name in verdict.not_identifiable
        start = free.start if free else (0.0 if u.name == "time_shift" else 1.0)
        estimates[u.name] = Estimate(
            value=u.value,
            sd=None if not_identifiable else sd,
            lower95=None if not_identifiable else low,
            upper95=None if not_identifiable else high,
            unit=_unit(problem, u.name),
            start=start,
            prior_share=verdict.prior_share[u.name],
            at_bound=u.at_bound,
            sd_white=None if not_identifiable else float(white * u.reference),
            sd_alone=None if not_identifiable else float(white * u.reference * insensitivity[i]),
        )
    return estimates


def with_limits(
    estimates: dict[str, Estimate], limits: Mapping[str, tuple[float, float]]
) -> dict[str, Estimate]:
    """The estimates with those ends of their 95 % intervals that are not the slopes'.

    Args:
        limits: by name lower and upper end, in the parameter's unit.
    """
    found = dict(estimates)
    for n, ends in limits.items():
        if n in found and found[n].sd is not None:
            lower, upper = _searched(n, ends)
            found[n] = found[n]._replace(lower95=lower, upper95=upper)
    return found


def _searched(name: str, ends: tuple[float, float]) -> tuple[float, float]:
    """The ends of an interval, of a time shift no further than it is searched for [s]."""
    if name != "time_shift":
        return ends
    # Through a tanh, which has no value beyond: slopes and likelihood are taken on past it.
    low, high = (float(v) for v in np.clip(ends, -MAX_TIME_SHIFT, MAX_TIME_SHIFT))
    return low, high


def _insensitivity(e: Evaluation) -> Float[np.ndarray, " q"]:
    """The standard deviation of each unknown if all others were known, over that which it has; 1
    where it is not identifiable."""
    norms = np.linalg.norm(np.asarray(e.J, np.float64), axis=0)
    sds = deviations(e.J)
    known = (norms > 0) & np.isfinite(sds)
    product = norms * np.where(known, sds, 1.0)
    # Knowing more narrows an interval; what rounding has above 1 is taken off.
    return np.minimum(1.0, np.divide(1.0, product, where=known, out=np.ones_like(norms)))


def _interval95(u: Unknown, relative: float, quantile: float) -> tuple[float, float, float]:
    sd = float(relative * u.reference)
    # Symmetric in the coordinate of the search: in the parameter of one sign, by equal factors.
    if u.symmetric or not u.logarithmic:
        return sd, u.value - quantile * sd, u.value + quantile * sd
    reach = float(np.exp(min(quantile * relative, _LARGEST)))
    low, high = sorted((u.value / reach, u.value * reach))
    return sd, float(low), float(high)


def _unit(problem: Problem, name: str) -> str:
    if name == "time_shift":
        return "s"
    if name.startswith("gain "):
        return problem.gain_units.get(name.removeprefix("gain "), "1")
    return naming.unit(problem.model.Params, name) or ""


def without_disturbance(estimate: Estimate, *, size: bool) -> Estimate:
    """The estimate of a disturbance's parameter where no disturbance shows.

    Args:
        estimate: of a size or of a correlation time.
        size: whether it is a size, which is zero then, at its bound; a time means nothing.
    """
    value = 0.0 if size else estimate.value
    return estimate._replace(value=value, sd=None, lower95=None, upper95=None, at_bound=size)


def noise_by_name(
    problem: Problem, noise: Noise, scales: Mapping[str, ArrayLike]
) -> dict[str, float]:
    """Standard deviation of the measurement noise as 'flight/output', in the output's SI unit.

    Args:
        scales: factors on it by output that are unknowns themselves (filter error); 1 unless named.
    """
    return {
        f"{label}/{n}": float(np.asarray(sd)) * float(np.asarray(scales.get(n, 1.0)))
        for label, by_name in zip(labels(problem.training), noise.sd, strict=True)
        for n, sd in by_name.items()
    }


def flight_nuisances(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    quantiles: Float[np.ndarray, " q"],
    wider: Float[np.ndarray, " q"],
) -> dict[str, Estimate]:
    """The disturbance, then initial states, biases and input offsets with their weak priors.

    Args:
        problem: with flights, units and starts.
        quantiles: (q,) standard deviations that an interval reaches to either side.
        wider: (q,) by which the standard deviations of white residuals are multiplied.
    """
    layout = at.layout
    if layout.size == len(layout.of_interest):
        return {}
    whites = deviations(e.J)
    sds = np.multiply(whites, wider, where=np.isfinite(whites), out=whites.copy())
    for name, relative in size_deviations(at, e).items():
        sds[layout.disturbance_at(name)] = relative * wider[layout.disturbance_at(name)]
    estimates = _disturbance(problem, at, sds, quantiles)
    unknowns = flight_unknowns(layout, labels(problem.training))
    for i, u in enumerate(unknowns, layout.first_nuisance):
        scale = u.scale(at.data)
        value, sd = float(at.z[i] * scale), float(sds[i] * scale)
        # Scaled so that the sd of each weak prior is one: its precision is the prior's share.
        share = min(1.0, float(whites[i]) ** 2)
        reach = float(quantiles[i]) * sd
        unit = _unit_of(problem, u) or ""
        estimates[u.label] = Estimate(
            value, sd, value - reach, value + reach, unit, 0.0, share, False
        )
    return estimates


def _disturbance(
    problem: Problem,
    at: Solution,
    sds: Float[np.ndarray, " q"],
    quantiles: Float[np.ndarray, " q"],
) -> dict[str, Estimate]:
    """The parameters of process noise, searched in their logarithms: intervals by factors."""
    layout = at.layout
    starts = problem.noise | {sensor_noise(n): f for n, f in problem.filtered_noise.items()}
    estimates = {}
    disturbance = unpack(layout, at.data, at.z).noise
    for i, name in enumerate(layout.noises, len(layout.of_interest)):
        value, relative = float(disturbance[name]), float(sds[i])
        reach = float(np.exp(min(float(quantiles[i]) * relative, _LARGEST)))
        unit = naming.unit(layout.model.Params, name) or ""
        limits = (value / reach, value * reach)
        numbers = (value * relative, *limits) if reach < _SAYS_NOTHING else (None, None, None)
        estimates[name] = Estimate(value, *numbers, unit, starts[name].start, 0.0, False)
    return estimates


def _unit_of(problem: Problem, u: FlightUnknown) -> str | None:
    if u.kind == "initial_state":
        return naming.unit(problem.model.State, u.of)
    if u.kind == "bias":
        return naming.unit(problem.model.Outputs, u.of)
    # An offset is in the log's plain numbers where the estimated gain carries the unit.
    plain = problem.gain_units.get(u.of, "1") != "1"
    return "1" if plain else naming.unit(problem.model.Inputs, u.of)
