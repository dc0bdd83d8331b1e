"""Restarts: further runs of the optimiser, their conditions and their start points."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.equation_error.start import equation_error_start
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.multistart import (
    FirstGuess,
    Search,
    named_values,
    sum_of_squares,
)
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum, with_noise_guess
from heli_jax.identification.estimation.starts import draw
from heli_jax.identification.identifiability.equivalents import second_solutions
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Noise, Solution, layout_of
from heli_jax.identification.validation.adequacy import is_unstable


class SearchState(NamedTuple):
    """State of a search."""

    search: Search
    """The search with its problem, layout and data."""
    guess: FirstGuess
    best: RelaxedOptimum
    """Best optimum so far."""
    drawn: int | None
    """Number of starts requested; None: the search decides."""
    seed: int
    """Seed of the draw of starts."""


type StartPoint = tuple[Noise, Float[Array, " q"]]
"""Start point of one run of the optimiser."""


class Restart(NamedTuple):
    """One reason to run the optimiser again. `search.is_better` selects the best of all runs."""

    name: str
    """Name in `Fit.starts`; its finding has the code 'search.NAME'."""
    when: Callable[[SearchState], bool]
    points: Callable[[SearchState], Iterable[StartPoint]]


# Restart with windows. If a damping starts with the wrong sign, the simulation grows by many powers
# of ten. Least squares does not recover, because the growth dominates the gradient. Nothing grows
# in short windows with initial states of their own (multiple shooting; Bock, 1983).

_FAR_WORSE = 10.0
"""Misfit above which the simulation diverges at the start, as a multiple of the misfit of no model.
"""
_WINDOWS = 16
"""Number of windows in the shortest flight, unless they would be too short."""
_PER_STATE = 5
"""Least samples in a window for each of its initial states."""
_STEPS = 60
"""Steps of the optimiser over the windows; the result is only a start."""


def _diverges(at: SearchState) -> bool:
    """True if the search failed, its start diverges and windows are possible."""
    problem, guess = at.search.problem, at.guess
    possible = (
        problem.noise_model == "white" and problem.window is None and problem.nuisance.initial_state
    )
    if at.best.best.converged or not possible:
        return False
    # Squares of a diverged run may overflow. Infinity exceeds the limit too.
    with np.errstate(all="ignore"):
        misfit = float(np.sum(np.square(np.asarray(guess.e.r, np.float64))))
    return misfit > _FAR_WORSE * at.search.misfit_without_response(guess.noise)


def _by_windows(at: SearchState) -> list[StartPoint]:
    """Return the estimate from short windows as a start point, without their initial states."""
    problem, guess = at.search.problem, at.guess
    dt = max(f.dt for f in problem.training)
    shortest = min(f.n_samples * f.dt for f in problem.training)
    # Windows must be so short that nothing grows, yet have more samples than unknowns.
    states = len(naming.names(problem.model.State))
    window = max(shortest / _WINDOWS, max(8, _PER_STATE * states) * dt)
    if window >= 0.5 * shortest:
        return []
    cut = replace(problem, window=window)
    layout = layout_of(cut, cut.training)
    data = data_of(cut, cut.training, layout)
    # Both layouts begin with these unknowns. Only the nuisance parameters behind them differ.
    shared = guess.layout.first_nuisance
    z = start_vector(layout, data, cut).at[:shared].set(guess.z[:shared])
    [short] = Search(cut, layout, data, _STEPS).run(guess.noise, z[None, :])
    # The estimate need not have converged: it is good enough as a start.
    if not (np.isfinite(short.cost) and bool(jnp.all(jnp.isfinite(short.z)))):
        return []
    # The windows' initial states are dropped: they may hide errors of the parameters.
    return [(guess.noise, guess.z.at[:shared].set(short.z[:shared]))]


# Further starts. Far from the start value of a mode there is no gradient towards it. With several
# outputs, relaxing the noise ends at the optimum of its first guess, where smooth outputs of little
# noise dominate. In frequency a pole and its mirror image have the same gain, so with weak inputs
# the likelihood has an optimum on either side.

_LITTLE = 0.5
"""Fraction of the outputs' variance below which an optimum explains too little."""
_DRAWN = 5


