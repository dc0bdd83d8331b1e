"""From an optimum to a Fit: estimates, verdict, signals, metrics, whiteness, notes."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from heli_jax.finding import Finding, weighed
from heli_jax.identification.agreement import (
    coloured_residuals,
    free_runs,
    pooled_metrics,
    signals_of,
)
from heli_jax.identification.estimation.arrival import unless_stuck
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, measured_count
from heli_jax.identification.estimation.multistart import Search, table
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.fit_notes import Numbers, fit_notes, open_directions
from heli_jax.identification.identifiability.swapped_modes import second_solutions
from heli_jax.identification.identifiability.valley import Valley
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.judgement import End, end_of, judge
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit, Signals, Status
from heli_jax.identification.uncertainty.estimates import (
    estimates_of,
    flight_nuisances,
    limit_notes,
    with_limits,
)
from heli_jax.identification.uncertainty.standard_errors import StandardErrors, standard_errors
from heli_jax.identification.unknowns.layout import Layout, Noise, Solution, scales_of
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation import excitation
from heli_jax.identification.validation.aliases import (
    FastMode,
    as_good_as_aliases,
    fast_modes,
    measurement_noise,
)
from heli_jax.identification.validation.closed_loop_trust import Loop
from heli_jax.identification.validation.held_out import validate, worse_than_mean
from heli_jax.identification.validation.held_out_agreement import HeldOutFrequency
from heli_jax.identification.validation.held_out_frequency import validate_in_frequency
from heli_jax.identification.validation.inputs_explain import unless_inputs_explain_nothing

# The parameters of a model are a class of the user's: `Any` here stands for them alone.


class OptimizationRun(NamedTuple):
    """How the optimiser was run."""

    before: Verdict
    """what the flights can determine, at the first guess"""
    points: Float[Array, "starts q"]
    """in the optimiser's coordinates"""
    optima: list[Optimum]
    """one for each start"""
    seed: int
    timing: dict[str, float]
    """[s], by what was done"""


def noise_by_name(
    problem: Problem, noise: Noise, scales: Mapping[str, ArrayLike]
) -> dict[str, float]:
    """Standard deviation of the measurement noise as 'flight/output', in the output's SI unit.

    Args:
        problem: whose flights are named.
        noise: by flight and output.
        scales: factors on it by output that are unknowns themselves (filter error); 1 unless named.
    """
    return {
        f"{label}/{n}": float(np.asarray(sd)) * float(np.asarray(scales.get(n, 1.0)))
        for label, by_name in zip(labels(problem.training), noise.sd, strict=True)
        for n, sd in by_name.items()
    }


class _HeldOut(NamedTuple):
    """The flights held out, predicted."""

    signals: tuple[Signals, ...] = ()
    free_run: tuple[Signals, ...] = ()
    """with windows: simulated in one piece"""
    findings: tuple[Finding, ...] = ()
    in_frequency: HeldOutFrequency | None = None


def _held_out(end: End, loop: Loop) -> _HeldOut:
    problem, at = end.problem, end.at
    flights = tuple(f for f in problem.flights if f.hold_out)
    if not flights:
        return _HeldOut()
    # With their own initial states and biases: those of the fitted flights belong to these.
    checked = validate(problem, at.layout, at.z, at.noise, flights)
    free_run = free_runs(flights, checked.free_run)
    in_frequency = None
    if end.arrived:
        closed = loop.held or any(f.present for f in loop.found)
        feedback = closed and not loop.instruments
        in_frequency = validate_in_frequency(problem, at, end.e, flights, feedback=feedback)
    signals, found = signals_of(checked.e, flights), list(checked.notes)
    if in_frequency is not None:
        found += in_frequency.findings
    elif not (at.layout.estimator.process_noise or at.layout.estimator.noise_spectrum):
        # With gusts in the model, or no simulation in the fit, a simulation says little.
        found += worse_than_mean(pooled_metrics(signals))
    return _HeldOut(signals, free_run, tuple(found), in_frequency)


def _numbers(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    errors: StandardErrors,
    absent: tuple[str, ...],
) -> Numbers:
    """The estimates; `absent`: the parameters of disturbances that do not show."""
    layout = at.layout
    verdict, wider, quantiles = errors.verdict, errors.wider, errors.quantiles
    of_interest = estimates_of(problem, layout, errors.by or e, verdict, quantiles, wider)
    of_interest = with_limits(of_interest, errors.limits)
    nuisance = {k: v for k, v in of_interest.items() if k not in layout.free}
    # A method that does not see initial states and biases has no interval of them.
    if layout.estimator.nuisances_in_rows:
        nuisance |= flight_nuisances(problem, at, e, quantiles, wider)
    nuisance |= {n: _absent(nuisance[n], gone=n in layout.sigmas) for n in absent}
    sds = noise_by_name(problem, at.noise, scales_of(layout, at.z))
    return Numbers(of_interest, nuisance, sds)


def _ill_conditioned(
    problem: Problem, search: Search, optimum: RelaxedOptimum, e: Evaluation
) -> bool:
    """Whether the numbers at the end of a search, with what they tell `e`, are rounding."""
    scales = scales_of(search.layout, optimum.best.z)
    sds = noise_by_name(problem, optimum.noise, scales)
    return search.layout.estimator.ill_conditioned(problem, e, sds)


