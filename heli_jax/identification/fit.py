"""fit and check: parameters with intervals and a verdict, from a Problem."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array

from heli_jax import naming
from heli_jax.flights.flight import Flight
from heli_jax.identification import search as starting
from heli_jax.identification.identifiability import Unknown, Verdict, judge, projected
from heli_jax.identification.metrics import Metrics, Whiteness, metrics, noise_guess, whiteness
from heli_jax.identification.optimise import Optimum
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.residual import (
    Data,
    Evaluation,
    Layout,
    data_of,
    evaluate,
    layout_of,
    predict,
    raw_residuals,
    start_vector,
    unpack,
)

Status = Literal["converged", "not-converged", "not-identifiable"]
Progress = Callable[[str], None]


class Estimate(NamedTuple):
    """One estimated number; sd and interval are None where the data do not determine it."""

    value: float
    sd: float | None
    lower95: float | None
    upper95: float | None
    unit: str
    start: float
    prior_share: float
    at_bound: bool


class Signals(NamedTuple):
    """One flight as measured and as simulated; arrays (N,), SI."""

    flight: str
    hold_out: bool
    times: np.ndarray
    inputs: dict[str, np.ndarray]
    measured: dict[str, np.ndarray]
    simulated: dict[str, np.ndarray]
    """with the estimated bias"""

    def residual(self, output: str) -> np.ndarray:
        """measured - simulated"""
        return self.measured[output] - self.simulated[output]


class StartRow(NamedTuple):
    """Where one start led."""

    start: dict[str, float]
    end: dict[str, float]
    cost: float
    steps: int
    converged: bool
    optimum: int
    """1 for the best optimum, 2 for the next, ...; 0 where it did not converge"""


@dataclass(frozen=True, eq=False)
class Check:
    """What is known before any fit."""

    verdict: Verdict
    noise: dict[str, float]
    """sd assumed for each flight and output"""
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit: plain data."""

    model: str
    method: str
    status: Status
    n_samples: int
    estimates: dict[str, Estimate]
    nuisance: dict[str, Estimate]
    params: Any
    """the vehicle with the estimates in place"""
    verdict_before: Verdict
    verdict: Verdict
    noise: dict[str, float]
    """residual sd for each flight and output: 'flight/output'"""
    signals: tuple[Signals, ...]
    metrics: dict[str, Metrics]
    """over the fitted flights, by output"""
    validation: dict[str, Metrics]
    """over the flights held out, by output"""
    whiteness: dict[str, Whiteness]
    starts: tuple[StartRow, ...]
    steps: int
    trace: tuple[tuple[int, float], ...]
    """(steps, cost) of every round of the optimiser"""
    notes: tuple[str, ...]
    seed: int = 0
    timing: dict[str, float] = field(default_factory=dict)

    @property
    def white(self) -> bool:
        """Whether all residuals look white, so that the intervals may be taken at their word."""
        return all(w.white for w in self.whiteness.values())


@eqx.filter_jit
def _simulated(layout: Layout, data: Data, z: Array) -> Any:
    """Simulated outputs with bias, by flight."""
    u = unpack(layout, data, z)
    return tuple(
        {n: getattr(run.outputs, n) + bias[n] for n in flight.outputs}
        for flight, run, bias in zip(data.flights, predict(layout, data, u), u.biases, strict=True)
    )


def check(problem: Problem) -> Check:
    """What the flights can determine, judged at the start values, before any fit.

    The noise is as stated, or guessed from the third differences of the measured signals.
    """
    layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
    sd, notes = _first_noise(problem)
    z = starting.first_guess(layout, data, sd, start_vector(layout, data, problem.free))
    verdict = _verdict(problem, layout, data, sd, z)
    return Check(verdict, _noise_by_name(problem, sd), tuple(notes))


