"""What is concluded of an optimum: whether the model explains its records, and who moved them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Finding
from heli_jax.identification.agreement import (
    correlated_residuals,
    pooled_metrics,
    signals_of,
    whiteness_of,
)
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.estimation.predictions_ahead import SECONDS, predictions_ahead
from heli_jax.identification.fit_notes import Numbers, absent_names
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Signals
from heli_jax.identification.uncertainty.standard_errors import StandardErrors
from heli_jax.identification.unknowns.layout import Layout, Solution
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    Adequacy,
    Evidence,
    assess,
    by_responses,
)
from heli_jax.identification.validation.advice import Record, is_unstable
from heli_jax.identification.validation.closed_loop_trust import (
    Loop,
    feedback_trust,
    held_upright,
    knows_no_gusts,
    moved_by_feedback,
)
from heli_jax.identification.validation.excitation_test import (
    WRONG_OPTIMUM,
    by_excitation,
    unless_unrelated,
)
from heli_jax.identification.validation.explains_nothing import unless_explains_nothing
from heli_jax.identification.validation.feedback import (
    FEEDBACK,
    feedback_notes,
    feedback_of,
    untested,
)
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.identification.validation.late_inputs import late_inputs
from heli_jax.identification.validation.late_stick import late_stick
from heli_jax.identification.validation.logging_rate import loop_between_samples
from heli_jax.identification.validation.metrics import Whiteness, metrics
from heli_jax.identification.validation.unmodelled import unmodelled
from heli_jax.identification.validation.weak_instrument import weak_by_instrument, weak_note

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
