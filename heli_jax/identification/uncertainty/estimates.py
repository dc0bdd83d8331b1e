"""Estimates with standard deviations and intervals, from an optimum and its verdict."""

import numpy as np
from jaxtyping import Array

from heli_jax import naming
from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.identifiability.sensitivity import references_of, unknowns_of
from heli_jax.identification.identifiability.verdict import Unknown, Verdict
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.result import Estimate
from heli_jax.identification.unknowns.layout import Data, Layout, disturbance_limits, unpack
from heli_jax.identification.unknowns.nuisances import labels

_SAYS_NOTHING = 1e3
"""A disturbance's standard deviation or memory whose interval reaches by this factor to either side
is not determined."""


def estimates_of(
    problem: Problem,
    layout: Layout,
    e: Evaluation,
    verdict: Verdict,
    quantiles: np.ndarray,
    wider: np.ndarray,
) -> dict[str, Estimate]:
    """The named unknowns; `wider` (q,) multiplies the white-noise deviations of all unknowns, and
    their intervals reach `quantiles` (q,) deviations to either side."""
    unknowns = unknowns_of(problem, layout, e)
    references = references_of(problem, layout, unknowns)
    norms = np.linalg.norm(np.asarray(e.J, np.float64), axis=0)
    sds = deviations(e.J)
    known = (norms > 0) & np.isfinite(sds)
    product = norms * np.where(known, sds, 1.0)
    alone = np.divide(1.0, product, where=known, out=np.ones_like(norms))
    out = {}
    for i, u in enumerate(unknowns):
        free = problem.free.get(u.name)
        white = float(np.sqrt(verdict.covariance[i, i]))
        relative = white * float(wider[i])
        sd, low, high = _interval95(u, relative, references[i], float(quantiles[i]))
        lost = u.name in verdict.undetermined or u.name in verdict.without_effect
        start = free.start if free else (0.0 if u.name == "time_shift" else 1.0)
        out[u.name] = Estimate(
            value=u.value,
            sd=None if lost else sd,
            lower95=None if lost else low,
            upper95=None if lost else high,
            unit=_unit(problem, u.name),
            start=start,
            prior_share=verdict.prior_share[u.name],
            at_bound=_at_bound(problem, u.name, u.value),
            sd_white=None if lost else float(white * references[i]),
            sd_alone=None if lost else float(white * references[i] * min(1.0, alone[i])),
        )
    return out


def _interval95(
    u: Unknown, relative: float, reference: float, quantile: float
) -> tuple[float, float, float]:
    sd = float(relative * reference)
    if u.symmetric or not u.logarithmic:
        return sd, u.value - quantile * sd, u.value + quantile * sd
    reach = float(np.exp(min(quantile * relative, 700.0)))
    low, high = sorted((u.value / reach, u.value * reach))
    return sd, float(low), float(high)


def _unit(problem: Problem, name: str) -> str:
    if name == "time_shift":
        return "s"
    if name.startswith("gain "):
        return problem.gain_units.get(name.removeprefix("gain "), "1")
    return naming.unit(problem.model.Params, name) or ""


def _at_bound(problem: Problem, name: str, value: float) -> bool:
    free = problem.free.get(name)
    if free is None:
        return name == "time_shift" and abs(value) > 0.999 * MAX_TIME_SHIFT
    low, high = free.lower, free.upper
    width = high - low if low is not None and high is not None else abs(value)
    near = 1e-3 * width
    by_low = low is not None and value - low < min(near, 1e-3 * abs(low) if low else near)
    by_high = high is not None and high - value < near
    return bool(by_low or by_high)


def bound_notes(estimates: dict[str, Estimate]) -> list[str]:
    return [
        f"{name} ended at its bound: the data want it beyond {one.value:g}; its interval does not "
        "hold there."
        for name, one in estimates.items()
        if one.at_bound
    ]


_FAR = 3.0
"""standard deviations of a prior at which an estimate contradicts it"""


