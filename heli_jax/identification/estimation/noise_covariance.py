"""Measurement noise: a first guess, then relaxation with the optimum."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_scales import own_changed, slopes_changed
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Layout, Noise
from heli_jax.numerics.white_noise import noise_guess

_ROUNDS = 30
"""of the optimiser at most: in slow gusts a spectrum settles by a fifth a round"""
_UNCHANGED = 1e-3
"""change in the logarithm of every sd below which the relaxation has ended"""
_SETTLED = 0.01
"""move of the optimum, in joint standard deviations, below which it has ended as well"""


class RelaxedOptimum(NamedTuple):
    """An optimum together with the noise that it shows."""

    best: Optimum
    noise: Noise
    trace: tuple[tuple[int, float], ...]
    """(steps, cost) of every round of the optimiser"""
    ratio: float | None = None
    """twice the log-likelihood that a disturbance gained, where that was asked"""
    notes: tuple[Finding, ...] = ()
    """what a reader should know of how the optimum was reached"""
    absent: tuple[str, ...] = ()
    """the parameters of those of several disturbances that do not show"""

    def after(self, earlier: "RelaxedOptimum", *notes: Finding) -> "RelaxedOptimum":
        """The same with the rounds and notes of an earlier one before its own."""
        return self._replace(
            trace=(*earlier.trace, *self.trace), ratio=earlier.ratio, notes=(*earlier.notes, *notes)
        )


def first_noise(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """The noise to begin with, by flight and output: as stated, else guessed.

    Where an output has one noise in all flights, what is not stated is guessed from all of them.
    """
    noise = first_noise_sizes(problem, flights)
    return objective_of(problem.method).first_noise(problem, noise, flights)


def first_noise_sizes(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """The same without what the method adds, such as a spectrum."""
    dtype = np.dtype(jnp.result_type(float))
    guesses = [{n: noise_guess(y) for n, y in f.outputs.items()} for f in flights]
    # The median: one flight in which an output hardly moves, or jumps, has no say.
    if problem.noise_model == "disturbance":
        outputs = {n for guess in guesses for n in guess}
        pooled = {n: float(np.median([g[n] for g in guesses if n in g])) for n in outputs}
        guesses = [{n: pooled[n] for n in guess} for guess in guesses]
    # Sorted, as `data_of` has the outputs: JAX sorts the names in what it compiles.
    sd = tuple(
        {n: np.asarray(flight.sd.get(n) or guess[n], dtype) for n in sorted(flight.outputs)}
        for flight, guess in zip(flights, guesses, strict=True)
    )
    return Noise(sd, np.zeros((), dtype))


def relax_noise_covariance(search: Search, noise: Noise, best: Optimum) -> RelaxedOptimum:
    """Alternate between the optimum and the noise until one of them stays.

    Source: relaxation of the noise covariance, Jategaonkar (2006), section 4.4.
    """
    layout, objective = search.layout, search.layout.objective
    trace = [(int(best.steps), float(best.cost))]
    moved, notes = np.inf, ()
    for _ in range(_ROUNDS):
        z, new = objective.relax(layout, search.data, noise, best.z)
        change = _changed(noise, new)
        # Residuals that overflowed show no noise, and where they do is no optimum.
        if not np.isfinite(change):
            best = best._replace(converged=np.asarray(False))
            break
        moves = objective.noise_matters(search.problem, layout, noise, new)
        # The noise first and the parameters after it: the parameters of one round are the best for
        # the noise of the round before, and where one stays so does the other.
        best, noise = best._replace(z=z), new
        # A search that failed with one noise is not repeated with another.
        if change < _UNCHANGED or moved < _SETTLED or not (moves and bool(best.converged)):
            break
        begin = np.array(best.z)
        # Nuisances have no part in the rows of a spectrum: their weak priors alone would be a
        # misfit. A model that is not linear is linearised where they put it.
        if layout.noise_model == "spectrum" and layout.model.linear:
            begin[layout.first_nuisance :] = 0.0
        [best] = search.run(noise, begin[None])
        trace.append((int(best.steps), float(best.cost)))
        moved = float(best.moved) ** 0.5
    else:
        notes = (found("search.noise-not-settled", value=moved, rounds=_ROUNDS, limit=_SETTLED),)
    best = best._replace(z=objective.finish(layout, search.data, noise, best.z))
    return RelaxedOptimum(best, noise, tuple(trace), notes=notes)


def _changed(noise: Noise, new: Noise) -> float:
    """Return the largest change in the logarithms."""
    change = abs(float(noise.log_variance_ratio - new.log_variance_ratio)) + max(
        abs(float(np.log(sd[n] / before[n])))
        for sd, before in zip(new.sd, noise.sd, strict=True)
        for n in before
    )
    return change + slopes_changed(noise, new) + float(own_changed(noise, new))


def relaxed_from(search: Search, noise: Noise, z: Float[Array, " q"]) -> RelaxedOptimum:
    """The optimum that a search from z leads to, its noise relaxed from `noise`."""
    [best] = search.run(noise, z[None, :])
    return relax_noise_covariance(search, noise, best)


def log_likelihood_of(search: Search, optimum: RelaxedOptimum) -> float:
    """At an optimum and its noise."""
    layout, data = search.layout, search.data
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    return layout.objective.log_likelihood(layout, data, optimum.noise, e)


# Whether a search that says so has arrived at an optimum.


_SHARE = 0.1
"""of the sum of squares that a modest step would take away, at most, at an optimum"""
_PER_UNKNOWN = 4.0
"""times what an unknown takes of white noise by chance: few samples explain much by nothing"""
_MODEST = 0.5
"""of a coordinate, most of them logarithms: a step for which the linear model still holds"""


def gain_left(
    r: Float[np.ndarray, " n"],
    J: Float[np.ndarray, "n q"],
    parameters: int,
    at_bound: Sequence[int] = (),
) -> float | None:
    """The share of the sum of squares that a modest step would take away, where that is so much
    that no optimiser can have converged; None where it is not.

    An optimiser calls its last step short and itself converged also where every longer one failed,
    as among the roundings of a simulation that grows by orders of magnitude. What the data
    determine is then no question to ask of that point.

    Args:
        parameters: how many of these, the first, are parameters, of which a step has a size.
        at_bound: those of them that the optimiser may move no further.
    """
    if at_bound:
        J = np.delete(J, list(at_bound), axis=1)
        parameters -= len(at_bound)
    squares = float(np.sum(np.square(r)))
    least = squares * max(_SHARE, _PER_UNKNOWN * J.shape[1] / r.size)
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return None
    norms = np.linalg.norm(J, axis=0)
    units = np.where(norms > 0, norms, 1.0)
    Q, R = np.linalg.qr(J / units)
    along = Q.T @ r
    # The whole of a Gauss-Newton step takes away the part of r in the span of J's columns.
    if not np.sum(along**2) > least:
        return None
    left, singular, right = np.linalg.svd(R)
    along = left.T @ along
    with np.errstate(divide="ignore", over="ignore"):
        steps = np.abs(along / singular)[:, None] * np.abs(right / units)[:, :parameters]
        # What the linear model promises for a step to far beyond where it holds is worth nothing:
        # a time constant on its way to zero has such a slope, and no optimum to come to.
        part = np.minimum(1.0, _MODEST / np.maximum(steps.max(axis=1, initial=0.0), 1e-300))
    gain = float(np.sum((2.0 * part - part**2) * along**2))
    return gain / squares if gain > least else None


def unless_stuck(
    layout: Layout, optimum: RelaxedOptimum, e: Evaluation, free: Mapping[str, Free]
) -> RelaxedOptimum:
    """The optimum, no longer taken for one where its own slopes say that it is none."""
    # A filter's rows hold the level of its variances too, and have no squares to take a share of.
    if not (bool(optimum.best.converged) and layout.noise_model == "white"):
        return optimum
    # What lies beyond a bound is a gain that no optimiser may take.
    at_bound = [
        i
        for i, name in enumerate(layout.free)
        if transforms.at_bound(free[name], float(e.named[i]))
    ]
    r, J = np.asarray(e.r, np.float64), np.asarray(e.J, np.float64)
    share = gain_left(r, J, len(layout.free), at_bound)
    if share is None:
        return optimum
    best = optimum.best._replace(converged=np.asarray(False))
    stuck = found("search.stuck", value=share)
    return optimum._replace(best=best, notes=(stuck, *optimum.notes))
