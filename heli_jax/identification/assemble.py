"""From an optimum to a Fit: estimates, verdict, signals, metrics, whiteness, notes."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array

from heli_jax import naming
from heli_jax.identification.agreement import (
    correlated_residuals,
    free_runs,
    pooled_metrics,
    signals_of,
    whiteness_of,
)
from heli_jax.identification.estimation.disturbance_search import NO_DISTURBANCE
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, measured_count
from heli_jax.identification.estimation.multistart import Search, table
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
)
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.identifiability.verdict import Z95, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit, Signals, Status
from heli_jax.identification.uncertainty.autocorrelated_residuals import (
    Sandwich,
    residual_curvature,
    sandwich,
)
from heli_jax.identification.uncertainty.estimates import (
    bound_notes,
    estimates_of,
    extreme_noise_notes,
    flight_nuisances,
    prior_notes,
    stated_noise_notes,
)
from heli_jax.identification.unknowns.layout import Layout, Noise, Solution, unpack
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation import excitation
from heli_jax.identification.validation.adequacy import Adequacy, assess
from heli_jax.identification.validation.advice import Record
from heli_jax.identification.validation.held_out import validate
from heli_jax.identification.validation.metrics import (
    Whiteness,
)
from heli_jax.identification.validation.other_hold import other_hold


class Ran(NamedTuple):
    """How the optimiser was run."""

    before: Verdict
    points: Array
    runs: list[Optimum]
    seed: int
    timing: dict[str, float]


def noise_by_name(
    problem: Problem, layout: Layout, noise: Noise, scales: dict[str, Any]
) -> dict[str, float]:
    """sd of the measurement noise as 'flight/output'."""
    return {
        f"{label}/{n}": float(s) * float(scales.get(n, 1.0))
        for label, by_name in zip(labels(problem.training), noise.sd, strict=True)
        for n, s in by_name.items()
    }


class _Uncertainty(NamedTuple):
    """How sure the numbers at the optimum are."""

    verdict: Verdict
    wider: np.ndarray
    """(q,) by how much autocorrelated residuals widen the standard deviations of the unknowns"""
    quantiles: np.ndarray
    """(q,) standard deviations that a 95 % interval reaches to either side"""
    coloured: bool
    """whether the intervals allow for residuals that are not white"""


def _uncertainty(
    problem: Problem, search: Search, settled: RelaxedOptimum, e: Evaluation, ran: Ran, white: bool
) -> _Uncertainty:
    """Cramér-Rao's bound, or where the residuals are not white and their autocorrelation can be
    estimated, the sandwich.

    Args:
        e: at the optimum.
        white: whether the residuals are white and independent between outputs.
    """
    layout, data, best, noise = search.layout, search.data, settled.best, settled.noise
    usable = bool(np.all(np.isfinite(e.J)))
    verdict = verdict_of(problem, layout, e) if usable else ran.before
    freedom = max(measured_count(data) - layout.determined, 1)
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
    quantiles = np.full(layout.size, quantile)
    estimator = layout.estimator
    white = white and estimator.rows_are_white
    if white or not (usable and estimator.rows_are_samples):
        return _Uncertainty(verdict, np.ones(layout.size), quantiles, False)
    errors = sandwich(layout, data, e, residual_curvature(layout, data, noise, best.z))
    quantiles = np.maximum(errors.quantile(), quantile)
    # The rule of the factor of ten has to see the intervals that are reported.
    verdict = verdict_of(problem, layout, e, _reported(errors, layout, e, quantiles))
    verdict = _widened(verdict, errors, _along(verdict, layout, e))
    return _Uncertainty(verdict, errors.inflation(), quantiles, True)


class _HeldOut(NamedTuple):
    """The flights held out, predicted."""

    signals: tuple[Signals, ...] = ()
    free_run: tuple[Signals, ...] = ()
    notes: tuple[str, ...] = ()


def _held_out(problem: Problem, search: Search, settled: RelaxedOptimum) -> _HeldOut:
    flights = tuple(f for f in problem.flights if f.hold_out)
    if not flights:
        return _HeldOut()
    checked = validate(problem, search.layout, settled.best.z, settled.noise, flights)
    free_run = free_runs(flights, checked.free_run)
    return _HeldOut(signals_of(checked.e, flights), free_run, checked.notes)


def assemble(problem: Problem, search: Search, settled: RelaxedOptimum, ran: Ran) -> Fit:
    """All that a fit says, from where the optimiser ended."""
    layout, data, best, noise = search.layout, search.data, settled.best, settled.noise
    e = evaluate(layout, data, noise, best.z)
    signals = signals_of(e, problem.training)
    white = whiteness_of(signals, e)
    together = correlated_residuals(signals)
    all_white = not together and all(w.white for w in white.values())
    sure = _uncertainty(problem, search, settled, e, ran, all_white)
    named = estimates_of(problem, layout, e, sure.verdict, sure.quantiles, sure.wider)
    estimates = {k: named[k] for k in layout.free}
    nuisance = {k: v for k, v in named.items() if k not in layout.free}
    nuisance |= flight_nuisances(problem, layout, data, best.z, e, sure.quantiles, sure.wider)
    none = settled.ratio is not None and settled.ratio < NO_DISTURBANCE
    if none:
        nuisance |= {name: _absent(name, nuisance[name]) for name in layout.disturbance}
    held = _held_out(problem, search, settled)
    sds = noise_by_name(problem, layout, noise, unpack(layout, data, best.z).scales)
    ill = layout.estimator.ill_conditioned(problem, e, sds)
    values = {k: jnp.asarray(v.value, jnp.result_type(float)) for k, v in estimates.items()}
    params = naming.replace(problem.vehicle, **values)
    against = None
    if not none:
        against = layout.estimator.against_expected(layout, data, noise, e, best.z)
    adequacy = _adequacy(problem, params, signals, white, against, layout.determined)
    notes = [
        *_notes(problem, search, settled, e, none=none, ill=ill),
        *stated_noise_notes(problem, sds),
        *_correlation_notes(together if sure.coloured else {}),
        *bound_notes(named),
        *prior_notes(problem, estimates),
        *_hold_notes(problem, search, settled, e, named),
        *adequacy.sentences,
        *held.notes,
    ]
    return Fit(
        model=problem.model.name,
        method=problem.method,
        status=_status(best, bool(np.all(np.isfinite(e.J))) and not ill, sure.verdict),
        n_samples=measured_count(data),
        estimates=estimates,
        nuisance=nuisance,
        params=params,
        verdict_before=ran.before,
        verdict=sure.verdict,
        noise=sds,
        log_likelihood=layout.estimator.log_likelihood(layout, data, noise, e),
        unknowns=_unknowns(layout, none=none),
        signals=(*signals, *held.signals),
        metrics=pooled_metrics(signals),
        validation=pooled_metrics(held.signals),
        validation_free_run=pooled_metrics(held.free_run),
        one_step=pooled_metrics(signals, one_step=True),
        one_step_validation=pooled_metrics(held.signals, one_step=True),
        whiteness=white,
        adequacy=adequacy,
        coloured=sure.coloured,
        starts=table(layout, data, ran.points, ran.runs),
        steps=sum(s for s, _ in settled.trace),
        trace=settled.trace,
        notes=tuple(notes),
        reached=Solution(layout, data, noise, best.z),
        seed=ran.seed,
        timing=ran.timing,
    )


def _unknowns(layout: Layout, *, none: bool) -> int:
    """All that was estimated; a disturbance that does not show is not among it."""
    estimated = layout.determined + layout.estimator.noise_unknowns(layout)
    return estimated - (len(layout.disturbance) if none else 0)


def _notes(
    problem: Problem,
    search: Search,
    settled: RelaxedOptimum,
    e: Evaluation,
    *,
    none: bool,
    ill: bool,
) -> list[str]:
    """Of the optimum and of what the method takes for granted.

    Args:
        e: at the optimum.
        none: whether no disturbance shows.
        ill: whether the numbers are rounding.
    """
    layout, data, best = search.layout, search.data, settled.best
    reached = {k: float(v) for k, v in zip(layout.of_interest, e.named, strict=True)}
    return [
        *_stopped_notes(layout, best, settled),
        *excitation.sampling(problem, reached),
        *_disturbance_notes(settled.ratio if none else None),
        *([] if none else extreme_noise_notes(layout, data, best.z)),
        *settled.notes,
        *layout.estimator.notes(layout, data, settled.noise, e, ill),
    ]


def _along(verdict: Verdict, layout: Layout, e: Evaluation) -> np.ndarray:
    """The logarithms of the verdict's combinations as directions (k, q) of the unknowns."""
    # What a logarithm gains by the optimiser's coordinate.
    slopes = np.asarray(e.slopes) / np.asarray(e.named)
    along = np.zeros((len(verdict.combinations), layout.size))
    for k, c in enumerate(verdict.combinations):
        for name, power in c.exponents.items():
            i = layout.of_interest.index(name)
            along[k, i] = power * slopes[i]
    return along


