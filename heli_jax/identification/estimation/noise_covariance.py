"""How large the measurement noise is: guessed first, then relaxed with the optimum."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noisy_scales import slopes_changed
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise

_ROUNDS = 8
"""of the optimiser at most"""
_UNCHANGED = 1e-3
"""change in the logarithm of every sd below which the relaxation has ended"""
_DAMPING = 0.01
"""of the first step of a search from an optimum with another noise, in the optimiser's units"""
_SETTLED = 3e-3
"""squared joint standard deviations by which another noise moved the optimum, below which the
relaxation of a noise that is a spectrum has ended: the next would move it by a fifth of that"""
_EXPLAINED = 2.0
"""times the noise that a record shows by itself up to which its residual is that noise"""
_FEW_DIFFERENCES = 0.2
"""third differences of neighbours for each sample, below which they are taken across gaps"""
_WORTH_TELLING = 0.1
"""log-likelihood by which two optima differ"""


class RelaxedOptimum(NamedTuple):
    """An optimum together with the noise that it shows."""

    best: Optimum
    noise: Noise
    trace: tuple[tuple[int, float], ...]
    """(steps, cost) of every round of the optimiser"""
    ratio: float | None = None
    """twice the log-likelihood that a disturbance gained, where that was asked"""
    notes: tuple[str, ...] = ()
    """what a reader should know of how the optimum was reached"""
    absent: tuple[str, ...] = ()
    """the parameters of those of several disturbances that do not show"""

    def after(self, earlier: "RelaxedOptimum", *notes: str) -> "RelaxedOptimum":
        """The same with the rounds and notes of an earlier one before its own."""
        return self._replace(
            trace=(*earlier.trace, *self.trace), ratio=earlier.ratio, notes=(*earlier.notes, *notes)
        )


def noise_guess(signal: np.ndarray) -> float:
    """White measurement noise sd of a smooth signal, from its third differences; NaN is skipped.

    Third differences of white noise have variance 20 sd^2; what is smooth all but vanishes in
    them. Robust against the corners of a response (median of absolute values).
    """
    # A gap makes NaN of the differences across it alone: no sample has to be filled in.
    d, at = np.diff(signal, 3) / np.sqrt(20.0), np.flatnonzero(np.isfinite(signal))
    d, signal = d[np.isfinite(d)], signal[at]
    # Where gaps leave few samples in a row, as of a slow sensor on a fast grid, from one sample to
    # the next wherever they stand.
    if d.size < _FEW_DIFFERENCES * signal.size:
        d = _divided_differences(at.astype(float), signal)
    # Of three samples and fewer, the signal itself bounds its noise.
    if not d.size:
        d = signal - np.median(signal)
    # The median of |x| of a normal x is 0.674 sd; 1 + 9 + 9 + 1 = 20.
    guess = float(np.median(np.abs(d)) / 0.6744897501960817)
    # A record without noise: rows divided by zero would be infinite.
    floor = 1e-9 * float(np.sqrt(np.mean(signal**2)))
    return max(guess, floor, 1e-300)


def white_part(signal: np.ndarray) -> float:
    """The sd of the white noise in a signal: what is there at its fastest and at its slowest.

    Args:
        signal: (N,), NaN where nothing is measured.
    """
    # Third differences look at the fast end of the spectrum alone, where a swing near the Nyquist
    # frequency passes for noise. With every other sign turned the ends change places.
    turned = signal * np.where(np.arange(signal.size) % 2, -1.0, 1.0)
    return min(noise_guess(signal), noise_guess(turned))