def fit(
    problem: Problem,
    *,
    starts: int = 1,
    seed: int = 0,
    max_steps: int = 100,
    progress: Progress | None = None,
) -> Fit:
    """Estimate the free parameters by output error: minimise the simulation error.

    Args:
        starts: how many points to start from; the first is the given one, the others are drawn
            within the bounds, or about a factor of three around the start.
        seed: of that draw.
        progress: told in words what is going on.

    Returns:
        A Fit whose `status` says whether it converged and whether the data determine what was
        asked. White-noise (Cramér-Rao) intervals; `white` says whether they may be believed.
    """
    begin = time.perf_counter()
    tell = progress or (lambda _: None)
    layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
    sd, notes = _first_noise(problem)
    z0 = starting.first_guess(layout, data, sd, start_vector(layout, data, problem.free))
    before = _verdict(problem, layout, data, sd, z0)
    tell(f"fitting {', '.join(layout.named)}")
    points = starting.draw(layout, problem, z0, starts, seed)
    search = starting.Search(problem, layout, data, max_steps, many=starts > 1)
    runs = search.run(sd, points, tell)
    best = min(runs, key=lambda o: (not bool(o.converged), _finite_cost(o)))
    best, sd, trace = _settle_noise(search, sd, best)
    return _assemble(
        problem, layout, data, sd, best, before, points, runs, trace, notes, seed,
        {"fit": time.perf_counter() - begin},
    )


def _finite_cost(o: Optimum) -> float:
    cost = float(o.cost)
    return cost if np.isfinite(cost) else np.inf


def _first_noise(problem: Problem) -> tuple[Any, list[str]]:
    """The noise to begin with: as stated, else guessed."""
    sd, notes = [], []
    for flight in problem.training:
        one = {}
        for name, y in flight.outputs.items():
            guess = flight.sd.get(name) or noise_guess(y)
            one[name] = jnp.asarray(guess, jnp.result_type(float))
        sd.append(one)
    return tuple(sd), notes


def _labels(flights: tuple[Flight, ...]) -> list[str]:
    return [f.name or f"flight {i + 1}" for i, f in enumerate(flights)]


def _noise_by_name(problem: Problem, sd: Any) -> dict[str, float]:
    labels = _labels(problem.training)
    return {
        f"{label}/{n}": float(s)
        for label, by_name in zip(labels, sd, strict=True)
        for n, s in by_name.items()
    }


def _settle_noise(
    search: starting.Search, sd: Any, best: Optimum
) -> tuple[Optimum, Any, tuple[tuple[int, float], ...]]:
    """Alternate between the optimum and the residual sd until both stay (relaxation of R)."""
    trace = [(int(best.steps), float(best.cost))]
    for _ in range(8):
        new = _residual_sd(search.layout, search.data, best.z)
        change = max(
            abs(float(jnp.log(n[k] / s[k])))
            for n, s in zip(new, sd, strict=True)
            for k in s
        )
        if not np.isfinite(change):
            break
        sd = new
        if change < 1e-3 or not bool(best.converged):
            break
        [best] = search.run(sd, best.z[None, :])
        trace.append((int(best.steps), float(best.cost)))
    return best, sd, tuple(trace)


@eqx.filter_jit
def _residual_sd(layout: Layout, data: Data, z: Array) -> Any:
    """Residual sd by flight and output, with the degrees of freedom taken off in proportion."""
    raw = raw_residuals(layout, data, z)
    n = sum(r.shape[0] for by_name in raw for r in by_name.values())
    freedom = n / max(n - layout.size, 1)

    def sd(r: Array, y: Array) -> Array:
        floor = 1e-12 * jnp.sqrt(jnp.mean(jnp.square(y))) + 1e-300
        return jnp.maximum(jnp.sqrt(jnp.mean(jnp.square(r)) * freedom), floor)

    return tuple(
        {k: sd(r, flight.outputs[k]) for k, r in by_name.items()}
        for by_name, flight in zip(raw, data.flights, strict=True)
    )


