"""Search for the optimum of a problem: first guess, starts, noise and disturbance."""

from typing import NamedTuple

import numpy as np

from heli_jax.finding import found
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.multistart import (
    FirstGuess,
    Progress,
    Run,
    Search,
    StartRow,
    named_values,
    rank,
    table,
)
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    first_noise,
    log_likelihood_of,
    relax_noise_covariance,
    significant_disturbances,
)
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.estimation.starts import delay_start, draw, noise_guess_at
from heli_jax.identification.problem import Problem
from heli_jax.identification.restarts import RESTARTS, SearchState, lost_stability
from heli_jax.identification.unknowns.layout import layout_of
from heli_jax.messages import messages


def first_guess(problem: Problem) -> FirstGuess:
    """Return the problem at its start values, with a first guess of the noise."""
    layout = layout_of(problem, problem.training)
    data = data_of(problem, problem.training, layout)
    noise = first_noise(problem, problem.training)
    search_data = layout.objective.data_at_start(data)
    z = start_vector(layout, data, problem)
    z = noise_guess_at(layout, search_data, noise, z) if layout.disturbance else z
    # Started at rest at zero, a record without input is insensitive to every parameter.
    if not any(np.ptp(u) > 0 for f in problem.training for u in f.inputs.values()):
        z = in_time(layout, data, noise, z)
    e = evaluate(layout, data, noise, z)
    return FirstGuess(layout, data, noise, z, e, search_data)


class SearchResult(NamedTuple):
    """Optimum of a search, and its runs."""

    search: Search
    """The search with its layout and data."""
    optimum: RelaxedOptimum
    runs: tuple[StartRow, ...]
    """All runs, the chosen one first."""


def search(
    problem: Problem,
    guess: FirstGuess,
    starts: int | None,
    seed: int,
    max_steps: int,
    report: Progress,
) -> SearchResult:
    """Search for the optimum of a problem from its first guess, then by each restart that applies.

    Args:
        guess: the result of `first_guess`.
        starts: number of start points, as in `fit`.
        report: called with a line of text before each longer computation.
    """
    layout, data, noise, z, e, search_data = guess
    if starts is None:
        points = delay_start(problem, layout, search_data, noise, z, e.J)[None]
    else:
        points = draw(layout, problem, z, starts, seed)

    over = Search(problem, layout, data, max_steps)
    first = Search(problem, layout, search_data, max_steps)
    optima = first.run(noise, points, report)
    best = relax_noise_covariance(over, noise, min(optima, key=rank))
    if layout.sigmas:
        best = significant_disturbances(over, best)
    name = "start" if len(optima) == 1 else "starts"
    runs = [Run(name, start, run) for start, run in zip(points, optima, strict=True)]
    chosen = min(runs, key=lambda run: rank(run.optimum))
    state = SearchState(over, guess, best, starts, seed)
    for restart in RESTARTS:
        if not restart.when(state):
            continue
        points = list(restart.points(state))
        if points:
            report(f"another search, {messages()[f'search.{restart.name}'].title}")
        previous = state.best
        for noise, start in points:
            [run] = over.run(noise, start[None, :])
            runs.append(Run(restart.name, start, run))
            other = relax_noise_covariance(over, noise, run)
            if is_better(over, other, state.best):
                state, chosen = state._replace(best=other), runs[-1]
        if state.best is previous:
            continue
        before, after = (log_posterior(over, o) for o in (previous, state.best))
        note = found(f"search.{restart.name}", "note", before=before, after=after)
        state = state._replace(best=state.best.after(previous, note))
    return SearchResult(over, state.best, table(layout, data, runs, chosen))


_BETTER = 0.1
"""Gain in log-posterior above which an optimum is better."""


def is_better(over: Search, optimum: RelaxedOptimum, other: RelaxedOptimum) -> bool:
    """True if `optimum` is preferred to `other`.

    A converged optimum wins, then a stable one if the start was stable, then the higher
    log-posterior. In a tie `other` stays.
    """

    def passes(o: RelaxedOptimum) -> tuple[bool, bool]:
        unstable = over.layout.model.linear and lost_stability(over, o)
        return o.best.converged, not unstable

    if passes(optimum) != passes(other):
        return passes(optimum) > passes(other)
    return log_posterior(over, optimum) > log_posterior(over, other) + _BETTER


def log_posterior(over: Search, optimum: RelaxedOptimum) -> float:
    """Return log-likelihood plus log-prior of the free parameters without its constant, or -inf if
    it is not finite."""
    values = named_values(over.layout, over.data, optimum.best.z)
    priors = {n: f.prior for n, f in over.problem.free.items() if f.prior is not None}
    against = sum(((values[n] - prior.mean) / prior.sd) ** 2 for n, prior in priors.items())
    posterior = log_likelihood_of(over, optimum) - 0.5 * against
    return posterior if np.isfinite(posterior) else -np.inf
