"""How large the measurement noise is: guessed first, then relaxed with the optimum."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search, gauss_newton_gain
from heli_jax.identification.estimation.noise_scales import own_changed, slopes_changed
from heli_jax.identification.free import Free
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Layout, Noise
from heli_jax.numerics.white_noise import noise_guess

_ROUNDS = 8
"""of the optimiser at most"""
_ROUNDS_OF_SPECTRA = 30
"""the same where the noise is a spectrum: in slow gusts it settles by a fifth a round, of which
the later ones are an evaluation or two"""
_UNCHANGED = 1e-3
"""change in the logarithm of every sd below which the relaxation has ended"""
_DAMPING = 0.01
"""of the first step of a search from an optimum with another noise, in the optimiser's units"""
_SETTLED = 3e-3
"""squared joint standard deviations by which another noise would move the optimum, below which the
relaxation of a noise that is a spectrum has ended"""
_NEARLY = 0.4
"""the same where a search by more of the data follows"""
_SLOWER = 3.0
"""times the fall from one such move to the next may the following fall be"""
_NEAR = 1.0
"""such a move, above which the fall after it says nothing: what moves fast is then done, and what
moves slowly is still to come"""


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
    return estimator_of(problem.method).prepared_for(problem, noise, flights)


def first_noise_sizes(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """The same without what the method adds, such as a spectrum."""
    dtype = np.dtype(jnp.result_type(float))
    guesses = [{n: noise_guess(y) for n, y in f.outputs.items()} for f in flights]
    # The median: one flight in which an output hardly moves, or jumps, has no say.
    if estimator_of(problem.method).shared_noise:
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
    """Alternate between the optimum and the noise until both stay.

    Source: relaxation of the noise covariance, Jategaonkar (2006), section 4.4.

    Args:
        noise: that `best` was found with.
    """
    layout, estimator = search.layout, search.layout.estimator
    trace = [(int(best.steps), float(best.cost))]
    # Where the first search began says nothing of the noise.
    best, earlier = best._replace(moved=np.asarray(np.inf)), np.inf
    if estimator.whole(noise) is not noise:
        best, noise, rounds = _alternated(search, noise, best, earlier, nearly=True)
        earlier, trace, noise = float(best.moved), [*trace, *rounds], estimator.whole(noise)
        # From here on by all of the data: what a part of them said is no verdict.
        best = best._replace(moved=np.asarray(np.inf), converged=np.asarray(True))
    best, noise, rounds = _alternated(search, noise, best, earlier)
    notes = _not_settled(best, len(rounds))
    best = best._replace(z=estimator.with_nuisances(layout, search.data, noise, best.z))
    return RelaxedOptimum(best, noise, (*trace, *rounds), notes=notes)


def _not_settled(best: Optimum, rounds: int) -> tuple[Finding, ...]:
    """Whether a spectrum still moved the optimum in the last of all its rounds."""
    moved = float(best.moved)
    if rounds < _ROUNDS_OF_SPECTRA or not bool(best.converged) or not _SETTLED <= moved < np.inf:
        return ()
    return (
        found("search.noise-not-settled", value=moved**0.5, rounds=rounds, limit=_SETTLED**0.5),
    )


def _alternated(
    search: Search, noise: Noise, best: Optimum, earlier: float, *, nearly: bool = False
) -> tuple[Optimum, Noise, list[tuple[int, float]]]:
    """Optimum and noise that stay, and steps and cost of each search.

    Args:
        noise: that `best` was found with.
        earlier: how far the noise moved it the last time; inf where that is not known.
    """
    layout, estimator = search.layout, search.layout.estimator
    trace: list[tuple[int, float]] = []
    for _ in range(_ROUNDS if estimator.nearing is None else _ROUNDS_OF_SPECTRA):
        e = evaluate(layout, search.data, noise, best.z) if estimator.relaxes_rows else None
        z, new = estimator.relax(layout, search.data, e, noise, best.z)
        change = _changed(noise, new)
        # Residuals that overflowed show no noise, and where they do is no optimum.
        if not np.isfinite(change):
            best = best._replace(converged=np.asarray(False))
            break
        moves = estimator.noise_matters(search.problem, layout, noise, new)
        # The noise first and the parameters after it: the parameters of one round are the best for
        # the noise of the round before, and where both stay they are so for each other.
        best, noise = best._replace(z=z), new
        # A search that failed with one noise is not repeated with another.
        settled = _next_move(float(best.moved), earlier) < _SETTLED
        if change < _UNCHANGED or settled or not bool(best.converged):
            break
        if not moves:
            break
        earlier = float(best.moved) if np.isfinite(best.moved) else earlier
        # Near its optimum a search needs no damping, which would only take it longer.
        nearing = estimator.nearing and estimator.nearing._replace(damping=_DAMPING)
        [best] = search.run(noise, _without_nuisances(layout, best.z)[None], nearing=nearing)
        trace.append((int(best.steps), float(best.cost)))
        # With less than that the noise stays as well; by more than a prediction where it is that of
        # the intervals.
        moved = float(best.moved)
        if moved < _SETTLED or (nearly and _next_move(moved, earlier) < _NEARLY):
            break
    return best, noise, trace


def _changed(noise: Noise, new: Noise) -> float:
    """By how much in its logarithms."""
    change = abs(float(noise.log_variance_ratio - new.log_variance_ratio)) + max(
        abs(float(np.log(sd[n] / before[n])))
        for sd, before in zip(new.sd, noise.sd, strict=True)
        for n in before
    )
    return change + slopes_changed(noise, new) + float(own_changed(noise, new))


def _next_move(moved: float, earlier: float) -> float:
    """How far another noise would move the optimum, in squared joint standard deviations.

    Args:
        earlier: how far the one before it did; inf where that is not known.
    """
    # Moves get smaller less fast the later they are, by up to this much from one to the next. After
    # a search that found no step that is not known.
    falls = _SLOWER * moved / earlier if 0.0 < earlier <= _NEAR else 1.0
    return moved * min(falls, 1.0)


def _without_nuisances(layout: Layout, z: Float[Array, " q"]) -> Float[np.ndarray, " q"]:
    """z where a search goes by rows that nuisances have no part in, in which their weak priors
    alone would be a misfit."""
    # A model that is not linear is linearised where they put it.
    without = np.array(z)
    if not layout.estimator.nuisances_in_rows and layout.model.linear:
        without[layout.first_nuisance :] = 0.0
    return without


def relaxed_from(search: Search, noise: Noise, z: Float[Array, " q"]) -> RelaxedOptimum:
    """The optimum that a search from z leads to, its noise relaxed from `noise`.

    Args:
        z: where to begin.
    """
    [best] = search.run(noise, z[None, :])
    return relax_noise_covariance(search, noise, best)


def log_likelihood_of(search: Search, optimum: RelaxedOptimum) -> float:
    """At an optimum and its noise."""
    layout, data = search.layout, search.data
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    return layout.estimator.log_likelihood(layout, data, optimum.noise, e)


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
    at_bound: Collection[int] = (),
) -> float | None:
    """The share of the sum of squares that a modest step would take away, where that is so much
    that no optimiser can have arrived; None where it is not.

    An optimiser calls its last step short and itself arrived also where every longer one failed,
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
    # Negated: also what is not finite is none of this function's business.
    if not gauss_newton_gain(r, J) > least:
        return None
    norms = np.linalg.norm(J, axis=0)
    units = np.where(norms > 0, norms, 1.0)
    left, singular, right = np.linalg.svd(J / units, full_matrices=False)
    along = left.T @ r
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
    """The optimum, no longer taken for one where its own slopes say that it is none.

    Args:
        optimum: where the search ended.
    """
    # A filter's rows hold the level of its variances too, and have no squares to take a share of.
    if not (bool(optimum.best.converged) and layout.estimator.least_squares):
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