def _unknowns(problem: Problem, layout: Layout, e: Evaluation) -> tuple[Unknown, ...]:
    """The named unknowns for the verdict, with their size and prior in relative coordinates."""
    found = []
    for i, name in enumerate(layout.named):
        value = float(e.named[i])
        free = problem.free.get(name)
        if name == "time_shift":
            found.append(Unknown(name, value, False, 1.0, 0.0, is_parameter=False))
        elif free is None:
            found.append(Unknown(name, value, True, 1.0, 0.0, is_parameter=False))
        else:
            reference, log = _reference(problem, name, value)
            prior = reference / free.prior.sd if free.prior else 0.0
            scale = 1.0 / prior if prior else _interval(free.lower, free.upper, log)
            found.append(Unknown(name, value, log, scale, prior))
    return tuple(found)


def _interval(lower: float | None, upper: float | None, log: bool) -> float:
    if log and lower and upper:
        return max(0.5 * float(np.log(upper / lower)), 1e-3)
    return 1.0


def _reference(problem: Problem, name: str, value: float) -> tuple[float, bool]:
    """What one unit of a parameter's relative coordinate is, and whether it is log |value|."""
    free = problem.free[name]
    low, high = free.lower, free.upper
    if low is not None and high is not None and low < 0 < high:
        return 0.5 * (high - low), False
    return abs(value), True


def _references(problem: Problem, layout: Layout, unknowns: tuple[Unknown, ...]) -> np.ndarray:
    dt = problem.training[0].dt
    out = []
    for u in unknowns:
        if u.name == "time_shift":
            out.append(dt)
        elif u.name in problem.free:
            out.append(_reference(problem, u.name, u.value)[0])
        else:
            out.append(abs(u.value))
    return np.array(out)


