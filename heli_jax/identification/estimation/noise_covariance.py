"""How large the noise is, and whether there is a disturbance: what surrounds the optimiser."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, measured_count
from heli_jax.identification.estimation.multistart import Search, gauss_newton_gain, noise_guess_at
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, noise_limits

NO_DISTURBANCE = 2.71
"""twice a log-likelihood ratio below which a disturbance is not significant at 5 %: sigma_w = 0 is
a boundary, where half of the chi-squared with one degree of freedom holds (Self and Liang, 1987)"""
_SURE = 0.4
"""sd of log sigma_w below which nobody need ask whether there is a disturbance"""
_NONE = 30.0
"""so far below the log of the smallest noise there is no disturbance"""


def noise_guess(signal: np.ndarray) -> float:
    """White measurement noise sd of a smooth signal, from its third differences; NaN is skipped.

    Third differences of white noise have variance 20 sd^2; what is smooth all but vanishes in
    them. Robust against the corners of a response (median of absolute values).
    """
    d = np.diff(signal, 3)
    d, signal = d[np.isfinite(d)], signal[np.isfinite(signal)]
    if not d.size:
        d = signal - np.median(signal)
    guess = float(np.median(np.abs(d)) / 0.6744897501960817 / np.sqrt(20.0))
    floor = 1e-9 * float(np.sqrt(np.mean(signal**2)))
    return max(guess, floor, 1e-300)


class Settled(NamedTuple):
    """An optimum together with the noise that it shows."""

    best: Optimum
    noise: Noise
    trace: tuple[tuple[int, float], ...]
    """(steps, cost) of every round of the optimiser"""
    ratio: float | None = None
    """twice the log-likelihood that a disturbance gained, where that was asked"""
    notes: tuple[str, ...] = ()
    """what a reader should know of how the optimum was reached"""


def first_noise(problem: Problem, flights: Sequence[Flight]) -> Noise:
    """The noise to begin with, by flight and output: as stated, else guessed.

    Where an output has one noise in all flights, what is not stated is guessed from all of them.
    """
    dtype = np.dtype(jnp.result_type(float))
    guesses = [{n: noise_guess(y) for n, y in f.outputs.items()} for f in flights]
    if estimator_of(problem.method).shared_noise:
        outputs = {n for guess in guesses for n in guess}
        pooled = {n: float(np.median([g[n] for g in guesses if n in g])) for n in outputs}
        guesses = [{n: pooled[n] for n in guess} for guess in guesses]
    sd = tuple(
        {n: np.asarray(flight.sd.get(n) or guess[n], dtype) for n in sorted(flight.outputs)}
        for flight, guess in zip(flights, guesses, strict=True)
    )
    return Noise(sd, np.zeros((), dtype))


def settle(search: Search, noise: Noise, best: Optimum) -> Settled:
    """Alternate between the optimum and the noise until both stay (relaxation of R)."""
    estimator = search.layout.estimator
    trace = [(int(best.steps), float(best.cost))]
    for _ in range(8):
        e = evaluate(search.layout, search.data, noise, best.z)
        z, new = estimator.relax(search.layout, search.data, e, noise, best.z)
        fall = float(noise.level - new.level)
        change = abs(fall) + max(
            abs(float(np.log(n[k] / s[k])))
            for n, s in zip(new.sd, noise.sd, strict=True)
            for k in s
        )
        if not np.isfinite(change):
            break
        best, noise = best._replace(z=z), new
        if change < 1e-3 or not bool(best.converged):
            break
        if not estimator.noise_matters(search.problem, search.layout, fall):
            break
        [best] = search.run(noise, best.z[None, :])
        trace.append((int(best.steps), float(best.cost)))
    return Settled(best, noise, tuple(trace))


_EXPLAINED = 2.0
"""times the noise that a record shows by itself up to which its residual is that noise"""


def second_guess(
    search: Search, points: Float[Array, "s q"], found: Settled, flights: Sequence[Flight]
) -> Settled:
    """The better of an optimum and of one whose noise is relaxed from the scale of the signals.

    Relaxation weighs several outputs by the noise, and ends in the optimum that its first guess
    leads to. That guess, from the third differences, is the end of the story where the model
    explains a record to its noise. Where it does not, a smooth output of little noise has had all
    the say, and outputs weighed by their own size may lead elsewhere. One output has no weights.

    Args:
        points: the starts; the first is begun from again.
        flights: those fitted.
    """
    layout, data = search.layout, search.data
    guesses = [{n: noise_guess(y) for n, y in f.outputs.items()} for f in flights]
    several = sum(len(o) for o in layout.outputs) > 1
    if not layout.estimator.least_squares or not several or _explained(found.noise, guesses):
        return found
    dtype = found.noise.level.dtype
    sd = tuple(
        {n: np.asarray(float(np.nanstd(f.outputs[n])) or guess[n], dtype) for n in sorted(guess)}
        for f, guess in zip(flights, guesses, strict=True)
    )
    noise = Noise(sd, found.noise.level)
    [best] = search.run(noise, points[:1])
    other = settle(search, noise, best)
    trace = (*found.trace, *other.trace)
    first, second = (_worth(layout, data, s) for s in (found, other))
    worse = bool(found.best.converged) and not bool(other.best.converged)
    if worse or not second > first + _WORTH_TELLING:
        return found._replace(trace=trace)
    said = (
        "Weighing the outputs by their size first led to a better optimum than the noise of their "
        f"differences did (log-likelihood {second:.1f} for {first:.1f}): this fit is the better "
        "one.",
    )
    return other._replace(trace=trace, notes=(*found.notes, *said))


_WORTH_TELLING = 0.1
"""log-likelihood by which two optima differ"""


def _explained(noise: Noise, guesses: list[dict[str, float]]) -> bool:
    """Whether every residual is about as small as the noise that its record shows by itself."""
    return all(
        float(sd[n]) <= _EXPLAINED * guess[n]
        for sd, guess in zip(noise.sd, guesses, strict=True)
        for n in guess
    )


def _worth(layout: Layout, data: Data, found: Settled) -> float:
    """The log-likelihood of output error, less what the priors hold against the parameters."""
    e = evaluate(layout, data, found.noise, found.best.z)
    measured = sum(
        float(np.nansum((np.asarray(r) / float(sd[n])) ** 2))
        for by_name, sd in zip(e.raw, found.noise.sd, strict=True)
        for n, r in by_name.items()
    )
    beside = float(np.sum(np.square(np.asarray(e.r, np.float64)))) - measured
    return layout.estimator.log_likelihood(layout, data, found.noise, e) - 0.5 * beside


def disturbance_or_none(search: Search, found: Settled) -> Settled:
    """The optimum with the disturbance where it is significant, else without one.

    Where sigma_w goes to zero, tau_w means nothing and the optimiser has no end to come to; the
    same residuals with sigma_w all but zero are those of output error. That model is nested in the
    one with a disturbance: a search that ends below its likelihood is begun anew from its optimum.
    """
    layout, data = search.layout, search.data
    e = evaluate(layout, data, found.noise, found.best.z)
    if _sure(layout, found, e) and _far_better(search, found, e):
        return found
    none = without_disturbance(search, found)
    alone = evaluate(layout, data, none.noise, none.best.z)
    if bool(np.isfinite(alone.r).all()) and not _corrects(alone, none.noise):
        without = layout.estimator.log_likelihood(layout, data, none.noise, alone)
        ratio = 2.0 * (layout.estimator.log_likelihood(layout, data, found.noise, e) - without)
        if not ratio > NO_DISTURBANCE:
            found, ratio = _from_nested(search, found, ratio, none, without)
        if bool(none.best.converged) and not ratio > NO_DISTURBANCE:
            return none._replace(trace=found.trace, ratio=ratio)
        found = found._replace(ratio=ratio)
    if not bool(found.best.converged):
        [best] = search.run(found.noise, found.best.z[None, :])
        again = settle(search, found.noise, best)
        found = again._replace(
            trace=(*found.trace, *again.trace), ratio=found.ratio, notes=found.notes
        )
    return _off_the_limit(search, found)


def _off_the_limit(search: Search, found: Settled) -> Settled:
    """Where the correlation time ran to an end of what a record can show, the better of that and of
    a search begun anew with the disturbance at its start: white noise is a local optimum of short
    records."""
    layout, data = search.layout, search.data
    if "tau_w" not in layout.noise:
        return found
    low, high = (float(v) for v in noise_limits(data)["tau_w"])
    if low < float(found.best.z[layout.noise_at("tau_w")]) < high:
        return found
    z = with_noise_guess(search, found)
    noise = layout.estimator.with_level(data, evaluate(layout, data, found.noise, z), found.noise)
    [best] = search.run(noise, z[None, :])
    again = settle(search, noise, best)
    before = layout.estimator.log_likelihood(
        layout, data, found.noise, evaluate(layout, data, found.noise, found.best.z)
    )
    after = layout.estimator.log_likelihood(
        layout, data, again.noise, evaluate(layout, data, again.noise, again.best.z)
    )
    if not (bool(again.best.converged) and after > before):
        return found
    return again._replace(trace=(*found.trace, *again.trace), ratio=found.ratio, notes=found.notes)


def _sure(layout: Layout, found: Settled, e: Evaluation) -> bool:
    """Whether a disturbance was found and all of it is determined."""
    if not (bool(found.best.converged) and np.all(np.isfinite(e.J))):
        return False
    at = len(layout.named)
    sds = deviations(e.J)
    known = np.isfinite(sds[at : at + len(layout.noise)]).all()
    return bool(known and sds[layout.noise_at("sigma_w")] < _SURE)


def _far_better(search: Search, found: Settled, e: Evaluation) -> bool:
    """Whether nobody need optimise without a disturbance to see that it would fit worse.

    One evaluation at the same parameters, and the gain of the Gauss-Newton step from there.
    """
    layout, data, noise = search.layout, search.data, found.noise
    alone = evaluate(layout, data, noise, _silenced(search, found))
    gained = gauss_newton_gain(alone.r, alone.J)
    if not np.isfinite(gained):
        return False
    before = float(np.sum(np.square(np.asarray(alone.r, np.float64))))
    after = max(before - gained, 1e-300)
    n = measured_count(data)
    gain = 0.5 * (n * np.log(before / after) if layout.concentrated else before - after)
    without = layout.estimator.log_likelihood(layout, data, noise, alone) + gain
    return bool(layout.estimator.log_likelihood(layout, data, noise, e) - without > n)


def _from_nested(
    search: Search, found: Settled, ratio: float, none: Settled, without: float
) -> tuple[Settled, float]:
    """The better of `found` and a search from the optimum without disturbance, and its ratio."""
    layout, data = search.layout, search.data
    z = with_noise_guess(search, none)
    guess = evaluate(layout, data, none.noise, z)
    noise = layout.estimator.with_level(data, guess, none.noise)
    promising = (
        layout.estimator.log_likelihood(layout, data, noise, guess) > without + NO_DISTURBANCE
    )
    if not (promising or ratio < -NO_DISTURBANCE or not np.isfinite(ratio)):
        return found, ratio
    [best] = search.run(noise, z[None, :])
    again = settle(search, noise, best)
    e = evaluate(layout, data, again.noise, again.best.z)
    other = 2.0 * (layout.estimator.log_likelihood(layout, data, again.noise, e) - without)
    if not np.isfinite(other) or other <= ratio:
        return found, ratio
    said = ()
    if other > NO_DISTURBANCE:
        said = (
            "The first search ended in a worse optimum, below what the model without a disturbance "
            "reaches: this fit was begun anew from that model's parameters.",
        )
    return again._replace(trace=(*found.trace, *again.trace), notes=said), other


def with_noise_guess(search: Search, none: Settled) -> Array:
    """z at the parameters of an optimum, the disturbance from a coarse search."""
    layout, at = search.layout, len(search.layout.named)
    starts = [np.log(search.problem.noise[n].start) for n in layout.noise]
    z = none.best.z.at[at : at + len(starts)].set(jnp.asarray(starts, none.best.z.dtype))
    return noise_guess_at(layout, search.data, none.noise, z)


def _corrects(e: Evaluation, noise: Noise) -> bool:
    """Whether the filter corrects its state even where there is no disturbance.

    It does in an unstable model, whose error grows from nothing: that is no output error.
    """
    return any(
        float(np.nanmax(s / sd[n] ** 2)) > 1.01
        for one, sd in zip(e.innovations, noise.sd, strict=True)
        for n, s in one.variance.items()
    )


def without_disturbance(search: Search, found: Settled) -> Settled:
    """The optimum with a sigma_w that is all but zero."""
    [none] = search.run(found.noise, _silenced(search, found)[None, :])
    return settle(search, found.noise, none)


def _silenced(search: Search, found: Settled) -> Array:
    at = search.layout.noise_at("sigma_w")
    smallest = min(float(s) for one in found.noise.sd for s in one.values())
    return found.best.z.at[at].set(np.log(smallest) - _NONE)
