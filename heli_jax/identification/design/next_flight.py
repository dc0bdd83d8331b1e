"""What to fly next: the manoeuvre that narrows the widest interval most, by Fisher's information.

Candidates of the same duration and amplitude as the record are put into the model at the start
values, one input moved at a time: doublets, 3-2-1-1 steps and a chirp, and the record once more for
comparison (input design over a few manoeuvres that a pilot can fly: Mehra, 1974; Jategaonkar, 2006,
chapter 2).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.flights.flight import Flight
from heli_jax.identification.design.accuracy import (
    Sensitivity,
    expected_sd,
    repeated,
    sensitivity_at,
    together,
    triangle,
)
from heli_jax.identification.design.windows import DETERMINES
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.simulated_flights import signal_numbers, signals
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, layout_of
from heli_jax.simulation.inputs import chirp, multistep_3211

# What outputs would tell that the model has and the log lacks, by Fisher's information.
#
# The Jacobian at the start values is that of the fit, with rows of further outputs as the model
# shows them; how much narrower each interval would be follows from the rows alone.


TYPICAL = {"rad": 0.01, "rad/s": 0.01, "m": 0.5, "m/s": 0.1, "m/s^2": 0.3}
"""noise of small autopilots' sensors (attitude, gyro, GPS position and velocity, accelerometer),
SI, by unit: for outputs of a unit that no measured output has"""


class MissingOutput(NamedTuple):
    """One output that the log lacks."""

    name: str
    sd: float
    """of the noise that it is taken to have [SI]"""
    ratios: Float[np.ndarray, " q"]
    """sd of each parameter of interest with it, over that without; 0 where only it determines"""
    before: Float[np.ndarray, " q"]
    """relative sd of each without it"""


def look_at_missing(
    problem: Problem, at: Solution
) -> tuple[tuple[str, ...], list[MissingOutput]] | None:
    """The parameters of interest, and for each output that no flight has what it would do; None
    where the method's rows are not samples of one output each.

    Args:
        problem: what is free.
        at: layout, data, noise and unknowns at the start values.
    """
    # The rows of a filter's predictions belong to all outputs together, which say each other's.
    if not at.layout.estimator.rows_are_samples:
        return None
    have = {n for names in at.layout.outputs for n in names}
    lacking = [n for n in naming.names(problem.model.Outputs) if n not in have]
    if not lacking:
        return at.layout.of_interest, []
    layout, data, z = _extended(problem, at, lacking)
    # Of noise one here: rows are divided by the right one once the simulation shows it.
    noise = at.noise._replace(sd=tuple({**sd, **dict.fromkeys(lacking, 1.0)} for sd in at.noise.sd))
    noise = jax.tree.map(lambda v: np.asarray(v, z.dtype), noise)
    evaluation = evaluate(layout, data, noise, z)
    sds = _noises(problem, at, evaluation.simulated, lacking)
    if not sds:
        return at.layout.of_interest, []
    s = _weighed(sensitivity_at(problem, layout, evaluation), layout, data, evaluation, sds)
    return at.layout.of_interest, _ratios(layout, data, s, lacking, sds)


def _extended(problem: Problem, at: Solution, lacking: list[str]) -> tuple[Layout, Data, jax.Array]:
    """Layout, data and unknowns with further outputs, of which nothing is measured yet."""
    flights, parts, z = [], [], [at.z[: at.layout.first_nuisance]]
    position = at.layout.first_nuisance
    for i, (flight, numbers) in enumerate(zip(problem.training, at.data.flights, strict=True)):
        zeros = np.zeros(flight.n_samples)
        outputs = {**flight.outputs, **dict.fromkeys(lacking, zeros)}
        flights.append(replace(flight, outputs=outputs))
        one = jnp.ones((), at.z.dtype)
        measured = {**numbers.outputs, **{n: jnp.asarray(zeros, at.z.dtype) for n in lacking}}
        scales = {**numbers.bias_scale, **dict.fromkeys(lacking, one)}
        parts.append(
            numbers._replace(
                outputs=dict(sorted(measured.items())),
                bias_scale=dict(sorted(scales.items())),
            )
        )
        states = at.layout.windows[i][0] * len(at.layout.states)
        size = states + at.layout.constants(at.layout.outputs[i])
        own = at.z[position : position + size]
        more = jnp.zeros(len(lacking) if at.layout.bias else 0, at.z.dtype)
        # Biases are zero at the start values, so that only their number counts.
        z += [own[:states], more, own[states:]]
        position += size
    layout = layout_of(problem, tuple(flights))
    return layout, at.data._replace(flights=tuple(parts)), jnp.concatenate(z)


def _noises(
    problem: Problem,
    at: Solution,
    simulated: tuple[dict[str, np.ndarray], ...],
    lacking: list[str],
) -> dict[str, float]:
    """The noise that each missing output is taken to have; none of what stands still."""
    record, by_unit = problem.model.Outputs, {}
    for sd in at.noise.sd:
        for n, size in sd.items():
            by_unit.setdefault(naming.unit(record, n), []).append(float(size))
    sds = {}
    for n in lacking:
        unit = naming.unit(record, n)
        moves = any(np.std(run[n]) > 0 for run in simulated)
        # A gyro has one noise in all its axes; of a unit that nothing measures yet that of small
        # autopilots' sensors, and of any other it is not known what it would be measured with.
        sd = float(np.median(by_unit[unit])) if unit in by_unit else TYPICAL.get(unit or "")
        if sd is not None and moves:
            sds[n] = sd
    return sds


def _weighed(
    s: Sensitivity, layout: Layout, data: Data, e: Evaluation, sds: dict[str, float]
) -> Sensitivity:
    """The rows of further outputs over their noise, their biases in sds of weak priors."""
    shared, own = s.shared.copy(), s.own.copy()
    numbers = signal_numbers(layout, data)
    for k, (_, name) in enumerate(signals(layout)):
        if name in sds:
            rows = np.flatnonzero(numbers == k)
            shared[rows] /= sds[name]
            own[rows] /= sds[name]
    column = 0
    for i, names in enumerate(layout.outputs):
        column += layout.windows[i][0] * len(layout.states)
        for j, name in enumerate(names):
            if layout.bias and name in sds:
                # Ten times the signal, as of the outputs that are measured.
                own[:, column + j] *= 10.0 * float(np.sqrt(np.mean(e.simulated[i][name] ** 2)))
        column += layout.constants(names)
    return Sensitivity(s.unknowns, shared, own)


def _ratios(
    layout: Layout, data: Data, s: Sensitivity, lacking: list[str], sds: dict[str, float]
) -> list[MissingOutput]:
    numbers, named = signal_numbers(layout, data), [n for _, n in signals(layout)]
    # What follows the samples are the defects between windows, which belong to every choice.
    output = np.concatenate([np.array(named)[numbers], np.full(len(s.shared) - numbers.size, "")])
    have = ~np.isin(output, lacking)
    before = expected_sd(s.unknowns, triangle(s, np.flatnonzero(have)))
    results = []
    for name, sd in sds.items():
        after = expected_sd(s.unknowns, triangle(s, np.flatnonzero(have | (output == name))))
        # What nothing determines before and after is as it was; what only the further output
        # determines is infinitely better.
        ratio = np.where(np.isfinite(after), 0.0, 1.0)
        both = np.isfinite(before) & np.isfinite(after) & (before > 0)
        np.divide(after, before, out=ratio, where=both)
        results.append(MissingOutput(name, sd, ratio, before))
    return results


_STEPS = (0.2, 0.5, 1.0)
"""lengths of the shortest step of a candidate [s]"""
_LONGEST = 20.0
"""duration of a candidate at most [s]: of a longer record several in a row"""
_BAND = (0.1, 5.0)
"""of the chirp [Hz]"""
_SHORT = 20_000
"""samples of a record up to which its own program serves for the candidates"""
_FREE = 1e-3
"""weight of weak priors where they are all that holds a parameter up"""


class Candidate(NamedTuple):
    """One manoeuvre of one input."""

    input: str
    words: str
    """as a pilot reads it: `3-2-1-1 steps of 0.5 s`"""
    values: Float[np.ndarray, " m"]
    """what is added to the input, SI"""


class Plan(NamedTuple):
    """What the candidates would do to the parameter with the widest interval."""

    parameter: str
    before: float
    """its expected sd relative to its value (of its logarithm); inf where it is not determined"""
    again: float
    """with the same record once more; inf where it does not determine the parameter"""
    best: Candidate
    after: float
    """with the best candidate, flown for as long as the record"""
    duration: float
    """of the record, and of the flight that is compared [s]"""
    amplitude: float
    """of the best candidate, SI"""
    left_out: tuple[str, ...]
    """inputs that do not move in the record, of which no amplitude is known"""


def plan_next_flight(problem: Problem, at: Solution, e: Evaluation) -> Plan | None:
    """Compare manoeuvres; None where nothing can be compared.

    Args:
        problem: what is free.
        at: layout, data, noise and unknowns at the start values.
        e: the evaluation there.
    """
    # A filter of a nonlinear model would be compiled for every candidate by itself.
    if not (at.layout.estimator.rows_are_samples or at.layout.model.linear):
        return None
    # Rows that weigh all flights together do not say what one more would add, and those at
    # frequencies are none of samples.
    estimator = at.layout.estimator
    if not estimator.rows_by_flight or estimator.noise_spectrum:
        return None
    # Of a simulation that diverges there is nothing to compare with.
    if not np.isfinite(e.J).all():
        return None
    flight = max(problem.training, key=lambda f: f.n_samples)
    i = problem.training.index(flight)
    # With windows one of them is simulated: no model that needs windows can be longer.
    m = at.layout.windows[i][1]
    m = min(m, max(round(_LONGEST / flight.dt), 3 * len(problem.free)))
    candidates = _candidates(flight, m)
    if not candidates:
        return None
    each = _each_by_itself(problem, at, candidates, m)
    if each is None:
        s, layout, data = _sensitivity(problem, at, i, candidates, m)
        each = _by_flight(s, layout, data)
    now = sensitivity_at(problem, at.layout, e)
    verdict = verdict_of(problem, at.layout, e)
    lacking = {*verdict.undetermined, *verdict.without_effect}
    if lacking:
        # What only weak priors of biases and offsets hold up is not known: neither now nor then.
        each, now = [_loosened(s) for s in each], _loosened(now)
    R = triangle(now)
    before = expected_sd(now.unknowns, R)
    absent = np.array([u.name in lacking for u in now.unknowns])
    widest = int(np.argmax(np.where(absent, before, 0.0) if lacking else before))
    times = flight.n_samples / m
    sds = [_widest_sd(now, widest, together(R, repeated(triangle(s), times)), absent) for s in each]
    best = int(np.argmin(sds))
    return Plan(
        now.unknowns[widest].name,
        np.inf if lacking else float(before[widest]),
        np.inf if lacking else _again(now, at, i, widest),
        candidates[best],
        sds[best],
        flight.n_samples * flight.dt,
        float(np.max(np.abs(candidates[best].values))),
        tuple(n for n, u in flight.inputs.items() if np.ptp(u) == 0),
    )


def _again(now: Sensitivity, at: Solution, i: int, widest: int) -> float:
    """The widest sd with the i-th flight flown once more."""
    T = triangle(_by_flight(now, at.layout, at.data)[i])
    return float(expected_sd(now.unknowns, together(triangle(now), T))[widest])


def _widest_sd(now: Sensitivity, widest: int, R: np.ndarray, absent: np.ndarray) -> float:
    """Of the parameter with the widest interval; inf while any of those that are not determined now
    (q,) is not: they take part in one another."""
    sds = expected_sd(now.unknowns, R)
    return np.inf if np.any(sds[absent] >= DETERMINES) else float(sds[widest])


def _loosened(s: Sensitivity) -> Sensitivity:
    """The same with weak priors that hold nothing up."""
    return s._replace(own=s.own / _FREE)


def _by_flight(s: Sensitivity, layout: Layout, data: Data) -> list[Sensitivity]:
    """The rows of each flight by itself."""
    flight = np.repeat(np.arange(len(layout.outputs)), [len(names) for names in layout.outputs])
    rows = flight[signal_numbers(layout, data)]
    samples = rows.size
    # Of a filter the same number of rows follows once more, for its variances.
    extra = np.full(len(s.shared) - samples, -1)
    if not layout.estimator.rows_are_samples and extra.size >= samples:
        extra[extra.size - samples :] = rows
    elif layout.continuity is not None:
        extra = np.repeat(
            np.arange(len(layout.windows)),
            [(count - 1) * len(layout.states) for count, _ in layout.windows],
        )
    rows = np.concatenate([rows, extra])
    each = [np.flatnonzero(rows == i) for i in range(len(layout.outputs))]
    return [s._replace(shared=s.shared[at], own=s.own[at]) for at in each]


def _candidates(flight: Flight, m: int) -> list[Candidate]:
    """Manoeuvres of m samples, of the amplitude that each input has in the record."""
    candidates, rng = [], np.random.default_rng(0)
    for name, u in flight.inputs.items():
        amplitude = 0.5 * float(np.ptp(u))
        if amplitude == 0:
            continue
        for step in _STEPS:
            # At least one whole doublet in the candidate.
            if 3 * step <= m * flight.dt:
                doublets = amplitude * _doublets(m, flight.dt, step)
                candidates.append(Candidate(name, f"doublets, {step:g} s a side", doublets))
            if 8 * step <= m * flight.dt:
                steps = amplitude * multistep_3211(m, flight.dt, rng, step, step)
                candidates.append(Candidate(name, f"3-2-1-1 steps of {step:g} s", steps))
        low, high = max(_BAND[0], 1.0 / (m * flight.dt)), min(_BAND[1], 0.1 / flight.dt)
        if high > 2 * low:
            words = f"a sine that rises from {low:.2g} to {high:.2g} Hz"
            candidates.append(Candidate(name, words, amplitude * chirp(m, flight.dt, low, high)))
    return candidates


def _doublets(m: int, dt: float, step: float) -> Float[np.ndarray, " m"]:
    """One side, the other, and as long of neutral, over and over."""
    samples = max(1, round(step / dt))
    phase = (np.arange(m) // samples) % 3
    return np.where(phase == 0, 1.0, np.where(phase == 1, -1.0, 0.0))


def _of_length(
    flight: Flight, inputs: dict[str, np.ndarray], outputs: dict[str, np.ndarray]
) -> Flight:
    """The flight with other signals; what else was logged is not as long as these."""
    return replace(flight, inputs=inputs, outputs=outputs, instruments={}, hold={}, hold_reason={})


def _each_by_itself(
    problem: Problem, at: Solution, candidates: list[Candidate], m: int
) -> list[Sensitivity] | None:
    """The rows of each candidate in the program of the record, which is compiled already; None
    where the record has another one, or is so long that a program of their own is done sooner."""
    flight, numbers = problem.training[0], at.data.flights[0]
    n, model, dtype = flight.n_samples, problem.model, at.z.dtype
    if len(problem.training) > 1 or n > _SHORT or not model.linear or numbers.by_instrument:
        return None
    rest = {name: np.zeros(n) for name in flight.inputs}
    # Alike but for what is logged: held inputs, one window.
    like = _of_length(flight, rest, {name: np.zeros(n) for name in flight.outputs})
    if layout_of(problem, (like,)) != at.layout or at.layout.windows != ((1, n),):
        return None
    # Behind the end of a candidate nothing is measured, and rows of that are zero.
    measured = jnp.asarray(np.where(np.arange(n) < m, 0.0, np.nan), dtype)
    z = _joined(at, [_begins_as(at, 0, linear=True)])
    sensitivities = []
    for candidate in candidates:
        inputs = {**rest, candidate.input: np.pad(candidate.values, (0, n - m))}
        part = numbers._replace(
            inputs=model.Inputs(**{k: jnp.asarray(v, dtype) for k, v in inputs.items()}),
            outputs=dict.fromkeys(numbers.outputs, measured),
        )
        data = at.data._replace(flights=(part,))
        s = sensitivity_at(problem, at.layout, evaluate(at.layout, data, at.noise, z))
        sensitivities += _by_flight(s, at.layout, data)
    return sensitivities


def _sensitivity(
    problem: Problem, at: Solution, i: int, candidates: list[Candidate], m: int
) -> tuple[Sensitivity, Layout, Data]:
    """The rows of all candidates, each a flight of m samples that begins as the i-th one does."""
    flight, numbers = problem.training[i], at.data.flights[i]
    linear, dtype = problem.model.linear, at.z.dtype
    # Held between samples: steps are, and of a chirp it makes no difference to the comparison. A
    # linear model is at rest with neutral sticks alone, and would answer to others as to a step;
    # another begins with the sticks that the record begins with.
    parts, flights = [], []
    for candidate in candidates:
        inputs = {}
        for n, u in flight.inputs.items():
            rest = np.full(m, 0.0 if linear else float(u[0]))
            inputs[n] = rest + candidate.values if n == candidate.input else rest
        outputs = {n: np.zeros(m) for n in flight.outputs}
        flights.append(_of_length(flight, inputs, outputs))
        record: Any = problem.model.Inputs
        parts.append(
            numbers._replace(
                inputs=record(**{n: jnp.asarray(inputs[n], dtype) for n in naming.names(record)}),
                outputs={n: jnp.zeros(m, dtype) for n in numbers.outputs},
            )
        )
    layout = replace(
        layout_of(problem, tuple(flights)), windows=((1, m),) * len(parts), continuity=None
    )
    data = at.data._replace(flights=tuple(parts))
    noise = Noise((at.noise.sd[i],) * len(parts), at.noise.log_variance_ratio)
    own = _begins_as(at, i, linear)
    z = _joined(at, [own] * len(parts))
    return sensitivity_at(problem, layout, evaluate(layout, data, noise, z)), layout, data


def _joined(at: Solution, flights: list[np.ndarray]) -> jax.Array:
    """The unknowns of the problem, and behind them those of the flights one by one."""
    # In NumPy, as they are made: each operation by itself would be a program to load.
    return jnp.asarray(np.concatenate([np.asarray(at.z)[: at.layout.first_nuisance], *flights]))


def _begins_as(at: Solution, i: int, linear: bool) -> np.ndarray:
    """The initial state of the i-th flight's first window, and no bias."""
    layout, position = at.layout, at.layout.first_nuisance
    for j in range(i):
        position += layout.windows[j][0] * len(layout.states)
        position += layout.constants(layout.outputs[j])
    states = np.asarray(at.z)[position : position + len(layout.states)]
    # A linear machine begins at rest, wherever the record begins.
    states = np.zeros_like(states) if linear else states
    return np.concatenate([states, np.zeros(layout.constants(layout.outputs[i]), states.dtype)])
