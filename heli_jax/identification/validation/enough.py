"""Is this log enough? What can be said of a record before any fit, each answer one sentence."""

from collections.abc import Sequence

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.excited_band import bands
from heli_jax.identification.validation.feedback import LEVEL, Feedback, feedback_notes
from heli_jax.identification.validation.finding import Finding
from heli_jax.identification.validation.logging_rate import logging_rate
from heli_jax.identification.validation.missing_outputs import missing_outputs
from heli_jax.identification.validation.next_flight import next_flight
from heli_jax.identification.validation.signal_quality import quantisation, saturation, stuck

_ORDER = {"refuse": 0, "doubt": 1, "ok": 2}


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
    found = [
        *logging_rate(problem, flights, at.noise.sd),
        *bands(problem.training),
        *_of_feedback(problem, feedback),
        *saturation(flights),
        *stuck(flights),
        *quantisation(flights, at.noise.sd),
    ]
    if compare:
        found += [*missing_outputs(problem, at), *next_flight(problem, at, e)]
    else:
        words = "what further outputs and manoeuvres would do is compared by heli-jax check."
        found.append(Finding("next flight", "ok", words))
    return tuple(sorted(found, key=lambda f: _ORDER[f.severity]))


def _of_feedback(problem: Problem, feedback: Sequence[Feedback]) -> list[Finding]:
    if not feedback:
        return []
    least = min(feedback, key=lambda f: f.p_value)
    criterion = f"p value of the surest input, {LEVEL:g}"
    present = feedback_notes(problem, feedback)
    if present:
        return [Finding("feedback", "doubt", s, least.p_value, criterion) for s in present]
    words = f"no input follows the response (p {least.p_value:.2g} of {least.input})."
    return [Finding("feedback", "ok", words, least.p_value, criterion)]
