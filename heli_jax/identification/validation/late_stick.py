"""Inputs that stand in the log, or act in the model, at another time than they acted.

A logger that reads a stick at 50 Hz stamps a step at the sample after it: half a sample late on
average. `late_inputs` sees an input that moves after its answer; a few ms hide in the estimates,
which take them up as a faster machine. So the derivative of the residuals by a shift of the inputs
is asked for (a score test, Rao, 1948): what is left of it beside the sensitivities says how late
they are, and what it has in common with them by how much that moves the estimates.

Whole samples show by the likelihood itself: with each input earlier or later it falls, unless the
record is late or the model lacks a lag. That holds in a closed loop too. An input that follows the
response knows the errors of later samples, but takes them back: used too early it foretells them
with the wrong sign.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import is_low_passed
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import directions, evaluate, pseudoinverse
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Solution
from heli_jax.identification.validation.late_inputs import LATE
from heli_jax.identification.validation.other_hold import feeds_through

LAG = "dynamics.residual-follows-input"
_CLEAR = 5.0
"""sds from zero, from which on a shift is spoken of; of twice the log-likelihood the square"""
_FARTHEST = 0.5
"""[s] that an input is moved at most"""
_LARGE = 0.1
"""of a parameter, by which half a sample of the stick has to move it for a doubt before any fit"""
_LEFT = 1e-3
"""part of the derivative by the shift that has to be left beside the sensitivities"""
_BLOCK = 1.0
"""[s] over which rows may be correlated"""
_MOST = 3
"""parameters that are named"""
_SEEN = 1e-3
"""of a parameter, below which a move is not named: of one held by a prior alone it is rounding"""


def late_stick(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    estimates: Mapping[str, tuple[float, float | None]],
) -> list[Finding]:
    """The inputs' lateness where it is clear and moves an estimate; nothing where it does not show.

    Args:
        problem: what was fitted.
        at: where the fit ended.
        e: the evaluation there.
        estimates: value and sd of those of interest, among them a free `time_shift` [s], SI.
    """
    if "time_shift" in estimates:
        return _freed(problem, *estimates["time_shift"])
    samples = _displaced(problem, at, e)
    # An input that is late by one sample may be late by less, which the derivative tells.
    within = _within_a_sample(problem, at, e) if not samples or samples.first[1] == -1 else []
    return within or ([_of_samples(at, e, samples)] if samples else [])


def _within_a_sample(problem: Problem, at: Solution, e: Evaluation) -> list[Finding]:
    """By the derivative of the residuals, of inputs as a log has them."""
    slope = _by_shift(problem, at)
    if slope is None:
        return []
    names, s = slope
    J, r = np.asarray(e.J), np.asarray(e.r)
    left = _beside(J, s)
    power = float(left @ left)
    if not power > _LEFT**2 * float(s @ s):
        return []  # a free delay stands for it already
    # The residuals are s times the lateness, and fall by as much with a shift of that size.
    seconds = float(left @ r) / power
    sd = np.sqrt(_correlated(at, left, r) / power)
    if not seconds > _CLEAR * sd:
        return []
    brief = _looks_late(names, seconds)
    moved = _moved(at, e, pseudoinverse(J) @ s * seconds)
    return [_late(at, e, names, seconds, f"{brief} (sd {1e3 * sd:.2g} ms)", moved)]


def _looks_late(names: Sequence[str], seconds: float) -> str:
    verb = "look" if len(names) > 1 else "looks"
    return f"{' and '.join(names)} {verb} {1e3 * seconds:.2g} ms late"


def _late(
    at: Solution,
    e: Evaluation,
    names: tuple[str, ...],
    seconds: float,
    told: str,
    moved: Mapping[str, float],
) -> Finding:
    """Return the finding that the response comes earlier than these inputs have it."""
    words = (
        f"{told}: the response comes earlier than the model makes it. "
        f"fit.nuisance.time_shift: true would move {_by_percent(moved)}."
    )
    brief, criterion = _looks_late(names, seconds), f"seconds, {_CLEAR:g} sd"
    return Finding(LATE, "doubt", words, seconds, criterion, names, _in_units(at, e, moved), brief)


def _by_percent(moved: Mapping[str, float]) -> str:
    return ", ".join(f"{n} by about {100 * part:+.2g} %" for n, part in _largest(moved))


def _in_units(at: Solution, e: Evaluation, moved: Mapping[str, float]) -> dict[str, float]:
    values = dict(zip(at.layout.of_interest, np.asarray(e.named).tolist(), strict=True))
    return {n: part * values[n] for n, part in moved.items()}


def _correlated(at: Solution, left: np.ndarray, r: np.ndarray) -> float:
    """By how much more the sum of left times r varies than white rows let it; 1 at least.

    Args:
        at: says how long a sample is.
        left: (n,) what the rows are regressed on.
        r: (n,) the rows.
    """
    power = float(left @ left)
    own = left * (r - left * (float(left @ r) / power))
    count = max(1, round(_BLOCK / float(at.data.flights[0].dt)))
    # Rows that are not white tell less than as many that are.
    sums = np.add.reduceat(own, np.arange(0, own.size, count))
    return max(1.0, float(sums @ sums) / power)


class _Samples(NamedTuple):
    """The inputs that fit better at another time."""

    count: dict[str, int]
    """samples by which each has to come later, below zero earlier"""
    gain: float
    """of twice the log-likelihood"""
    there: Data
    """with all of them there"""

    @property
    def first(self) -> tuple[str, int]:
        """The input that is farthest from its time."""
        return max(self.count.items(), key=lambda item: abs(item[1]))


def _displaced(problem: Problem, at: Solution, e: Evaluation) -> _Samples | None:
    """The inputs with which the record is likelier some samples earlier or later."""
    layout, free = at.layout, set(problem.free)
    if not _in_time(at) or free & set(problem.model.delay_parameters):
        return None
    before, dt = _beside(e.J, e.r), float(at.data.flights[0].dt)
    farthest, count, most = max(1, round(_FARTHEST / dt)), {}, 0.0
    # Innovations forget within a few samples: between now and the right time none need be likelier.
    doubled = [2**k for k in range(farthest.bit_length())]
    begun = doubled if e.innovations else doubled[:1]

    def gained(data: Data) -> float:
        """Of twice the log-likelihood where the unknowns follow, and rows are as white as these."""
        there = residual_and_jacobian(layout, data, at.noise, at.z)
        rows, J = jax.device_get((there.r, there.J))
        if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(J))):
            return -np.inf
        left = _beside(J, rows)
        change = left - before
        gain = float(before @ before - left @ left)
        return gain / _correlated(at, change, before) if gain > 0 else gain

    for name in naming.names(layout.model.Inputs):
        if not any(np.ptp(f.inputs[name]) > 0 for f in problem.training):
            continue
        for sign in (-1, 1):
            gains = {k: gained(_shifted(at.data, (name,), sign * k * dt)) for k in begun}
            k = max(gains, key=lambda one: gains[one])
            best, k = gains[k], sign * k
            for step in (sign, -sign):
                while best > 0 and 0 < sign * (k + step) <= farthest:
                    gain = gained(_shifted(at.data, (name,), (k + step) * dt))
                    if not gain > best:
                        break
                    k, best = k + step, gain
            if best > _CLEAR**2:
                count[name], most = k, max(most, best)
    there = at.data
    for name, k in count.items():
        there = _shifted(there, (name,), k * dt)
    return _Samples(count, most, there) if count else None


def _beside(J: np.ndarray, v: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the part of v (n,) that no step of the unknowns, of slopes J (n, q), takes up."""
    Q = directions(J)
    return v - Q @ (Q.T @ v)


