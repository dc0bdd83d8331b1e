"""From an optimum to a Fit: estimates, verdict, signals, metrics, whiteness, notes."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.identification.agreement import (
    correlated_residuals,
    free_runs,
    pooled_metrics,
    signals_of,
    whiteness_of,
)
from heli_jax.identification.estimation.arrival import unless_stuck
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, measured_count
from heli_jax.identification.estimation.multistart import Search, table
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.estimation.predictions_ahead import SECONDS, predictions_ahead
from heli_jax.identification.fit_notes import Numbers, absent_names, fit_notes
from heli_jax.identification.identifiability.as_likely import unless_as_likely
from heli_jax.identification.identifiability.swapped_modes import second_solutions
from heli_jax.identification.identifiability.twins import twins_of
from heli_jax.identification.identifiability.valley import Valley
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit, Signals, Status
from heli_jax.identification.uncertainty.estimates import (
    delay_doubts,
    estimates_of,
    flight_nuisances,
    limit_notes,
    with_limits,
)
from heli_jax.identification.uncertainty.standard_errors import StandardErrors, standard_errors
from heli_jax.identification.unknowns.layout import Layout, Noise, Solution, scales_of
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation import excitation
from heli_jax.identification.validation.adequacy import Adequacy, Evidence, assess, by_responses
from heli_jax.identification.validation.advice import Record, is_unstable
from heli_jax.identification.validation.aliases import (
    as_good_as_aliases,
    fast_modes,
    measurement_noise,
)
from heli_jax.identification.validation.closed_loop_trust import (
    Loop,
    feedback_trust_notes,
    held_upright,
    known_no_gusts,
    moved_by_feedback,
)
from heli_jax.identification.validation.excitation_test import (
    WRONG_OPTIMUM,
    by_excitation,
    unless_unrelated,
)
from heli_jax.identification.validation.explains_nothing import unless_explains_nothing
from heli_jax.identification.validation.feedback import (
    Feedback,
    feedback_notes,
    feedback_of,
    untested,
)
from heli_jax.identification.validation.held_out import validate
from heli_jax.identification.validation.inputs_explain import unless_inputs_explain_nothing
from heli_jax.identification.validation.late_stick import late_stick, with_late_stick
from heli_jax.identification.validation.metrics import Whiteness, metrics
from heli_jax.identification.validation.missing_dynamics import Left, missing_dynamics
from heli_jax.identification.validation.noisy_inputs import noisy_inputs, with_noisy_inputs
from heli_jax.identification.validation.unmodelled import unasked, unmodelled, with_unmodelled
from heli_jax.identification.validation.weak_instrument import weak_by_instrument, weak_note

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
    doubts: tuple[str, ...] = ()
    """why no model of these records is adequate, in a few words each"""


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
    notes: tuple[str, ...] = ()


def _held_out(problem: Problem, search: Search, optimum: RelaxedOptimum) -> _HeldOut:
    flights = tuple(f for f in problem.flights if f.hold_out)
    if not flights:
        return _HeldOut()
    # With their own initial states and biases: those of the fitted flights belong to these.
    checked = validate(problem, search.layout, optimum.best.z, optimum.noise, flights)
    free_run = free_runs(flights, checked.free_run)
    return _HeldOut(signals_of(checked.e, flights), free_run, checked.notes)


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
    layout, data, best, noise = search.layout, search.data, optimum.best, optimum.noise
    signals, absent = signals_of(e, problem.training), absent_names(layout, optimum)
    white, correlated = whiteness_of(signals, e, problem.training), correlated_residuals(signals)
    # Outputs whose residuals go together count one piece of news twice, as autocorrelation does.
    all_white = not correlated and all(w.white for w in white.values())
    solution = Solution(layout, data, noise, best.z)
    # Whether the sample time is short enough is a question to the estimated machine.
    values = {k: float(v) for k, v in zip(layout.of_interest, e.named, strict=True)}
    fast = fast_modes(problem, values, measurement_noise(problem, noise.sd))
    if bool(best.converged):
        fast = as_good_as_aliases(fast, Valley(problem, solution, e))
    aliased = frozenset(n for mode in fast for n in mode.undetermined)
    arrived = bool(best.converged)
    twins = twins_of(problem, solution, e) if arrived else ()
    second = second_solutions(problem, solution, e, reported=twins) if arrived else ()
    errors = standard_errors(
        problem,
        solution,
        e,
        run.before,
        white=all(w.white for w in white.values()) if e.innovations else all_white,
        aliased=aliased,
        twins=twins,
        second=second,
        optimum=bool(best.converged),
    )
    if bool(best.converged):
        verdict = unless_as_likely(errors.verdict, optimum.as_likely)
        verdict = unless_inputs_explain_nothing(solution, e, verdict)
        errors = errors._replace(verdict=verdict)
    numbers = _numbers(problem, solution, e, errors, absent)._replace(ill=ill)
    status = _status(best, e, errors.verdict)
    if status == "not-converged":
        numbers = numbers.without_intervals()
    held = _held_out(problem, search, optimum)
    estimates = {k: numbers.of_interest[k] for k in layout.free}
    params = _params(problem, estimates)
    against = _against_expected(search, optimum, e, absent)
    feedback, closed_loop = _feedback(problem, white, numbers if bool(best.converged) else None)
    moved = moved_by_feedback(solution, e.J) if bool(best.converged) else {}
    stays = bool(moved) and held_upright(solution)
    by_instrument = data.flights[0].by_instrument is not None
    weak = weak_by_instrument(problem, solution, e.J) if bool(best.converged) else ()
    responses = layout.estimator.response_agreement(layout, data, noise, best.z)
    instruments = _instruments(problem, by_instrument, responses)
    in_time = (problem, params, signals, white, against, layout.determined)
    ahead = against is not None and is_unstable(problem, params)
    pooled = pooled_metrics(signals)
    adequacy = (
        by_responses(responses, pooled)
        or by_excitation(problem, solution, pooled)
        or (_ahead(problem, params, solution, white) if ahead else _adequacy(*in_time))
    )
    if layout.estimator.noise_spectrum:
        adequacy = unless_unrelated(problem, adequacy)
    verdict, lacking, late = unless_explains_nothing(errors.verdict, adequacy), (), None
    if bool(best.converged) and verdict is not errors.verdict:
        errors = errors._replace(verdict=verdict, limits={})
        numbers = _numbers(problem, solution, e, errors, absent)
        status = _status(best, e, verdict)
        estimates = {k: numbers.of_interest[k] for k in layout.free}
    elif bool(best.converged) and not (ahead or instruments or any(f.present for f in feedback)):
        in_colour = errors.coloured and not layout.estimator.noise_spectrum
        sds = {n: estimate.sd for n, estimate in numbers.of_interest.items()}
        flights = labels(problem.training)
        lacking = unmodelled(solution, e, sds, coloured=in_colour, flights=flights)
        adequacy = with_unmodelled(adequacy, lacking, unasked(solution))
        named = {n: (x.value, x.sd) for n, x in numbers.of_interest.items()}
        late = late_stick(problem, solution, e, named)
        adequacy = with_late_stick(adequacy, late)
    if bool(best.converged) and not (ahead or instruments):
        named = {n: (x.value, x.sd) for n, x in numbers.of_interest.items()}
        adequacy = with_noisy_inputs(adequacy, noisy_inputs(problem, solution, e, named))
    adequacy = adequacy.doubted(delay_doubts(problem, estimates))
    stays = stays and WRONG_OPTIMUM not in adequacy.advice
    if adequacy.by_chance:
        # Of an optimum of chance nothing is to be told, of who holds the machine either.
        moved, stays = {}, False
    correlated = correlated if errors.coloured else {}
    notes = fit_notes(problem, search, optimum, e, numbers, correlated, all_white)
    notes += [*limit_notes(errors.limits), *excitation.aliasing(fast)]
    mentioned = any(not f.by_amplitude for f in lacking)
    notes += [*closed_loop, *feedback_trust_notes(moved, Loop(feedback, instruments, stays))]
    notes += [*weak_note(weak), *adequacy.sentences]
    # Of several outputs and flights the same is said once.
    notes += [
        *(() if all_white else _missing(problem, signals, adequacy, mentioned=mentioned)),
        *held.notes,
    ]
    return Fit(
        model=problem.model.name,
        method=problem.method,
        status=status,
        n_samples=measured_count(data),
        estimates=estimates,
        nuisance=numbers.nuisance,
        params=params,
        verdict_before=run.before,
        verdict=errors.verdict,
        noise=numbers.noise,
        log_likelihood=layout.estimator.log_likelihood(layout, data, noise, e),
        unknowns=_unknowns(layout, len(absent)),
        signals=(*signals, *held.signals),
        metrics=pooled_metrics(signals),
        validation=pooled_metrics(held.signals),
        validation_free_run=pooled_metrics(held.free_run),
        one_step=pooled_metrics(signals, one_step=True),
        one_step_validation=pooled_metrics(held.signals, one_step=True),
        whiteness=white,
        adequacy=adequacy.doubted(
            # What is wrong with the record makes any mode: that one is no reason of its own then.
            run.doubts or [mode.words for mode in fast if mode.undetermined]
        )._replace(at_optimum=status != "not-converged"),
        coloured=errors.coloured,
        responses=responses,
        starts=table(layout, data, run.points, run.optima),
        steps=sum(s for s, _ in optimum.trace),
        trace=optimum.trace,
        notes=tuple(dict.fromkeys(notes)),
        reached=solution,
        feedback=feedback,
        moved_by_feedback=moved,
        held_upright=stays,
        weak_instrument=weak,
        instruments=instruments,
        disturbed_loop=not all_white and known_no_gusts(problem, feedback),
        late_stick=late,
        seed=run.seed,
        timing=run.timing,
    )


def _instruments(
    problem: Problem, by_instrument: bool, responses: ResponseAgreement | None
) -> tuple[str, ...]:
    """The inputs that were taken by their instrument."""
    if responses is not None:
        return responses.instruments
    return instruments_of(problem) if by_instrument else ()


def _against_expected(
    search: Search, optimum: RelaxedOptimum, e: Evaluation, absent: tuple[str, ...]
) -> dict[str, float] | None:
    """What a perfect model's simulation would leave, None without any disturbance."""
    layout = search.layout
    # With every disturbance gone the simulation has to explain the record by itself, as with output
    # error.
    if layout.disturbance and set(layout.disturbance) <= set(absent):
        return None
    at = (layout, search.data, optimum.noise, e, optimum.best.z)
    return layout.estimator.against_expected(*at)


