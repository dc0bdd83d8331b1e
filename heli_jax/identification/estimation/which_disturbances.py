"""Which of several disturbances there are, each asked by itself, and the optimum with those."""

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.dynamics.model import Disturbance
from heli_jax.identification.estimation.disturbance_search import (
    NO_DISTURBANCE,
    at_its_start,
    at_limit,
    from_other_taus,
    is_sure,
    silenced,
)
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    log_likelihood_of,
    relaxed_from,
)
from heli_jax.identification.estimation.noise_search import one_noise_guess


def those_that_show(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """The optimum with the disturbances that are significant, the others at zero and named.

    One whose variance goes to zero has no slope left that leads back: before it is given up it is
    tried again from a coarse search of its own, all others as they are.
    """
    if not bool(optimum.best.converged):
        # The search was cut short before it was known that there is something to find.
        optimum = relaxed_from(search, optimum.noise, optimum.best.z).after(optimum)
    several = [d for d in disturbances_of(search.layout.model) if d.sigma in search.layout.sigmas]
    absent: list[Disturbance] = []
    # One after another, each beside those that have not been given up: two that can stand for one
    # another would both be found superfluous if each were left out of the full set.
    for d in several:
        # The cheap question first: a disturbance that is well determined needs no search without
        # it.
        if _is_known(search, optimum, d):
            continue
        optimum = from_other_taus(search, _begun_again(search, optimum, d), d)
        optimum, shows = _with_or_without(search, optimum, d)
        if not shows:
            absent.append(d)
    # Both of its parameters: without a size the correlation time is in no likelihood.
    names = [n for d in absent for n in (d.sigma, d.tau) if n in search.layout.disturbance]
    return optimum._replace(absent=tuple(names))


def _is_known(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> bool:
    """Whether a disturbance is there beyond doubt, its correlation time within what can be seen."""
    e = evaluate(search.layout, search.data, optimum.noise, optimum.best.z)
    return is_sure(search.layout, optimum, e, d) and not at_limit(search, optimum, d)


def _begun_again(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> RelaxedOptimum:
    """The better of the optimum and of one begun anew with a guess of this disturbance.

    Args:
        search: the optimiser over the problem.
        optimum: with all that show so far; those that do not are silenced and stay so.
        d: the one in question.
    """
    layout, data = search.layout, search.data
    likelihood = log_likelihood_of(search, optimum)
    z = at_its_start(search, optimum, d)
    # One evaluation for each of the grid's points, at the parameters that there are.
    z = one_noise_guess(layout, data, optimum.noise, z, (d.sigma, d.tau))
    guess = evaluate(layout, data, optimum.noise, z)
    gain = layout.estimator.log_likelihood(layout, data, optimum.noise, guess) - likelihood
    if not (gain > NO_DISTURBANCE or at_limit(search, optimum, d)):
        return optimum
    again = relaxed_from(search, layout.estimator.with_level(data, guess, optimum.noise), z)
    gained = log_likelihood_of(search, again) > likelihood
    return again.after(optimum) if bool(again.best.converged) and gained else optimum


def _with_or_without(
    search: Search, optimum: RelaxedOptimum, d: Disturbance
) -> tuple[RelaxedOptimum, bool]:
    """The optimum and whether a disturbance shows; without it where it does not."""
    layout, data = search.layout, search.data
    # Without it all other parameters are fitted anew, from where they are: a likelihood ratio is
    # that of two optima, not of one and a point.
    z = silenced(search, optimum, (d.sigma,))
    alone = evaluate(layout, data, optimum.noise, z)
    # The rows are laid out about the level of their own innovations.
    noise = layout.estimator.with_level(data, alone, optimum.noise)
    without = relaxed_from(search, noise, z)
    ratio = 2.0 * (log_likelihood_of(search, optimum) - log_likelihood_of(search, without))
    # Negated: a ratio that is NaN is none that speaks for a disturbance.
    if bool(without.best.converged) and not ratio > NO_DISTURBANCE:
        return without.after(optimum), False
    return optimum, True
