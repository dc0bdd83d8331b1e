"""Manoeuvres of the library of excitations, and the best one to add to a record (Mehra, 1974)."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax.identification.design.accuracy import (
    DETERMINES,
    expected_sd,
    together,
    triangle,
)
from heli_jax.identification.design.information import planned
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.analysis import sensitivity_at, verdict_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution, flight_places, layout_of
from heli_jax.simulation.inputs import excitation, slewed

_STEPS = (0.1, 0.2, 0.5, 1.0)
"""Shortest steps of a candidate [s]."""
_BANDS = ((0.1, 2.0), (0.1, 5.0), (0.1, 10.0))
"""Frequencies of a candidate [Hz]."""
_STEPPED = {
    "doublet": ("doublets of {:g} s", 3),
    "3-2-1-1": ("3-2-1-1 steps of {:g} s", 8),
    "prbs": ("a binary sequence of {:g} s", 5),
}
"""Words, and the number of shortest steps that a manoeuvre takes with its pause."""
_SWEPT = {
    "chirp": "a chirp",
    "ardupilot-chirp": "ArduPilot's chirp",
    "betaflight-chirp": "Betaflight's chirp",
    "multisine": "a multisine",
}
_FADE, _LONGEST_FADE = 0.05, 5.0
"""Fades of ArduPilot's chirp: share of the record, and at most [s]."""


class Manoeuvre(NamedTuple):
    """A kind of excitation with its settings."""

    words: str
    """Such as `3-2-1-1 steps of 0.5 s`."""
    kind: str
    settings: dict[str, Any]
    """Settings of `excitation`."""

    def samples(
        self, n: int, dt: float, rates: Sequence[float] = (np.inf,)
    ) -> Float[np.ndarray, "i n"]:
        """Return the samples of several inputs, with deflections of at most 1.

        Inputs move together if their motions are independent, else one after another. The first
        sample is zero, as the inputs before the flight.

        Args:
            rates: largest rate of each input [deflection/s].
        """
        number, length = len(rates), self.length(n, len(rates))
        u = np.zeros((number, n))
        for i, rate in enumerate(rates):
            # One generator per input: two binary sequences of one seed would be equal.
            rng = np.random.default_rng(i)
            settings = {**self.settings, "place": (i, number)}
            begin = 1 if self._at_once else 1 + i * length
            u[i, begin : begin + length] = excitation(
                self.kind, length, dt, rng, settings, rate=rate
            )
            # The begin and the end of an excitation are steps.
            u[i] = slewed(u[i], rate * dt)
        return u

    @property
    def _at_once(self) -> bool:
        return self.kind in ("multisine", "prbs", "random-steps")

    def length(self, n: int, inputs: int) -> int:
        """Return the samples of one input's excitation in a flight of n samples."""
        return n - 1 if self._at_once else (n - 1) // inputs


def manoeuvres(
    inputs: int, duration: float, dt: float, chirps: Sequence[str] = ("chirp",)
) -> list[Manoeuvre]:
    """Return the manoeuvres that a flight has time for.

    Args:
        inputs: number of inputs.
        duration: duration of the flight [s].
        chirps: kinds of chirps.
    """
    found = [
        Manoeuvre(words.format(step), kind, {"step": step, "pause": step})
        for kind, (words, takes) in _STEPPED.items()
        for step in _STEPS
        if 2.0 * dt <= step and takes * step <= duration / inputs
    ]
    for low, high in _BANDS:
        # The lowest line has a period in the record, and each input a line of its own.
        low = max(low, inputs / duration)
        for kind in (*chirps, "multisine"):
            # Two periods of ArduPilot's first frequency take half of the record. Betaflight counts
            # tenths of a hertz.
            first = max(low, 4.0 * inputs / duration) if kind == "ardupilot-chirp" else low
            first = math.ceil(10.0 * first) / 10.0 if kind == "betaflight-chirp" else first
            fade = (
                min(_FADE * duration / inputs, _LONGEST_FADE) if kind == "ardupilot-chirp" else 0.0
            )
            if 2.0 * first < high <= 0.2 / dt:
                words = f"{_SWEPT[kind]} from {first:.2g} to {high:.2g} Hz"
                found.append(Manoeuvre(words, kind, {"band": (first, high), "fade": fade}))
    found.append(Manoeuvre("random steps of 0.3 to 2 s", "random-steps", {"hold": (0.3, 2.0)}))
    return found


# The next flight.


_QUICK = ("doublet", "3-2-1-1", "chirp")
"""Kinds that need no library of signals and no optimisation: for every `check`."""
_LONGEST = 20.0
"""Longest candidate [s]; it is repeated for a longer record."""


