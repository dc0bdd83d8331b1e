"""From an optimum to a Fit: estimates, verdict, signals, metrics, whiteness, notes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Finding, weighed
from heli_jax.identification.agreement import (
    coloured_residuals,
    correlated_residuals,
    free_runs,
    pooled_metrics,
    signals_of,
    whiteness_of,
)
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.filter_error import SECONDS, predictions_ahead
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.levenberg_marquardt import measured_count
from heli_jax.identification.estimation.multistart import Search, StartRow
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum, unless_stuck
from heli_jax.identification.fit_notes import Numbers, absent_names, fit_notes, open_directions
from heli_jax.identification.identifiability.equivalents import Valley, second_solutions
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit, Signals, Status
from heli_jax.identification.uncertainty.estimates import (
    estimates_of,
    flight_nuisances,
    limit_notes,
    with_limits,
)
from heli_jax.identification.uncertainty.standard_errors import StandardErrors, standard_errors
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.unknowns.layout import Layout, Noise, Solution, scales_of
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    Adequacy,
    Evidence,
    assess,
    by_responses,
    unless_explains_nothing,
    unless_inputs_explain_nothing,
)
from heli_jax.identification.validation.advice import Record, is_unstable
from heli_jax.identification.validation.aliases import (
    FastMode,
    aliasing,
    as_good_as_aliases,
    fast_modes,
    measurement_noise,
)
from heli_jax.identification.validation.closed_loop_trust import (
    Loop,
    feedback_trust,
    held_upright,
    knows_no_gusts,
    moved_by_feedback,
    weak_by_instrument,
    weak_note,
)
from heli_jax.identification.validation.excitation_test import (
    WRONG_OPTIMUM,
    by_excitation,
    unless_unrelated,
)
from heli_jax.identification.validation.feedback import (
    FEEDBACK,
    feedback_notes,
    feedback_of,
    untested,
)
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.identification.validation.held_out import validate, worse_than_mean
from heli_jax.identification.validation.held_out_agreement import HeldOutFrequency
from heli_jax.identification.validation.held_out_frequency import validate_in_frequency
from heli_jax.identification.validation.late_inputs import late_inputs
from heli_jax.identification.validation.late_stick import late_stick
from heli_jax.identification.validation.logging_rate import loop_between_samples
from heli_jax.identification.validation.metrics import Whiteness, metrics
from heli_jax.identification.validation.unmodelled import unmodelled

# What is concluded of an optimum: whether the model explains its records, and who moved them.


# The parameters of a model are a class of the user's: `Any` here stands for them alone.


_HELD = 1.0
"""a mode that grows by e to this over a record shows that its vehicle is held"""
_IN_A_LOOP = "the inputs follow the response, and the residuals are not white"


class End(NamedTuple):
    """Where a search ended, and what its residuals are like."""

    problem: Problem
    optimum: RelaxedOptimum
    at: Solution
    e: Evaluation
    signals: tuple[Signals, ...]
    white: dict[str, Whiteness]
    correlated: dict[str, float]
    """by pair of outputs"""
    absent: tuple[str, ...]
    """the parameters of disturbances that do not show"""
    params: Any
    """the vehicle with the estimates in place"""

    @property
    def arrived(self) -> bool:
        """Whether the optimiser came to an optimum."""
        return bool(self.optimum.best.converged)

    @property
    def all_white(self) -> bool:
        """Whether residuals, or innovations, are white, and those of each output by themselves."""
        # Outputs whose residuals go together count one piece of news twice, as autocorrelation
        # does.
        return not self.correlated and all(w.white for w in self.white.values())


def end_of(problem: Problem, search: Search, optimum: RelaxedOptimum, e: Evaluation) -> End:
    """Where a search ended.

    Args:
        problem: what was fitted.
        search: with its layout and data.
        optimum: where the optimiser ended.
        e: what it tells.
    """
    signals, layout = signals_of(e, problem.training), search.layout
    return End(
        problem,
        optimum,
        Solution(layout, search.data, optimum.noise, optimum.best.z),
        e,
        signals,
        whiteness_of(signals, e, problem.training, layout),
        correlated_residuals(signals),
        absent_names(layout, optimum),
        # Parameters alone: offsets, gains and shifts belong to the log, and a model that flies by
        # itself has none of them.
        problem.params_with(
            {n: v for n, v in zip(layout.of_interest, e.named, strict=True) if n in layout.free}
        ),
    )


class Judgement(NamedTuple):
    """What is concluded of an optimum."""

    errors: StandardErrors
    numbers: Numbers
    adequacy: Adequacy
    loop: Loop
    responses: ResponseAgreement | None
    findings: tuple[Finding, ...]


def judge(
    end: End, errors: StandardErrors, numbers_of: Callable[[StandardErrors], Numbers]
) -> Judgement:
    """Whether the model explains its records, and what of the estimates may not be trusted.

    Args:
        end: where the search ended.
        errors: how far off the estimates may be.
        numbers_of: the estimates with such errors. Where the model explains nothing they lose their
            intervals.
    """
    problem, at, J, arrived = end.problem, end.at, end.e.J, end.arrived
    layout, numbers = at.layout, numbers_of(errors)
    feedback, closed_loop = _feedback(end, numbers)
    moved = moved_by_feedback(at, J) if arrived else {}
    held = bool(moved) and held_upright(at)
    weak = weak_by_instrument(problem, at, J) if arrived else ()
    responses = layout.estimator.response_agreement(layout, at.data, at.noise, at.z)
    instruments = _instruments(end, responses)
    adequacy, ahead = _adequacy(end, responses)
    verdict = unless_explains_nothing(errors.verdict, adequacy)
    explains = verdict is errors.verdict
    if arrived and not explains:
        errors = errors._replace(verdict=verdict, limits={})
        numbers = numbers_of(errors)
    misfits: list[Finding] = []
    named = {n: (x.value, x.sd) for n, x in numbers.of_interest.items()}
    if arrived and explains and not instruments:
        simulated = not (ahead or any(f.present for f in feedback))
        misfits += _misfits(end, errors, named, simulated=simulated)
    if layout.estimator.noise_spectrum or not (arrived and explains):
        misfits += _late_inputs(problem, layout, feedback)
    held = held and all(f.code != WRONG_OPTIMUM for f in adequacy.findings)
    against = adequacy.findings
    if adequacy.by_chance:
        # Of an optimum of chance nothing is to be told, of who holds the vehicle either.
        moved, held = {}, False
        against = tuple(f._replace(distrusts=tuple(layout.free)) for f in against)
    loop = Loop(feedback, instruments, held)
    findings = (
        *closed_loop,
        *feedback_trust(moved, loop),
        *weak_note(weak),
        *misfits,
        *against,
    )
    return Judgement(errors, numbers, adequacy, loop, responses, findings)


def _misfits(
    end: End,
    errors: StandardErrors,
    estimates: Mapping[str, tuple[float, float | None]],
    *,
    simulated: bool,
) -> list[Finding]:
    """Return what the rows tell of the inputs' timing and, where the simulation's residuals may be
    asked (`simulated`), of dynamics that the model lacks."""
    problem, at, e = end.problem, end.at, end.e
    timing, lacking = late_stick(problem, at, e, estimates), ()
    if simulated:
        in_colour = errors.coloured and not at.layout.estimator.noise_spectrum
        lacking = unmodelled(at, e, coloured=in_colour, flights=labels(problem.training))
    # A lag that is missing shows in both, and in the residual more closely.
    told = {f.code for f in lacking}
    return [*(f for f in timing if f.code not in told), *lacking]


def _late_inputs(problem: Problem, layout: Layout, feedback: Sequence[Feedback]) -> list[Finding]:
    """Return the inputs that an output precedes, where no likelihood tells how late they are."""
    if layout.shift or set(problem.model.delay_parameters) & set(problem.free):
        return []
    return late_inputs(list(zip(labels(problem.training), problem.training, strict=True)), feedback)


def _adequacy(end: End, responses: ResponseAgreement | None) -> tuple[Adequacy, bool]:
    """Whether the model explains its records, and whether that was asked some seconds ahead."""
    problem, against = end.problem, _against_expected(end)
    ahead = against is not None and (is_unstable(problem, end.params) or _bent(end, against))
    pooled = pooled_metrics(end.signals)
    adequacy = (
        by_responses(responses)
        or by_excitation(problem, end.at, pooled)
        or (_ahead(end) if ahead else _over_records(end, against))
    )
    if end.at.layout.estimator.noise_spectrum:
        adequacy = unless_unrelated(problem, adequacy)
    return adequacy, ahead


def _bent(end: End, against: Mapping[str, float]) -> bool:
    """True if a simulation misses by more than a disturbance makes of a linear model, though all
    innovations of a nonlinear one are white: gusts may have carried it where slopes along the
    simulation say nothing, such as a pendulum over the top."""
    white = all(w.white for w in end.white.values())
    return not end.problem.model.linear and white and max(against.values()) > EXPECTED


def _instruments(end: End, responses: ResponseAgreement | None) -> tuple[str, ...]:
    """The inputs that were taken by their instrument."""
    if responses is not None:
        return responses.instruments
    by_instrument = end.at.data.flights[0].by_instrument is not None
    return instruments_of(end.problem) if by_instrument else ()


def _against_expected(end: End) -> dict[str, float] | None:
    """What a perfect model's simulation would leave, None without any disturbance."""
    layout = end.at.layout
    # With every disturbance gone the simulation has to explain the record by itself, as with output
    # error.
    if layout.disturbance and set(layout.disturbance) <= set(end.absent):
        return None
    at = end.at
    return layout.estimator.against_expected(layout, at.data, at.noise, end.e, at.z)