def _reported(errors: Sandwich, layout: Layout, e: Evaluation, quantiles: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of the named unknowns with autocorrelated residuals, as wide as the
    intervals that are reported."""
    named = np.eye(layout.size)[: len(layout.of_interest)]
    factor = quantiles[: len(layout.of_interest)] / Z95
    return errors.covariance(named) * np.outer(factor, factor)


def _widened(verdict: Verdict, errors: Sandwich, along: np.ndarray) -> Verdict:
    """The verdict with intervals of its combinations, directions (k, q), that allow for
    autocorrelated residuals."""
    if not verdict.combinations:
        return verdict
    wider = errors.inflation(along)
    reach = wider * errors.quantile(along) / Z95
    combinations = tuple(
        c._replace(
            sd=float(c.sd * w),
            lower95=float(c.value * (c.lower95 / c.value) ** r),
            upper95=float(c.value * (c.upper95 / c.value) ** r),
        )
        for c, w, r in zip(verdict.combinations, wider, reach, strict=True)
    )
    return replace(verdict, combinations=combinations)


def _status(best: Optimum, usable: bool, verdict: Verdict) -> Status:
    if not bool(best.converged) or not usable:
        return "not-converged"
    return "converged" if verdict.identifiable else "not-identifiable"


def _absent(name: str, one: Estimate) -> Estimate:
    """The estimate of a disturbance parameter where no disturbance shows."""
    gone = name == "sigma_w"
    value = 0.0 if gone else one.value
    return one._replace(value=value, sd=None, lower95=None, upper95=None, at_bound=gone)


def _hold_notes(
    problem: Problem,
    search: Search,
    settled: RelaxedOptimum,
    e: Evaluation,
    named: dict[str, Estimate],
) -> list[str]:
    """Where the log let inputs be taken as linear between samples, and it matters."""
    if not bool(settled.best.converged):
        return []
    sd = {n: one.sd for n, one in named.items() if one.sd is not None}
    at = (search.layout, search.data, settled.noise, settled.best.z)
    return other_hold(problem, *at, e, sd, in_doubt=True)


def _correlation_notes(together: dict[str, float]) -> list[str]:
    if not together:
        return []
    words = "; ".join(f"{names}: {rho:+.2f}" for names, rho in together.items())
    return [f"Residuals of outputs are correlated ({words}): the intervals allow for it."]


def _adequacy(
    problem: Problem,
    params: Any,
    signals: tuple[Signals, ...],
    white: dict[str, Whiteness],
    against: dict[str, float] | None,
    unknowns: int,
) -> Adequacy:
    records = tuple(
        Record(s.flight, flight.dt, s.measured, s.simulated)
        for s, flight in zip(signals, problem.training, strict=True)
    )
    return assess(problem, params, records, pooled_metrics(signals), white, against, unknowns)


def _disturbance_notes(ratio: float | None) -> list[str]:
    if ratio is None:
        return []
    return [
        "No disturbance shows in the record (twice the log-likelihood gained by one is "
        f"{ratio:.2g}): output error suffices, and these are its numbers."
    ]


def _stopped_notes(layout: Layout, best: Optimum, settled: RelaxedOptimum) -> list[str]:
    """What to do where the optimiser has not arrived."""
    if bool(best.converged):
        return []
    steps = sum(s for s, _ in settled.trace)
    windows = sum(count for count, _ in layout.windows)
    remedy = "start nearer, with bounds or several starts, or allow more steps"
    if windows > len(layout.windows) and layout.continuity is None:
        remedy = (
            "tie the windows together (continuity), since a state that no output shows is free in "
            f"each of them; or {remedy}"
        )
    return [
        f"The optimiser stopped after {steps} steps without arriving: these numbers are no result. "
        f"Remedy: {remedy}."
    ]
