"""Signals that stand in a log at another time than they acted: three tests.

- `leads`: no vehicle responds before its input. Where the past of an output and of all inputs
  leaves something of the output unexplained that an input's future explains, that input is logged
  late, or it follows the output (C. A. Sims, Money, income, and causality, Am. Econ. Rev. 62,
  1972). It needs no model.
- `late_angles`: an angle is the integral of its rate. Where the two fit together once one of them
  is moved in time, it is logged late.
- `input_shift`: the likelihood of a fitted model with each input earlier or later by whole samples,
  and between them by its slope (a score test, Rao, 1948). An input that follows the response knows
  the errors of later samples, but takes them back: used too early it predicts them with the wrong
  sign, so that the test holds in a closed loop too.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.filters import states_behind
from heli_jax.flights.align import NotAligned, correlations, other_peak
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import is_low_passed
from heli_jax.identification.estimation.evaluation import (
    Evaluation,
    directions,
    evaluate,
    pseudoinverse,
)
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Solution
from heli_jax.identification.validation.metrics import autocorrelation
from heli_jax.identification.validation.other_hold import feeds_through
from heli_jax.identification.validation.signal_signs import (
    PARTS,
    WITHIN,
    integral,
    over_gaps,
    rates_and_angles,
)

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
    """By flight and input the surest lead of an output."""
    surest: dict[tuple[str, str], Lead] = {}
    for label, flight in flights:
        for output, y in flight.outputs.items():
            led = led_by(y, flight.inputs, flight.dt)
            if led is not None:
                share, seconds, name = led
                lead = Lead(label, name, output, share, seconds)
                surest[label, name] = max(surest.get((label, name), lead), lead, key=_share)
    return list(surest.values())


def _share(lead: Lead) -> float:
    return lead.share


def led_by(
    y: Float[np.ndarray, " N"], inputs: Mapping[str, Float[np.ndarray, " N"]], dt: float
) -> tuple[float, float, str] | None:
    """Of the input whose future explains most of an output what it explains of what the past leaves
    (0 to 1), by how much the output precedes it [s], and its name; None where none is.

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
    # By as much as that input has to be moved ahead until its future tells no more.
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
    """Part of what the past of all leaves of an output that an input's future explains, less what
    as many numbers explain of noise; 0 where chance makes as much."""
    lags = max(2, round(LEAD.seconds / step))
    first, last = max(lags, LEAD.own), y.size - lags
    regressors = LEAD.own + len(drives) * (lags + 1) + lags
    if last - first < LEAD.fewest * regressors:
        return 0.0

    def column(x: np.ndarray, k: int) -> np.ndarray:
        return x[first - k : last - k]

    past = [column(y, k) for k in range(1, LEAD.own + 1)] + [np.ones(last - first)]
    past += [column(u, k) for u in drives.values() for k in range(lags + 1)]
    # A step within a mean is told in full by the next one: that is no lead yet.
    past += [column(u, -1) for u in drives.values()]
    known = _basis(np.stack(past, axis=1))
    future = np.stack([column(drives[name], -k) for k in range(2, lags + 1)], axis=1)
    size = float(np.linalg.norm(future - future.mean(axis=0), axis=0).max())
    new = _basis(future - known @ (known.T @ future), size)
    rest = column(y, 0) - known @ (known.T @ column(y, 0))
    freedom = rest.size - known.shape[1] - new.shape[1]
    power = float(rest @ rest)
    if not (new.shape[1] and power > 0):
        return 0.0
    share = min(float(np.sum((new.T @ rest) ** 2)) / power, 1.0)
    F = share / new.shape[1] / max((1.0 - share) / freedom, 1e-300)
    if scipy.special.fdtrc(new.shape[1], freedom, F) > LEAD.chance:
        return 0.0
    return max(0.0, 1.0 - (1.0 - share) * (freedom + new.shape[1]) / freedom)


