"""Fit a Problem, or check it before the fit: estimates, intervals and identifiability."""

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from heli_jax.finding import Finding, distrusted
from heli_jax.identification.design.accuracy import starting_at_zero, unstated_gusts
from heli_jax.identification.design.windows import Ranking, rank_windows
from heli_jax.identification.diagnostics import diagnose
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.diagnostics.record import (
    NOTHING_FOLLOWS,
    gusts_guessed,
    nothing_follows,
    of_rates,
    rates_enough,
)
from heli_jax.identification.estimation import multistart as starting
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import measured_count
from heli_jax.identification.estimation.multistart import FirstGuess, StartRow
from heli_jax.identification.estimation.noise_covariance import first_noise, likely_gusts
from heli_jax.identification.estimation.objective import noise_unknowns
from heli_jax.identification.identifiability.analysis import Around, verdict_of
from heli_jax.identification.identifiability.equivalents import (
    Valley,
    own_record,
    second_solutions,
)
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check, Estimate, Fit, Signals, Status
from heli_jax.identification.search import SearchResult, first_guess, search
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.metrics import pooled_metrics
from heli_jax.messages import sentence
from heli_jax.stages import stage

__all__ = [
    "Check",
    "Estimate",
    "Fit",
    "Signals",
    "StartRow",
    "Status",
    "check",
    "fit",
    "rates",
    "windows",
]


def _with_likely_gusts(problem: Problem) -> FirstGuess:
    """Return the first guess, with the most likely gusts unless their size is stated."""
    guess = first_guess(problem)
    if not (unstated_gusts(problem) and guess.layout.disturbance):
        return guess
    z, e = likely_gusts(Solution(*guess[:4]))
    return guess._replace(z=z, e=e)


def _require_problem(problem: Any) -> None:
    if not isinstance(problem, Problem):
        raise TypeError(
            f"problem: expected a heli_jax.Problem, got {type(problem).__name__}; of a "
            "configuration heli_jax.config.problem(heli_jax.load_config(path)) makes it"
        )
    # In single precision rounding decides the rank of a Jacobian.
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "fit and check need double precision: call jax.config.update('jax_enable_x64', True) "
            "before the problem is made"
        )


def check(problem: Problem) -> Check:
    """Analyse before the fit, at the start values, which parameters the flights can determine.

    The noise is as stated, or guessed from the third differences of the measured signals.
    """
    _require_problem(problem)
    guess = _with_likely_gusts(problem)
    noise = guess.layout.objective.noise_of_check(guess.layout, guess.data, guess.noise)
    if noise is not guess.noise:
        guess = guess._replace(noise=noise, e=evaluate(guess.layout, guess.data, noise, guess.z))
    c = context_of(problem, guess)
    findings, verdict = diagnose(c), c.verdict
    # The sensitivities come from the model alone, so they mean nothing if the outputs ignore the
    # inputs.
    if any(f.code == NOTHING_FOLLOWS and f.severity == "refuse" for f in findings):
        words = sentence("verdict.nothing-follows", names=verdict.names)
        verdict = verdict.nothing(words)
    guessed = tuple(
        f"{label}/{name}" for label, f in c.flights for name in f.outputs if name not in f.sd
    )
    return Check(verdict, c.noise, guessed, findings, starting_at_zero(problem))


def context_of(problem: Problem, guess: FirstGuess | None = None) -> Context:
    """Return the Context of a problem at its start values.

    Args:
        guess: the result of `first_guess`, if it is already computed.
    """
    guess = guess or first_guess(problem)
    # Other parameters may be identifiable far from the optimum. The fit repeats the analysis there.
    at = Solution(*guess[:4])
    # The record is the model's own, because any step from start values is an improvement.
    own = own_record(at, guess.e)
    # Rows that are sums over frequencies change with the record, and states at the begin of windows
    # are no optimum before a fit.
    at_optimum = guess.layout.noise_model == "white" and guess.layout.continuity is None
    second = second_solutions(problem, *own) if at_optimum else ()
    around = Around(second=second, valley=Valley(problem, *own))
    verdict = verdict_of(problem, guess.layout, guess.e, around)
    return Context(problem, at, guess.e, verdict)


def rates(problem: Problem) -> tuple[Finding, ...]:
    """Return the findings on logging rates, which need no simulation."""
    return tuple(of_rates(problem, first_noise(problem, problem.training).sd))


