"""Unmodelled dynamics in the residuals: a mode, a response that depends on amplitude, or one that
changes over the record.

The residual in time of each output is tested (`score_test`) against

- the inputs through a bank of filters: a missing mode or lag;
- nonlinear functions of the inputs and of the simulated output, beyond the inputs through the same
  filter: saturation, rate limit, deadband, play, friction, a nonlinear spring, drag, asymmetry;
- the sensitivities times the time, and those of single flights: parameters that change.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from heli_jax import naming
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.identification.estimation.evaluation import Evaluation, simulated_outputs
from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.estimation.simulated_flights import signals
from heli_jax.identification.unknowns.layout import Solution, flight_places
from heli_jax.identification.validation.score_test import (
    BROAD,
    NARROW,
    Drive,
    Lines,
    Strongest,
    lines_of,
    pulled_away,
    step_to_least,
    strongest,
)

# Outputs that are sampled more slowly than the grid.


_REGULAR = 0.98
"""least share of the steps between samples that have the usual length"""
_MOST = 50
"""largest number of grid steps between two samples"""
_JITTERS = 5
"""grid steps between two samples, from which on they may fall one step sooner or later"""


class OwnSamples(NamedTuple):
    """Rows of the grid at which an output was sampled, at even times."""

    rows: np.ndarray
    """(M,)"""
    every: int
    """grid steps from one to the next"""

    @property
    def holes(self) -> tuple[int, ...]:
        """Return the places in `rows` before which a sample is missing."""
        apart = np.diff(self.rows)
        return tuple((np.flatnonzero(apart > self.every + (self.every >= _JITTERS)) + 1).tolist())

    def of_input(self, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " M"]:
        """Return the mean of an input (N,) from one sample to the next."""
        summed = np.concatenate([[0.0], np.cumsum(u)])
        # An input acts from its own sample on: that at the output's sample moves the next one.
        first = np.maximum(self.rows + 1 - self.every, 0)
        return (summed[self.rows + 1] - summed[first]) / (self.rows + 1 - first)


def own_samples(seen: Bool[np.ndarray, " N"]) -> OwnSamples | None:
    """Return the samples of an output; None if they are not at even times."""
    rows = np.flatnonzero(seen)
    if rows.size == seen.size:
        return OwnSamples(rows, 1)
    if rows.size < 2:
        return None
    steps = np.diff(rows)
    usual = int(np.median(steps))
    # A clock that is no multiple of the grid's falls on a row sooner or later now and then.
    near = np.abs(steps - usual) <= (0 if usual < _JITTERS else 1)
    if usual > _MOST or np.mean(near) < _REGULAR:
        return None
    return OwnSamples(rows, usual)


# Residuals of the simulation, and their sensitivities.


_FLIGHTS = 6
"""number of flights that are tested, the longest"""
_DIVERGED = -10.0
"""VAF below which a simulation has left the record"""
_ROUNDING = 1e-5
"""residual over the output's sd below which it is rounding"""
_STEP = 1e-4
"""step of an unknown's coordinate, for differences"""


def testable(at: Solution, e: Evaluation, name: str) -> list[tuple[int, OwnSamples]]:
    """Return the flights in which an output moves and the simulation follows it, and its samples
    there: the longest flights, with one sample time, since filters are of samples.
    """
    flights, asked = at.data.flights, list[tuple[int, OwnSamples]]()
    sizes = [next(iter(f.outputs.values())).shape[0] for f in flights]
    order = np.argsort(sizes, kind="stable")[::-1].tolist()
    dt = float(flights[order[0]].dt)
    for i in sorted([i for i in order if np.isclose(float(flights[i].dt), dt)][:_FLIGHTS]):
        y = np.asarray(flights[i].outputs.get(name, np.nan))
        own = own_samples(np.isfinite(y)) if name in at.layout.outputs[i] else None
        if own is None or not np.std(y[own.rows]) > 0:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            size = np.std(np.asarray(e.raw[i][name])[own.rows]) / np.std(y[own.rows])
        if _ROUNDING < size < np.sqrt(1.0 - _DIVERGED):
            asked.append((i, own))
    return [(i, own) for i, own in asked if own.every == asked[0][1].every]


