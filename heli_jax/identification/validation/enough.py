"""Is this log enough? What can be said of a record before any fit, each answer one sentence."""

from collections.abc import Mapping, Sequence
from typing import Any

from heli_jax.finding import Finding
from heli_jax.identification.design.next_flight import missing_outputs, next_flight
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.aliases import measurement_noise
from heli_jax.identification.validation.excitation_test import outputs_against_excitation
from heli_jax.identification.validation.excited_band import NOTHING, NOTHING_FOLLOWS, bands
from heli_jax.identification.validation.feedback import feedback_notes, untested, why_untested
from heli_jax.identification.validation.follows_response import LEVEL, Feedback
from heli_jax.identification.validation.late_inputs import LATE, late_angles, late_inputs
from heli_jax.identification.validation.logging_rate import (
    LOGGING_RATE,
    logging_rate,
    loop_between_samples,
)
from heli_jax.identification.validation.misread import doubtful_inputs, misread
from heli_jax.identification.validation.signal_quality import (
    quantisation,
    saturation,
    smoothed,
    strays,
    stuck,
)
from heli_jax.identification.validation.signal_signs import (
    against_start,
    rate_against_angle,
    sticks_of,
)
from heli_jax.numbers import p_value

# params is Any: a record of a model's Params, whose class may be a user's own.

_CHANCE = 0.1
"""p value of the output that follows the inputs most surely, from which on none is taken to: of a
machine in strong gusts it is far less"""
_ORDER = {"refuse": 0, "doubt": 1, "ok": 2, "note": 2}


def _rank(finding: Finding) -> tuple[int, bool]:
    """Rank findings: the worst first, and of those a late input, which makes modes look fast."""
    return _ORDER[finding.severity], finding.code != LATE


def is_it_enough(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    feedback: Sequence[Feedback],
    *,
    compare: bool = True,
) -> tuple[Finding, ...]:
    """All findings, what is worst first.

    Args:
        problem: the flights and what is free.
        at: layout, data, noise and unknowns at the start values.
        e: the evaluation there.
        feedback: whether inputs follow the response, of all flights.
        compare: whether to compute what further outputs and manoeuvres would do, too.
    """
    flights = list(zip(labels(problem.training), problem.training, strict=True))
    findings = [
        *logging_rate(problem, flights, at.noise.sd),
        *loop_between_samples(flights, feedback),
        *(_if_nothing_follows(problem, f, feedback) for f in bands(problem.training)),
        *_of_feedback(problem, feedback),
        *saturation(flights),
        *stuck(flights),
        *strays(flights),
        *quantisation(flights, at.noise.sd),
        *smoothed(flights, process_noise=estimator_of(problem.method).process_noise),
        *misread(problem),
        *rate_against_angle(problem),
        *late_angles(problem),
        *against_start(flights, e.simulated, sticks_of(problem.model)),
        *doubtful_inputs(flights, e.simulated, sticks_of(problem.model)),
        *late_inputs(flights, feedback),
    ]
    if compare:
        findings += [*missing_outputs(problem, at), *next_flight(problem, at, e)]
    else:
        words = "what further outputs and manoeuvres would do is compared by heli-jax check."
        findings.append(Finding("excitation.next-flight", "note", words))
    return tuple(sorted(findings, key=_rank))


def _if_nothing_follows(problem: Problem, f: Finding, feedback: Sequence[Feedback]) -> Finding:
    """Refuse a record in which no output follows any input, where what the two have in common is
    chance, or comes from inputs that follow the response: a rate loop on the ground."""
    if f.code != NOTHING_FOLLOWS or f.value is None or f.value >= NOTHING:
        return f
    p_values = outputs_against_excitation(problem)
    by_chance = not p_values or min(p_values.values()) >= _CHANCE
    is_refused = by_chance or any(one.present for one in feedback)
    return f._replace(severity="refuse") if is_refused else f


def judged_again(
    problem: Problem, findings: Sequence[Finding], params: Any, sd: Sequence[Mapping[str, Any]]
) -> tuple[Finding, ...]:
    """The findings with the logging rate at the estimates.

    Args:
        problem: what was fitted.
        findings: at the start values.
        params: the model's Params with the estimates in place, SI.
        sd: of the residuals by flight and output, SI.
    """
    flights = list(zip(labels(problem.training), problem.training, strict=True))
    again = logging_rate(problem, flights, measurement_noise(problem, sd), params)
    kept = [f for f in findings if f.code != LOGGING_RATE]
    return tuple(sorted([*again, *kept], key=_rank))


def _of_feedback(problem: Problem, feedback: Sequence[Feedback]) -> list[Finding]:
    # What is not tested is said: "no input follows" would be taken for all outputs.
    aside = untested(problem)
    if not feedback:
        why = why_untested(problem)
        if why is None:
            return aside
        # Steps that somebody commanded follow nothing; of the rest nothing is known.
        severity = "note" if why.programmed else "doubt"
        words = f"whether an input follows the response was not tested: {why.reason}."
        return [Finding("loop.not-tested", severity, words)]
    least = min(feedback, key=lambda f: f.p_value)
    criterion = f"p value of the surest input, {LEVEL:g}"
    present = feedback_notes(problem, feedback)
    if present:
        return [*present, *aside]
    words = (
        "no input follows what is unforeseen of the response (p-value "
        f"{p_value(least.p_value)} for {least.input})."
    )
    # The loop is closed, and nothing is to be doubted of inputs that are taken by an instrument.
    if least.present:
        closed = list(dict.fromkeys(f.input for f in feedback if f.present))
        follow = "follows" if len(closed) == 1 else "follow"
        words = (
            f"{', '.join(closed)} {follow} what is unforeseen of the response (p-value "
            f"{p_value(least.p_value)} for {least.input}): the loop is closed, which the logged "
            "excitation (instrument) allows for."
        )
    return [Finding("loop.feedback", "ok", words, least.p_value, criterion), *aside]