def _feedback(
    problem: Problem, white: dict[str, Whiteness], arrived: Numbers | None
) -> tuple[tuple[Feedback, ...], tuple[str, ...]]:
    """Whether inputs follow the outputs, and what is to be said of it."""
    # Whether feedback does harm depends on the residuals: with white innovations the direct method
    # is unbiased in a closed loop too.
    estimates = arrived.of_interest if arrived is not None else {}
    # A late log looks like feedback: each input at the time at which it acted.
    feedback = feedback_of(problem, {n: (e.value, e.sd) for n, e in estimates.items()})
    notes = feedback_notes(problem, feedback, all(w.white for w in white.values()))
    return feedback, (*notes, *untested(problem))


def _missing(
    problem: Problem, signals: tuple[Signals, ...], adequacy: Adequacy, *, mentioned: bool
) -> list[str] | tuple[()]:
    """What inputs still explain of the residuals (innovations)."""
    # Where the model is inadequate its own sentences say more.
    if not adequacy.adequate:
        return ()
    return missing_dynamics(
        tuple(
            Left(flight.dt, {n: s.error(n) for n in s.measured}, s.inputs)
            for s, flight in zip(signals, problem.training, strict=True)
        ),
        sensors=is_kinematic(problem.model),
        mentioned=mentioned,
    )


