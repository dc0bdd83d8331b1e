"""Inputs that are logged later than the machine answered them.

No machine answers before its input. Where the past of an output and of all inputs leaves something
of the output unexplained that an input's future explains, that input is logged late, or it follows
the output (C. A. Sims, Money, income, and causality, Am. Econ. Rev. 62, 1972).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.filters import states_behind
from heli_jax.finding import Finding
from heli_jax.flights.align import NotAligned, correlations, other_peak
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.identification.validation.metrics import autocorrelation
from heli_jax.identification.validation.signal_signs import (
    PARTS,
    WITHIN,
    integral,
    over_gaps,
    rates_and_angles,
)
from heli_jax.numbers import percent

LATE = "timing.late-input"
"""the topic of such a finding"""
_RATE = 50.0
"""[Hz] to which logs are averaged, so that the verdict is the same at any rate of the log: samples
that come faster each tell less"""
_SECONDS = 0.4
"""past and future of an input that are looked at"""
_OWN = 6
"""past samples of the output that foretell it"""
_FEWEST = 10
"""samples for each regressor"""
_CLEAR = 0.1
"""part of what the past does not foretell of an output that an input's future explains, from which
on it is spoken of"""
_BY_CHANCE = 1e-6
"""probability of as much by chance, at most"""


def late_inputs(
    flights: Sequence[tuple[str, Flight]], feedback: Sequence[Feedback]
) -> list[Finding]:
    """A doubt for each input that an output precedes; by flight the surest output alone.

    Args:
        flights: by what each is called.
        feedback: inputs that follow the response, of which it is said that they may be late.
    """
    said = {(one.flight, one.input) for one in feedback if one.present}
    findings = []
    for label, flight in flights:
        surest: dict[str, tuple[float, float, str]] = {}
        for output, y in flight.outputs.items():
            led = led_by(y, flight.inputs, flight.dt)
            if led is not None and (label, led[2]) not in said:
                share, lead, name = led
                surest[name] = max(surest.get(name, (0.0, 0.0, "")), (share, lead, output))
        findings += [_finding(label, name, *one) for name, one in surest.items()]
    return findings


def led_by(
    y: Float[np.ndarray, " N"], inputs: Mapping[str, Float[np.ndarray, " N"]], dt: float
) -> tuple[float, float, str] | None:
    """Of the input whose future explains most of an output what it explains of what the past leaves
    (0 to 1), by how much the output precedes it [s], and its name; None where none is.

    Args:
        y: the output, NaN where nothing is measured.
        inputs: by name, any unit.
        dt: [s].
    """
    moving = {n: u for n, u in inputs.items() if np.isfinite(u).all() and np.ptp(u) > 0}
    if not moving or not np.isfinite(y).all() or not np.ptp(y) > 0:
        return None
    count = max(1, round(1.0 / (_RATE * dt)))
    step = count * dt
    slow, drives = _averaged(y, count), {n: _averaged(u, count) for n, u in moving.items()}
    shares = {n: _of_future(slow, drives, n, step) for n in drives}
    name, share = max(shares.items(), key=lambda item: item[1])
    if share < _CLEAR:
        return None
    # By as much as that input has to be moved ahead until its future tells no more.
    most = max(1, round(_SECONDS / step))
    for k in range(1, most + 1):
        ahead = {n: u[k:] if n == name else u[: u.size - k] for n, u in drives.items()}
        if _of_future(slow[: slow.size - k], ahead, name, step) < _CLEAR:
            return share, k * step, name
    return share, most * step, name


def _averaged(x: np.ndarray, count: int) -> np.ndarray:
    """Means (N // count,) of so many samples."""
    size = x.size // count
    return x[: size * count].reshape(size, count).mean(axis=1)


def _of_future(y: np.ndarray, drives: Mapping[str, np.ndarray], name: str, step: float) -> float:
    """Part of what the past of all leaves of an output that an input's future explains, less what
    as many numbers explain of noise; 0 where chance makes as much."""
    lags = max(2, round(_SECONDS / step))
    first, last = max(lags, _OWN), y.size - lags
    regressors = _OWN + len(drives) * (lags + 1) + lags
    if last - first < _FEWEST * regressors:
        return 0.0

    def column(x: np.ndarray, k: int) -> np.ndarray:
        return x[first - k : last - k]

    past = [column(y, k) for k in range(1, _OWN + 1)] + [np.ones(last - first)]
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
    if scipy.special.fdtrc(new.shape[1], freedom, F) > _BY_CHANCE:
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


def _finding(label: str, name: str, share: float, lead: float, output: str) -> Finding:
    words = (
        f"{label}: {output} moves {lead:.2g} s or more before {name} does (what {name} does later "
        f"explains {percent(share, 0)} of what the past leaves of {output}): {name} is logged late "
        "(free a delay: fit.nuisance.time_shift, or delays of the model) or follows the response "
        "(feedback)."
    )
    criterion = f"part of what the past leaves that the later input explains, {_CLEAR:g}"
    return Finding(LATE, "doubt", words, share, criterion)


# Angles that are logged later than their rates, or earlier.
#
# An angle is the integral of its rate. Where the two fit together once one of them is moved in
# time, it is logged late, and a fit of both takes the delay for the machine's.


_MOST, _PART = 5.0, 0.25
"""[s], and part of the record, over which a delay is looked for, to either side"""
_USUAL = 0.3
"""[s] to either side: a longer delay has to explain far more, since a motion that nearly repeats
itself fits nearly as well one swing later"""
_STEP = 0.01
"""[s]; samples that come faster tell no more of a delay"""
_LEAST = 0.02
"""[s], or a sample, below which a delay is not spoken of"""
_SURE = 4.0
"""times its standard deviation, for a delay"""
_ALIKE = 0.9
"""correlation of angle and integral, once moved, from which on they are one motion"""
_EXPLAINED = 0.25
"""part of what the two differ by that the delay has to explain: rotation about other axes makes
differences too, and no delay takes them away"""
_FAR_EXPLAINED = 0.75
"""the same of a delay that is longer than usual"""
_NEARLY = 2.0
"""times the unexplained part of the best delay, up to which another explains nearly as well"""
_BLOCKS = 20
"""parts of a record by whose spread the standard deviation of a delay is told"""


def late_angles(problem: Problem) -> list[Finding]:
    """A doubt for each angle that moves later or earlier than the integral of its rate, where the
    model has no filter and no delay behind either.

    Args:
        problem: the flights that are fitted, and the model, whose axes name rates and angles.
    """
    known = _behind_devices(problem.model)
    pairs = [(r, a) for r, a in rates_and_angles(problem.model) if not known & {r, a}]
    findings = []
    for label, flight in zip(labels(problem.training), problem.training, strict=True):
        for rate, angle in pairs:
            if rate in flight.outputs and angle in flight.outputs:
                late = lateness(flight.outputs[angle], flight.outputs[rate], flight.dt)
                if late is not None and late.matters(flight.dt):
                    findings.append(_late_angle(label, rate, angle, late))
    return findings


def _behind_devices(model: Model) -> set[str]:
    """The outputs behind a filter or a delay that the model knows."""
    behind = {n.rsplit("_filter", 1)[0].rsplit("_late", 1)[0] for n in states_behind(model)}
    return behind | dict(model.delay_lines).keys()


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
        return abs(self.late) > max(_LEAST, dt, _SURE * self.sd)


def _late_angle(label: str, rate: str, angle: str, lateness: Lateness) -> Finding:
    late = lateness.late
    first, second = (angle, rate) if late > 0 else (rate, angle)
    criterion = f"delay of the angle against its integrated rate [s], {_LEAST:g}"
    if lateness.other is not None:
        words = (
            f"{label}: {angle} and {rate} go together only where one of them is moved in time, and "
            f"the motion repeats itself: {angle} is logged {late:.2g} s or {lateness.other:.2g} s "
            f"later than {rate} (negative: earlier). State the delay if it is known, or leave one "
            "of the two out."
        )
        return Finding("timing.late-output", "doubt", words, late, criterion)
    words = (
        f"{label}: {first} is logged {abs(late):.2g} s later than {second}, with which it goes "
        f"together then (sd {lateness.sd:.1g} s): a fit of both takes that for the machine's; "
        f"state it ({first}: {{delay: {abs(late):.2g}}}), or leave one of the two out."
    )
    return Finding("timing.late-output", "doubt", words, late, criterion)


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
    every = max(1, int(_STEP / dt))
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
    spare = int(np.ceil(_USUAL / dt))
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
    explained = _EXPLAINED if abs(late) < _USUAL else _FAR_EXPLAINED
    if after > 1.0 - _ALIKE**2 or after > (1.0 - explained) * before:
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
    most = int(min(_MOST, _PART * x.size * dt) / dt)
    inside = np.abs(shifts) <= max(most, int(_USUAL / dt))
    shifts, r = shifts[inside], r[inside]
    best = int(np.argmax(r))
    usual = np.flatnonzero(np.abs(shifts) * dt <= _USUAL)
    near = int(usual[np.argmax(r[usual])])
    left = 1.0 - np.maximum(r, 0.0) ** 2
    # A swing later all looks much the same: what explains nearly as much nearby goes before.
    if left[best] > (1.0 - _FAR_EXPLAINED) * left[near] or left[near] < _NEARLY * left[best]:
        best = near
    if r[best] < _ALIKE - 0.1:
        return None
    late, rival = float(shifts[best]) * dt, other_peak(r, best)
    if rival is not None and left[rival] <= _NEARLY * left[best]:
        return late, float(shifts[rival]) * dt
    if best == near:
        return late, None
    # Few long swings go together at some delay whatever they are (Bartlett, 1935).
    lags, pairs = max(1, y.size // 5), np.count_nonzero(np.isfinite(y))
    window = 1.0 - np.arange(lags + 1) / (lags + 1)
    both = window * autocorrelation(y, lags) * autocorrelation(x, lags)
    chance = float(np.sqrt(max(both[0] + 2.0 * both[1:].sum(), 1e-12) / pairs))
    return None if r[best] < _SURE * chance else (late, None)


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
    parts = np.array_split(np.arange(y.size), _BLOCKS)
    steps = [_step(np.delete(y, part), np.delete(X, part, axis=0)) for part in parts]
    known = np.array([s for s in steps if s is not None])
    if known.size < _BLOCKS:
        return float("inf")
    return float(np.sqrt((_BLOCKS - 1) * np.mean((known - known.mean()) ** 2)))
