"""fit and check: parameters with intervals and a verdict, from a Problem."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array

from heli_jax import naming
from heli_jax.flights.flight import Flight
from heli_jax.identification import excitation
from heli_jax.identification import search as starting
from heli_jax.identification.coloured import inflation
from heli_jax.identification.estimates import (
    bound_notes,
    deviations,
    estimates_of,
    flight_nuisances,
    labels,
    stated_noise_notes,
)
from heli_jax.identification.identifiability import Verdict
from heli_jax.identification.judgement import verdict_of
from heli_jax.identification.metrics import Metrics, Whiteness, metrics, noise_guess, whiteness
from heli_jax.identification.optimise import Optimum, residuals_count
from heli_jax.identification.problem import Problem
from heli_jax.identification.residual import (
    Data,
    Evaluation,
    Layout,
    Noise,
    data_of,
    evaluate,
    layout_of,
    start_vector,
)
from heli_jax.identification.result import Check, Estimate, Fit, Signals, StartRow, Status

__all__ = ["Check", "Estimate", "Fit", "Signals", "StartRow", "Status", "check", "fit"]


def check(problem: Problem) -> Check:
    """What the flights can determine, judged at the start values, before any fit.

    The noise is as stated, or guessed from the third differences of the measured signals.
    """
    layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
    noise = _first_noise(problem.training)
    z = starting.first_guess(layout, data, noise, start_vector(layout, data, problem))
    e = _evaluation(layout, data, noise, z)
    verdict = verdict_of(problem, layout, e)
    runs = tuple(s.simulated for s in _signals(e.raw, problem.training))
    notes = excitation.notes(problem, runs, noise.sd)
    return Check(verdict, _noise_by_name(problem, noise), tuple(notes))


def fit(
    problem: Problem,
    *,
    starts: int = 1,
    seed: int = 0,
    max_steps: int = 200,
    progress: starting.Progress | None = None,
) -> Fit:
    """Estimate the free parameters by the problem's method: output error or filter error.

    Args:
        starts: how many points to start from; the first is the given one, the others are drawn
            within the bounds, or about a factor of three around the start.
        seed: of that draw.
        progress: told in words what is going on.

    Returns:
        A Fit whose `status` says whether it converged and whether the data determine what was
        asked. Cramér-Rao intervals; those of output error allow for residuals that are not white
        (`coloured`), and `narrow` says where nothing does.
    """
    begin = time.perf_counter()
    tell = progress or (lambda _: None)
    layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
    noise = _first_noise(problem.training)
    z0 = starting.first_guess(layout, data, noise, start_vector(layout, data, problem))
    before = verdict_of(problem, layout, _evaluation(layout, data, noise, z0))
    tell(f"fitting {', '.join(layout.named)}")
    points = starting.draw(layout, problem, z0, starts, seed)
    # Without a disturbance in the record the filter's optimiser finds no end: it is cut short,
    # and goes on only where there is one.
    short = min(max_steps, _FIRST_STEPS) if layout.noise else max_steps
    search = starting.Search(problem, layout, data, short)
    runs = search.run(noise, points, tell)
    best = min(runs, key=starting.rank)
    best, noise, trace = _settle_noise(search, noise, best)
    ratio = None
    search.max_steps = max_steps
    if "sigma_w" in layout.noise:
        best, noise, ratio = _disturbance_or_none(search, noise, best)
    return _assemble(
        problem,
        layout,
        data,
        noise,
        best,
        before,
        points,
        runs,
        trace,
        ratio,
        seed,
        {"fit": time.perf_counter() - begin},
    )


def _evaluation(layout: Layout, data: Data, noise: Noise, z: Array) -> Evaluation:
    """`evaluate` as NumPy arrays, for what is not compiled."""
    return jax.device_get(evaluate(layout, data, noise, z))


def _first_noise(flights: Sequence[Flight]) -> Noise:
    """The noise to begin with, by flight and output: as stated, else guessed."""
    dtype = np.dtype(jnp.result_type(float))
    sd = tuple(
        {
            name: np.asarray(flight.sd.get(name) or noise_guess(y), dtype)
            for name, y in flight.outputs.items()
        }
        for flight in flights
    )
    return Noise(sd, np.zeros((), dtype))


def _noise_by_name(problem: Problem, noise: Noise) -> dict[str, float]:
    return {
        f"{label}/{n}": float(s)
        for label, by_name in zip(labels(problem.training), noise.sd, strict=True)
        for n, s in by_name.items()
    }


def _settle_noise(
    search: starting.Search, noise: Noise, best: Optimum
) -> tuple[Optimum, Noise, tuple[tuple[int, float], ...]]:
    """Alternate between the optimum and the noise until both stay (relaxation of R)."""
    trace = [(int(best.steps), float(best.cost))]
    for _ in range(8):
        e = _evaluation(search.layout, search.data, noise, best.z)
        z, new = _updated_noise(search.layout, search.data, e, noise, best.z)
        change = max(
            abs(float(np.log(n[k] / s[k])))
            for n, s in zip(new.sd, noise.sd, strict=True)
            for k in s
        ) + abs(float(new.level - noise.level))
        if not np.isfinite(change):
            break
        best, noise = best._replace(z=z), new
        if change < 1e-3 or not bool(best.converged) or not _scale_matters(search):
            break
        [best] = search.run(noise, best.z[None, :])
        trace.append((int(best.steps), float(best.cost)))
    return best, noise, tuple(trace)


_FIRST_STEPS = 40
_NO_DISTURBANCE = 2.71
"""twice a log-likelihood ratio below which a disturbance is not significant at 5 %: sigma_w = 0 is
a boundary, where half of the chi-squared with one degree of freedom holds (Self and Liang, 1987)"""
_SURE = 0.4
"""sd of log sigma_w below which nobody need ask whether there is a disturbance"""


def _disturbance_or_none(
    search: starting.Search, noise: Noise, best: Optimum
) -> tuple[Optimum, Noise, float | None]:
    """The optimum with the disturbance where it is significant, else without one.

    Where sigma_w goes to zero, tau_w means nothing and the optimiser has no end to come to; the
    same residuals with sigma_w all but zero are those of output error.
    """
    layout = search.layout
    e = _evaluation(layout, search.data, noise, best.z)
    at = layout.noise_at("sigma_w")
    if bool(best.converged) and np.all(np.isfinite(e.J)) and deviations(e.J)[at] < _SURE:
        return best, noise, None
    smallest = min(float(s) for one in noise.sd for s in one.values())
    [none] = search.run(noise, best.z.at[at].set(np.log(smallest) - 30.0)[None, :])
    if not bool(none.converged):
        return best, noise, None
    ratio = residuals_count(search.data) * float(np.log(none.cost / _cost(search.data, e)))
    if np.isfinite(ratio) and ratio >= _NO_DISTURBANCE:
        if not bool(best.converged):
            [best] = search.run(noise, best.z[None, :])
            best, noise, _ = _settle_noise(search, noise, best)
        return best, noise, ratio
    none, noise, _ = _settle_noise(search, noise, none)
    return none, noise, ratio


def _cost(data: Data, e: Evaluation) -> float:
    """The cost that `optimise` gives, at any point."""
    return float(np.sum(e.r**2)) / residuals_count(data)


def _scale_matters(search: starting.Search) -> bool:
    """Whether the optimum moves with the scale of the noise: not where filter error has it
    concentrated out and no prior is weighed against it."""
    priors = any(f.prior for f in search.problem.free.values())
    return priors or not search.layout.filtered


def _updated_noise(
    layout: Layout, data: Data, e: Evaluation, noise: Noise, z: Array
) -> tuple[Array, Noise]:
    """The noise that the residuals show, degrees of freedom taken off in proportion.

    With filter error all noise changes by one factor, that of the disturbance in z included, so
    that the optimum stays where it is.
    """
    n = residuals_count(data)
    freedom = n / max(n - layout.size, 1)
    if not layout.filtered:
        new = tuple(
            {k: _residual_sd(r, flight.outputs[k], freedom) for k, r in by_name.items()}
            for by_name, flight in zip(e.raw, data.flights, strict=True)
        )
        return z, Noise(new, noise.level)
    squares, logs = _innovation_sums(e, noise)
    factor = np.sqrt(squares / n * freedom)
    if "sigma_w" in layout.noise:
        at = layout.noise_at("sigma_w")
        z = z.at[at].add(jnp.asarray(np.log(factor), z.dtype))
    sd = tuple({k: np.asarray(s * factor, s.dtype) for k, s in one.items()} for one in noise.sd)
    return z, Noise(sd, np.asarray(logs / n, noise.level.dtype))


def _innovation_sums(e: Evaluation, noise: Noise) -> tuple[float, float]:
    """Sums over all measurements of e^2/s and of log(s/sd^2)."""
    squares, logs = 0.0, 0.0
    for one, sd in zip(e.innovations, noise.sd, strict=True):
        for n, s in one.variance.items():
            squares += float(np.nansum(one.error[n] ** 2 / s))
            logs += float(np.nansum(np.log(s / sd[n] ** 2)))
    return squares, logs


def _residual_sd(r: np.ndarray, y: Any, freedom: float) -> np.ndarray:
    floor = 1e-12 * np.sqrt(np.nanmean(np.square(np.asarray(y)))) + 1e-300
    return np.asarray(max(np.sqrt(np.nanmean(np.square(r)) * freedom), floor), r.dtype)


def _assemble(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    best: Optimum,
    before: Verdict,
    points: Array,
    runs: list[Optimum],
    trace: tuple[tuple[int, float], ...],
    ratio: float | None,
    seed: int,
    timing: dict[str, float],
) -> Fit:
    e = _evaluation(layout, data, noise, best.z)
    usable = bool(np.all(np.isfinite(e.J)))
    verdict = verdict_of(problem, layout, e) if usable else before
    status: Status = "converged"
    if not bool(best.converged) or not usable:
        status = "not-converged"
    notes = excitation.sampling(
        problem, {k: float(v) for k, v in zip(layout.named, e.named, strict=True)}
    )
    if usable and not verdict.identifiable:
        status = "not-identifiable"
    n = residuals_count(data)
    quantile = float(scipy.special.stdtrit(max(n - layout.size, 1), 0.975))
    signals = _signals(e.raw, problem.training)
    if e.innovations:
        signals = tuple(
            s._replace(innovations=one.error) for s, one in zip(signals, e.innovations, strict=True)
        )
    white = _whiteness(signals, e)
    coloured = usable and not layout.filtered and not all(w.white for w in white.values())
    wider = inflation(layout, data, e) if coloured else np.ones(layout.size)
    named = estimates_of(problem, layout, e, verdict, quantile, wider)
    held = tuple(f for f in problem.flights if f.hold_out)
    validation = _validation(problem, best.z, layout, held) if held else ()
    estimates = {k: named[k] for k in layout.free}
    nuisance = {k: v for k, v in named.items() if k not in layout.free}
    nuisance |= flight_nuisances(problem, layout, data, best.z, e, quantile, wider)
    if ratio is not None and ratio < _NO_DISTURBANCE:
        notes.append(
            "No disturbance shows in the record (twice the log-likelihood gained by one is "
            f"{ratio:.2g}): output error suffices, and these are its numbers."
        )
        for name in layout.noise:
            nuisance[name] = nuisance[name]._replace(
                value=0.0 if name == "sigma_w" else nuisance[name].value,
                sd=None,
                lower95=None,
                upper95=None,
                at_bound=name == "sigma_w",
            )
    dtype = jnp.result_type(float)
    values = jax.device_put({k: np.asarray(v.value, dtype) for k, v in estimates.items()})
    notes = [*notes, *stated_noise_notes(problem, noise.sd), *bound_notes(estimates)]
    return Fit(
        model=problem.model.name,
        method=problem.method,
        status=status,
        n_samples=n,
        estimates=estimates,
        nuisance=nuisance,
        params=naming.replace(problem.vehicle, **values),
        verdict_before=before,
        verdict=verdict,
        noise=_noise_by_name(problem, noise),
        signals=(*signals, *validation),
        metrics=_pooled(signals),
        validation=_pooled(validation),
        whiteness=white,
        coloured=coloured,
        starts=starting.table(layout, data, points, runs),
        steps=sum(s for s, _ in trace),
        trace=trace,
        notes=tuple(notes),
        seed=seed,
        timing=timing,
    )


def _whiteness(signals: tuple[Signals, ...], e: Evaluation) -> dict[str, Whiteness]:
    """Of the innovations where there are some, else of the residuals."""
    if not e.innovations:
        return {f"{s.flight}/{n}": whiteness(s.residual(n)) for s in signals for n in s.measured}
    return {
        f"{s.flight}/{n}": whiteness(error[np.isfinite(error)])
        for s, one in zip(signals, e.innovations, strict=True)
        for n, error in ((n, v / np.sqrt(one.variance[n])) for n, v in one.error.items())
    }


def _signals(raw: Any, flights: tuple[Flight, ...]) -> tuple[Signals, ...]:
    """Measured and simulated signals; what is simulated carries the bias."""
    return tuple(
        Signals(
            label,
            f.hold_out,
            f.times,
            dict(f.inputs),
            dict(f.outputs),
            {n: f.outputs[n] - np.asarray(r) for n, r in by_name.items()},
        )
        for label, f, by_name in zip(labels(flights), flights, raw, strict=True)
    )


def _validation(
    problem: Problem, z: Array, layout: Layout, held: tuple[Flight, ...]
) -> tuple[Signals, ...]:
    """Flights held out, predicted with the estimates; only their initial state and bias are
    adjusted, by linear least squares."""
    other = layout_of(problem, held, simulated=True)
    data = data_of(problem, held, simulated=True)
    q = len(layout.named)
    full = jnp.concatenate([z[:q], jnp.zeros(other.size - q, z.dtype)])
    noise = _first_noise(held)
    if other.size > q:
        e = _evaluation(other, data, noise, full)
        step, *_ = np.linalg.lstsq(np.asarray(e.J)[:, q:], -np.asarray(e.r), rcond=1e-10)
        full = full.at[q:].add(jnp.asarray(step, z.dtype))
    return _signals(_evaluation(other, data, noise, full).raw, held)


def _pooled(signals: tuple[Signals, ...]) -> dict[str, Metrics]:
    """Metrics by output over all the flights that have it."""
    outputs = sorted({n for s in signals for n in s.measured})
    return {
        n: metrics(
            np.concatenate([s.measured[n] for s in signals if n in s.measured]),
            np.concatenate([s.simulated[n] for s in signals if n in s.measured]),
        )
        for n in outputs
    }