def _basis(X: np.ndarray, size: float | None = None) -> np.ndarray:
    """Orthonormal columns (N, rank) that span those of X (N, m); of the columns' own size, or of
    `size`, what is rounding is left out."""
    norms = np.linalg.norm(X, axis=0) if size is None else np.full(X.shape[1], size)
    scaled = X / np.maximum(norms, 1e-300)
    parts: Any = scipy.linalg.qr(scaled, mode="economic", pivoting=True)
    Q, R = parts[:2]
    values = np.abs(np.diag(R))
    return Q[:, values > (1e-8 * values[0] if size is None else 1e-6)]


# Angles that are logged later than their rates, or earlier.


@dataclass(frozen=True)
class _AngleLimits:
    most: float = 5.0
    """[s] over which a delay is looked for, to either side"""
    part: float = 0.25
    """of the record, likewise"""
    usual: float = 0.3
    """[s] to either side: a longer delay has to explain far more, since a motion that nearly
    repeats itself fits nearly as well one swing later"""
    step: float = 0.01
    """[s]; samples that come faster tell no more of a delay"""
    least: float = 0.02
    """[s], or a sample, below which a delay does not matter"""
    sure: float = 4.0
    """times its standard deviation, for a delay"""
    alike: float = 0.9
    """correlation of angle and integral, once moved, from which on they are one motion"""
    explained: float = 0.25
    """part of what the two differ by that the delay has to explain: rotation about other axes makes
    differences too, and no delay takes them away"""
    far_explained: float = 0.75
    """the same of a delay that is longer than usual"""
    nearly: float = 2.0
    """times the unexplained part of the best delay, up to which another explains nearly as well"""
    blocks: int = 20
    """parts of a record by whose spread the standard deviation of a delay is told"""


ANGLE = _AngleLimits()


class Lateness(NamedTuple):
    """By how much an angle is later than its rate."""

    late: float
    """[s]"""
    sd: float
    """[s]"""
    other: float | None = None
    """[s] that explains the two nearly as well, since the motion repeats itself"""

    def matters(self, dt: float) -> bool:
        """Whether it is surely more than a sample of `dt` [s]."""
        return abs(self.late) > max(ANGLE.least, dt, ANGLE.sure * self.sd)


def late_angles(
    model: Model, flights: Sequence[tuple[str, Flight]]
) -> list[tuple[str, str, str, Lateness]]:
    """By flight, rate and angle how much later the angle is, where that matters and the model has
    no filter and no delay behind either.
    """
    known = {n.rsplit("_filter", 1)[0].rsplit("_late", 1)[0] for n in states_behind(model)}
    known |= dict(model.delay_lines).keys()
    late = []
    for label, flight in flights:
        for rate, angle in rates_and_angles(model):
            if {rate, angle} <= flight.outputs.keys() - known:
                one = lateness(flight.outputs[angle], flight.outputs[rate], flight.dt)
                if one is not None and one.matters(flight.dt):
                    late.append((label, rate, angle, one))
    return late


