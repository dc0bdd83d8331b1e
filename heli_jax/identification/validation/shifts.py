"""Signals that act at another time than their log has them.

The likelihood of a fitted model with a signal at another time is computed where the unknowns follow
to first order (a score test, Rao, 1948). An input or an output is moved by whole samples, an input
also within a sample by the slope of the residual; the other hold of an input moves it by half a
sample. Every candidate has the same statistic and the same limit. An input that follows the
response knows the errors of later samples, but takes them back: used too early it predicts them
with the wrong sign, so that the test holds in a closed loop too.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import is_low_passed
from heli_jax.identification.estimation.evaluation import (
    Evaluation,
    directions,
    pseudoinverse,
)
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Solution


@dataclass(frozen=True)
class _ShiftLimits:
    clear: float = 25.0
    """gain of twice the log-likelihood, from which on a shift is significant: 5 sd"""
    farthest: float = 0.5
    """[s] largest shift"""
    block: float = 1.0
    """[s] over which rows may be correlated"""


SHIFT = _ShiftLimits()


class Shift(NamedTuple):
    """Signals at another time."""

    kind: str
    """input, output: logged late; response: to an input, later than in the model; hold: inputs are
    held that were taken as linear"""
    names: tuple[str, ...]
    seconds: float
    """by which the first of them is late"""
    gain: float
    """of twice the log-likelihood"""
    moved: dict[str, float]
    """by parameter how far the right time would move its estimate [SI]"""


def shift_in_time(
    problem: Problem, at: Solution, e: Evaluation, outputs: Collection[str]
) -> Shift | None:
    """Return the inputs, or the output, that the record places at another time; None if no shift is
    clear, if inputs are shifted or delayed by an unknown, or if rows are no samples in time.

    Args:
        outputs: those that are moved too.
    """
    layout = at.layout
    in_time = not (is_kinematic(layout.model) or layout.shift or layout.noise_model == "spectrum")
    if not in_time or set(problem.free) & set(problem.model.delay_parameters):
        return None
    inputs = naming.names(problem.model.Inputs)
    moving = [n for n in inputs if any(np.ptp(f.inputs[n]) > 0 for f in problem.training)]
    # To first order in the sample time a held input is a linear one that is late by half a sample.
    guessed = [n for n in moving if all(_linear_by_guess(f, n) for f in problem.training)]
    signals = [*(("input", n) for n in moving), *(("output", n) for n in outputs)]
    found = {one: _best_place(at, e, *one) for one in [*signals, *(("hold", n) for n in guessed)]}
    found = {one: best for one, best in found.items() if best[1] > SHIFT.clear}
    if not found:
        return None
    kind, surest = max(found, key=lambda one: found[one][1])
    together = {one for one in found if one[0] == kind != "output"} | {(kind, surest)}
    places = {one[1]: found[one][0] for one in found if one in together}
    dt, there = float(at.data.flights[0].dt), at.data
    for name, place in places.items():
        there = _moved(there, kind, name, place * dt)
    first = max(places.values(), key=abs)
    names = tuple(n for n, place in places.items() if place * first > 0)
    gain, moved = found[kind, surest][1], _change(at, e, *_rows(at, there))
    late = "response" if kind == "input" and first > 0 else kind
    return Shift(late, names, abs(first) * dt, gain, moved)


def _linear_by_guess(flight: Flight, name: str) -> bool:
    """True if an input is taken as linear by a guess, and was not low-passed."""
    linear = flight.hold[name] == "linear" and name in flight.hold_reason
    return linear and not is_low_passed(flight, name)


def _best_place(at: Solution, e: Evaluation, kind: str, name: str) -> tuple[float, float]:
    """Return by how many samples a signal has to come later to fit best (below zero: earlier), and
    what twice the log-likelihood gains there."""
    dt = float(at.data.flights[0].dt)
    left, gains = {0.0: _beside(e.J, e.r)}, {0.0: 0.0}

    def gained(k: float) -> float:
        """Return the gain where the unknowns follow, and rows are as white as these."""
        if k not in gains:
            rows, J = _rows(at, _moved(at.data, kind, name, k * dt))
            gains[k] = -np.inf
            if np.all(np.isfinite(rows)) and np.all(np.isfinite(J)):
                left[k] = _beside(J, rows)
                gains[k] = _gain(_block(dt), left[0], left[k])
        return gains[k]

    if kind == "hold":
        return 0.5, gained(0.5)
    farthest = max(1, round(SHIFT.farthest / dt))
    # Innovations forget within a few samples: between now and the right time none need be likelier.
    begun = [2**k for k in range(farthest.bit_length())] if e.innovations else [1]
    # No output is logged before it was measured.
    later = begun if kind == "input" else []
    place = max((0, *later, *(-k for k in begun)), key=gained)
    for step in (1, -1):
        while place and abs(place + step) <= farthest and gained(place + step) > gained(place):
            place += step
    if kind == "output" or place > 0 or not {place - 1, place + 1} <= left.keys():
        return float(place), gains[place]
    # A logger stamps a step at the sample after it: within a sample the slope tells by how much.
    slope, rest = 0.5 * (left[place + 1] - left[place - 1]), left[place]
    part = float(slope @ rest) / max(float(slope @ slope), 1e-300)
    gain = part**2 * float(slope @ slope) / _correlated(_block(dt), slope, rest)
    if not (gain > SHIFT.clear and abs(part) <= 1.0 and part > place):
        return float(place), gains[place]
    return place - part, gains[place] + gain


def _rows(at: Solution, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Return the whitened rows (n,) and their slopes (n, q) with other data."""
    there = residual_and_jacobian(at.layout, data, at.noise, at.z)
    return jax.device_get((there.r, there.J))