def _split(
    problem: Problem, layout: Layout, e: Evaluation, unknowns: tuple[Unknown, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Data rows of the Jacobian: named unknowns in relative coordinates, and the nuisances."""
    J = np.asarray(e.J, dtype=np.float64)
    q, p = len(layout.named), len(layout.free)
    weak = layout.size - q
    data_rows = np.r_[0 : J.shape[0] - p - weak, J.shape[0] - weak : J.shape[0]]
    references = _references(problem, layout, unknowns)
    slopes = np.asarray(e.slopes, dtype=np.float64)
    factor = np.divide(references, slopes, out=np.zeros_like(slopes), where=slopes != 0)
    # A parameter of negative sign falls as its logarithm rises; the size is what counts.
    return J[data_rows][:, :q] * np.abs(factor) * np.sign(slopes) * _signs(unknowns), J[
        data_rows
    ][:, q:]


def _signs(unknowns: tuple[Unknown, ...]) -> np.ndarray:
    return np.array([np.sign(u.value) or 1.0 if u.logarithmic else 1.0 for u in unknowns])


def _remedy(problem: Problem) -> str:
    added = [f"{n}_added" for n in problem.free if f"{n}_added" in naming.names(problem.model.Params)]
    return ", or add a run with a known inertia" if added else ""


def _verdict(problem: Problem, layout: Layout, data: Data, sd: Any, z: Array) -> Verdict:
    e = evaluate(layout, data, sd, z)
    return _judge(problem, layout, e)


def _judge(problem: Problem, layout: Layout, e: Evaluation) -> Verdict:
    if not bool(jnp.all(jnp.isfinite(e.J))):
        raise ValueError(
            "the simulation is not finite at the given values: the model is unstable there over "
            "the length of this record; start elsewhere or use a shorter window"
        )
    unknowns = _unknowns(problem, layout, e)
    sensitivity, nuisances = _split(problem, layout, e, unknowns)
    return judge(projected(sensitivity, nuisances), unknowns, _remedy(problem))


def _assemble(
    problem: Problem,
    layout: Layout,
    data: Data,
    sd: Any,
    best: Optimum,
    before: Verdict,
    points: Array,
    runs: list[Optimum],
    trace: tuple[tuple[int, float], ...],
    notes: list[str],
    seed: int,
    timing: dict[str, float],
) -> Fit:
    e = evaluate(layout, data, sd, best.z)
    usable = bool(jnp.all(jnp.isfinite(e.J)))
    verdict = _judge(problem, layout, e) if usable else before
    status: Status = "converged"
    if not bool(best.converged):
        status = "not-converged"
    if usable and not verdict.identifiable:
        status = "not-identifiable"
    n = sum(y.size for f in problem.training for y in f.outputs.values())
    quantile = float(scipy.stats.t.ppf(0.975, max(n - layout.size, 1)))
    named = _estimates(problem, layout, e, verdict, quantile)
    signals = _signals(layout, data, best.z, problem.training)
    held = tuple(f for f in problem.flights if f.hold_out)
    validation = _validation(problem, sd, best.z, layout, held) if held else ()
    estimates = {k: named[k] for k in layout.free}
    nuisance = {k: v for k, v in named.items() if k not in layout.free}
    nuisance |= _flight_nuisances(problem, layout, data, best.z, e, quantile)
    values = {k: jnp.asarray(v.value, jnp.result_type(float)) for k, v in estimates.items()}
    notes = [*notes, *_stated_noise_notes(problem, sd), *_bound_notes(estimates)]
    return Fit(
        model=problem.model.name,
        method="output-error",
        status=status,
        n_samples=n,
        estimates=estimates,
        nuisance=nuisance,
        params=naming.replace(problem.vehicle, **values),
        verdict_before=before,
        verdict=verdict,
        noise=_noise_by_name(problem, sd),
        signals=(*signals, *validation),
        metrics=_pooled(signals),
        validation=_pooled(validation),
        whiteness={
            f"{s.flight}/{n}": whiteness(s.residual(n)) for s in signals for n in s.measured
        },
        starts=starting.table(layout, data, points, runs),
        steps=sum(s for s, _ in trace),
        trace=trace,
        notes=tuple(notes),
        seed=seed,
        timing=timing,
    )


def _estimates(
    problem: Problem, layout: Layout, e: Evaluation, verdict: Verdict, quantile: float
) -> dict[str, Estimate]:
    unknowns = _unknowns(problem, layout, e)
    references = _references(problem, layout, unknowns)
    out = {}
    for i, u in enumerate(unknowns):
        free = problem.free.get(u.name)
        relative = float(np.sqrt(verdict.covariance[i, i]))
        sd, low, high = _interval95(u, relative, references[i], quantile)
        lost = u.name in verdict.undetermined or u.name in verdict.without_effect
        start = free.start if free else (0.0 if u.name == "time_shift" else 1.0)
        out[u.name] = Estimate(
            value=u.value,
            sd=None if lost else sd,
            lower95=None if lost else low,
            upper95=None if lost else high,
            unit=_unit(problem, u.name),
            start=start,
            prior_share=verdict.prior_share[u.name],
            at_bound=_at_bound(problem, u.name, u.value),
        )
    return out


def _interval95(
    u: Unknown, relative: float, reference: float, quantile: float
) -> tuple[float, float, float]:
    sd = float(relative * reference)
    if not u.logarithmic:
        return sd, u.value - quantile * sd, u.value + quantile * sd
    reach = float(np.exp(min(quantile * relative, 700.0)))
    low, high = sorted((u.value / reach, u.value * reach))
    return sd, float(low), float(high)


def _unit(problem: Problem, name: str) -> str:
    if name == "time_shift":
        return "s"
    if name.startswith("gain "):
        return problem.gain_units.get(name.removeprefix("gain "), "1")
    return naming.unit(problem.model.Params, name) or ""


def _at_bound(problem: Problem, name: str, value: float) -> bool:
    free = problem.free.get(name)
    if free is None:
        return name == "time_shift" and abs(value) > 0.999 * MAX_TIME_SHIFT
    low, high = free.lower, free.upper
    width = high - low if low is not None and high is not None else abs(value)
    near = 1e-3 * width
    by_low = low is not None and value - low < min(near, 1e-3 * abs(low) if low else near)
    by_high = high is not None and high - value < near
    return bool(by_low or by_high)


def _bound_notes(estimates: dict[str, Estimate]) -> list[str]:
    return [
        f"{name} ended at its bound: the data want it beyond {one.value:g}; its interval does not "
        "hold there."
        for name, one in estimates.items()
        if one.at_bound
    ]


def _stated_noise_notes(problem: Problem, sd: Any) -> list[str]:
    notes = []
    for flight, label, by_name in zip(
        problem.training, _labels(problem.training), sd, strict=True
    ):
        for name, stated in flight.sd.items():
            ratio = float(by_name[name]) / stated
            if not 0.5 < ratio < 2.0:
                notes.append(
                    f"{label}: the residual of {name} has {ratio:.2g} times the stated noise; the "
                    "intervals go by the residual."
                )
    return notes


def _flight_nuisances(
    problem: Problem, layout: Layout, data: Data, z: Array, e: Evaluation, quantile: float
) -> dict[str, Estimate]:
    """Initial states and biases, with the weak priors they carry."""
    q = len(layout.named)
    if layout.size == q:
        return {}
    J = np.asarray(e.J, dtype=np.float64)
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    inverse = np.linalg.pinv(J / norms, rcond=1e-10)
    sds = np.sqrt(np.sum(inverse**2, axis=1)) / norms
    out, at = {}, q
    state_names = naming.names(layout.model.State)
    for label, flight, outputs in zip(
        _labels(problem.training), data.flights, layout.outputs, strict=True
    ):
        parts = []
        if layout.initial_state:
            parts += [
                (f"initial {n}", flight.state_scale[n], naming.unit(layout.model.State, n))
                for n in state_names
            ]
        if layout.bias:
            parts += [
                (f"bias {n}", flight.bias_scale[n], naming.unit(layout.model.Outputs, n))
                for n in outputs
            ]
        for name, scale, unit in parts:
            value, sd = float(z[at] * scale), float(sds[at] * scale)
            share = min(1.0, float(sds[at]) ** 2)
            out[f"{label}/{name}"] = Estimate(
                value, sd, value - quantile * sd, value + quantile * sd, unit or "", 0.0, share,
                False,
            )
            at += 1
    return out


def _signals(
    layout: Layout, data: Data, z: Array, flights: tuple[Flight, ...]
) -> tuple[Signals, ...]:
    simulated = _simulated(layout, data, z)
    return tuple(
        Signals(
            label,
            f.hold_out,
            f.times,
            dict(f.inputs),
            dict(f.outputs),
            {n: np.asarray(y) for n, y in by_name.items()},
        )
        for label, f, by_name in zip(_labels(flights), flights, simulated, strict=True)
    )


def _validation(
    problem: Problem, sd: Any, z: Array, layout: Layout, held: tuple[Flight, ...]
) -> tuple[Signals, ...]:
    """Flights held out, predicted with the estimates; only their initial state and bias are
    adjusted, by linear least squares."""
    other, data = layout_of(problem, held), data_of(problem, held)
    q = len(layout.named)
    full = jnp.concatenate([z[:q], jnp.zeros(other.size - q, z.dtype)])
    noise = tuple(
        {n: jnp.asarray(f.sd.get(n) or noise_guess(y), z.dtype) for n, y in f.outputs.items()}
        for f in held
    )
    if other.size > q:
        e = evaluate(other, data, noise, full)
        step, *_ = np.linalg.lstsq(np.asarray(e.J)[:, q:], -np.asarray(e.r), rcond=1e-10)
        full = full.at[q:].add(jnp.asarray(step, z.dtype))
    return _signals(other, data, full, held)


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