def _of_samples(at: Solution, e: Evaluation, samples: _Samples) -> Finding:
    """Return the finding of inputs at another time; one step of the unknowns makes its shifts."""
    _, k = samples.first
    names = tuple(n for n, other in samples.count.items() if other * k > 0)
    seconds = abs(k) * float(at.data.flights[0].dt)
    there = evaluate(at.layout, samples.there, at.noise, at.z)
    step = _step(there) - _step(e)
    moved = _moved(at, e, step)
    gain = f"twice the log-likelihood gains {samples.gain:.3g}"
    if k < 0:
        return _late(at, e, names, seconds, f"{_looks_late(names, seconds)} ({gain})", moved)
    brief = f"the response to {' and '.join(names)} comes {1e3 * seconds:.2g} ms later"
    words = (
        f"The response to {' and '.join(names)} comes about {1e3 * seconds:.2g} ms later than the "
        f"model makes it ({gain}): a delay or a lag (a servo, a filter) is missing. It would move "
        f"{_by_percent(moved)}."
    )
    shifts = _in_units(at, e, moved)
    return Finding(LAG, "doubt", words, seconds, "seconds", names, shifts, brief)


def _step(e: Evaluation) -> Float[np.ndarray, " q"]:
    return -pseudoinverse(np.asarray(e.J)) @ np.asarray(e.r)


def _freed(problem: Problem, value: float, sd: float | None) -> list[Finding]:
    """A free shift [s] that says that inputs in steps acted before they were logged."""
    names = _stepped(problem.training)
    if not names or not sd or not -value > _CLEAR * sd:
        return []
    words = (
        f"{', '.join(names)} acted {-1e3 * value:.2g} ms before it was logged: a step stands at "
        "the stamp after it. The shift makes up for the mean of that; each step was late by a time "
        "of its own, for which no interval allows."
    )
    return [Finding("timing.steps-between-stamps", "note", words, -value, "seconds", names)]


