"""Time shifts of signals: inputs and outputs that act at another time than the log has them.

The likelihood of a fitted model is computed with a signal shifted in time. The unknowns follow to
first order (a score test, Rao, 1948). Inputs and outputs are shifted by whole samples; the slope of
the residual gives an input's shift within a sample. The other hold shifts an input by half a
sample. All candidates have the same statistic and limit. The test is also valid in a closed loop:
an input that follows the response counteracts its errors, so an input shifted too early predicts
them with the wrong sign.
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
from heli_jax.identification.estimation.simulated_flights import signal_numbers
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Solution


@dataclass(frozen=True)
class _ShiftLimits:
    clear: float = 25.0
    """Gain of twice the log-likelihood from which on a shift is significant: 5 sd."""
    farthest: float = 0.5
    """Largest shift [s]."""
    block: float = 1.0
    """Longest time over which rows may be correlated [s]."""


SHIFT = _ShiftLimits()


class Shift(NamedTuple):
    """Time shift of signals."""

    kind: str
    """input, output: logged late; response: to an input, later than in the model; hold: inputs that
    were taken as linear are held."""
    names: tuple[str, ...]
    seconds: float
    """Delay of the first signal [s]."""
    gain: float
    """Gain of twice the log-likelihood."""
    moved: dict[str, float]
    """Change of each parameter's estimate at the right time [SI]."""


def shift_in_time(
    problem: Problem, at: Solution, e: Evaluation, outputs: Collection[str]
) -> Shift | None:
    """Return the inputs, or the output, that fit better at another time.

    None if no shift is significant, if a delay or time shift is estimated, or if the fit is not in
    time.

    Args:
        outputs: outputs that are tested too.
    """
    layout = at.layout
    in_time = not (is_kinematic(layout.model) or layout.shift or layout.noise_model == "spectrum")
    if not in_time or set(problem.free) & set(problem.model.delay_parameters):
        return None
    inputs = naming.names(problem.model.Inputs)
    moving = [n for n in inputs if any(np.ptp(f.inputs[n]) > 0 for f in problem.training)]
    # To first order in the sample time, a held input is a linear one delayed by half a sample.
    guessed = [n for n in moving if all(_linear_by_guess(f, n) for f in problem.training)]
    signals = [*(("input", n) for n in moving), *(("output", n) for n in outputs)]
    found = {one: _best_place(at, e, *one) for one in [*signals, *(("hold", n) for n in guessed)]}
    found = {one: best for one, best in found.items() if best[1] > SHIFT.clear}
    if not found:
        return None
    kind, best = max(found, key=lambda one: found[one][1])
    together = {one for one in found if one[0] == kind != "output"} | {(kind, best)}
    places = {one[1]: found[one][0] for one in found if one in together}
    dt, there = float(at.data.flights[0].dt), at.data
    for name, place in places.items():
        there = _moved(there, kind, name, place * dt)
    first = max(places.values(), key=abs)
    names = tuple(n for n, place in places.items() if place * first > 0)
    gain, moved = found[kind, best][1], _change(at, e, *_rows(at, there))
    late = "response" if kind == "input" and first > 0 else kind
    return Shift(late, names, abs(first) * dt, gain, moved)


def _linear_by_guess(flight: Flight, name: str) -> bool:
    """True if an input is only assumed to be linear, and was not low-passed."""
    linear = flight.hold[name] == "linear" and name in flight.hold_reason
    return linear and not is_low_passed(flight, name)