def sensitivities(at: Solution, e: Evaluation) -> dict[tuple[int, str], np.ndarray]:
    """Return by flight and output the derivative (N, q) of the residual by all unknowns."""
    layout, data, noise, z = at
    if layout.objective is OUTPUT_ERROR:
        rows, J = {}, np.asarray(e.J)
        first = 0
        for i, n in signals(layout):
            count = data.flights[i].outputs[n].shape[0]
            rows[i, n] = J[first : first + count] * float(noise.sd[i][n])
            first += count
        return rows
    # Differences of the simulation: its program is compiled already, that of a Jacobian is not.
    z = np.asarray(z)
    blocks = [places.every for places in flight_places(layout)]
    common = [np.array([k]) for k in range(layout.first_nuisance)]
    most = max((b.size for b in blocks), default=0)
    # The nuisance parameters of all flights move at once: each acts on its own flight alone.
    own = [np.array([b[k] for b in blocks if k < b.size]) for k in range(most)]
    before = simulated_outputs(layout, data, jnp.asarray(z))
    slopes = {(i, n): np.zeros((before[i][n].size, z.size)) for i, n in signals(layout)}
    step = _STEP if z.dtype == np.float64 else np.sqrt(_STEP)
    for columns in (*common, *own):
        there = z.copy()
        there[columns] += step
        after = simulated_outputs(layout, data, jnp.asarray(there))
        for i, n in signals(layout):
            for k in columns:
                if k < layout.first_nuisance or k in blocks[i]:
                    slopes[i, n][:, k] = (before[i][n] - after[i][n]) / step
    return slopes


# Drives that a residual may follow.


_PLAY = 0.1
"""play of a linkage, as a part of the input's range; the test finds other sizes as well"""
_DEAD = 0.02
"""deadband to either side of zero, as a part of the input's range; likewise"""


def moving_inputs(at: Solution) -> list[str]:
    """Return the inputs that move in some flight."""
    flights = [naming.asdict(f.inputs) for f in at.data.flights]
    return [n for n in flights[0] if any(np.ptp(np.asarray(u[n])) > 0 for u in flights)]