def _needs_further_starts(at: SearchState) -> bool:
    """True if a linear model explains less than half of the outputs' variance, or became unstable
    in a search in frequency."""
    layout, best = at.search.layout, at.best
    if at.drawn is not None or not layout.model.linear or layout.disturbance:
        return False
    if layout.noise_model == "white":
        # The first guess of the noise is used because the relaxed noise makes the misfits of all
        # outputs equal.
        data, noise = at.search.data, at.guess.noise
        left = sum_of_squares(evaluate(layout, data, best.noise, best.best.z).raw, noise)
        outputs = [{n: np.asarray(y) for n, y in f.outputs.items()} for f in data.flights]
        moved = [{n: y - np.nanmean(y) for n, y in of.items()} for of in outputs]
        explained = 1.0 - left / sum_of_squares(moved, noise)
        return not (best.best.converged and explained > _LITTLE)
    return layout.noise_model == "spectrum" and lost_stability(at.search, best)


def lost_stability(search: Search, optimum: RelaxedOptimum) -> bool:
    """True if the start values are stable and the optimum is not."""
    problem = search.problem
    values = named_values(search.layout, search.data, optimum.best.z)
    return is_unstable(problem, problem.params_with(values)) and not is_unstable(
        problem, problem.start_params()
    )


def _further_starts(at: SearchState) -> list[StartPoint]:
    """Return the equation-error estimate, if there is one, and values drawn around the start."""
    problem, guess, layout = at.search.problem, at.guess, at.guess.layout
    points = np.array(draw(layout, problem, guess.z, 1 + _DRAWN, at.seed))
    try:
        with np.errstate(all="ignore"):
            regressed = equation_error_start(
                problem.model, problem.vehicle, problem.training, problem.free
            )
        values = {n: regressed.values[n].value for n in problem.free}
        points[0] = _with_values(at, np.array(guess.z), values)
    # Regression needs measured states.
    except (ValueError, np.linalg.LinAlgError):
        points = points[1:]
    return [(guess.noise, jnp.asarray(z, guess.z.dtype)) for z in points]


def _with_values(at: SearchState, z: np.ndarray, values: dict[str, float]) -> np.ndarray:
    """Return the unknowns with new values of free parameters; values out of bounds are ignored."""
    for i, (name, free) in enumerate(at.search.problem.free.items()):
        coordinate = transforms.coordinate(free, at.guess.layout.kinds[i], values[name])
        z[i] = z[i] if coordinate is None else coordinate
    return z


# Same responses: two modes may exchange their roles. Heave and inflow respond alike to collective
# with a slow damping and a fast lag as with a fast damping and a slow lag. Only the disturbance,
# which acts on one of them, distinguishes the two. A search that starts on the wrong side ends
# there, with white innovations and a likelihood only a few units lower.

_MOST_PARAMETERS = 8
"""Most parameters for a search of equal responses; more take too long."""
_OTHERS = 2
"""Most alternative values that a filter is started from."""


def _has_one_disturbance(at: SearchState) -> bool:
    layout, best = at.search.layout, at.best
    return (
        best.best.converged
        and len(layout.sigmas) == 1
        # Only a disturbance can distinguish such values.
        and not best.absent
        and at.search.problem.model.linear
        and len(layout.free) <= _MOST_PARAMETERS
    )


def _same_responses(at: SearchState) -> list[StartPoint]:
    """Return alternative values with the same responses to the inputs."""
    search, best, layout = at.search, at.best, at.search.layout
    here = Solution(layout, search.data, best.noise, best.best.z)
    others = second_solutions(at.search.problem, here, evaluate(*here))
    points = []
    for other in others[:_OTHERS]:
        z = _with_values(at, np.array(best.best.z), other.values)
        # The initial states differ for the alternative values, so their estimation begins at zero.
        z[layout.first_nuisance :] = 0.0
        z = with_noise_guess(search, best.noise, jnp.asarray(z, best.best.z.dtype))
        points.append((best.noise, z))
    return points


RESTARTS: tuple[Restart, ...] = (
    Restart("by-windows", _diverges, _by_windows),
    Restart("further-starts", _needs_further_starts, _further_starts),
    Restart("same-responses", _has_one_disturbance, _same_responses),
)
"""All restarts, in the order in which they are tried."""