def _beside(J: np.ndarray, v: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the part of v (n,) that no step of the unknowns, of slopes J (n, q), takes up."""
    Q = directions(J)
    return v - Q @ (Q.T @ v)


def _block(dt: float) -> int:
    """Return the samples over which rows may be correlated."""
    return max(1, round(SHIFT.block / dt))


def _gain(block: int, before: np.ndarray, after: np.ndarray) -> float:
    """Return the gain of twice the log-likelihood between two residuals (n,), below zero a loss."""
    # A sample that moves out of the record takes its square along, 1 on average; its row is zero.
    lost = np.count_nonzero(before) - np.count_nonzero(after)
    gain = float(before @ before - after @ after) - lost
    return gain / _correlated(block, after - before, before) if gain > 0 else gain


def _correlated(block: int, left: np.ndarray, r: np.ndarray) -> float:
    """Return how many times the variance with white rows the sum of left times r has; 1 at least.

    Args:
        block: rows that may be correlated.
        left: (n,) what the rows are regressed on.
        r: (n,) the rows.
    """
    power = max(float(left @ left), 1e-300)
    own = left * (r - left * (float(left @ r) / power))
    sums = np.add.reduceat(own, np.arange(0, own.size, block))
    return max(1.0, float(sums @ sums) / power)


def _change(at: Solution, e: Evaluation, r: np.ndarray, J: np.ndarray) -> dict[str, float]:
    """Return by parameter how far rows r (n,) of slopes J (n, q) move its estimate [SI]."""
    # From an optimum: the next step of Gauss and Newton, less that which the optimiser left.
    step = pseudoinverse(e.J) @ e.r - pseudoinverse(J) @ r
    change = step[: len(e.slopes)] * np.asarray(e.slopes)
    return {
        n: float(v)
        for n, v in zip(at.layout.of_interest, change, strict=True)
        if n in at.layout.free and n not in at.layout.disturbance
    }


def _moved(data: Data, kind: str, name: str, seconds: float) -> Data:
    """Return an input or an output later by so much; an input between samples by its mean."""
    flights = []
    for flight in data.flights:
        inputs, outputs = naming.asdict(flight.inputs), dict(flight.outputs)
        of = outputs if kind == "output" else inputs
        if name in of:
            # By NumPy: each step of it would be a program of JAX's to load.
            v = np.asarray(of[name])
            at = np.clip(np.arange(v.size) - seconds / float(flight.dt), 0, v.size - 1)
            # A missing sample has no mean with another.
            whole = kind == "output"
            line = v[np.rint(at).astype(int)] if whole else np.interp(at, np.arange(v.size), v)
            of[name] = jax.device_put(line.astype(v.dtype))
        flights.append(flight._replace(inputs=type(flight.inputs)(**inputs), outputs=outputs))
    return data._replace(flights=tuple(flights))
