"""Measurement noise: a first guess, then relaxation with the optimum."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_scales import corrections_changed
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Noise
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


def relaxed_from(search: Search, noise: Noise, z: Float[Array, " q"]) -> RelaxedOptimum:
    """Return the optimum of a search from z, its noise relaxed from `noise`."""
    [best] = search.run(noise, z[None, :])
    return relax_noise_covariance(search, noise, best)


def log_likelihood_of(search: Search, optimum: RelaxedOptimum) -> float:
    """Return the log-likelihood at an optimum and its noise."""
    layout, data = search.layout, search.data
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    return layout.objective.log_likelihood(layout, data, optimum.noise, e)