def _divided_differences(at: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Third divided differences (N - 3,) of samples (N,) at any instants, scaled so that those of
    white noise have its variance; a parabola has none."""
    if y.size < 4:
        return np.zeros(0)
    t, y = (np.lib.stride_tricks.sliding_window_view(x, 4) for x in (at, y))
    apart = t[:, :, None] - t[:, None, :] + np.eye(4)
    weights = 1.0 / np.prod(apart, axis=2)
    return np.sum(weights * y, axis=1) / np.linalg.norm(weights, axis=1)


def first_noise(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """The noise to begin with, by flight and output: as stated, else guessed.

    Where an output has one noise in all flights, what is not stated is guessed from all of them.
    """
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
    noise = Noise(sd, np.zeros((), dtype))
    return estimator_of(problem.method).prepared_for(problem, noise, flights)


def relax_noise_covariance(search: Search, noise: Noise, best: Optimum) -> RelaxedOptimum:
    """Alternate between the optimum and the noise until both stay.

    Source: relaxation of the noise covariance, Jategaonkar (2006), section 4.4.

    Args:
        search: the optimiser over the problem.
        noise: that `best` was found with.
        best: the optimum to begin with.
    """
    layout, estimator = search.layout, search.layout.estimator
    trace = [(int(best.steps), float(best.cost))]
    # Where the first search began says nothing of the noise.
    best = best._replace(moved=np.asarray(np.inf))
    for _ in range(_ROUNDS):
        e = evaluate(layout, search.data, noise, best.z) if estimator.relaxes_rows else None
        z, new = estimator.relax(layout, search.data, e, noise, best.z)
        fall = float(noise.log_variance_ratio - new.log_variance_ratio)
        change = abs(fall) + max(
            abs(float(np.log(sd[n] / before[n])))
            for sd, before in zip(new.sd, noise.sd, strict=True)
            for n in before
        )
        change += slopes_changed(noise, new)
        # Residuals that overflowed show no noise, and where they do is no optimum.
        if not np.isfinite(change):
            best = best._replace(converged=np.asarray(False))
            break
        moves = estimator.noise_matters(search.problem, layout, noise, new)
        # The noise first and the parameters after it: the parameters of one round are the best for
        # the noise of the round before, and where both stay they are so for each other.
        best, noise = best._replace(z=z), new
        # A search that failed with one noise is not repeated with another.
        if change < _UNCHANGED or best.moved < _SETTLED or not bool(best.converged):
            break
        if not moves:
            break
        # Near its optimum a search needs no damping, which would only take it longer.
        nearing = estimator.nearing and estimator.nearing._replace(damping=_DAMPING)
        [best] = search.run(noise, _without_nuisances(layout, best.z)[None, :], nearing=nearing)
        trace.append((int(best.steps), float(best.cost)))
    return RelaxedOptimum(best, noise, tuple(trace))


def _without_nuisances(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " q"]:
    """z where a search goes by rows that nuisances have no part in, in which their weak priors
    alone would be a misfit."""
    # A model that is not linear is linearised where they put it.
    if layout.estimator.nuisances_in_rows or not layout.model.linear:
        return z
    return z.at[layout.first_nuisance :].set(0.0)


def relaxed_from(search: Search, noise: Noise, z: Float[Array, " q"]) -> RelaxedOptimum:
    """The optimum that a search from z leads to, its noise relaxed from `noise`.

    Args:
        search: the optimiser over the problem.
        noise: to begin with.
        z: where to begin.
    """
    [best] = search.run(noise, z[None, :])
    return relax_noise_covariance(search, noise, best)


def log_likelihood_of(search: Search, optimum: RelaxedOptimum) -> float:
    """At an optimum and its noise."""
    layout, data = search.layout, search.data
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    return layout.estimator.log_likelihood(layout, data, optimum.noise, e)


def better_of_two_guesses(
    search: Search,
    points: Float[Array, "s q"],
    optimum: RelaxedOptimum,
    flights: Sequence[Flight],
) -> RelaxedOptimum:
    """The better of an optimum and of one whose noise is relaxed from the scale of the signals.

    Relaxation weighs several outputs by the noise, and ends in the optimum that its first guess
    leads to. That guess, from the third differences, is the end of the story where the model
    explains a record to its noise. Where it does not, a smooth output of little noise has had all
    the say, and outputs weighed by their own size may lead elsewhere. One output has no weights.

    Args:
        search: the optimiser over the problem.
        points: the starts; the first is begun from again.
        optimum: that the guess from differences led to.
        flights: those fitted.
    """
    layout = search.layout
    guesses = [{n: noise_guess(y) for n, y in f.outputs.items()} for f in flights]
    # One output has no weights, and a filter's noise is not relaxed output by output.
    several = sum(len(o) for o in layout.outputs) > 1
    if not layout.estimator.least_squares or not several or _explained(optimum.noise, guesses):
        return optimum
    dtype = optimum.noise.log_variance_ratio.dtype
    sd = tuple(
        {n: np.asarray(float(np.nanstd(f.outputs[n])) or guess[n], dtype) for n in sorted(guess)}
        for f, guess in zip(flights, guesses, strict=True)
    )
    other = relaxed_from(search, Noise(sd, optimum.noise.log_variance_ratio), points[0])
    first, second = (_log_posterior(layout, search.data, o) for o in (optimum, other))
    # An optimum is not given up for a point on the way to one, however likely that is.
    worse = bool(optimum.best.converged) and not bool(other.best.converged)
    if worse or not second > first + _WORTH_TELLING:
        return optimum._replace(trace=(*optimum.trace, *other.trace))
    return other.after(
        optimum,
        "Weighing the outputs by their size first led to a better optimum than the noise of their "
        f"differences did (log-likelihood {second:.1f} for {first:.1f}): this fit is the better "
        "one.",
    )


def _explained(noise: Noise, guesses: list[dict[str, float]]) -> bool:
    """Whether every residual is about as small as the noise that its record shows by itself."""
    return all(
        float(sd[n]) <= _EXPLAINED * guess[n]
        for sd, guess in zip(noise.sd, guesses, strict=True)
        for n in guess
    )


def _log_posterior(layout: Layout, data: Data, optimum: RelaxedOptimum) -> float:
    """The log-likelihood, less what the priors hold against the parameters."""
    e = evaluate(layout, data, optimum.noise, optimum.best.z)
    # Scaled by the noise that is in the rows: what is left of their squares are the priors'.
    measured = sum(
        float(np.nansum((np.asarray(r) / float(sd[n])) ** 2))
        for by_name, sd in zip(e.raw, optimum.noise.sd, strict=True)
        for n, r in by_name.items()
    )
    of_priors = float(np.sum(np.square(np.asarray(e.r, np.float64)))) - measured
    return layout.estimator.log_likelihood(layout, data, optimum.noise, e) - 0.5 * of_priors