def _best_place(at: Solution, e: Evaluation, kind: str, name: str) -> tuple[float, float]:
    """Return the best delay of a signal [samples] and its gain of twice the log-likelihood.

    A negative delay shifts the signal to earlier times.
    """
    dt = float(at.data.flights[0].dt)
    left, gains = {0.0: _beside(_without_level(at, e.r, e.J), e.r)}, {0.0: 0.0}

    def gained(k: float) -> float:
        """Return the gain if the unknowns follow, for rows as white as the present ones."""
        if k not in gains:
            rows, J = _rows(at, _moved(at.data, kind, name, k * dt))
            gains[k] = -np.inf
            if np.all(np.isfinite(rows)) and np.all(np.isfinite(J)):
                left[k] = _beside(_without_level(at, rows, J), rows)
                gains[k] = _gain(_block(dt), left[0], left[k])
        return gains[k]

    if kind == "hold":
        return 0.5, gained(0.5)
    farthest = max(1, round(SHIFT.farthest / dt))
    # Innovations are correlated over a few samples only, so the gain may stay flat until close to
    # the right delay: start from several delays.
    delays = [2**k for k in range(farthest.bit_length())] if e.innovations else [1]
    # An output cannot be logged before it was measured.
    later = delays if kind == "input" else []
    place = max((0, *later, *(-k for k in delays)), key=gained)
    for step in (1, -1):
        while place and abs(place + step) <= farthest and gained(place + step) > gained(place):
            place += step
    if kind == "output" or place > 0 or not {place - 1, place + 1} <= left.keys():
        return float(place), gains[place]
    # A logger stamps a step at the next sample: the slope estimates the shift within a sample.
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


def _without_level(at: Solution, r: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Return the slopes J (n, q) of innovations over a noise whose mean log variance is fixed.

    The level of the noise would follow the residual that a shift removes. Ratios of noises remain.
    """
    if at.layout.noise_model != "disturbance":
        return J
    # The row below the innovations is sqrt(N), with half of the derivative of sqrt(N) times the
    # mean log variance.
    n, J = signal_numbers(at.layout, at.data).size, J.copy()
    J[:n] += np.outer(r[:n], J[n]) * (r[n] / np.count_nonzero(r[:n]))
    J[n] = 0.0
    return J


def _beside(J: np.ndarray, v: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the part of v (n,) that no step of the unknowns, of slopes J (n, q), explains."""
    Q = directions(J)
    return v - Q @ (Q.T @ v)


def _block(dt: float) -> int:
    """Return the number of samples over which rows may be correlated."""
    return max(1, round(SHIFT.block / dt))


def _gain(block: int, before: np.ndarray, after: np.ndarray) -> float:
    """Return the gain of twice the log-likelihood between two residuals (n,)."""
    # A sample that leaves the record has a zero row: this removes a square of 1 on average.
    lost = np.count_nonzero(before) - np.count_nonzero(after)
    gain = float(before @ before - after @ after) - lost
    return gain / _correlated(block, after - before, before) if gain > 0 else gain


def _correlated(block: int, left: np.ndarray, r: np.ndarray) -> float:
    """Return the variance of the sum of left * r over that for white rows; at least 1.

    Args:
        block: rows that may be correlated.
        left: (n,) regressor of the rows.
        r: (n,) the rows.
    """
    power = max(float(left @ left), 1e-300)
    own = left * (r - left * (float(left @ r) / power))
    sums = np.add.reduceat(own, np.arange(0, own.size, block))
    return max(1.0, float(sums @ sums) / power)


def _change(at: Solution, e: Evaluation, r: np.ndarray, J: np.ndarray) -> dict[str, float]:
    """Return by parameter the change of its estimate for rows r (n,) of slopes J (n, q) [SI]."""
    # One Gauss-Newton step from the optimum, less the step that the optimiser left.
    step = pseudoinverse(e.J) @ e.r - pseudoinverse(J) @ r
    change = step[: len(e.slopes)] * np.asarray(e.slopes)
    return {
        n: float(v)
        for n, v in zip(at.layout.of_interest, change, strict=True)
        if n in at.layout.free and n not in at.layout.disturbance
    }


def _moved(data: Data, kind: str, name: str, seconds: float) -> Data:
    """Return the data with an input or output delayed; inputs are interpolated, outputs rounded."""
    flights = []
    for flight in data.flights:
        inputs, outputs = naming.asdict(flight.inputs), dict(flight.outputs)
        of = outputs if kind == "output" else inputs
        if name in of:
            # NumPy avoids loading a JAX program for each step.
            v = np.asarray(of[name])
            at = np.clip(np.arange(v.size) - seconds / float(flight.dt), 0, v.size - 1)
            # Round for outputs, since a missing sample cannot be interpolated.
            whole = kind == "output"
            line = v[np.rint(at).astype(int)] if whole else np.interp(at, np.arange(v.size), v)
            of[name] = jax.device_put(line.astype(v.dtype))
        flights.append(flight._replace(inputs=type(flight.inputs)(**inputs), outputs=outputs))
    return data._replace(flights=tuple(flights))
