"""Signals that act at another time than their log has them.

- `shifts`: the likelihood of a fitted model with a signal at another time, where its unknowns
  follow to first order (a score test, Rao, 1948). An input or an output is moved by whole samples,
  an input also within a sample by the slope of the residual; the other hold of an input moves it
  by half a sample. Every candidate has the same statistic and the same limit. An input that
  follows the response knows the errors of later samples, but takes them back: used too early it
  predicts them with the wrong sign, so that the test holds in a closed loop too.
- `leads`: no vehicle responds before its input. If the past of an output and of all inputs leaves
  something of the output that an input's future explains, that input is logged late, or it follows
  the output (C. A. Sims, Money, income, and causality, Am. Econ. Rev. 62, 1972). It needs no model.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
import scipy.special
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

# Signals with which a model explains the record better at another time.


@dataclass(frozen=True)
class _ShiftLimits:
    clear: float = 25.0
    """gain of twice the log-likelihood, from which on another time is clear: 5 sd, so that of a
    hundred candidates one is clear by chance in 20,000 records"""
    farthest: float = 0.5
    """[s] that a signal is moved at most"""
    block: float = 1.0
    """[s] over which rows may be correlated"""


SHIFT = _ShiftLimits()


class Shift(NamedTuple):
    """Signals at another time."""

    kind: str
    """input or output: it is logged late; response: that to an input comes later than the model
    makes it; hold: inputs are held that were taken as linear"""
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
    # A held input is a linear one that is late by half a sample, but for terms of second order in
    # the sample time; a command that changes at every sample is taken for a linear one.
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
    """True if an input is taken as linear, which nobody stated and no low-pass made so."""
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


# Inputs whose future an output shows.


@dataclass(frozen=True)
class _LeadLimits:
    rate: float = 50.0
    """[Hz] to which logs are averaged, so that the verdict is the same at any rate of the log"""
    seconds: float = 0.4
    """past and future of an input that are looked at"""
    own: int = 6
    """past samples of the output that predict it"""
    fewest: int = 10
    """samples for each regressor"""
    share: float = 0.1
    """part of what the past leaves of an output that an input's future explains, for a lead"""
    chance: float = 1e-6
    """probability of as much by chance, at most"""


LEAD = _LeadLimits()


class Lead(NamedTuple):
    """An output that moves before an input does."""

    flight: str
    input: str
    output: str
    share: float
    """part of what the past leaves of the output that the later input explains"""
    seconds: float


def leads(flights: Sequence[tuple[str, Flight]]) -> list[Lead]:
    """Return by flight and input the surest lead of an output."""
    surest: dict[tuple[str, str], Lead] = {}
    for label, flight in flights:
        for output, y in flight.outputs.items():
            led = led_by(y, flight.inputs, flight.dt)
            if led is not None:
                share, seconds, name = led
                lead = Lead(label, name, output, share, seconds)
                if (label, name) not in surest or surest[label, name].share < share:
                    surest[label, name] = lead
    return list(surest.values())


def led_by(
    y: Float[np.ndarray, " N"], inputs: Mapping[str, Float[np.ndarray, " N"]], dt: float
) -> tuple[float, float, str] | None:
    """Return the input whose future explains most of an output: the part (0 to 1) that it explains
    of what the past leaves, by how much the output precedes it [s], and its name; None without one.

    Args:
        y: the output, NaN where nothing is measured.
        dt: [s].
    """
    moving = {n: u for n, u in inputs.items() if np.isfinite(u).all() and np.ptp(u) > 0}
    if not moving or not np.isfinite(y).all() or not np.ptp(y) > 0:
        return None
    count = max(1, round(1.0 / (LEAD.rate * dt)))
    step = count * dt
    slow, drives = _averaged(y, count), {n: _averaged(u, count) for n, u in moving.items()}
    shares = {n: _of_future(slow, drives, n, step) for n in drives}
    name, share = max(shares.items(), key=lambda item: item[1])
    if share < LEAD.share:
        return None
    # Move that input ahead until its future explains no more.
    most = max(1, round(LEAD.seconds / step))
    for k in range(1, most + 1):
        ahead = {n: u[k:] if n == name else u[: u.size - k] for n, u in drives.items()}
        if _of_future(slow[: slow.size - k], ahead, name, step) < LEAD.share:
            return share, k * step, name
    return share, most * step, name


def _averaged(x: np.ndarray, count: int) -> np.ndarray:
    """Means (N // count,) of so many samples."""
    size = x.size // count
    return x[: size * count].reshape(size, count).mean(axis=1)


def _of_future(y: np.ndarray, drives: Mapping[str, np.ndarray], name: str, step: float) -> float:
    """Return the part of what the past of all leaves of an output that an input's future explains,
    less what as many regressors explain of noise; 0 if chance may make as much."""
    lags = max(2, round(LEAD.seconds / step))
    first, last = max(lags, LEAD.own), y.size - lags
    regressors = LEAD.own + len(drives) * (lags + 1) + lags
    if last - first < LEAD.fewest * regressors:
        return 0.0

    def column(x: np.ndarray, k: int) -> np.ndarray:
        return x[first - k : last - k]

    past = [column(y, k) for k in range(1, LEAD.own + 1)] + [np.ones(last - first)]
    past += [column(u, k) for u in drives.values() for k in range(lags + 1)]
    # A step within a mean shows in full in the next one: that is no lead yet.
    past += [column(u, -1) for u in drives.values()]
    known = directions(np.stack(past, axis=1))
    future = np.stack([column(drives[name], -k) for k in range(2, lags + 1)], axis=1)
    size = float(np.linalg.norm(future - future.mean(axis=0), axis=0).max())
    beside = future - known @ (known.T @ future)
    # What the past determines of the future is left as rounding.
    beside = beside[:, np.linalg.norm(beside, axis=0) > 1e-6 * size]
    if not beside.size:
        return 0.0
    new = directions(beside)
    rest = column(y, 0) - known @ (known.T @ column(y, 0))
    freedom = rest.size - known.shape[1] - new.shape[1]
    power = float(rest @ rest)
    if not power > 0:
        return 0.0
    share = min(float(np.sum((new.T @ rest) ** 2)) / power, 1.0)
    F = share / new.shape[1] / max((1.0 - share) / freedom, 1e-300)
    if scipy.special.fdtrc(new.shape[1], freedom, F) > LEAD.chance:
        return 0.0
    return max(0.0, 1.0 - (1.0 - share) * (freedom + new.shape[1]) / freedom)
