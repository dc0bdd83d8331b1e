"""Restarts: where a search begins again, when it does, and why."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.equation_error.start import equation_error_start
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.disturbance_search import NO_DISTURBANCE, with_noise_guess
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.multistart import (
    FirstGuess,
    Search,
    named_values,
    sum_of_squares,
)
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.estimation.starts import draw
from heli_jax.identification.identifiability.equivalents import second_solutions
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Noise, Solution, layout_of
from heli_jax.identification.validation.adequacy import is_unstable


class SearchState(NamedTuple):
    """State of a search."""

    search: Search
    """with its problem, layout and data"""
    guess: FirstGuess
    best: RelaxedOptimum
    """the best optimum so far"""
    drawn: int | None
    """how many starts were asked for; None where they are left to the search"""
    seed: int
    """of a draw of starts"""


type StartPoint = tuple[Noise, Float[Array, " q"]]
"""of a run of the optimiser"""


class Restart(NamedTuple):
    """One reason to run the optimiser again; the best of all runs is taken (`search.is_better`)."""

    name: str
    """in `Fit.starts`, and of the code 'search.NAME' of its finding"""
    when: Callable[[SearchState], bool]
    points: Callable[[SearchState], Iterable[StartPoint]]


# By windows: if a damping starts with the wrong sign, the simulation over the whole record grows
# by many powers of ten, and least squares does not recover: all of the gradient is in the growth.
# Over short windows, each from an initial state of its own, nothing grows (multiple shooting; Bock,
# 1983).

_FAR_WORSE = 10.0
"""times the misfit of no model above which the simulation diverges at the start"""
_WINDOWS = 16
"""of the shortest flight, unless they had too few samples each"""
_PER_STATE = 5
"""samples that a window has at least for each initial state that it brings"""
_STEPS = 60
"""of the optimiser over the windows, whose end is only a start"""


def _diverges(at: SearchState) -> bool:
    """Return True if the search failed, its start diverges and windows are possible."""
    problem, guess = at.search.problem, at.guess
    possible = (
        problem.noise_model == "white" and problem.window is None and problem.nuisance.initial_state
    )
    if bool(at.best.best.converged) or not possible:
        return False
    # Squares of a run that diverged may overflow: infinity is past the limit too.
    with np.errstate(all="ignore"):
        misfit = float(np.sum(np.square(np.asarray(guess.e.r, np.float64))))
    return misfit > _FAR_WORSE * at.search.misfit_of_nothing(guess.noise)


def _by_windows(at: SearchState) -> list[StartPoint]:
    """Return the start that a fit to short windows gives, without the windows' initial states."""
    problem, guess = at.search.problem, at.guess
    dt = max(f.dt for f in problem.training)
    shortest = min(f.n_samples * f.dt for f in problem.training)
    # Short enough that nothing grows, long enough that a window's samples outnumber its unknowns.
    states = len(naming.names(problem.model.State))
    window = max(shortest / _WINDOWS, max(8, _PER_STATE * states) * dt)
    if window >= 0.5 * shortest:
        return []
    cut = replace(problem, window=window)
    layout = layout_of(cut, cut.training)
    data = data_of(cut, cut.training, layout)
    # It stands first in z in either layout; behind it windows have more.
    shared = guess.layout.first_nuisance
    z = start_vector(layout, data, cut).at[:shared].set(guess.z[:shared])
    [short] = Search(cut, layout, data, _STEPS).run(guess.noise, z[None, :])
    # Converged or not: half the way out of the growth is a good enough start.
    if not (np.isfinite(short.cost) and bool(jnp.all(jnp.isfinite(short.z)))):
        return []
    # Without the windows' initial states, which could take up what the parameters missed.
    return [(guess.noise, guess.z.at[:shared].set(short.z[:shared]))]


# Further starts: a mode far from its start leaves no gradient towards it. With several outputs the
# relaxation of the noise ends in the optimum of its first guess, in which a smooth output of little
# noise has the most weight. In frequency a pole and its mirror image have the same gain: with weak
# inputs the likelihood has an optimum on either side.

_LITTLE = 0.5
"""part of the outputs' variance below which an optimum explains too little"""
_DRAWN = 5