def nonlinear(y: np.ndarray, inputs: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """Return nonlinear functions of signals (N,): of all inputs together, so that a deadband of two
    sticks is one drive; then of a simulated output, its rate and its integral."""
    u = [_normal(v) for v in inputs]
    # A nonlinear spring acts by the angle, of which only the rate may be measured.
    response = [_normal(v) for v in (y, np.gradient(y), np.cumsum(y - y.mean()))]
    groups = [
        [np.abs(v) * v for v in u],
        [v**2 for v in u],
        # Play depends on the direction of the motion; no power of the position does.
        [v - _behind_play(v) for v in u],
        [np.clip(v, *_DEAD * np.array([-1, 1]) * np.ptp(v)) for v in inputs],
    ]
    groups += [[w] for v in response for w in (np.abs(v) * v, v**2)]
    # Friction has a sign and no size.
    return groups + [[np.sign(v)] for v in response[:2]]


def _behind_play(v: np.ndarray) -> np.ndarray:
    """Return a signal (N,) behind a linkage with play."""
    half, at, out = 0.5 * _PLAY * float(np.ptp(v)), 0.0, []
    # A held stick moves at few samples.
    begins = np.flatnonzero(np.diff(v, prepend=np.nan))
    for x in v[begins].tolist():
        at = min(max(at, x - half), x + half)
        out.append(at)
    return np.repeat(out, np.diff(begins, append=v.size))


def _normal(v: np.ndarray) -> np.ndarray:
    v = v - v.mean()
    size = float(np.std(v))
    return v / size if size > 0 else v


LEVEL, IN_COLOUR = 0.01, 1e-3
"""level of the test of all outputs and drives together; and if residuals are autocorrelated, since
the autoregression that whitens them is too short for strong gusts"""


class Unmodelled(NamedTuple):
    """A drive that the residual of an output follows significantly."""

    output: str
    drive: Drive
    gain: float
    """of twice the log-likelihood, about"""
    p_value: float
    frequency: float | None
    """[rad/s] of a missing mode; None if the drive has none"""
    shifts: dict[str, float]
    """by unknown of interest how far the drive moves it [SI]"""


def unmodelled(
    at: Solution, e: Evaluation, flights: Sequence[str], *, coloured: bool = False
) -> tuple[list[Unmodelled], tuple[float, dict[str, float]]]:
    """Return the drives that the residuals follow significantly, at most one an output; then the
    p value of the test that the response to the inputs gives the same estimates, and the step [SI]
    to those that it gives.

    Output error takes slow drift for slow modes. Filter error learns also from the response to its
    disturbance, which misleads it if the disturbance acts elsewhere or has another spectrum.

    Outputs with many gaps, simulations that left the record, windows and kinematic models are not
    tested. The inputs must not follow the response: in a closed loop any residual follows them.

    Args:
        flights: names of the flights.
        coloured: whether residuals are autocorrelated.
    """
    layout, nothing = at.layout, ([], (1.0, {}))
    if is_kinematic(layout.model) or any(count > 1 for count, _ in layout.windows):
        return nothing
    names = sorted({n for outputs in layout.outputs for n in outputs if testable(at, e, n)})
    if not names:
        return nothing
    level = (IN_COLOUR if coloured else LEVEL) / len(names)
    lacking, J = [], sensitivities(at, e)
    each = {name: _lines(at, e, name, J, flights) for name in names}
    for name, (drives, records) in each.items():
        if not drives:
            continue
        strong = strongest(records, drives)
        if strong.p_value < level:
            lacking.append(_unmodelled(at, e, name, strong))
    asked, k = [records for _, records in each.values() if records], len(layout.of_interest)
    chances = [pulled_away(records, k) for records in asked]
    p = min(1.0, min(chances) * len(chances)) if chances else 1.0
    if p > IN_COLOUR:
        return lacking, (p, {})
    step = step_to_least([one for records in asked for one in records])[:k] * np.asarray(e.slopes)
    return lacking, (p, dict(zip(layout.of_interest, step.tolist(), strict=True)))


def _lines(
    at: Solution,
    e: Evaluation,
    name: str,
    J: Mapping[tuple[int, str], np.ndarray],
    called: Sequence[str],
) -> tuple[list[Drive], list[Lines]]:
    """Return the drives that the residual of an output is tested against, and its lines by flight;
    no drives if nothing can be tested.

    Args:
        called: names of the flights.
    """
    moving, samples = moving_inputs(at), testable(at, e, name)
    k, m = len(at.layout.of_interest), len(moving)
    lines: dict[int, Lines] = {}
    # A parameter may change in one flight, steadily over the flights in their order, or halfway.
    steps = [J[i, name].shape[0] for i, _ in samples]
    times = np.split(np.linspace(-1.0, 1.0, sum(steps)), np.cumsum(steps)[:-1])
    groups = list[list[np.ndarray]]()
    for place, ((i, own), time) in enumerate(zip(samples, times, strict=True)):
        inputs = naming.asdict(at.data.flights[i].inputs)
        u, slopes = [np.asarray(inputs[n]) for n in moving], J[i, name][:, :k]
        groups = nonlinear(np.asarray(e.simulated[i][name]), u)
        X = [np.stack([own.of_input(v) for v in itertools.chain(u, *groups)], axis=1)]
        changes = [np.full_like(time, other == place) for other in range(len(samples))]
        X += [(slopes * by[:, None])[own.rows] for by in (*changes, time, np.sign(time))]
        residual = np.asarray(e.raw[i][name])[own.rows]
        found = lines_of(residual, J[i, name][own.rows], np.concatenate(X, axis=1), own.holes)
        if found is not None:
            lines[place] = found
    if not lines or not m:
        return [], list(lines.values())
    drives = [Drive((c,), "input", (n,), NARROW) for c, n in enumerate(moving)]
    begins = list(itertools.accumulate((len(group) for group in groups), initial=m))
    drives += [
        Drive(tuple(range(*ends)), "amplitude", (), BROAD, tuple(range(m)))
        for ends in itertools.pairwise(begins)
    ]
    names = {p: called[samples[p][0]] for p in lines}
    for p in lines if len(lines) > 1 else ():
        # Of two flights either may be the odd one.
        of = tuple(names.values()) if len(names) == 2 else (names[p], "the others")
        drives += [Drive((begins[-1] + p * k + c,), "flights", of, unknown=c) for c in range(k)]
    first = begins[-1] + len(samples) * k
    drives += [Drive((first + c,), "time", unknown=c % k) for c in range(2 * k)]
    return drives, list(lines.values())


def _unmodelled(at: Solution, e: Evaluation, name: str, strong: Strongest) -> Unmodelled:
    slopes, drive = np.asarray(e.slopes), strong.drive
    shifts = strong.shift[: slopes.size] * slopes
    if drive.unknown is not None:
        # The drive is the sensitivity of one parameter, which is off by its change as well.
        change = strong.amount * slopes[drive.unknown]
        there = shifts[drive.unknown] + change
        shifts[drive.unknown] = max((shifts[drive.unknown], there, -change), key=abs)
    first, own = testable(at, e, name)[0]
    frequency = strong.frequency / (float(at.data.flights[first].dt) * own.every)
    return Unmodelled(
        name,
        drive,
        strong.statistic,
        strong.p_value,
        frequency if strong.damping < 1.0 else None,
        dict(zip(at.layout.of_interest, shifts.tolist(), strict=True)),
    )
