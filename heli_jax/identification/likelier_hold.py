"""What an input does between samples, by the record where the log leaves it open."""

import dataclasses
from collections.abc import Callable

from heli_jax.finding import note
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.other_hold import likelier_hold


def with_likelier_hold(
    problem: Problem, fit: Fit, refit: Callable[[Problem], Fit]
) -> tuple[Problem, Fit]:
    """The fit, and what was fitted, with inputs held of which the log left that open, where the
    record bears it out.

    An input that moves at every sample may be a stick that was sampled on its way or a command that
    is computed at each sample and held. The log looks the same; the answer is half a sample later.

    Args:
        problem: what was fitted.
        fit: the fit.
        refit: fits a problem as that one was.
    """
    if fit.status == "not-converged":
        return problem, fit
    # By how much the colour of the residuals widens intervals: the record is worth so much less.
    wider = [e.sd / e.sd_white for e in fit.estimates.values() if e.sd and e.sd_white]
    held = likelier_hold(problem, fit.reached, max(wider, default=1.0))
    if held is None:
        return problem, fit
    again = refit(held.problem)
    if again.status == "not-converged" or not again.log_likelihood > fit.log_likelihood:
        return problem, fit
    taken = note("timing.likelier-hold", held.sentence, *held.inputs)
    return held.problem, dataclasses.replace(again, findings=(taken, *again.findings))