def windows(problem: Problem, length: float | None = None) -> Ranking:
    """Rank windows of the flights by their information on the free parameters at the start values.

    Args:
        length: length of a window [s]; default: a twelfth of the longest flight, between 2 and 20
            s.

    Raises:
        ValueError: the length fits no flight, no window is usable, or the simulation is not finite
            at the start values.
    """
    if problem.noise_model == "spectrum":
        # The ranking needs a simulation, also if the fit works in frequency.
        problem = dataclasses.replace(problem, method="output-error", instrument=None)
    guess = _with_likely_gusts(problem)
    at = Solution(*guess[:4])
    ranking = rank_windows(problem, at, guess.e, length)
    c = Context(problem, at, guess.e, verdict_of(problem, guess.layout, guess.e))
    notes = tuple(gusts_guessed(c))
    # A record that is mostly at rest may still have a good window.
    chosen = (rates_enough, nothing_follows)
    record = tuple(
        f._replace(severity="doubt") if f.code == NOTHING_FOLLOWS else f
        for diagnostic in chosen
        for f in diagnostic(c)
        if f.bad
    )
    return dataclasses.replace(ranking, record=record, notes=notes)


def fit(
    problem: Problem,
    *,
    starts: int | None = None,
    seed: int = 0,
    max_steps: int = 200,
    progress: starting.Progress | None = None,
) -> Fit:
    """Estimate the free parameters by the problem's method (`methods.METHODS`).

    Args:
        problem: model, vehicle, flights and free parameters.
        starts: number of start points. The first is the stated one. The others are drawn within the
            bounds, or within a factor of about three around the start. None: one start point. If a
            delay is free, it starts at the deepest minimum of the misfit over the delay.
            `restarts.RESTARTS` may add others.
        seed: seed of the draw.
        max_steps: limit for each run of the optimiser.
        progress: called with a line of text before each longer computation.

    Returns:
        The Fit. Its `status` states whether it converged and whether the parameters are
        identifiable. Intervals are Cramér-Rao. Those of output error allow for autocorrelated
        residuals (`coloured`); `overconfident` marks intervals without that correction.

    Raises:
        ValueError: the simulation is not finite at the start values.
    """
    began = time.perf_counter()
    _require_problem(problem)
    report = progress or (lambda _: None)
    with stage("first guess"):
        guess = first_guess(problem)
    before = verdict_of(problem, guess.layout, guess.e)
    words = f"fitting {', '.join(guess.layout.of_interest)}"
    report(words)
    # Simulations of an unstable model may overflow. The search handles that.
    with stage(words), np.errstate(over="ignore", invalid="ignore"):
        ended = search(problem, guess, starts, seed, max_steps, report)
    timing = {"fit": time.perf_counter() - began}
    with stage("intervals and verdicts"), np.errstate(over="ignore", invalid="ignore"):
        c = _context_at_optimum(problem, guess, before, ended)
        return _result(c, ended.runs, seed, timing)


def _context_at_optimum(
    problem: Problem, guess: FirstGuess, before: Verdict, ended: SearchResult
) -> Context:
    """Return the Context at the end of the search."""
    layout, data, optimum = ended.search.layout, ended.search.data, ended.optimum
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    c = Context(problem, Solution(layout, data, optimum.noise, optimum.best.z), e, before, optimum)
    if not c.rounding:
        return c
    # Diagnostics must not use a likelihood that consists of rounding errors.
    failed = optimum.best._replace(converged=False)
    return dataclasses.replace(c, optimum=optimum._replace(best=failed))


def _result(c: Context, starts: tuple[StartRow, ...], seed: int, timing: dict[str, float]) -> Fit:
    """Assemble the Fit."""
    layout, data, noise, _ = c.at
    assert c.optimum is not None
    # A vanished disturbance (sigma_w = 0) counts in neither AIC nor BIC: its correlation time has
    # no effect either.
    unknowns = layout.determined + noise_unknowns(layout) - len(c.absent)
    findings = diagnose(c)
    everything = {**c.nuisance, **c.estimates}
    doubted = distrusted(findings, everything) if c.status != "not-converged" else {}
    everything |= {n: everything[n]._replace(lower95=None, upper95=None) for n in doubted}
    held = c.held_out
    return Fit(
        model=c.problem.model.name,
        method=c.problem.method,
        status=c.status,
        n_samples=measured_count(data),
        estimates={n: everything[n] for n in layout.free},
        nuisance={n: everything[n] for n in c.nuisance},
        params=c.params,
        verdict_before=c.before,
        verdict=c.verdict,
        noise=c.noise,
        log_likelihood=layout.objective.log_likelihood(layout, data, noise, c.e),
        unknowns=unknowns,
        signals=(*c.signals, *held.signals),
        metrics=c.metrics,
        validation=pooled_metrics(held.signals),
        validation_free_run=pooled_metrics(held.free_run),
        held_out_frequency=held.in_frequency,
        one_step=pooled_metrics(c.signals, one_step=True),
        one_step_validation=pooled_metrics(held.signals, one_step=True),
        whiteness=c.whiteness,
        adequacy=c.adequacy,
        coloured=c.errors.coloured,
        responses=c.responses,
        starts=starts,
        steps=sum(s for s, _ in c.optimum.trace),
        trace=c.optimum.trace,
        findings=findings,
        reached=c.at,
        feedback=c.feedback,
        instruments=c.instruments,
        seed=seed,
        timing=timing,
    )
