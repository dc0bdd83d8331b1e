"""Expected standard deviations before a fit, and the best manoeuvre to add to a record.

Rows of the whitened Jacobian at the start values are samples. The information of a part of a record
is that of its rows, with its own initial states, biases and input offsets projected out. It is
carried as a factor R of Fisher's matrix R'R; the factor of two parts together is that of both, one
above the other.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.identifiability.analysis import (
    NO_EFFECT,
    Sensitivity,
    projected,
    sensitivity_at,
    verdict_of,
)
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Solution,
    flight_places,
    layout_of,
)
from heli_jax.identification.unknowns.transforms import scale
from heli_jax.simulation.inputs import chirp, multistep


def triangle(s: Sensitivity) -> Float[np.ndarray, "s s"]:
    """Return the factor of the information on the shared unknowns, with all others free."""
    # Without the unknowns that have no effect on these rows: nearly all of a long record.
    return projected(s.shared, s.own[:, np.linalg.norm(s.own, axis=0) > NO_EFFECT])


def together(*triangles: np.ndarray) -> Float[np.ndarray, "s s"]:
    """Return the factor of several parts of the data with the same shared unknowns."""
    return np.linalg.qr(np.vstack(triangles), mode="r")


def expected_sd(
    unknowns: tuple[Unknown, ...], R: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, " q"]:
    """Return expected standard deviations of the parameters of interest in relative coordinates;
    infinite for those that data and priors do not determine."""
    q = len(unknowns)
    prior = np.hstack([np.diag([u.prior for u in unknowns]), np.zeros((q, R.shape[1] - q))])
    rows = np.vstack([R, prior])
    # Parameters of the noise without effect are no unknowns.
    felt = np.any(rows != 0.0, axis=0) | (np.arange(R.shape[1]) < q)
    return deviations(rows[:, felt])[:q]


GUESSED = "guessed: too small if the log was smoothed; state the output's sd"
"""remark on a noise that nobody stated"""


def starting_at_zero(problem: Problem) -> dict[str, tuple[float, str]]:
    """Return the unit of the relative coordinate [SI], and its name, of each free parameter that
    starts at zero."""
    return {
        n: (scale(f), naming.unit(problem.model.Params, n) or "1")
        for n, f in problem.free.items()
        if f.start == 0
    }


def unstated_gusts(problem: Problem) -> list[str]:
    """Return the sizes of disturbances that are not stated; none without process noise."""
    if problem.noise_model != "disturbance":
        return []
    sizes = [d.sigma for d in disturbances_of(problem.model)]
    stated = {n: float(getattr(problem.vehicle, n)) for n in sizes}
    return [n for n, size in stated.items() if not (math.isfinite(size) and size > 0.0)]


# The best manoeuvre to add to a record. Candidates are doublets, 3-2-1-1 steps and a chirp of one
# input, with the duration and amplitude of the record; the record once more is for comparison
# (Mehra, 1974; Jategaonkar, 2006, chapter 2).


DETERMINES = 1.0
"""relative sd below which a parameter is determined"""
_STEPS = (0.2, 0.5, 1.0)
"""lengths of the shortest step of a candidate [s]"""
_LONGEST = 20.0
"""duration of a candidate at most [s]; it is repeated for a longer record"""
_BAND = (0.1, 5.0)
"""of the chirp [Hz]"""


class Candidate(NamedTuple):
    """One manoeuvre of one input."""

    input: str
    words: str
    """such as `3-2-1-1 steps of 0.5 s`"""
    values: Float[np.ndarray, " m"]
    """added to the input, SI"""


class Plan(NamedTuple):
    """The effect of the candidates on the parameter with the widest interval."""

    parameter: str
    before: float
    """its expected relative sd; inf if it is not determined"""
    again: float
    """with the same record once more"""
    best: Candidate
    after: float
    """with the best candidate, as long as the record"""
    duration: float
    """of the record and of the candidates [s]"""
    amplitude: float
    """of the best candidate, SI"""
    left_out: tuple[str, ...]
    """inputs that do not move in the record"""


def plan_next_flight(problem: Problem, at: Solution, e: Evaluation) -> Plan | None:
    """Compare manoeuvres; None if there is nothing to compare."""
    layout = at.layout
    # A filter of a nonlinear model would be compiled for every candidate. Rows at frequencies weigh
    # all flights together.
    comparable = layout.noise_model == "white" or layout.model.linear
    if not comparable or layout.noise_model == "spectrum" or not np.isfinite(e.J).all():
        return None
    flight = max(problem.training, key=lambda f: f.n_samples)
    i = problem.training.index(flight)
    # With multiple shooting a candidate is one window.
    m = at.layout.windows[i][1]
    m = min(m, max(round(_LONGEST / flight.dt), 3 * len(problem.free)))
    candidates = _candidates(flight, m)
    if not candidates:
        return None
    now = sensitivity_at(problem, layout, e)
    each = _candidate_rows(problem, at, i, candidates, m)
    flights = layout.objective.tags(layout, at.data, len(now.shared)).flight
    once_more = now.part(flights == i)
    lacking = verdict_of(problem, layout, e).not_identifiable
    absent = np.array([u.name in lacking for u in now.unknowns])
    R, unknowns = triangle(now), now.unknowns
    before = expected_sd(unknowns, R)
    widest = int(np.argmax(np.where(absent, before, 0.0) if lacking else before))
    times, sds = flight.n_samples / m, []
    for s in each:
        after = expected_sd(unknowns, together(R, np.sqrt(times) * triangle(s)))
        lost = np.any(after[absent] >= DETERMINES)
        sds.append(np.inf if lost else float(after[widest]))
    best = int(np.argmin(sds))
    again = expected_sd(unknowns, together(R, triangle(once_more)))
    return Plan(
        unknowns[widest].name,
        np.inf if lacking else float(before[widest]),
        np.inf if lacking else float(again[widest]),
        candidates[best],
        sds[best],
        flight.n_samples * flight.dt,
        float(np.max(np.abs(candidates[best].values))),
        tuple(n for n, u in flight.inputs.items() if np.ptp(u) == 0),
    )


def _candidate_rows(
    problem: Problem, at: Solution, i: int, candidates: list[Candidate], m: int
) -> list[Sensitivity]:
    """Return the rows of each candidate, a flight of m samples that begins as the i-th one does."""
    flight, numbers, model = problem.training[i], at.data.flights[i], problem.model
    dtype, whole, places = at.z.dtype, np.asarray(at.z), flight_places(at.layout)[i]
    signals = (dict.fromkeys(s, np.zeros(m)) for s in (flight.inputs, flight.outputs))
    names = ("inputs", "outputs", "instruments", "hold", "hold_reason")
    alone = replace(flight, **dict(zip(names, (*signals, {}, {}, {}), strict=True)))
    layout = replace(layout_of(problem, (alone,)), windows=((1, m),), continuity=None)
    # A linear model begins at rest with neutral sticks, a nonlinear one as the record does.
    moves = 0.0 if model.linear else 1.0
    rest = {k: np.full(m, moves * float(u[0])) for k, u in flight.inputs.items()}
    shared, begin = whole[: at.layout.first_nuisance], moves * whole[places.states[0]]
    z = jnp.asarray(np.concatenate([shared, begin, np.zeros(places.constants.size)]))
    noise = at.noise._replace(sd=(at.noise.sd[i],))
    each = []
    for candidate in candidates:
        inputs = {**rest, candidate.input: rest[candidate.input] + candidate.values}
        part = numbers._replace(
            inputs=model.Inputs(**{k: jnp.asarray(v, dtype) for k, v in inputs.items()}),
            outputs=dict.fromkeys(numbers.outputs, jnp.zeros(m, dtype)),
        )
        data = at.data._replace(flights=(part,))
        s = sensitivity_at(problem, layout, evaluate(layout, data, noise, z))
        each.append(s.part(layout.objective.tags(layout, data, len(s.shared)).flight == 0))
    return each


def _candidates(flight: Flight, m: int) -> list[Candidate]:
    """Return manoeuvres of m samples, with the amplitude that each input has in the record."""
    candidates, rng = [], np.random.default_rng(0)
    for name, u in flight.inputs.items():
        amplitude = 0.5 * float(np.ptp(u))
        if amplitude == 0:
            continue
        for step in _STEPS:
            if 3 * step <= m * flight.dt:
                # One side, the other, neutral, repeated.
                phase = np.arange(m) // max(1, round(step / flight.dt)) % 3
                doublets = amplitude * np.array([1.0, -1.0, 0.0])[phase]
                candidates.append(Candidate(name, f"doublets, {step:g} s a side", doublets))
            if 8 * step <= m * flight.dt:
                steps = amplitude * multistep(m, flight.dt, rng, step, step)
                candidates.append(Candidate(name, f"3-2-1-1 steps of {step:g} s", steps))
        low, high = max(_BAND[0], 1.0 / (m * flight.dt)), min(_BAND[1], 0.1 / flight.dt)
        if high > 2 * low:
            words = f"a sine that rises from {low:.2g} to {high:.2g} Hz"
            candidates.append(Candidate(name, words, amplitude * chirp(m, flight.dt, low, high)))
    return candidates
