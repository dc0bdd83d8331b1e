"""fit and check: parameters with intervals and a verdict, from a Problem."""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.finding import UNIT_IN_DOUBT, Finding, note
from heli_jax.flights.instruments import own_instruments, own_said
from heli_jax.identification.agreement import signals_of
from heli_jax.identification.assemble import OptimizationRun, assemble, noise_by_name
from heli_jax.identification.design.accuracy import (
    guessed_gusts,
    starting_at_zero,
    unstated_gusts,
)
from heli_jax.identification.design.windows import Ranking, rank_windows
from heli_jax.identification.estimation import multistart as starting
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.disturbance_search import (
    disturbance_or_none,
    likely_gusts,
    those_that_show,
)
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import FirstGuess, StartRow, first_optima
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    better_of_two_guesses,
    first_noise,
    relax_noise_covariance,
)
from heli_jax.identification.estimation.starts import BY_WINDOWS, by_windows, delay_starts, draw
from heli_jax.identification.further_starts import SAID as SAID_FURTHER
from heli_jax.identification.further_starts import (
    SAID_STABLE,
    better_of_same_responses,
    better_of_stable,
    explains_little,
    further_starts,
    left_stability,
)
from heli_jax.identification.identifiability.equivalents import Valley, second_solutions
from heli_jax.identification.identifiability.sensitivity import Around, verdict_of
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.through_inputs import of_disturbances
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check, Estimate, Fit, Signals, Status, concluded
from heli_jax.identification.unknowns.initial_guess import labels, start_vector
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    layout_of,
    scales_of,
)
from heli_jax.identification.validation.aliases import excitation_notes
from heli_jax.identification.validation.enough import is_it_enough
from heli_jax.identification.validation.excited_band import NOTHING_FOLLOWS, bands
from heli_jax.identification.validation.feedback import feedback_notes, feedback_of
from heli_jax.identification.validation.late_stick import slow_sticks
from heli_jax.identification.validation.logging_rate import logging_rate
from heli_jax.identification.validation.misread import doubtful_inputs, record_doubts, scaled_by
from heli_jax.identification.validation.other_hold import other_hold
from heli_jax.identification.validation.signal_signs import (
    RATE_AGAINST_ANGLE,
    RATE_SCALE,
    against_start,
    sticks_of,
)
from heli_jax.stages import stage

__all__ = [
    "Check",
    "Estimate",
    "Fit",
    "Signals",
    "StartRow",
    "Status",
    "check",
    "findings",
    "fit",
    "rates",
    "windows",
]

_FIRST_STEPS = 40
"""of filter error, until it is known that there is a disturbance to find"""


def first_guess(problem: Problem) -> FirstGuess:
    """The problem at its start values, with a first guess of the noise.

    Args:
        problem: model, vehicle, flights and what is free.
    """
    # In this order: the layout says which numbers there are, the noise weighs the outputs, and only
    # with both can a coarse search compare starts.
    layout = layout_of(problem, problem.training)
    data = data_of(problem, problem.training, layout)
    noise = first_noise(problem, problem.training)
    begun = layout.estimator.begins_with(data)
    z = starting.first_guess(layout, begun, noise, start_vector(layout, data, problem))
    e = evaluate(layout, data, noise, z)
    level = layout.estimator.with_level(data, e, noise)
    if not any(np.ptp(u) > 0 for f in problem.training for u in f.inputs.values()):
        z, e = _in_free_motion(layout, data, noise, z, e)
    # The same object where a method keeps the noise as it is, so that nothing is evaluated twice.
    if level is not noise:
        noise = level
        e = evaluate(layout, data, noise, z)
    return FirstGuess(layout, data, noise, z, e, begun)


def _in_free_motion(
    layout: Layout, data: Data, noise: Noise, z: Array, e: Evaluation
) -> tuple[Array, Evaluation]:
    """Unknowns whose initial states and biases come from the record, in which nothing else moves:
    from rest at zero no parameter would have any effect."""
    own = slice(layout.first_nuisance, layout.size)
    if not (layout.initial_state and np.isfinite(e.J).all()):
        return z, e
    step = np.linalg.lstsq(e.J[:, own], -e.r, rcond=1e-10)[0]
    moved = z.at[own].add(step)
    after = evaluate(layout, data, noise, moved)
    return (moved, after) if after.r @ after.r < e.r @ e.r else (z, e)