def assemble(
    problem: Problem, search: Search, optimum: RelaxedOptimum, run: OptimizationRun
) -> Fit:
    """All that a fit says, from where the optimiser ended.

    Args:
        problem: what was fitted.
        search: with its layout and data.
        optimum: where the optimiser ended, with the measurement noise there.
        run: how it came there.
    """
    e = evaluate(search.layout, search.data, optimum.noise, optimum.best.z)
    optimum = unless_stuck(search.layout, optimum, e, problem.free)
    ill = _ill_conditioned(problem, search, optimum, e)
    if ill:
        # Of rounding no likelihood can be asked, by whatever asks further on.
        optimum = optimum._replace(best=optimum.best._replace(converged=np.asarray(False)))
    end = end_of(problem, search, optimum, e)
    errors, fast = _errors(end, run)

    def numbers_of(errors: StandardErrors) -> Numbers:
        numbers = _numbers(problem, end.at, e, errors, end.absent)._replace(ill=ill)
        done = _status(end, errors.verdict) != "not-converged"
        return numbers if done else numbers.without_intervals()

    judged = judge(end, errors, numbers_of)
    errors, numbers = judged.errors, judged.numbers
    layout, status = search.layout, _status(end, errors.verdict)
    held = _held_out(end, judged.loop)
    # Of rounding, and of numbers that are none, notes of their own speak.
    astray = status == "not-converged" and not ill and bool(np.all(np.isfinite(e.J)))
    coloured = coloured_residuals(
        end.white,
        layout,
        layout.free,
        allowed_for=errors.coloured,
        converged=status != "not-converged",
    )
    findings = [
        *fit_notes(
            problem,
            search,
            optimum,
            e,
            numbers,
            end.correlated if errors.coloured else {},
            end.all_white,
            coloured,
        ),
        *(open_directions(run.before, errors.verdict) if astray else ()),
        *limit_notes(errors.limits),
        *excitation.aliasing(fast),
        *judged.findings,
        *held.findings,
    ]
    return Fit(
        model=problem.model.name,
        method=problem.method,
        status=status,
        n_samples=measured_count(search.data),
        estimates={k: numbers.of_interest[k] for k in layout.free},
        nuisance=numbers.nuisance,
        params=end.params,
        verdict_before=run.before,
        verdict=errors.verdict,
        noise=numbers.noise,
        log_likelihood=layout.estimator.log_likelihood(layout, search.data, optimum.noise, e),
        unknowns=_unknowns(layout, len(end.absent)),
        signals=(*end.signals, *held.signals),
        metrics=pooled_metrics(end.signals),
        validation=pooled_metrics(held.signals),
        validation_free_run=pooled_metrics(held.free_run),
        held_out_frequency=held.in_frequency,
        one_step=pooled_metrics(end.signals, one_step=True),
        one_step_validation=pooled_metrics(held.signals, one_step=True),
        whiteness=end.white,
        adequacy=judged.adequacy,
        coloured=errors.coloured,
        responses=judged.responses,
        starts=table(layout, search.data, run.points, run.optima),
        steps=sum(s for s, _ in optimum.trace),
        trace=optimum.trace,
        # Of several outputs and flights the same is said once.
        findings=tuple(weighed(findings, numbers.of_interest)),
        reached=end.at,
        feedback=tuple(judged.loop.found),
        instruments=tuple(judged.loop.instruments),
        seed=run.seed,
        timing=run.timing,
    )


def _errors(end: End, run: OptimizationRun) -> tuple[StandardErrors, list[FastMode]]:
    """How far off the estimates may be, and the modes near the Nyquist frequency."""
    problem, at, e, arrived = end.problem, end.at, end.e, end.arrived
    # Whether the sample time is short enough is a question to the estimated machine.
    values = {k: float(v) for k, v in zip(at.layout.of_interest, e.named, strict=True)}
    fast = fast_modes(problem, values, measurement_noise(problem, at.noise.sd))
    if arrived:
        fast = as_good_as_aliases(fast, Valley(problem, at, e))
    errors = standard_errors(
        problem,
        at,
        e,
        run.before,
        white=all(w.white for w in end.white.values()) if e.innovations else end.all_white,
        aliased=frozenset(n for mode in fast for n in mode.undetermined),
        second=second_solutions(problem, at, e) if arrived else (),
        optimum=arrived,
    )
    if not arrived:
        return errors, fast
    return errors._replace(verdict=unless_inputs_explain_nothing(at, e, errors.verdict)), fast


def _unknowns(layout: Layout, absent: int) -> int:
    """All that was estimated; disturbances that do not show, of so many parameters, are not among
    it."""
    # AIC and BIC count them: with sigma_w = 0 the correlation time has no meaning either.
    estimated = layout.determined + layout.estimator.noise_unknowns(layout)
    return estimated - absent


def _status(end: End, verdict: Verdict) -> Status:
    if not end.arrived or not bool(np.all(np.isfinite(end.e.J))):
        return "not-converged"
    return "converged" if verdict.identifiable else "not-identifiable"


def _absent(estimate: Estimate, *, gone: bool) -> Estimate:
    """The estimate of a disturbance parameter where no disturbance shows; `gone`: it is a size."""
    # Its size is then zero, at its bound; its correlation time means nothing.
    value = 0.0 if gone else estimate.value
    return estimate._replace(value=value, sd=None, lower95=None, upper95=None, at_bound=gone)
