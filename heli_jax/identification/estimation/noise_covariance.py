"""Noise of a search: a first guess, relaxation with the optimum, and significant disturbances."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.dynamics.model import Disturbance
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, fit_nuisances
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_scales import corrections_changed
from heli_jax.identification.estimation.starts import noise_guess_at
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Noise, Solution, disturbance_limits
from heli_jax.numerics.white_noise import noise_guess

_ROUNDS = 30
"""Most rounds of the optimiser; in slow gusts a spectrum changes by a fifth each round."""
_UNCHANGED = 1e-3
"""Change of every log sd below which the relaxation has converged."""
_SETTLED = 0.01
"""Move of the optimum, in joint standard deviations, below which the relaxation has converged."""


class RelaxedOptimum(NamedTuple):
    """An optimum, and the noise of its residuals."""

    best: Optimum
    noise: Noise
    trace: tuple[tuple[int, float], ...]
    """Steps and cost of each round of the optimiser."""
    notes: tuple[Finding, ...] = ()
    """Notes on how the optimum was reached."""
    absent: tuple[str, ...] = ()
    """Parameters of disturbances that are not significant."""

    def after(self, earlier: "RelaxedOptimum", *notes: Finding) -> "RelaxedOptimum":
        """Return this optimum with the rounds and notes of an earlier one before its own."""
        return self._replace(trace=(*earlier.trace, *self.trace), notes=(*earlier.notes, *notes))


def first_noise(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """Return the first guess of the noise by flight and output: as stated, else guessed.

    If an output has one noise in all flights, they all contribute to the guess.
    """
    noise = first_noise_sizes(problem, flights)
    return objective_of(problem.method).first_noise(problem, noise, flights)


def first_noise_sizes(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """Return the first guess without additions of the method, such as a spectrum."""
    dtype = np.dtype(jnp.result_type(float))
    guesses = [{n: noise_guess(y) for n, y in f.outputs.items()} for f in flights]
    # The median ignores single flights in which an output hardly moves, or jumps.
    if problem.noise_model == "disturbance":
        outputs = {n for guess in guesses for n in guess}
        pooled = {n: float(np.median([g[n] for g in guesses if n in g])) for n in outputs}
        guesses = [{n: pooled[n] for n in guess} for guess in guesses]
    # The order is that of `data_of`, because JAX sorts names in compiled programs.
    sd = tuple(
        {n: np.asarray(flight.sd.get(n) or guess[n], dtype) for n in sorted(flight.outputs)}
        for flight, guess in zip(flights, guesses, strict=True)
    )
    return Noise(sd, np.zeros((), dtype))


def relax_noise_covariance(search: Search, noise: Noise, best: Optimum) -> RelaxedOptimum:
    """Alternate between optimum and noise until one of them stays the same.

    Source: relaxation of the noise covariance, Jategaonkar (2006), section 4.4.
    """
    layout, objective = search.layout, search.layout.objective
    trace = [(best.steps, best.cost)]
    moved, notes = np.inf, ()
    for _ in range(_ROUNDS):
        z, new = objective.relax(layout, search.data, noise, best.z)
        change = _changed(noise, new)
        # Overflowed residuals show no noise, and such a point is no optimum.
        if not np.isfinite(change):
            best = best._replace(converged=False)
            break
        moves = objective.noise_matters(search.problem, layout, noise, new)
        # The parameters of a round are optimal for the previous round's noise. If one stays the
        # same, so does the other.
        best, noise = best._replace(z=z), new
        # A search that failed with one noise is not repeated with another.
        if change < _UNCHANGED or moved < _SETTLED or not (moves and best.converged):
            break
        begin = np.array(best.z)
        # Rows of a spectrum do not depend on nuisances, whose weak priors alone would add misfit. A
        # nonlinear model is linearised at the point that they define.
        if layout.noise_model == "spectrum" and layout.model.linear:
            begin[layout.first_nuisance :] = 0.0
        [best] = search.run(noise, begin[None])
        trace.append((best.steps, best.cost))
        moved = best.moved**0.5
    else:
        notes = (found("search.noise-not-settled", value=moved, rounds=_ROUNDS, limit=_SETTLED),)
    best = best._replace(z=objective.finish(layout, search.data, noise, best.z))
    return RelaxedOptimum(best, noise, tuple(trace), notes=notes)


def _changed(noise: Noise, new: Noise) -> float:
    """Return the largest change of a logarithm of the noise."""
    change = abs(float(noise.log_determinant - new.log_determinant)) + max(
        abs(float(np.log(sd[n] / before[n])))
        for sd, before in zip(new.sd, noise.sd, strict=True)
        for n in before
    )
    return change + corrections_changed(noise, new)


def log_likelihood_of(search: Search, optimum: RelaxedOptimum) -> float:
    """Return the log-likelihood at an optimum and its noise."""
    layout, data = search.layout, search.data
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    return layout.objective.log_likelihood(layout, data, optimum.noise, e)


# Search for the optimum with or without disturbances.


def likely_gusts(at: Solution) -> tuple[Float[Array, " q"], Evaluation]:
    """Return z with the most likely disturbances, all else unchanged, and its evaluation.

    The expected accuracy of a fit depends on their size, and a search may start a decade off.
    """
    layout, data, noise, z = at
    places = np.array([layout.disturbance_at(n) for n in layout.disturbance])
    # Nuisances are fitted first. Otherwise an unknown initial bank counts as gust: one case gave
    # gusts a tenth of their true size.
    settled = fit_nuisances(layout, data, noise, z)
    likely = noise_guess_at(layout, data, noise, settled, finer=True)
    z = jnp.asarray(z).at[places].set(likely[places])
    return z, evaluate(layout, data, noise, z)


NO_DISTURBANCE = 2.71
"""Twice the log-likelihood ratio below which a disturbance is not significant at 5 %. At the
boundary sigma_w = 0 half of the chi-squared with one degree of freedom holds (Self and Liang,
1987)."""
_SURE = 0.4
"""sd of log sigma_w below which a disturbance is significant without a separate search."""
_NONE = 30.0
"""Logarithm by which sigma_w lies below the smallest noise if there is no disturbance."""


def significant_disturbances(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """Return the optimum with the significant disturbances, the others almost zero.

    If sigma_w goes to zero, tau_w has no effect and the optimiser does not converge. If all sigma_w
    are almost zero, the residuals equal those of output error.

    Args:
        optimum: the optimum with all disturbances.
    """
    layout = search.layout
    absent: list[str] = []
    # Disturbances are removed one after another. If each were left out of the full set, two
    # exchangeable ones would both look superfluous.
    for d in disturbances_of(layout.model):
        # A well-determined disturbance needs no search without it.
        if d.sigma not in layout.sigmas or _is_known(search, optimum, d):
            continue
        without, ratio = _without(search, optimum, d)
        # The condition is negated because a NaN ratio is no evidence of a disturbance.
        if without.best.converged and not ratio > NO_DISTURBANCE:
            optimum = without.after(optimum)
            # Without sigma_w the correlation time has no effect.
            absent += [n for n in (d.sigma, d.tau) if n in layout.disturbance]
    return optimum._replace(absent=tuple(absent))


def with_noise_guess(search: Search, noise: Noise, z: Float[Array, " q"]) -> Float[Array, " q"]:
    """Return z with the disturbances from a coarse search around their start values."""
    layout = search.layout
    for name in layout.disturbance:
        start = np.log(search.problem.noise[name].start)
        z = z.at[layout.disturbance_at(name)].set(jnp.asarray(start, z.dtype))
    return noise_guess_at(layout, search.data, noise, z)


def _is_known(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> bool:
    """True if all parameters of a disturbance are determined, and within what a record can show."""
    layout, z = search.layout, optimum.best.z
    e = evaluate(layout, search.data, optimum.noise, z)
    if not (optimum.best.converged and np.all(np.isfinite(e.J))):
        return False
    sds = deviations(e.J)
    its = [layout.disturbance_at(n) for n in (d.sigma, d.tau) if n in layout.disturbance]
    if not (np.isfinite(sds[its]).all() and sds[layout.disturbance_at(d.sigma)] < _SURE):
        return False
    if d.tau not in layout.disturbance:
        return True
    # `unpack` clips at the limits, so the likelihood is flat there. It is nearly flat below one
    # sample.
    _, high = (float(v) for v in disturbance_limits(layout, search.data)[d.tau])
    low = np.log(min(float(f.dt) for f in search.data.flights))
    return bool(low < float(z[layout.disturbance_at(d.tau)]) < high)


def _without(
    search: Search, optimum: RelaxedOptimum, d: Disturbance
) -> tuple[RelaxedOptimum, float]:
    """Return the optimum without one disturbance, and twice the log-likelihood lost."""
    layout = search.layout
    # A value far below the smallest noise replaces zero, whose logarithm is infinite.
    smallest = min(float(s) for by_name in optimum.noise.sd for s in by_name.values())
    at = layout.disturbance_at(d.sigma)
    # All other parameters are fitted again, because a likelihood ratio compares two optima.
    z = optimum.best.z.at[at].set(np.log(smallest) - _NONE)
    [run] = search.run(optimum.noise, z[None, :])
    without = relax_noise_covariance(search, optimum.noise, run)
    ratio = 2.0 * (log_likelihood_of(search, optimum) - log_likelihood_of(search, without))
    return without, ratio
