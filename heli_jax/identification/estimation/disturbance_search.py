"""Whether there is a disturbance, and the optimum with or without it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.dynamics.model import Disturbance
from heli_jax.finding import note
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.estimation.multistart import (
    Search,
    finer_noise_guess,
    gauss_newton_gain,
    noise_guess_at,
    noise_guesses_by_tau,
    one_noise_guess,
)
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    log_likelihood_of,
    relaxed_from,
)
from heli_jax.identification.estimation.simulated_flights import measured_count
from heli_jax.identification.unknowns.layout import (
    Layout,
    Solution,
    disturbance_limits,
    scales_of,
)

# How large gusts are at the start values: what expected standard deviations go with.


def likely_gusts(at: Solution, e: Evaluation) -> tuple[Float[Array, " q"], Evaluation]:
    """z with the disturbances of the greatest likelihood, all else as it is, and what that tells.

    A search may begin a decade off; what a fit may be expected to determine goes with the size.

    Args:
        at: the start values.
        e: there.
    """
    layout, data, noise, z = at
    k, places = layout.first_nuisance, [layout.disturbance_at(n) for n in layout.disturbance]
    # Without the initial states and biases of the flights, which nobody states: one that begins in
    # a bank is no gust, and weighed as one it made gusts a tenth of what they were.
    step = np.linalg.lstsq(e.J[:, k:], -e.r)[0] if np.isfinite(e.J).all() else np.zeros(z.size - k)
    settled = jnp.asarray(z).at[k:].add(jnp.asarray(step, z.dtype))
    likely = noise_guess_at(layout, data, noise, settled)
    likely = finer_noise_guess(layout, data, noise, likely)
    z = jnp.asarray(z).at[jnp.asarray(places)].set(likely[jnp.asarray(places)])
    return z, evaluate(layout, data, noise, z)


NO_DISTURBANCE = 2.71
"""twice a log-likelihood ratio below which a disturbance is not significant at 5 %: sigma_w = 0 is
a boundary, where half of the chi-squared with one degree of freedom holds (Self and Liang, 1987)"""
_SURE = 0.4
"""sd of log sigma_w below which nobody need ask whether there is a disturbance"""
_NONE = 30.0
"""so far below the log of the smallest noise there is no disturbance"""


def disturbance_or_none(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """The optimum with the disturbance where it is significant, else without one.

    Where sigma_w goes to zero, tau_w means nothing and the optimiser has no end to come to; the
    same residuals with sigma_w all but zero are those of output error. That model is nested in the
    one with a disturbance: a search that ends below its likelihood is begun anew from its optimum.
    """
    layout, data = search.layout, search.data
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    # First what costs one evaluation: the search without a disturbance takes as long as a fit.
    [d] = disturbances_of(layout.model)
    if is_sure(layout, optimum, e, d) and _far_better(search, optimum, e):
        return optimum
    without = without_disturbance(search, optimum)
    alone = evaluate(layout, data, without.noise, without.best.z)
    if bool(np.isfinite(alone.r).all()) and not _corrects(search, without, alone):
        likelihood = layout.estimator.log_likelihood(layout, data, without.noise, alone)
        ratio = 2.0 * (layout.estimator.log_likelihood(layout, data, optimum.noise, e) - likelihood)
        # Negated comparisons: a ratio that is NaN is none that speaks for a disturbance.
        if not ratio > NO_DISTURBANCE:
            optimum, ratio = _from_nested(search, optimum, ratio, without, likelihood)
        if bool(without.best.converged) and not ratio > NO_DISTURBANCE:
            return without._replace(trace=optimum.trace, ratio=ratio)
        optimum = optimum._replace(ratio=ratio)
    if not bool(optimum.best.converged):
        # The search was cut short before it was known that there is something to find.
        optimum = relaxed_from(search, optimum.noise, optimum.best.z).after(optimum)
    return _restarted_from_a_limit(search, optimum)


def _restarted_from_a_limit(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """Where the correlation time ran to an end of what a record can show, the better of that and of
    a search begun anew with the disturbance at its start: white noise is a local optimum of short
    records."""
    [d] = disturbances_of(search.layout.model)
    if not at_limit(search, optimum, d):
        return optimum
    z = with_noise_guess(search, optimum)
    again = begun_at(search, optimum, z)
    gained = log_likelihood_of(search, again) > log_likelihood_of(search, optimum)
    if bool(again.best.converged) and gained:
        optimum = again.after(optimum)
    return from_other_taus(search, optimum, d)


def at_limit(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> bool:
    """Whether the correlation time ran to an end of what a record can show, or below a sample.

    Args:
        search: the optimiser over the problem.
        optimum: where it ended.
        d: the disturbance.
    """
    if d.tau not in search.layout.disturbance:
        return False
    # At the limits `unpack` clips, so that the likelihood is flat and no optimiser comes back; and
    # it is all but flat below a sample.
    _, high = (float(v) for v in disturbance_limits(search.layout, search.data)[d.tau])
    low = np.log(min(float(f.dt) for f in search.data.flights))
    return not low < float(optimum.best.z[search.layout.disturbance_at(d.tau)]) < high


def from_other_taus(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> RelaxedOptimum:
    """The better of an optimum whose correlation time ran to an end and of searches from other
    ones, all other parameters as they are; any other optimum as it is.

    Args:
        search: the optimiser over the problem.
        optimum: where it ended.
        d: the disturbance.
    """
    if not at_limit(search, optimum, d):
        return optimum
    start, layout = at_its_start(search, optimum, d), search.layout
    # With it an output's noise may have run to zero, beside which no other parameter has a slope.
    scales = slice(layout.first_nuisance - len(layout.scaled), layout.first_nuisance)
    start = start.at[scales].set(0.0)
    likelihood = log_likelihood_of(search, optimum)
    for z in noise_guesses_by_tau(search.layout, search.data, optimum.noise, start, d):
        again = begun_at(search, optimum, z)
        inside = bool(again.best.converged) and not at_limit(search, again, d)
        # Each takes as long as a fit: the first that ends between the limits will do.
        if inside and log_likelihood_of(search, again) > likelihood:
            return again.after(optimum)
    return optimum


def at_its_start(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> Float[Array, " q"]:
    """z of an optimum with one disturbance at its start, from where its grid reaches all sizes.

    Args:
        search: the optimiser over the problem.
        optimum: where it ended.
        d: the disturbance.
    """
    z = optimum.best.z
    for name in (d.sigma, d.tau):
        if name in search.layout.disturbance:
            start = np.log(search.problem.noise[name].start)
            z = z.at[search.layout.disturbance_at(name)].set(jnp.asarray(start, z.dtype))
    return z


def begun_at(search: Search, optimum: RelaxedOptimum, z: Float[Array, " q"]) -> RelaxedOptimum:
    """A search begun anew from z, its noise at the level that shows there.

    Args:
        search: the optimiser over the problem.
        optimum: whose noise is taken to z.
        z: where to begin (q,).
    """
    at_guess = evaluate(search.layout, search.data, optimum.noise, z)
    noise = search.layout.estimator.with_level(search.data, at_guess, optimum.noise)
    return relaxed_from(search, noise, z)


def is_sure(layout: Layout, optimum: RelaxedOptimum, e: Evaluation, d: Disturbance) -> bool:
    """Whether a disturbance was found and all of it is determined.

    Args:
        layout: what the unknowns are.
        optimum: where the search ended.
        e: at that optimum.
        d: the disturbance, its sigma among the unknowns.
    """
    if not (bool(optimum.best.converged) and np.all(np.isfinite(e.J))):
        return False
    sds = deviations(e.J)
    its = [layout.disturbance_at(n) for n in (d.sigma, d.tau) if n in layout.disturbance]
    return bool(np.isfinite(sds[its]).all() and sds[layout.disturbance_at(d.sigma)] < _SURE)


def _far_better(search: Search, optimum: RelaxedOptimum, e: Evaluation) -> bool:
    """Whether nobody need optimise without a disturbance to see that it would fit worse.

    One evaluation at the same parameters, and the gain of the Gauss-Newton step from there.

    Args:
        search: the optimiser over the problem.
        optimum: with a disturbance.
        e: at that optimum.
    """
    layout, data, noise = search.layout, search.data, optimum.noise
    alone = evaluate(layout, data, noise, silenced(search, optimum, layout.sigmas))
    gained = gauss_newton_gain(alone.r, alone.J)
    if not np.isfinite(gained):
        return False
    n = measured_count(data)
    # In float64 whatever the rows are: the gain is a small difference of large sums.
    before = float(np.sum(np.square(np.asarray(alone.r, np.float64))))
    after = max(before - gained, 1e-300)
    gain = 0.5 * float(layout.estimator.deviance(layout, before / n, after / n, n))
    without = layout.estimator.log_likelihood(layout, data, noise, alone) + gain
    # By one a measured number: far past what the linear model of the residuals may be wrong by.
    return bool(layout.estimator.log_likelihood(layout, data, noise, e) - without > n)


def _from_nested(
    search: Search,
    optimum: RelaxedOptimum,
    ratio: float,
    without: RelaxedOptimum,
    likelihood: float,
) -> tuple[RelaxedOptimum, float]:
    """The better of an optimum and of a search from that without disturbance, and its ratio.

    Args:
        search: the optimiser over the problem.
        optimum: with a disturbance.
        ratio: twice the log-likelihood that it gains over `without`.
        without: the optimum without one.
        likelihood: the logarithm of that of `without`.
    """
    layout, data = search.layout, search.data
    z = with_noise_guess(search, without)
    guess = evaluate(layout, data, without.noise, z)
    # The rows are laid out about the level of their own innovations; that of a filter that never
    # corrects is far from it.
    noise = layout.estimator.with_level(data, guess, without.noise)
    with_guess = layout.estimator.log_likelihood(layout, data, noise, guess)
    promising = with_guess > likelihood + NO_DISTURBANCE
    # A nested model cannot fit better: where it does, the first search ended in a worse optimum.
    if not (promising or ratio < -NO_DISTURBANCE or not np.isfinite(ratio)):
        return optimum, ratio
    again = relaxed_from(search, noise, z)
    other = 2.0 * (log_likelihood_of(search, again) - likelihood)
    if not np.isfinite(other) or other <= ratio:
        return optimum, ratio
    notes = ()
    if other > NO_DISTURBANCE:
        notes = (
            note(
                "search.begun-anew",
                "The first search ended in a worse optimum, below what the model without a "
                "disturbance reaches: this fit was begun anew from that model's parameters.",
            ),
        )
    return again._replace(trace=(*optimum.trace, *again.trace), notes=notes), other


def with_noise_guess(search: Search, optimum: RelaxedOptimum) -> Float[Array, " q"]:
    """z (q,) at the parameters of an optimum, the disturbance from a coarse search.

    Args:
        search: the optimiser over the problem.
        optimum: where it ended.
    """
    layout, at = search.layout, len(search.layout.of_interest)
    starts = [np.log(search.problem.noise[n].start) for n in layout.disturbance]
    # From the problem's own start values: those of the optimum have run off to a limit.
    z = optimum.best.z
    z = z.at[at : at + len(starts)].set(jnp.asarray(starts, z.dtype))
    return noise_guess_at(layout, search.data, optimum.noise, z)


def _corrects(search: Search, without: RelaxedOptimum, e: Evaluation) -> bool:
    """Whether the filter corrects its state even where there is no disturbance.

    It does in an unstable model, whose error grows from nothing: that is no output error.

    Args:
        search: the optimiser over the problem.
        without: the optimum without a disturbance.
        e: at that optimum.
    """
    # The noise of each output but the first has a factor of its own among the unknowns.
    scales = scales_of(search.layout, without.best.z)
    # Without a state to correct the innovation's variance is that of the measurement.
    return any(
        float(np.nanmax(s / (sd[n] * float(scales.get(n, 1.0))) ** 2)) > 1.01
        for flight, sd in zip(e.innovations, without.noise.sd, strict=True)
        for n, s in flight.variance.items()
    )


def without_disturbance(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """The optimum with a sigma_w that is all but zero."""
    z = silenced(search, optimum, search.layout.sigmas)
    return relaxed_from(search, optimum.noise, z)


def silenced(
    search: Search, optimum: RelaxedOptimum, sigmas: tuple[str, ...]
) -> Float[Array, " q"]:
    """z of an optimum with the named standard deviations of disturbances all but zero.

    Args:
        search: whose layout says where the sizes stand in z.
        optimum: where z and the noise are taken from.
        sigmas: the parameters to be silenced.
    """
    # Far below the smallest noise rather than zero, whose logarithm no z holds.
    smallest = min(float(s) for by_name in optimum.noise.sd for s in by_name.values())
    z = optimum.best.z
    for name in sigmas:
        z = z.at[search.layout.disturbance_at(name)].set(np.log(smallest) - _NONE)
    return z


# Which of several disturbances there are, each asked by itself, and the optimum with those.


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