def _params(problem: Problem, estimates: dict[str, Estimate]) -> Any:
    """The vehicle with the estimates in place."""
    # Parameters alone: offsets, gains and shifts belong to the log, and a model that flies by
    # itself has none of them.
    values = {k: jnp.asarray(v.value, jnp.result_type(float)) for k, v in estimates.items()}
    return naming.replace(problem.vehicle, **values)


def _unknowns(layout: Layout, absent: int) -> int:
    """All that was estimated; disturbances that do not show, of so many parameters, are not among
    it."""
    # AIC and BIC count them: with sigma_w = 0 the correlation time has no meaning either.
    estimated = layout.determined + layout.estimator.noise_unknowns(layout)
    return estimated - absent


def _status(best: Optimum, e: Evaluation, verdict: Verdict) -> Status:
    if not bool(best.converged) or not bool(np.all(np.isfinite(e.J))):
        return "not-converged"
    return "converged" if verdict.identifiable else "not-identifiable"


def _absent(estimate: Estimate, *, gone: bool) -> Estimate:
    """The estimate of a disturbance parameter where no disturbance shows; `gone`: it is a size."""
    # Its size is then zero, at its bound; its correlation time means nothing.
    value = 0.0 if gone else estimate.value
    return estimate._replace(value=value, sd=None, lower95=None, upper95=None, at_bound=gone)


def _ahead(problem: Problem, params: Any, at: Solution, white: dict[str, Whiteness]) -> Adequacy:
    """Of an unstable model under filter error, whose simulation says nothing over a whole record:
    by what is predicted some seconds ahead."""
    records, error, expected = [], {}, {}
    for label, flight, prediction in zip(
        labels(problem.training), problem.training, predictions_ahead(at), strict=True
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
    return assess(
        problem, params, Evidence(tuple(records), agreement, white, against, ahead=SECONDS)
    )


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
    ahead = tuple(None if s.innovations is None else dict(s.innovations) for s in signals)
    evidence = Evidence(records, pooled_metrics(signals), white, against, unknowns, ahead)
    return assess(problem, params, evidence)
