"""What a fit says in sentences: of its optimum, of what its method assumes, of its numbers."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.finding import Finding, note
from heli_jax.identification.estimation.disturbance_search import NO_DISTURBANCE
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.through_inputs import of_disturbances
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate
from heli_jax.identification.uncertainty.estimates import (
    bound_findings,
    delay_findings,
    extreme_noise_notes,
    prior_findings,
    stated_noise_notes,
)
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.unknowns.layout import Layout, Solution
from heli_jax.identification.validation.other_hold import other_hold

STOPPED = "search.stopped"
_NO_DISTURBANCE = "noise.no-disturbance"
_NEAR_ZERO = 0.2
"""of an estimate, below which a start says nothing of its sign"""


class Numbers(NamedTuple):
    """All that was estimated."""

    of_interest: dict[str, Estimate]
    """free parameters, gains of the inputs, time shift"""
    nuisance: dict[str, Estimate]
    """all but the free parameters"""
    noise: dict[str, float]
    """standard deviations as 'flight/output'"""
    ill: bool = False
    """whether the numbers are rounding"""

    def without_intervals(self) -> "Numbers":
        """Of a search that did not arrive: slopes where it stopped bound nothing."""
        of_interest, nuisance = (
            {
                n: e._replace(sd=None, lower95=None, upper95=None, sd_white=None, sd_alone=None)
                for n, e in estimates.items()
            }
            for estimates in (self.of_interest, self.nuisance)
        )
        return self._replace(of_interest=of_interest, nuisance=nuisance)


def no_disturbance(optimum: RelaxedOptimum) -> bool:
    """Whether a disturbance was looked for and does not show.

    Args:
        optimum: where the optimiser ended.
    """
    return optimum.ratio is not None and optimum.ratio < NO_DISTURBANCE


def absent_names(layout: Layout, optimum: RelaxedOptimum) -> tuple[str, ...]:
    """The parameters of all disturbances that do not show.

    Args:
        layout: what the unknowns are.
        optimum: where the optimiser ended.
    """
    return layout.disturbance if no_disturbance(optimum) else optimum.absent


def fit_notes(
    problem: Problem,
    search: Search,
    optimum: RelaxedOptimum,
    e: Evaluation,
    numbers: Numbers,
    correlated: dict[str, float],
    white: bool,
    coloured: Sequence[Finding],
) -> list[Finding]:
    """Findings about the optimum, what the method takes for granted, and the estimates.

    Args:
        problem: what was fitted.
        search: with its layout and data.
        optimum: where the optimiser ended, with the measurement noise there.
        e: at the optimum.
        numbers: all that was estimated.
        correlated: by pair of outputs the correlations that the intervals allow for.
        white: whether all residuals, or innovations, are white.
        coloured: what it does to the intervals where they are not.
    """
    layout, data, best = search.layout, search.data, optimum.best
    at = Solution(layout, data, optimum.noise, best.z)
    none, absent = no_disturbance(optimum), absent_names(layout, optimum)
    # A bound that the data do not bear out comes first: it is the cause of what follows. Then an
    # optimiser that has not arrived, which makes all else doubtful.
    return [
        *bound_findings(numbers.of_interest),
        # Rounding has a remedy of its own.
        *([] if numbers.ill else _stopped_notes(layout, best, optimum)),
        *coloured,
        *_disturbance_notes(optimum.ratio if none else None, white),
        *([] if none else extreme_noise_notes(layout, data, best.z, absent)),
        *_absent_notes(layout, optimum.absent),
        *of_disturbances(layout, e, absent),
        *optimum.notes,
        *layout.estimator.notes(at, e, labels(problem.training), numbers.ill),
        *stated_noise_notes(problem, numbers.noise),
        *_correlation_notes(correlated),
        *delay_findings(problem, numbers.of_interest),
        *prior_findings(problem, {k: numbers.of_interest[k] for k in layout.free}),
        *(sign_notes(problem, numbers.of_interest) if bool(best.converged) else []),
        *_hold_notes(problem, search, optimum, e, numbers.of_interest),
    ]


def sign_notes(problem: Problem, estimates: Mapping[str, Estimate]) -> list[Finding]:
    """Doubt about parameters that surely have the other sign than they began with, where they began
    with a value and not next to zero: a turned signal fits as well, and the start alone tells.

    One whose sign is declared (`Model.positive`, `sign: keep`, bounds) cannot turn.

    Args:
        problem: with the starts.
        estimates: by name.
    """
    turned = {}
    for name, free in problem.free.items():
        e = estimates[name]
        # A delay says by itself what it means to be negative.
        if name in problem.model.delay_parameters or e.lower95 is None or e.upper95 is None:
            continue
        surely = e.lower95 * e.upper95 > 0 and e.value * free.start < 0
        if surely and abs(free.start) > _NEAR_ZERO * abs(e.value):
            turned[name] = f"{name} ({free.start:.3g} to {e.value:.3g})"
    if not turned:
        return []
    words = (
        f"{listed(list(turned.values()))} ended with the other sign than the start's: "
        "where that sign is known, an input or an output has the wrong one in the log, or an axis "
        "points the other way (`invert: true`)."
    )
    return [Finding("signs.turned-from-start", "doubt", words, subjects=tuple(turned))]


def _hold_notes(
    problem: Problem,
    search: Search,
    optimum: RelaxedOptimum,
    e: Evaluation,
    estimates: dict[str, Estimate],
) -> list[Finding]:
    """Where the log let inputs be taken as linear between samples, and it matters."""
    # Elsewhere a step of Gauss and Newton tells how far the optimum is, not what the hold does.
    if not bool(optimum.best.converged):
        return []
    sd = {n: estimate.sd for n, estimate in estimates.items() if estimate.sd is not None}
    at = Solution(search.layout, search.data, optimum.noise, optimum.best.z)
    return other_hold(problem, at, e, sd, in_doubt=True)


def _correlation_notes(correlated: dict[str, float]) -> list[Finding]:
    if not correlated:
        return []
    words = "; ".join(f"{names}: {rho:+.2f}" for names, rho in correlated.items())
    sentence = f"Residuals of outputs are correlated ({words}): the intervals allow for it."
    return [note("noise.outputs-correlated", sentence, *correlated)]


def _disturbance_notes(ratio: float | None, white: bool) -> list[Finding]:
    if ratio is None:
        return []
    gained = f"(twice the log-likelihood gained by one is {ratio:.2g})"
    if white:
        words = "output error suffices, and these are its numbers."
        words = f"No disturbance shows in the record {gained}: {words}"
        return [note(_NO_DISTURBANCE, words)]
    # Output error by its own name allows for what is left; a filter's intervals do not.
    words = (
        f"No disturbance of this kind shows in the record {gained}: these are the estimates of "
        "output error, whose residuals are not white. Use method: output-error, whose intervals "
        "allow for it."
    )
    return [note(_NO_DISTURBANCE, words)]


def _absent_notes(layout: Layout, absent: tuple[str, ...]) -> list[Finding]:
    """Which of several disturbances do not show."""
    names = [d.name for d in disturbances_of(layout.model) if d.sigma in absent]
    if not names:
        return []
    words = (
        f"No disturbance shows on {', '.join(names)} (twice the log-likelihood gained by each is "
        f"below {NO_DISTURBANCE:g}): the fit goes without."
    )
    return [note(_NO_DISTURBANCE, words, *names)]


def _stopped_notes(layout: Layout, best: Optimum, optimum: RelaxedOptimum) -> list[Finding]:
    """What to do where the optimiser has not arrived."""
    if bool(best.converged):
        return []
    steps = sum(s for s, _ in optimum.trace)
    windows = sum(count for count, _ in layout.windows)
    remedy = "start nearer, with bounds or several starts, or allow more steps"
    if windows > len(layout.windows) and layout.continuity is None:
        remedy = (
            "tie the windows together (continuity), since a state that no output shows is free in "
            f"each of them; or {remedy}"
        )
    words = (
        f"The optimiser stopped after {steps} step{'s' * (steps != 1)} without converging: these "
        f"numbers are no result. Remedy: {remedy}."
    )
    return [Finding(STOPPED, "doubt", words, float(steps), "steps")]


def open_directions(before: Verdict, at_end: Verdict) -> list[Finding]:
    """Why a search that has not arrived may never do so: what the data leave open from the start.

    Args:
        before: at the start values.
        at_end: where the search stopped.
    """
    either = [{*v.undetermined, *v.without_effect} for v in (before, at_end)]
    names = [n for n in at_end.names if n in either[0] & either[1]]
    if not names:
        return []
    words = (
        f"The data do not determine {listed(names)}, neither at the start nor where the search "
        "stopped, so that it may go on without end: fix some of these or give them priors."
    )
    return [Finding("search.open-directions", "doubt", words, subjects=tuple(names))]