class Plan(NamedTuple):
    """The effect of the best manoeuvre on the parameter with the widest interval."""

    parameter: str
    before: float
    """Its expected relative sd; infinite if it is not determined."""
    again: float
    """With the same record once more."""
    after: float
    """With the best manoeuvre, as long as the record."""
    input: str
    manoeuvre: str
    """In words, such as `3-2-1-1 steps of 0.5 s`."""
    excitation: np.ndarray
    """(m,), added to the input, SI."""
    duration: float
    """Duration of the record [s]."""
    left_out: tuple[str, ...]
    """Inputs that do not move in the record."""


def plan_next_flight(problem: Problem, at: Solution, e: Evaluation) -> Plan | None:
    """Compare manoeuvres of one input, as large as it moves in the record; None without any."""
    layout = at.layout
    # A filter of a nonlinear model would be compiled for every candidate. Rows at frequencies weigh
    # all flights together.
    comparable = layout.noise_model == "white" or layout.model.linear
    if not comparable or layout.noise_model == "spectrum" or not np.isfinite(e.J).all():
        return None
    flight = max(problem.training, key=lambda f: f.n_samples)
    i = problem.training.index(flight)
    # With multiple shooting a candidate is one window.
    m = min(at.layout.windows[i][1], max(round(_LONGEST / flight.dt), 3 * len(problem.free)))
    moving = [n for n, u in flight.inputs.items() if np.ptp(u) > 0]
    candidates = [
        (n, c.words, 0.5 * float(np.ptp(flight.inputs[n])) * c.samples(m, flight.dt)[0])
        for n in moving
        for c in manoeuvres(1, m * flight.dt, flight.dt)
        if c.kind in _QUICK
    ]
    if not candidates:
        return None
    now = sensitivity_at(problem, layout, e)
    unknowns, R = now.unknowns, triangle(now)
    lacking = verdict_of(problem, layout, e).not_identifiable
    absent = np.array([u.name in lacking for u in unknowns])
    before = expected_sd(unknowns, R)
    widest = int(np.argmax(np.where(absent, before, 0.0) if lacking else before))
    flights = layout.objective.tags(layout, at.data, len(now.shared)).flight
    again = expected_sd(unknowns, together(R, triangle(now.part(flights == i))))
    sds = _sds_after(problem, at, i, R, [(n, u) for n, _, u in candidates], m)
    lost = np.any(sds[:, absent] >= DETERMINES, axis=1)
    after = np.where(lost, np.inf, sds[:, widest])
    best = int(np.argmin(after))
    name, words, u = candidates[best]
    return Plan(
        unknowns[widest].name,
        np.inf if lacking else float(before[widest]),
        np.inf if lacking else float(again[widest]),
        float(after[best]),
        name,
        words,
        u,
        flight.n_samples * flight.dt,
        tuple(n for n in flight.inputs if n not in moving),
    )


def _sds_after(
    problem: Problem,
    at: Solution,
    i: int,
    R: np.ndarray,
    candidates: list[tuple[str, np.ndarray]],
    m: int,
) -> np.ndarray:
    """Return the sds (candidates, p) with a flight of m samples that begins as the i-th one does.

    Args:
        R: factor of the information of the record.
        candidates: input and excitation (m,).
    """
    flight, model = problem.training[i], problem.model
    signals = (dict.fromkeys(s, np.zeros(m)) for s in (flight.inputs, flight.outputs))
    names = ("inputs", "outputs", "instruments", "hold", "hold_reason")
    alone = replace(flight, **dict(zip(names, (*signals, {}, {}, {}), strict=True)))
    layout = replace(layout_of(problem, (alone,)), windows=((1, m),), continuity=None)
    # A linear model begins at rest with neutral sticks, a nonlinear one as the record does.
    whole, dtype = np.asarray(at.z), at.z.dtype
    moves, places = 0.0 if model.linear else 1.0, flight_places(at.layout)[i]
    shared, begin = whole[: at.layout.first_nuisance], moves * whole[places.states[0]]
    z = np.concatenate([shared, begin, np.zeros(places.constants.size)])
    rest = {k: np.full(m, moves * float(u[0]), dtype) for k, u in flight.inputs.items()}
    part = at.data.flights[i]._replace(
        inputs=model.Inputs(**rest), outputs=dict.fromkeys(layout.outputs[0], np.zeros(m, dtype))
    )
    data, noise = at.data._replace(flights=(part,)), at.noise._replace(sd=(at.noise.sd[i],))
    experiment = planned(problem, layout, data, noise, z[None], flown=R)
    # The candidate is repeated until it is as long as the record; priors and record count once.
    times, vehicles = math.sqrt(flight.n_samples / m), experiment.vehicles
    experiment = experiment._replace(vehicles=vehicles._replace(rows=vehicles.rows / times))

    @jax.jit
    def sds(inputs: Any) -> Any:
        return jnp.sqrt(jnp.diagonal(experiment.outcome((inputs,), ({},)).covariance[0]))

    each = [
        sds(model.Inputs(**{**rest, name: rest[name] + u.astype(dtype)})) for name, u in candidates
    ]
    return np.array(each) / times