def prior_notes(problem: Problem, estimates: dict[str, Estimate]) -> list[str]:
    """Where an estimate has left its prior."""
    notes = []
    for name, one in estimates.items():
        prior = problem.free[name].prior
        if prior is None:
            continue
        away = abs(one.value - prior.mean) / prior.sd
        if away > _FAR:
            notes.append(
                f"{name} lies {away:.2g} sd of its prior from the prior's mean: data and priors "
                "contradict each other, and the interval does not know it."
            )
    return notes


def extreme_noise_notes(layout: Layout, data: Data, z: Array) -> list[str]:
    """Where a parameter of the disturbance ran to the end of what a record can show."""
    notes = []
    limits = disturbance_limits(data)
    for i, name in enumerate(layout.disturbance):
        at = float(z[len(layout.of_interest) + i])
        low, high = (float(v) for v in limits[name])
        if low < at < high:
            continue
        value = np.exp(min(max(at, low), high))
        meaning = {
            ("tau_w", True): "to this record the disturbance is white noise",
            ("tau_w", False): "to this record the disturbance is a random walk",
        }.get((name, at <= low), "the record bounds it to one side at most")
        unit = naming.unit(layout.model.Params, name) or ""
        notes.append(f"{name} is not determined: it ran to {value:.3g} {unit}; {meaning}.")
    return notes


def stated_noise_notes(problem: Problem, sds: dict[str, float]) -> list[str]:
    """Where the noise found, by 'flight/output', is not the stated one."""
    notes = []
    for flight, label in zip(problem.training, labels(problem.training), strict=True):
        for name, stated in flight.sd.items():
            ratio = sds[f"{label}/{name}"] / stated
            if not 0.5 < ratio < 2.0:
                notes.append(
                    f"{label}: the residual of {name} has {ratio:.2g} times the stated noise; the "
                    "intervals go by the residual."
                )
    return notes


def flight_nuisances(
    problem: Problem,
    layout: Layout,
    data: Data,
    z: Array,
    e: Evaluation,
    quantiles: np.ndarray,
    wider: np.ndarray,
) -> dict[str, Estimate]:
    """The disturbance, then initial states, biases and input offsets with their weak priors."""
    q = len(layout.of_interest)
    if layout.size == q:
        return {}
    whites = deviations(e.J)
    sds = np.multiply(whites, wider, where=np.isfinite(whites), out=whites.copy())
    out, starts = {}, problem.noise
    disturbance = unpack(layout, data, z).noise
    for i, name in enumerate(layout.disturbance):
        value, relative = float(disturbance[name]), float(sds[q + i])
        reach = float(np.exp(min(float(quantiles[q + i]) * relative, 700.0)))
        unit = naming.unit(layout.model.Params, name) or ""
        limits = (value / reach, value * reach)
        said = (value * relative, *limits) if reach < _SAYS_NOTHING else (None, None, None)
        out[name] = Estimate(value, *said, unit, starts[name].start, 0.0, False)
    at = layout.first_nuisance
    for label, flight, outputs, (count, _) in zip(
        labels(problem.training), data.flights, layout.outputs, layout.windows, strict=True
    ):
        parts = [
            (
                f"initial {n}" + (f" of window {k + 1}" if count > 1 else ""),
                flight.state_scale[n],
                naming.unit(layout.model.State, n),
            )
            for k in range(count)
            for n in layout.states
        ]
        if layout.bias:
            parts += [
                (f"bias {n}", flight.bias_scale[n], naming.unit(layout.model.Outputs, n))
                for n in outputs
            ]
        parts += [
            (f"offset {n}", flight.offset_scale[n], _offset_unit(problem, n))
            for n in layout.offsets
        ]
        for name, scale, unit in parts:
            value, sd = float(z[at] * scale), float(sds[at] * scale)
            share = min(1.0, float(whites[at]) ** 2)
            reach = float(quantiles[at]) * sd
            limits = (value - reach, value + reach)
            out[f"{label}/{name}"] = Estimate(value, sd, *limits, unit or "", 0.0, share, False)
            at += 1
    return out


def _offset_unit(problem: Problem, name: str) -> str | None:
    """Of an input's offset: the log's plain number where the estimated gain carries the unit."""
    if problem.gain_units.get(name, "1") != "1":
        return "1"
    return naming.unit(problem.model.Inputs, name)
