"""Starts to go on from where a fit explains little: a mode far from where it is sought leaves no
slope towards it."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.finding import note
from heli_jax.identification.equation_error.start import equation_error_start
from heli_jax.identification.estimation.disturbance_search import (
    NO_DISTURBANCE,
    begun_at,
    with_noise_guess,
)
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, measured_count
from heli_jax.identification.estimation.multistart import Search, named_values, rank
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    log_likelihood_of,
    relax_noise_covariance,
)
from heli_jax.identification.estimation.starts import draw
from heli_jax.identification.identifiability.equivalents import same_responses
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Layout, Noise, unpack
from heli_jax.identification.validation.advice import is_unstable

SAID_STABLE = "the model became unstable on the way: from further starts"
SAID = "little is explained: from further starts"
_LITTLE = 0.5
"""part of the outputs' variance below which an optimum explains little"""
_DRAWN = 5


def explains_little(search: Search, noise: Noise, best: Optimum) -> bool:
    """Whether the optimum of a linear model by output error explains less than half of the
    outputs' variance; of others nothing is asked, which take long.

    Args:
        search: that ended there.
        noise: of the measurements, by which its rows were divided.
        best: the best optimum so far.
    """
    layout = search.layout
    if not layout.model.linear or layout.disturbance or not layout.estimator.rows_are_samples:
        return False
    left = float(best.cost) * measured_count(search.data) / search.variation(noise)
    return not (bool(best.converged) and 1.0 - left > _LITTLE)


def further_starts(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], seed: int
) -> Float[Array, "s q"]:
    """Starts (s, q) that differ from z0 in the free parameters: what a regression of the states'
    derivatives makes of the record, where it can, and values drawn about the start.

    Args:
        layout: what the unknowns are.
        problem: with the records, and the free parameters' bounds and priors.
        z0: the first start.
        seed: of the draw.
    """
    drawn = draw(layout, problem, z0, 1 + _DRAWN, seed)[1:]
    try:
        with np.errstate(all="ignore"):
            guess = equation_error_start(
                problem.model, problem.vehicle, problem.training, problem.free
            )
    # Nothing can be regressed: no state was measured, say.
    except (ValueError, np.linalg.LinAlgError):
        return drawn
    row = np.array(z0, np.float64)
    for i, (name, free) in enumerate(problem.free.items()):
        z = transforms.coordinate(free, layout.kinds[i], guess.values[name].value)
        row[i] = row[i] if z is None else z
    return jnp.concatenate([jnp.asarray(row[None, :], z0.dtype), drawn])


def left_stability(problem: Problem, search: Search, optimum: RelaxedOptimum) -> bool:
    """Whether a search in frequency that began with a stable linear model ended with an unstable
    one.

    A pole and its mirror image have the same gain at all frequencies, so that where inputs tell
    little a spectrum which is estimated leaves the likelihood an optimum on either side.

    Args:
        problem: what was fitted.
        search: over it.
        optimum: where it ended.
    """
    layout = search.layout
    if not layout.model.linear or not layout.estimator.noise_spectrum:
        return False
    begun, ended = problem.start_params(), _params(problem, search, optimum)
    return is_unstable(problem, ended) and not is_unstable(problem, begun)


def better_of_stable(
    problem: Problem,
    search: Search,
    noise: Noise,
    points: Float[Array, "s q"],
    optimum: RelaxedOptimum,
) -> RelaxedOptimum:
    """The better of an optimum with an unstable model and the best of further starts with a stable
    one.

    Args:
        problem: what was fitted.
        search: over it.
        noise: that the search began with.
        points: where to begin again.
        optimum: with the unstable model.
    """
    stable = [
        run
        for run in search.run(noise, points, nearing=search.layout.estimator.nearing)
        if bool(run.converged)
        and not is_unstable(problem, _params(problem, search, optimum._replace(best=run)))
    ]
    if not stable:
        return optimum
    other = relax_noise_covariance(search, noise, min(stable, key=rank))
    if not bool(other.best.converged):
        return optimum
    first, second = (log_likelihood_of(search, o) for o in (optimum, other))
    if not second > first:
        return optimum._replace(trace=(*optimum.trace, *other.trace))
    return other.after(optimum)


_MOST_PARAMETERS = 8
"""of which equal responses are sought: more take long"""
_OTHERS = 2
"""other values that a filter is begun from"""
_BETTER = 0.1
"""log-likelihood by which an optimum is better than another"""


def better_of_same_responses(
    problem: Problem, search: Search, optimum: RelaxedOptimum
) -> RelaxedOptimum:
    """The best of a filter's optimum and of those that it finds from other values with the same
    responses to the inputs; of linear models with one disturbance.

    Two modes may exchange their parts: a heave mode and an inflow with a slow damping and a quick
    lag answer a collective like one with a quick damping and a slow lag. A disturbance tells them
    apart, as it acts through one of them alone; but a search that began on the wrong side ends
    there, with white innovations and a likelihood that lacks a few units.

    Args:
        problem: what was fitted.
        search: over it.
        optimum: where it ended.
    """
    layout = search.layout
    # Where the record shows no disturbance nothing tells such values apart.
    disturbed = optimum.ratio is None or optimum.ratio > NO_DISTURBANCE
    if not (
        bool(optimum.best.converged)
        and len(layout.sigmas) == 1
        and disturbed
        and problem.model.linear
        and len(layout.free) <= _MOST_PARAMETERS
    ):
        return optimum
    best, likelihood = optimum, _log_posterior(search, optimum)
    here = named_values(layout, search.data, optimum.best.z)
    for values in same_responses(problem, here)[:_OTHERS]:
        z = np.array(optimum.best.z)
        for i, (name, free) in enumerate(problem.free.items()):
            z[i] = transforms.coordinate(free, layout.kinds[i], values[name])
        # Initial states are those of the other values too: from zero they follow.
        z[layout.first_nuisance :] = 0.0
        begun = optimum._replace(best=optimum.best._replace(z=jnp.asarray(z)))
        again = begun_at(search, optimum, with_noise_guess(search, begun))
        likelier = _log_posterior(search, again) if bool(again.best.converged) else -np.inf
        if likelier > likelihood + _BETTER:
            words = (
                "Other parameter values have the same responses to the inputs: begun from these "
                f"the filter found a better optimum (log-likelihood {likelier:.1f} for "
                f"{likelihood:.1f}), and this fit is the better one."
            )
            best = again.after(best, note("search.same-responses", words))
            likelihood = likelier
    return best


def _log_posterior(search: Search, optimum: RelaxedOptimum) -> float:
    """The log-likelihood, less what priors hold against the free parameters."""
    values = named_values(search.layout, search.data, optimum.best.z)
    against = [
        ((values[n] - f.prior.mean) / f.prior.sd) ** 2
        for n, f in search.problem.free.items()
        if f.prior is not None
    ]
    return log_likelihood_of(search, optimum) - 0.5 * sum(against)


# Any: a record of the model's Params.
def _params(problem: Problem, search: Search, optimum: RelaxedOptimum) -> Any:
    values = unpack(search.layout, search.data, optimum.best.z).params
    return naming.replace(
        problem.start_params(), **{n: np.asarray(values[n]) for n in search.layout.free}
    )