def slow_sticks(
    problem: Problem, at: Solution, e: Evaluation, *, skip: Collection[str] = ()
) -> list[Finding]:
    """A doubt where half a sample of an input that was commanded in steps moves a parameter far.

    Args:
        problem: what is to be fitted.
        at: the start values.
        e: the evaluation there.
        skip: parameters that the data do not determine.
    """
    periods = _periods(problem.training)
    if not periods or not np.all(np.isfinite(e.J)):
        return []
    slope = _by_shift(problem, at, tuple(periods))
    if slope is None:
        return []
    longest = max(periods.values())
    change = pseudoinverse(np.asarray(e.J)) @ slope[1] * (0.5 * longest)
    moved = {n: one for n, one in _moved(at, e, change).items() if n not in skip}
    # What is late makes an estimate wrong by as much as a shift would have to take back.
    most = max((abs(part) for part in moved.values()), default=0.0)
    if most < _LARGE:
        return []
    each = [f"{n} by about {-100 * part:+.2g} %" for n, part in _largest(moved)]
    words = (
        f"{', '.join(periods)} moves in steps and was sampled at {1 / longest:.3g} Hz: a step "
        f"stands at the sample after it, up to {1e3 * longest:.2g} ms late. Half of that moves "
        f"{', '.join(each)}, beside which intervals say little: log it faster; "
        "fit.nuisance.time_shift: true makes up for the mean of it."
    )
    criterion = f"part of a parameter that half a sample of the stick moves, {_LARGE:g}"
    return [Finding("timing.slow-stick", "doubt", words, most, criterion)]


def _largest(moved: Mapping[str, float]) -> list[tuple[str, float]]:
    """Those that move most, and none that stay where they are but for rounding."""
    first, *others = sorted(moved.items(), key=lambda item: -abs(item[1]))[:_MOST]
    return [first, *(item for item in others if abs(item[1]) >= _SEEN)]


def _stepped(flights: Sequence[Flight]) -> tuple[str, ...]:
    """The inputs that move in steps in their logs."""
    names = [
        n
        for f in flights
        for n, u in f.inputs.items()
        if np.ptp(u) > 0 and f.hold[n] == "zero-order" and n in f.hold_reason
    ]
    return tuple(dict.fromkeys(names))


def _periods(flights: Sequence[Flight]) -> dict[str, float]:
    """By input that moves in steps the time between its samples as they were logged [s]."""
    longest: dict[str, float] = {}
    for name in _stepped(flights):
        usual = [f.facts[name, "input"].usual for f in flights if name in f.inputs]
        longest[name] = max(usual)
    return longest


def _by_shift(
    problem: Problem, at: Solution, names: Sequence[str] | None = None
) -> tuple[tuple[str, ...], Float[np.ndarray, " n"]] | None:
    """The inputs that move, and the derivative (n,) of the rows by how much later they come [1/s];
    None where a shift is free, or makes no sense."""
    layout, flights = at.layout, problem.training
    if not _in_time(at):
        return None
    moving = tuple(
        n
        for n in naming.names(layout.model.Inputs)
        # Whoever simulates an input knows when it acted.
        if any(np.ptp(f.inputs[n]) > 0 and (f.source or n in f.hold_reason) for f in flights)
        and not any(is_low_passed(f, n) for f in flights)
        and (names is None or n in names)
    )
    # The mean of two samples is another value where an input acts on an output at once.
    if not moving or feeds_through(problem):
        return None
    by = 0.5 * min(float(f.dt) for f in at.data.flights)
    both = [evaluate(layout, _shifted(at.data, moving, s * by), at.noise, at.z) for s in (1, -1)]
    # Both ways, so that what the means smooth is the same in both.
    s = (np.asarray(both[0].r) - np.asarray(both[1].r)) / (2.0 * by)
    return (moving, s) if np.all(np.isfinite(s)) and np.any(s) else None


def _in_time(at: Solution) -> bool:
    """True if rows are samples in time that inputs move, and no free shift moves the inputs."""
    layout = at.layout
    spectral = layout.estimator.noise_spectrum
    return not (is_kinematic(layout.model) or layout.shift or spectral)


def _shifted(data: Data, names: Collection[str], seconds: float) -> Data:
    """The inputs of these names later by so much, or earlier; between samples their mean."""
    flights = []
    for flight in data.flights:
        inputs = naming.asdict(flight.inputs)
        for n in inputs.keys() & set(names):
            # By NumPy: each step of it would be a program of JAX's to load.
            u = np.asarray(inputs[n])
            t = np.arange(u.size, dtype=u.dtype)
            moved = np.interp(t - seconds / float(flight.dt), t, u).astype(u.dtype)
            inputs[n] = jax.device_put(moved)
        flights.append(flight._replace(inputs=type(flight.inputs)(**inputs)))
    return data._replace(flights=tuple(flights))


def _moved(at: Solution, e: Evaluation, step: np.ndarray) -> dict[str, float]:
    """By parameter what a step of the unknowns (q,) does to it, as a part of its value."""
    values, slopes = np.asarray(e.named), np.asarray(e.slopes)
    return {
        name: float(step[k] * slopes[k] / values[k])
        for k, name in enumerate(at.layout.of_interest)
        if name in at.layout.free and name not in at.layout.disturbance and values[k]
    }