def _feedback(end: End, numbers: Numbers) -> tuple[tuple[Feedback, ...], list[Finding]]:
    """Whether inputs follow the outputs, and what is to be said of it."""
    # Whether feedback does harm depends on the residuals: with white innovations the direct method
    # is unbiased in a closed loop too.
    problem, estimates = end.problem, numbers.of_interest if end.arrived else {}
    # A late log looks like feedback: each input at the time at which it acted.
    feedback = feedback_of(problem, {n: (e.value, e.sd) for n, e in estimates.items()})
    white = all(w.white for w in end.white.values())
    findings = feedback_notes(problem, feedback, white)
    if end.arrived and not end.all_white and knows_no_gusts(problem):
        # Nothing shows which of them: a disturbance in the inputs moves all.
        if any(one.present for one in feedback):
            findings = [
                f._replace(severity="doubt", brief=_IN_A_LOOP, distrusts=tuple(estimates))
                for f in findings
            ]
        elif is_unstable(problem, end.params, _HELD):
            findings.append(_held(tuple(estimates)))
    flights = list(zip(labels(problem.training), problem.training, strict=True))
    fast = [f._replace(distrusts=tuple(estimates)) for f in loop_between_samples(flights, feedback)]
    return feedback, [*fast, *findings, *untested(problem)]