def _with_likely_gusts(problem: Problem) -> FirstGuess:
    """The first guess, with gusts of the greatest likelihood where nobody stated their size."""
    guess = first_guess(problem)
    if not (unstated_gusts(problem) and guess.layout.disturbance):
        return guess
    z, e = likely_gusts(Solution(*guess[:4]), guess.e)
    return guess._replace(z=z, e=e)


def _require_problem(problem: Any) -> None:
    if not isinstance(problem, Problem):
        raise TypeError(
            f"problem: expected a heli_jax.Problem, got {type(problem).__name__}; of a "
            "configuration heli_jax.config.problem(heli_jax.load_config(path)) makes it"
        )
    # In single precision a filter's likelihood and the rank of a Jacobian are lost in rounding.
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "fit and check need double precision: call jax.config.update('jax_enable_x64', True) "
            "before the problem is made"
        )


def check(problem: Problem) -> Check:
    """What the flights can determine at the start values, before any fit.

    The noise is as stated, or guessed from the third differences of the measured signals.
    """
    _require_problem(problem)
    guess = _with_likely_gusts(problem)
    noise = guess.layout.estimator.as_it_ends(guess.layout, guess.data, guess.noise)
    if noise is not guess.noise:
        guess = guess._replace(noise=noise, e=evaluate(guess.layout, guess.data, noise, guess.z))
    # At the start values, since nothing else is known yet: where these are far off, what is
    # determined there may differ from what is at the optimum, for which the fit asks again.
    at = Solution(*guess[:4])
    second = second_solutions(problem, at, guess.e, optimum=False)
    around = Around(second=second, valley=Valley(problem, at, guess.e))
    verdict = verdict_of(problem, guess.layout, guess.e, around=around)
    # What the model does at the start values says whether the record can show it in this noise.
    runs = tuple(s.simulated for s in signals_of(guess.e, problem.training))
    notes = [*cautions(problem), *excitation_notes(problem, runs, guess.noise.sd)]
    feedback = feedback_of(problem)
    notes += feedback_notes(problem, feedback)
    # A parameter that is not identifiable moves by any amount, with another hold too.
    not_identifiable = (*verdict.undetermined, *verdict.without_effect)
    notes += of_disturbances(guess.layout, guess.e)
    notes += other_hold(problem, at, guess.e, skip=not_identifiable)
    notes += guessed_gusts(problem, at)
    guessed = tuple(
        f"{label}/{name}"
        for label, flight in zip(labels(problem.training), problem.training, strict=True)
        for name in flight.outputs
        if name not in flight.sd
    )
    sds = noise_by_name(problem, guess.noise, scales_of(guess.layout, guess.z))
    findings = is_it_enough(problem, at, guess.e, feedback)
    # Sensitivities are those of the model, whatever moved what was measured.
    for nothing in [f for f in findings if f.code == NOTHING_FOLLOWS and f.severity == "refuse"]:
        names = listed(verdict.names, "or")
        verdict = verdict.nothing(f"The data do not determine {names}: {nothing.sentence}")
    slow = slow_sticks(problem, at, guess.e, skip=not_identifiable)
    findings = (*(f for f in findings if f.bad), *slow, *(f for f in findings if not f.bad))
    return Check(verdict, sds, tuple(notes), guessed, findings, starting_at_zero(problem))


def findings(problem: Problem, guess: FirstGuess | None = None) -> tuple[Finding, ...]:
    """Whether the flights are enough for what is asked, at the start values: as `check` says it.

    What missing outputs would tell and what to fly next is compared for output error of linear
    models alone: others are compiled for each of both, which takes as long as many a fit.

    Args:
        problem: model, vehicle, flights and what is free.
        guess: of `first_guess`, where it is at hand already.
    """
    guess = guess or first_guess(problem)
    at, feedback = Solution(*guess[:4]), feedback_of(problem)
    quick = problem.model.linear and at.layout.estimator.rows_are_samples
    return is_it_enough(problem, at, guess.e, feedback, compare=quick)


def rates(problem: Problem) -> tuple[Finding, ...]:
    """Of the findings those on logging rates alone, which need no simulation.

    Args:
        problem: model, vehicle, flights and what is free.
    """
    flights = list(zip(labels(problem.training), problem.training, strict=True))
    return tuple(logging_rate(problem, flights, first_noise(problem, problem.training).sd))


