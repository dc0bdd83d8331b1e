"""Search for the optimum of a problem: first guess, starts, noise and disturbance."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation import multistart as starting
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.disturbance_search import (
    disturbance_or_none,
    those_that_show,
)
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import FirstGuess, first_optima
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
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, layout_of

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


class SearchResult(NamedTuple):
    """Where a search ended and how it came there."""

    search: starting.Search
    """with its layout and data"""
    points: Float[Array, "s q"]
    """the starts"""
    optima: list[Optimum]
    """one for each start"""
    optimum: RelaxedOptimum


def search(
    problem: Problem,
    guess: FirstGuess,
    starts: int | None,
    seed: int,
    max_steps: int,
    report: starting.Progress,
) -> SearchResult:
    """Search for the optimum of a problem from its first guess.

    Where the starts explain little others are gone to, unless a number of starts is asked for.

    Args:
        problem: what is fitted.
        guess: of `first_guess`.
        starts: how many points to start from, as `fit` takes it.
        seed: of their draw.
        max_steps: of the optimiser, in each of its runs.
        report: called with a line of text before each longer part of the work.
    """
    layout, data, noise = guess.layout, guess.data, guess.noise

    def begin(quick: Noise, known: tuple[Any, Any]) -> Float[Array, "s q"]:
        if starts is None:
            return delay_starts(problem, layout, guess.begun, quick, guess.z, known)
        return draw(layout, problem, guess.z, starts, seed)

    disturbed = bool(layout.sigmas)
    # Without a disturbance in the record the filter's optimiser finds no end: it is cut short,
    # and goes on only where there is one.
    over = starting.Search(
        problem, layout, data, min(max_steps, _FIRST_STEPS) if disturbed else max_steps
    )
    first, quick, points, optima = first_optima(over, guess, begin, report)
    best, notes = min(optima, key=starting.rank), ()
    # Before the noise is relaxed, which would take the error of a simulation that diverges for it.
    shooting = by_windows(problem, over, noise, guess.e, guess.z, best)
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
    optimum = relax_noise_covariance(over, quick, best)
    optimum = optimum._replace(notes=(*notes, *optimum.notes))
    # Relaxation ends where its first weights of the outputs lead: tried from others too.
    optimum = better_of_two_guesses(over, points, optimum, problem.training)
    over.max_steps = max_steps
    # A search that began with a part of the data has not tried where all of them lead.
    again = [] if quick is noise else [points]
    if (starts is None or again) and left_stability(problem, over, optimum):
        report(SAID_STABLE)
        again += [further_starts(layout, problem, guess.z, seed)] if starts is None else []
        optimum = better_of_stable(problem, over, noise, jnp.concatenate(again), optimum)
    if disturbed:
        several = len(disturbances_of(problem.model)) > 1
        which = those_that_show if several else disturbance_or_none
        optimum = better_of_same_responses(problem, over, which(over, optimum))
    return SearchResult(over, points, optima, optimum)
