"""Estimates with standard deviations and intervals, from an optimum and its verdict."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import sensor_noise
from heli_jax.finding import Finding, note
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import combined_deviations, deviations, evaluate
from heli_jax.identification.estimation.filter_error import innovation_sums
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.identifiability.sensitivity import unknowns_of
from heli_jax.identification.identifiability.verdict import Unknown, Verdict
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.result import Estimate
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Solution,
    disturbance_limits,
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

    Args:
        at: the optimum.
        e: what it tells.
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
        layout: of the unknowns.
        e: at the optimum.
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
        estimates: by name.
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


def limit_notes(limits: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Which intervals are those of the likelihood, by name lower and upper end."""
    if not limits:
        return []
    those = (
        "interval of " + ", ".join(limits) + " is"
        if len(limits) == 1
        else ("intervals of " + ", ".join(limits) + " are")
    )
    words = (
        f"The {those} by the profile likelihood: it is not quadratic here, and the standard "
        "deviations alone would claim too much. More excitation would make them narrower."
    )
    return [note("uncertainty.profile-interval", words, *limits)]


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


def bound_findings(estimates: dict[str, Estimate]) -> list[Finding]:
    """Estimates that ended at their bounds: all estimates are those of a bound that the data do not
    bear out."""
    return [
        Finding(
            "fit.at-bound",
            "doubt",
            f"{name} ended at its bound: the data want it beyond {estimate.value:.3g}. "
            + (
                # No key widens that one.
                "Mend what makes the data want that: an input or an output of another column or "
                "sign, or two logs whose clocks differ."
                if name == "time_shift"
                else "Widen the bound, or mend what makes the data want that."
            ),
            estimate.value,
            "the bound",
            (name,),
            brief=f"{name} is at its bound",
            distrusts=tuple(estimates),
        )
        for name, estimate in estimates.items()
        if estimate.at_bound
    ]


def delay_findings(problem: Problem, estimates: dict[str, Estimate]) -> list[Finding]:
    """Delays, and the shift of the inputs, that may be none, or are negative.

    A negative one makes up for an input that was logged late: the other estimates are right with
    it.

    Args:
        problem: its model says which parameters are delays.
        estimates: of interest, by name.
    """
    findings = []
    for name in (*problem.model.delay_parameters, "time_shift"):
        estimate = estimates.get(name)
        if estimate is None or estimate.lower95 is None or estimate.upper95 is None:
            continue
        value, limit = estimate.value, "seconds"
        if estimate.upper95 < 0:
            words = (
                f"{name} is {1e3 * value:.3g} ms: the response comes before the log has its input. "
                "The input is logged late, or the clocks of inputs and outputs differ (two logs on "
                "one clock: also.align)."
            )
            findings.append(Finding("timing.delay-negative", "note", words, value, limit, (name,)))
        elif estimate.lower95 <= 0 and name != "time_shift":
            words = (
                f"{name} cannot be told from zero: with 95 % probability it is below "
                f"{estimate.upper95:.3g} s."
            )
            findings.append(Finding("timing.delay-near-zero", "note", words, value, limit, (name,)))
    return findings


FAR = 3.0
"""standard deviations of a prior at which an estimate contradicts it"""


def prior_findings(problem: Problem, estimates: dict[str, Estimate]) -> list[Finding]:
    """Estimates that have left their priors."""
    findings = []
    for name, estimate in estimates.items():
        prior = problem.free[name].prior
        if prior is None:
            continue
        away = abs(estimate.value - prior.mean) / prior.sd
        if away > FAR:
            words = (
                f"{name} lies {away:.2g} sd of its prior from the prior's mean: data and prior "
                "contradict each other. Check the prior, and what was measured."
            )
            findings.append(
                Finding(
                    "fit.prior-contradicted",
                    "doubt",
                    words,
                    away,
                    f"standard deviations of the prior, {FAR:g}",
                    (name,),
                    brief=f"{name} contradicts its prior",
                    distrusts=(name,),
                )
            )
    return findings