def windows(problem: Problem, length: float | None = None) -> Ranking:
    """What each window of the flights says of the free parameters, at the start values.

    Args:
        problem: model, vehicle, flights and what is free.
        length: of a window [s]; unless given a twelfth of the longest flight, between 2 and 20 s.

    Raises:
        ValueError: the length fits no flight, no window may be used, or the simulation is not
            finite at the start values.
    """
    if not estimator_of(problem.method).rows_by_flight:
        # Which part says most is asked of the simulation, whatever the fit goes by.
        problem = dataclasses.replace(problem, method="output-error", instrument=None)
    guess = _with_likely_gusts(problem)
    at = Solution(*guess[:4])
    ranking = rank_windows(problem, at, guess.e, length)
    flights = list(zip(labels(problem.training), problem.training, strict=True))
    findings = [*logging_rate(problem, flights, guess.noise.sd), *bands(problem.training)]
    notes = (*ranking.notes, *guessed_gusts(problem, at))
    return dataclasses.replace(ranking, record=tuple(f for f in findings if f.bad), notes=notes)


def fit(
    problem: Problem,
    *,
    starts: int | None = None,
    seed: int = 0,
    max_steps: int = 200,
    progress: starting.Progress | None = None,
    guess: FirstGuess | None = None,
) -> Fit:
    """Estimate the free parameters by the problem's method: one of `methods.METHODS`.

    Args:
        problem: model, vehicle, flights and what is free.
        starts: how many points to start from; the first is the given one, the others are drawn
            within the bounds, or about a factor of three around the start. None: one, or where a
            delay is free the deepest valleys of the misfit over the delay, three at most; of a
            linear model by output error six others are tried where the best of these explains less
            than half of the outputs, and by frequency error where a stable model became unstable:
            what equation error makes of the record, and five that are drawn.
        seed: of that draw.
        max_steps: of the optimiser, in each of its runs.
        progress: called with a line of text before each longer part of the work.
        guess: of `first_guess`, where it is at hand already.

    Returns:
        A Fit whose `status` says whether it converged and whether the data determine what was
        asked. Cramér-Rao intervals; those of output error allow for residuals that are not white
        (`coloured`), and `overconfident` says where nothing does.

    Raises:
        ValueError: the simulation is not finite at the start values.
    """
    began = time.perf_counter()
    _require_problem(problem)
    report = progress or (lambda _: None)
    with stage("first guess"):
        guess = guess or first_guess(problem)
    # Where the optimiser does not arrive, this is all that can be said of what is identifiable.
    before = verdict_of(problem, guess.layout, guess.e)
    words = f"fitting {', '.join(guess.layout.of_interest)}"
    report(words)
    # A model that is unstable where the search passes overflows, in time as in its powers; that is
    # told by what is not finite, and no warning of NumPy's says it better.
    with stage(words), np.errstate(over="ignore", invalid="ignore"):
        search, points, optima, optimum = _search(problem, guess, starts, seed, max_steps, report)
    about_record = (*cautions(problem), *record_doubts(problem))
    optimum = optimum._replace(notes=(*about_record, *optimum.notes))
    timing = {"fit": time.perf_counter() - began}
    with stage("intervals and verdicts"), np.errstate(over="ignore", invalid="ignore"):
        run = OptimizationRun(before, points, optima, seed, timing)
        estimate = assemble(problem, search, optimum, run)
        return concluded(_with_doubtful_signals(problem, guess, estimate))


def _with_doubtful_signals(problem: Problem, guess: FirstGuess, estimate: Fit) -> Fit:
    """With the parameters that a signal in a doubtful unit moves, and where the model did not
    follow from the start values what moved the wrong way there, first of all findings."""
    # Of an angle that is in other units than its rate that is said already, and is surer.
    if any(f.code == RATE_AGAINST_ANGLE and f.denies for f in estimate.findings):
        return estimate
    flights = list(zip(labels(problem.training), problem.training, strict=True))
    at_start = (flights, guess.e.simulated, sticks_of(problem.model))
    doubts = doubtful_inputs(*at_start)
    if not estimate.adequate:
        doubts += against_start(*at_start)
    findings = []
    for f in (*doubts, *estimate.findings):
        if estimate.status != "not-converged" and not f.denies:
            if f.code == UNIT_IN_DOUBT:
                f = f._replace(distrusts=scaled_by(estimate.reached, f.subjects[0]))
            elif f.code == RATE_SCALE:
                # A scale, a unit or the clock is off: each parameter depends on one of them.
                f = f._replace(distrusts=tuple(estimate.estimates))
        findings.append(f)
    return dataclasses.replace(estimate, findings=tuple(findings))