def lateness(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> Lateness | None:
    """By how much an angle is later than its rate; None where the two do not fit together once
    moved, or hardly better than before.

    Args:
        angle: [rad], NaN where missing.
        rate: [rad/s], likewise.
        dt: [s].
    """
    if min(np.count_nonzero(np.isfinite(x)) for x in (angle, rate)) < 2:
        return None
    every = max(1, int(ANGLE.step / dt))
    whole, seen = over_gaps(angle, dt)
    # Headings jump by a turn where they pass south.
    turned, seen = np.unwrap(whole)[::every], seen[::every]
    rates, rate_seen = over_gaps(rate, dt)
    turn, lost = integral(rates, dt)[::every], np.cumsum(~rate_seen)[::every]
    dt *= every
    steps = max(1, round(WITHIN / dt))
    if turned.size < (PARTS + 1) * steps:
        return None
    angle_changes = np.where(seen[steps:] & seen[:-steps], turned[steps:] - turned[:-steps], np.nan)
    turns = np.where(lost[steps:] == lost[:-steps], turn[steps:] - turn[:-steps], np.nan)
    if min(np.count_nonzero(np.isfinite(x)) for x in (angle_changes, turns)) < PARTS * steps:
        return None
    coarse = _coarse(angle_changes, turns, dt)
    if coarse is None:
        return None
    late, other = coarse
    # Samples whose integral is there whatever the delay that is tried from here on.
    spare = int(np.ceil(ANGLE.usual / dt))
    begin = max(0, round(late / dt)) + spare
    end = turned.size - steps - 1 - max(0, round(-late / dt)) - spare
    rows = np.arange(begin, max(begin, end))
    # One sample more to either side, as far as the delay is followed.
    moved_back = rows - round(late / dt)
    rows = rows[
        np.isfinite(angle_changes[rows]) & (lost[moved_back + steps + 1] == lost[moved_back - 1])
    ]
    if rows.size < (PARTS - 2) * steps:
        return None
    changes = angle_changes[rows]

    def moved(late: float) -> np.ndarray:
        """The integral's changes and their slope (K, 2), so much later."""
        at = rows - late / dt
        ends = [np.interp(at + k, np.arange(turn.size), turn) for k in (0.0, steps)]
        slopes = np.gradient(turn, dt)
        rising = [np.interp(at + k, np.arange(turn.size), slopes) for k in (0.0, steps)]
        return np.stack([ends[1] - ends[0], rising[1] - rising[0]], axis=1)

    def left(late: float) -> float:
        return _unexplained(changes, moved(late)[:, 0])

    # Gauss and Newton's steps from there, as far as the next sample.
    for _ in range(3):
        step = _step(changes, moved(late))
        if step is None or not abs(step) < dt:
            break
        late += step
    after, before = left(late), left(0.0)
    explained = ANGLE.explained if abs(late) < ANGLE.usual else ANGLE.far_explained
    if after > 1.0 - ANGLE.alike**2 or after > (1.0 - explained) * before:
        return None
    return Lateness(late, _spread(changes, moved(late)), other)


def _coarse(y: np.ndarray, x: np.ndarray, dt: float) -> tuple[float, float | None] | None:
    """By how much the angle's changes y (n,) are later than the integral's x (n,), to a sample, and
    another delay [s] that explains them nearly as well; None where none explains them."""
    try:
        r = correlations(y, x)
    except NotAligned:
        return None
    shifts = np.arange(-(x.size - 1), y.size)
    most = int(min(ANGLE.most, ANGLE.part * x.size * dt) / dt)
    inside = np.abs(shifts) <= max(most, int(ANGLE.usual / dt))
    shifts, r = shifts[inside], r[inside]
    best = int(np.argmax(r))
    usual = np.flatnonzero(np.abs(shifts) * dt <= ANGLE.usual)
    near = int(usual[np.argmax(r[usual])])
    left = 1.0 - np.maximum(r, 0.0) ** 2
    # A swing later all looks much the same: what explains nearly as much nearby goes before.
    if (
        left[best] > (1.0 - ANGLE.far_explained) * left[near]
        or left[near] < ANGLE.nearly * left[best]
    ):
        best = near
    if r[best] < ANGLE.alike - 0.1:
        return None
    late, rival = float(shifts[best]) * dt, other_peak(r, best)
    if rival is not None and left[rival] <= ANGLE.nearly * left[best]:
        return late, float(shifts[rival]) * dt
    if best == near:
        return late, None
    # Few long swings go together at some delay whatever they are (Bartlett, 1935).
    lags, pairs = max(1, y.size // 5), np.count_nonzero(np.isfinite(y))
    window = 1.0 - np.arange(lags + 1) / (lags + 1)
    both = window * autocorrelation(y, lags) * autocorrelation(x, lags)
    chance = float(np.sqrt(max(both[0] + 2.0 * both[1:].sum(), 1e-12) / pairs))
    return None if r[best] < ANGLE.sure * chance else (late, None)


def _unexplained(y: np.ndarray, x: np.ndarray) -> float:
    """Part of the variance of y (K,) that x (K,) leaves."""
    if not (np.std(y) > 0 and np.std(x) > 0):
        return 1.0
    return 1.0 - float(np.corrcoef(y, x)[0, 1]) ** 2


def _step(y: np.ndarray, X: np.ndarray) -> float | None:
    """How much later x has to be for y = size x(t - step), of x and its slope (K, 2)."""
    A = np.column_stack([X, np.ones(y.size)])
    size, slope, _ = np.linalg.lstsq(A, y, rcond=None)[0]
    return -float(slope / size) if size > 0 else None


def _spread(y: np.ndarray, X: np.ndarray) -> float:
    """Standard deviation of the delay by leaving out parts of the record one by one (jackknife):
    what angle and integral differ by is no white noise."""
    parts = np.array_split(np.arange(y.size), ANGLE.blocks)
    steps = [_step(np.delete(y, part), np.delete(X, part, axis=0)) for part in parts]
    known = np.array([s for s in steps if s is not None])
    if known.size < ANGLE.blocks:
        return float("inf")
    return float(np.sqrt((ANGLE.blocks - 1) * np.mean((known - known.mean()) ** 2)))


# Inputs with which the fitted model explains the record better at another time.


@dataclass(frozen=True)
class _ShiftLimits:
    clear: float = 5.0
    """sds from zero, from which on a shift is clear; of twice the log-likelihood the square"""
    farthest: float = 0.5
    """[s] that an input is moved at most"""
    block: float = 1.0
    """[s] over which rows may be correlated"""


SHIFT = _ShiftLimits()


class Shift(NamedTuple):
    """Inputs that fit better at another time."""

    inputs: tuple[str, ...]
    late: float
    """[s] by which the log has the first of them too late; below zero the response comes later than
    the model makes it"""
    gain: float
    """of twice the log-likelihood"""
    moved: dict[str, float]
    """by parameter how far the right time would move its estimate [SI]"""


def input_shift(problem: Problem, at: Solution, e: Evaluation) -> Shift | None:
    """The inputs that the record places at another time; None where none is clear, where inputs are
    shifted or delayed by an unknown already, or where rows are no samples in time.
    """
    if not _in_time(at) or set(problem.free) & set(problem.model.delay_parameters):
        return None
    found = {n: _best_place(problem, at, e, n) for n in _moving(problem)}
    found = {n: one for n, one in found.items() if one[1] > SHIFT.clear**2}
    if not found:
        return None
    dt, there = float(at.data.flights[0].dt), at.data
    for name, (place, _) in found.items():
        there = _shifted(there, (name,), place * dt)
    first = max((place for place, _ in found.values()), key=abs)
    moved = _next_step(evaluate(at.layout, there, at.noise, at.z)) - _next_step(e)
    names = tuple(n for n, (place, _) in found.items() if place * first > 0)
    gain = max(one for _, one in found.values())
    return Shift(names, -first * dt, gain, _in_units(at, e, moved))


def _best_place(problem: Problem, at: Solution, e: Evaluation, name: str) -> tuple[float, float]:
    """By how many samples an input has to come later to fit best (below zero: earlier), and what
    twice the log-likelihood gains there."""
    dt = float(at.data.flights[0].dt)
    left = {0: _beside(e.J, e.r)}
    gains = {0: 0.0}

    def gained(k: int) -> float:
        """Where the unknowns follow, and rows are as white as these."""
        if k not in gains:
            data = _shifted(at.data, (name,), k * dt)
            there = residual_and_jacobian(at.layout, data, at.noise, at.z)
            rows, J = jax.device_get((there.r, there.J))
            gains[k] = -np.inf
            if np.all(np.isfinite(rows)) and np.all(np.isfinite(J)):
                left[k] = _beside(J, rows)
                gain = float(left[0] @ left[0] - left[k] @ left[k])
                gains[k] = gain / _correlated(dt, left[k] - left[0], left[0]) if gain > 0 else gain
        return gains[k]

    farthest = max(1, round(SHIFT.farthest / dt))
    # Innovations forget within a few samples: between now and the right time none need be likelier.
    begun = [2**k for k in range(farthest.bit_length())] if e.innovations else [1]
    place = max((0, *begun, *(-k for k in begun)), key=gained)
    for step in (1, -1):
        while place and abs(place + step) <= farthest and gained(place + step) > gained(place):
            place += step
    if place > 0 or not (place + 1 in left and place - 1 in left and _is_logged(problem, name)):
        return float(place), gains[place]
    # A logger stamps a step at the sample after it: within a sample the slope tells by how much.
    slope, rest = 0.5 * (left[place + 1] - left[place - 1]), left[place]
    within = float(slope @ rest) / max(float(slope @ slope), 1e-300)
    if not (abs(within) <= 1.0 and within > place):
        return float(place), gains[place]
    gain = within**2 * float(slope @ slope) / _correlated(dt, slope, rest)
    return place - within, gains[place] + gain


def _beside(J: np.ndarray, v: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the part of v (n,) that no step of the unknowns, of slopes J (n, q), takes up."""
    Q = directions(J)
    return v - Q @ (Q.T @ v)


def _correlated(dt: float, left: np.ndarray, r: np.ndarray) -> float:
    """By how much more the sum of left times r varies than white rows let it; 1 at least.

    Args:
        dt: of a sample [s].
        left: (n,) what the rows are regressed on.
        r: (n,) the rows.
    """
    power = max(float(left @ left), 1e-300)
    own = left * (r - left * (float(left @ r) / power))
    # Rows that are not white tell less than as many that are.
    sums = np.add.reduceat(own, np.arange(0, own.size, max(1, round(SHIFT.block / dt))))
    return max(1.0, float(sums @ sums) / power)


def _moving(problem: Problem) -> list[str]:
    names = naming.names(problem.model.Inputs)
    return [n for n in names if any(np.ptp(f.inputs[n]) > 0 for f in problem.training)]


def _is_logged(problem: Problem, name: str) -> bool:
    """True for an input as a log has it, whose time within a sample nobody knows."""
    logged = any(f.source or name in f.hold_reason for f in problem.training)
    filtered = any(is_low_passed(f, name) for f in problem.training)
    # The mean of two samples is another value where an input acts on an output at once.
    return logged and not filtered and not feeds_through(problem)


def _in_time(at: Solution) -> bool:
    """True if rows are samples in time that inputs move, and no free shift moves the inputs."""
    layout = at.layout
    spectral = layout.noise_model == "spectrum"
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


def _next_step(e: Evaluation) -> Float[np.ndarray, " q"]:
    return -pseudoinverse(np.asarray(e.J)) @ np.asarray(e.r)


def _in_units(at: Solution, e: Evaluation, step: np.ndarray) -> dict[str, float]:
    """By parameter what a step of the unknowns (q,) does to it [SI]."""
    return {
        name: float(step[k] * slope)
        for k, (name, slope) in enumerate(zip(at.layout.of_interest, e.slopes, strict=True))
        if name in at.layout.free and name not in at.layout.disturbance
    }


def late_steps(problem: Problem, at: Solution, e: Evaluation) -> tuple[float, dict[str, float]]:
    """The longest time between samples [s] of inputs that move in steps in their logs, and by
    parameter how far half of it moves the estimate [SI]; (0, {}) where there is none.
    """
    names = [n for n in stepped(problem.training) if _is_logged(problem, n)]
    if not (names and _in_time(at) and np.all(np.isfinite(e.J))):
        return 0.0, {}
    longest = max(
        f.facts[n, "input"].usual for f in problem.training for n in names if n in f.inputs
    )
    dt = min(float(f.dt) for f in at.data.flights)
    later, earlier = (
        np.asarray(evaluate(at.layout, _shifted(at.data, names, s * dt), at.noise, at.z).r)
        for s in (1, -1)
    )
    change = -pseudoinverse(np.asarray(e.J)) @ (later - earlier) / (2.0 * dt) * 0.5 * longest
    return longest, _in_units(at, e, change) if np.all(np.isfinite(change)) else {}


def stepped(flights: Sequence[Flight]) -> tuple[str, ...]:
    """The inputs that move in steps in their logs."""
    names = [
        n
        for f in flights
        for n, u in f.inputs.items()
        if np.ptp(u) > 0 and f.hold[n] == "zero-order" and n in f.hold_reason
    ]
    return tuple(dict.fromkeys(names))