def extreme_noise_notes(
    layout: Layout, data: Data, z: Float[Array, " q"], absent: tuple[str, ...] = ()
) -> list[Finding]:
    """Where a parameter of the disturbance ran to the end of what a record can show.

    Args:
        layout: of the unknowns.
        data: whose length and sample time say what can be shown.
        z: the optimum (q,), with logarithms of the disturbance's parameters.
        absent: parameters of disturbances that do not show, of which nothing is said here.
    """
    notes = []
    limits = disturbance_limits(layout, data)
    for i, name in enumerate(layout.disturbance):
        at = float(z[len(layout.of_interest) + i])
        low, high = (float(v) for v in limits[name])
        if low < at < high or name in absent:
            continue
        value = np.exp(min(max(at, low), high))
        meaning = {
            # Shorter than a sample, or longer than the record.
            (False, True): "in this record the disturbance cannot be told from white noise",
            (False, False): "in this record the disturbance cannot be told from a random walk",
        }.get((name in layout.sigmas, at <= low), "the record bounds it to one side at most")
        unit = naming.unit(layout.model.Params, name) or ""
        words = f"{name} is not determined: it ran to {value:.3g} {unit}; {meaning}."
        notes.append(note("noise.disturbance-open", words, name))
    return notes


def stated_noise_notes(problem: Problem, sds: dict[str, float]) -> list[Finding]:
    """Where the estimated noise, sd by 'flight/output', is not the stated one."""
    notes = []
    for flight, label in zip(problem.training, labels(problem.training), strict=True):
        for name, stated in flight.sd.items():
            ratio = sds[f"{label}/{name}"] / stated
            if not 0.5 < ratio < 2.0:
                words = (
                    f"{label}: the residual of {name} has {ratio:.2g} times the stated noise; the "
                    "intervals go by the residual."
                )
                limit = "residual over stated noise, 0.5 to 2"
                notes.append(
                    Finding("noise.not-as-stated", "note", words, ratio, limit, (label, name))
                )
    return notes


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
        at: the optimum.
        e: what it tells.
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
    # In the order in which `unpack` takes them from z.
    i = layout.first_nuisance
    for k, label in enumerate(labels(problem.training)):
        for name, scale, unit in _nuisances_of(problem, at, k):
            value, sd = float(at.z[i] * scale), float(sds[i] * scale)
            # Scaled so that the sd of each weak prior is one: its precision is the prior's share.
            share = min(1.0, float(whites[i]) ** 2)
            reach = float(quantiles[i]) * sd
            limits = (value - reach, value + reach)
            estimates[f"{label}/{name}"] = Estimate(value, sd, *limits, unit, 0.0, share, False)
            i += 1
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


def _nuisances_of(problem: Problem, at: Solution, k: int) -> list[tuple[str, float, str]]:
    """Name, scale and unit of the nuisance parameters of flight k."""
    layout, flight, (count, _) = at.layout, at.data.flights[k], at.layout.windows[k]
    State, Outputs = layout.model.State, layout.model.Outputs
    parts = [
        (
            f"initial {n}" + (f" of window {w + 1}" if count > 1 else ""),
            flight.state_scale[n],
            naming.unit(State, n),
        )
        for w in range(count)
        for n in layout.states
    ]
    if layout.bias:
        parts += [
            (f"bias {n}", flight.bias_scale[n], naming.unit(Outputs, n)) for n in layout.outputs[k]
        ]
    parts += [
        (f"offset {n}", flight.offset_scale[n], _offset_unit(problem, n)) for n in layout.offsets
    ]
    return [(name, scale, unit or "") for name, scale, unit in parts]


def _offset_unit(problem: Problem, name: str) -> str | None:
    """Of an input's offset: the log's plain number where the estimated gain carries the unit."""
    if problem.gain_units.get(name, "1") != "1":
        return "1"
    return naming.unit(problem.model.Inputs, name)