def _search(
    problem: Problem,
    guess: FirstGuess,
    starts: int | None,
    seed: int,
    max_steps: int,
    report: starting.Progress,
) -> tuple[starting.Search, Float[Array, "s q"], list[Optimum], RelaxedOptimum]:
    """The search with its layout and data, its starts, an optimum for each, and where it ended.

    Where these explain little others are gone to, unless a number of starts is asked for.
    """
    layout, data, noise = guess.layout, guess.data, guess.noise

    def begin(quick: Noise, known: tuple[Any, Any]) -> Float[Array, "s q"]:
        if starts is None:
            return delay_starts(problem, layout, guess.begun, quick, guess.z, known)
        return draw(layout, problem, guess.z, starts, seed)

    disturbed = bool(layout.sigmas)
    # Without a disturbance in the record the filter's optimiser finds no end: it is cut short,
    # and goes on only where there is one.
    search = starting.Search(
        problem, layout, data, min(max_steps, _FIRST_STEPS) if disturbed else max_steps
    )
    first, quick, points, optima = first_optima(search, guess, begin, report)
    best, notes = min(optima, key=starting.rank), ()
    # Before the noise is relaxed, which would take the error of a simulation that diverges for it.
    shooting = by_windows(problem, search, noise, guess.e, guess.z, best)
    if shooting is not None:
        best, notes = shooting, (BY_WINDOWS,)
    if starts is None and explains_little(first, quick, best):
        report(SAID_FURTHER)
        more = further_starts(layout, problem, guess.z, seed)
        optima += first.run(quick, more, report, nearing=layout.estimator.nearing)
        points = jnp.concatenate([points, more])
        better = min(optima, key=starting.rank)
        if starting.rank(better) < starting.rank(best):
            best, notes = better, ()
    optimum = relax_noise_covariance(search, quick, best)
    optimum = optimum._replace(notes=(*notes, *optimum.notes))
    # Relaxation ends where its first weights of the outputs lead: tried from others too.
    optimum = better_of_two_guesses(search, points, optimum, problem.training)
    search.max_steps = max_steps
    # A search that began with a part of the data has not tried where all of them lead.
    again = [] if quick is noise else [points]
    if (starts is None or again) and left_stability(problem, search, optimum):
        report(SAID_STABLE)
        again += [further_starts(layout, problem, guess.z, seed)] if starts is None else []
        optimum = better_of_stable(problem, search, noise, jnp.concatenate(again), optimum)
    if disturbed:
        several = len(disturbances_of(problem.model)) > 1
        which = those_that_show if several else disturbance_or_none
        optimum = better_of_same_responses(problem, search, which(search, optimum))
    return search, points, optima, optimum


def cautions(problem: Problem) -> tuple[Finding, ...]:
    """What the logs say of their signals that biases a fit to them; once where flights agree."""
    flights = tuple(problem.flights)
    said: dict[str, Finding] = {}
    for label, flight in zip(labels(flights), flights, strict=True):
        for caution in flight.source.cautions if flight.source else ():
            said.setdefault(caution.sentence, caution.of(label))
    own = own_instruments(problem.training, naming.names(problem.model.Inputs))
    own = own if problem.instrument is None else ()
    return (
        *said.values(),
        *((note("loop.instrument-unused", f"{own_said(own)}; it is not used."),) if own else ()),
        *_whole_band(problem),
    )


def _whole_band(problem: Problem) -> tuple[Finding, ...]:
    """That a band which is stated is none of the fit's."""
    estimator, band = estimator_of(problem.method), problem.frequency.band
    if band is None or not estimator.noise_spectrum or estimator.fits_responses:
        return ()
    words = (
        f"frequency.band ({band[0]:g} to {band[1]:g} Hz) is that of the report's responses alone: "
        "frequency error uses all frequencies of a record. frequency-response fits within a band."
    )
    return (note("frequency.band-unused", words),)