def _held(names: tuple[str, ...]) -> Finding:
    """The finding that the inputs must follow the response, whatever a test of them says."""
    words = (
        "The model has a mode that grows, and the record does not: the inputs hold the vehicle, so "
        "that they follow its response. The residuals are not white, and output error is biased "
        "where gusts act in a loop: method: filter-error with a disturbance is advised."
    )
    return Finding(FEEDBACK, "doubt", words, brief=_IN_A_LOOP, distrusts=names)


def _ahead(end: End) -> Adequacy:
    """Adequacy by what is predicted some seconds ahead, under filter error: of a model whose
    simulation says nothing over a whole record."""
    problem, records, error, expected = end.problem, [], {}, {}
    for label, flight, prediction in zip(
        labels(problem.training), problem.training, predictions_ahead(end.at), strict=True
    ):
        records.append(Record(label, flight.dt, flight.outputs, prediction.predicted))
        for n, v in prediction.predicted.items():
            missed = float(np.nansum(np.square(flight.outputs[n] - v)))
            error[n] = error.get(n, 0.0) + missed
            expected[n] = expected.get(n, 0.0) + float(np.nansum(prediction.variance[n]))
    agreement = {}
    for n in error:
        both = [(r.measured[n], r.simulated[n]) for r in records if n in r.measured]
        measured, predicted = (np.concatenate(v) for v in zip(*both, strict=True))
        agreement[n] = metrics(measured, predicted)
    against = {n: error[n] / expected[n] if expected[n] > 0 else np.inf for n in error}
    evidence = Evidence(tuple(records), agreement, end.white, against, ahead=SECONDS)
    return assess(problem, end.params, evidence)


def _over_records(end: End, against: dict[str, float] | None) -> Adequacy:
    """By what is simulated from the beginning of each record to its end."""
    problem, signals = end.problem, end.signals
    records = tuple(
        Record(s.flight, flight.dt, s.measured, s.simulated)
        for s, flight in zip(signals, problem.training, strict=True)
    )
    ahead = tuple(None if s.innovations is None else dict(s.innovations) for s in signals)
    unknowns = end.at.layout.determined
    evidence = Evidence(records, pooled_metrics(signals), end.white, against, unknowns, ahead)
    return assess(problem, end.params, evidence)


# The parameters of a model are a class of the user's: `Any` here stands for them alone.


class OptimizationRun(NamedTuple):
    """How the optimiser was run."""

    before: Verdict
    """what the flights can determine, at the first guess"""
    runs: tuple[StartRow, ...]
    """every run from a start"""
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
        *aliasing(fast),
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
        starts=run.runs,
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