def _needs_further_starts(at: SearchState) -> bool:
    """Return True if a linear model explains less than half of the outputs' variance, or became
    unstable in a search in frequency."""
    layout, best = at.search.layout, at.best
    if at.drawn is not None or not layout.model.linear or layout.disturbance:
        return False
    if layout.noise_model == "white":
        # By the noise of the first guess: the relaxed one makes all outputs' misfits equal.
        data, noise = at.search.data, at.guess.noise
        left = sum_of_squares(evaluate(layout, data, best.noise, best.best.z).raw, noise)
        outputs = [{n: np.asarray(y) for n, y in f.outputs.items()} for f in data.flights]
        moved = [{n: y - np.nanmean(y) for n, y in of.items()} for of in outputs]
        explained = 1.0 - left / sum_of_squares(moved, noise)
        return not (bool(best.best.converged) and explained > _LITTLE)
    return layout.noise_model == "spectrum" and left_stability(at.search, best)


def left_stability(search: Search, optimum: RelaxedOptimum) -> bool:
    """Return True if the start values were stable and an optimum is not."""
    problem = search.problem
    values = named_values(search.layout, search.data, optimum.best.z)
    return is_unstable(problem, problem.params_with(values)) and not is_unstable(
        problem, problem.start_params()
    )


def _further_starts(at: SearchState) -> list[StartPoint]:
    """Return the estimate of equation error, if it has one, and values drawn about the start."""
    problem, guess, layout = at.search.problem, at.guess, at.guess.layout
    points = np.array(draw(layout, problem, guess.z, 1 + _DRAWN, at.seed))
    try:
        with np.errstate(all="ignore"):
            regressed = equation_error_start(
                problem.model, problem.vehicle, problem.training, problem.free
            )
        values = {n: regressed.values[n].value for n in problem.free}
        points[0] = _with_values(at, np.array(guess.z), values)
    # Without measured states there is no regression.
    except (ValueError, np.linalg.LinAlgError):
        points = points[1:]
    return [(guess.noise, jnp.asarray(z, guess.z.dtype)) for z in points]


def _with_values(at: SearchState, z: np.ndarray, values: dict[str, float]) -> np.ndarray:
    """Return the unknowns with values of the free parameters; one out of bounds stays as it is."""
    for i, (name, free) in enumerate(at.search.problem.free.items()):
        coordinate = transforms.coordinate(free, at.guess.layout.kinds[i], values[name])
        z[i] = z[i] if coordinate is None else coordinate
    return z


# Same responses: two modes may exchange their parts. Heave and inflow with a slow damping and a
# quick lag have the same response to collective as with a quick damping and a slow lag. Only the
# disturbance, which acts through one of them, distinguishes them; but a search that began on the
# wrong side ends there, with white innovations and a likelihood lower by a few units.

_MOST_PARAMETERS = 8
"""of which equal responses are searched: more take long"""
_OTHERS = 2
"""other values that a filter is started from"""


def _has_one_disturbance(at: SearchState) -> bool:
    layout, best = at.search.layout, at.best
    return (
        bool(best.best.converged)
        and len(layout.sigmas) == 1
        # Without a disturbance nothing distinguishes such values.
        and (best.ratio is None or best.ratio > NO_DISTURBANCE)
        and at.search.problem.model.linear
        and len(layout.free) <= _MOST_PARAMETERS
    )


def _same_responses(at: SearchState) -> list[StartPoint]:
    """Return other values with the same responses to the inputs."""
    search, best, layout = at.search, at.best, at.search.layout
    here = Solution(layout, search.data, best.noise, best.best.z)
    others = second_solutions(at.search.problem, here, evaluate(*here))
    points = []
    for other in others[:_OTHERS]:
        z = _with_values(at, np.array(best.best.z), other.values)
        # Initial states belong to the other values too: they are estimated again from zero.
        z[layout.first_nuisance :] = 0.0
        z = with_noise_guess(search, best.noise, jnp.asarray(z, best.best.z.dtype))
        e = evaluate(layout, search.data, best.noise, z)
        points.append((layout.objective.noise_at_start(layout, search.data, e, best.noise), z))
    return points


RESTARTS: tuple[Restart, ...] = (
    Restart("by-windows", _diverges, _by_windows),
    Restart("further-starts", _needs_further_starts, _further_starts),
    Restart("same-responses", _has_one_disturbance, _same_responses),
)
"""in the order in which they are tried"""
