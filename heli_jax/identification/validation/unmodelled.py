"""Unmodelled dynamics in the residuals: a mode, a response that depends on amplitude, or one that
changes over the record.

Of every output the residual in time is tested against the inputs through a bank of filters, beyond
what the sensitivities explain (`score_test`): the simulation and its residual are there by any
method. Then against powers of inputs, of the simulated output, its rate and its integral, and the
sign of the first two, beyond what the input through the same filter explains: a saturation, a rate
limit, a deadband, friction, a spring that is not linear and a vehicle that is not alike to both
sides do not answer in proportion. Then against the sensitivities times the time, and of single
flights: a rotor that slows down, a mass that changes and a stick of another scale leave what no
constant takes up.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from heli_jax import naming
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.finding import HALF_INTERVAL
from heli_jax.identification.estimation.evaluation import (
    Evaluation,
    deviations,
    evaluate,
    pseudoinverse,
    simulated_outputs,
)
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

# An output that is slower than the grid at its own samples, for what needs a row of them.


_REGULAR = 0.98
"""part of the steps between samples that are of one length, from which on they are a clock's"""
_MOST = 50
"""grid steps between two samples at most"""
_JITTERS = 5
"""grid steps between two samples from which on a clock falls on the grid one sooner or later"""


class OwnSamples(NamedTuple):
    """The places on the grid of an output that was sampled at even times."""

    rows: np.ndarray
    """(M,) their numbers"""
    every: int
    """grid steps from one to the next"""

    @property
    def holes(self) -> tuple[int, ...]:
        """Places in `rows` before which a sample is missing: a slow residual jumps there, and so
        does an input."""
        apart = np.diff(self.rows)
        return tuple((np.flatnonzero(apart > self.every + (self.every >= _JITTERS)) + 1).tolist())

    def of_input(self, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " M"]:
        """An input's mean from one sample to the next, so that nothing between them is lost; the
        first from where the flight begins.

        Args:
            u: the input (N,), any unit.
        """
        summed = np.concatenate([[0.0], np.cumsum(u)])
        # An input acts from its own sample on: that at the output's sample moves the next one.
        first = np.maximum(self.rows + 1 - self.every, 0)
        return (summed[self.rows + 1] - summed[first]) / (self.rows + 1 - first)


def own_samples(seen: Bool[np.ndarray, " N"]) -> OwnSamples | None:
    """The places of an output's samples; None if too many of its own samples are missing."""
    rows = np.flatnonzero(seen)
    if rows.size == seen.size:
        return OwnSamples(rows, 1)
    if rows.size < 2:
        return None
    steps = np.diff(rows)
    usual = int(np.median(steps))
    # A clock that is no multiple of the grid's falls on its rows one sooner or later.
    near = np.abs(steps - usual) <= (0 if usual < _JITTERS else 1)
    if usual > _MOST or np.mean(near) < _REGULAR:
        return None
    return OwnSamples(rows, usual)


# What a simulation leaves of each output, which can be asked, and how the unknowns move it.


_FLIGHTS = 6
"""that are looked at, the longest"""
_DIVERGED = -10.0
"""VAF of a simulation below which its residual says nothing"""
_ROUNDING = 1e-5
"""part of an output's sd below which its residual is no noise"""
_STEP = 1e-4
"""of an unknown's coordinate, for differences"""


def of_one_clock(at: Solution, e: Evaluation, name: str) -> list[tuple[int, OwnSamples]]:
    """The flights whose residual of an output can be asked, and where it was sampled in each: it
    moves, and a simulation follows it. The longest flights, of one sample time and one clock of the
    output, since filters are of samples.
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
    """By flight and output (N, q) the derivative of the residual by all unknowns."""
    layout, data, noise, z = at
    if layout.objective is OUTPUT_ERROR:
        rows, J = {}, np.asarray(e.J)
        first = 0
        for i, n in signals(layout):
            count = data.flights[i].outputs[n].shape[0]
            rows[i, n] = J[first : first + count] * float(noise.sd[i][n])
            first += count
        return rows
    # By differences of the simulation, whose program is there: a Jacobian would compile another.
    z = np.asarray(z)
    blocks = [places.every for places in flight_places(layout)]
    common = [np.array([k]) for k in range(layout.first_nuisance)]
    most = max((b.size for b in blocks), default=0)
    # Each flight's own unknowns move at once: none is felt by another flight.
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


# What may drive what a model lacks.
#
# The inputs, what is not linear of them and of the response, and what parameters do that change.


_PLAY = 0.1
"""part of an input's range that a linkage's play is asked for with; other plays answer alike"""
_DEAD = 0.02
"""part of an input's range, to either side of zero, that a deadband is asked for with"""


def moving_inputs(at: Solution) -> list[str]:
    """The inputs that move in some flight."""
    flights = [naming.asdict(f.inputs) for f in at.data.flights]
    return [n for n in flights[0] if any(np.ptp(np.asarray(u[n])) > 0 for u in flights)]


def nonlinear(y: np.ndarray, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Nonlinear functions of inputs and of the `motions` of a simulated output (each (N,)), and
    what a linkage with play, or one that is dead about zero, keeps of the inputs."""
    u = [_normal(v) for v in inputs]
    response = [_normal(v) for v in motions(y)]
    curved = [w for v in (*u, *response) for w in (np.abs(v) * v, v**2)]
    # Friction has a sign and no size.
    curved += [np.sign(v) for v in response[:2]]
    # Play depends on where the stick came from, not on where it is: no power does.
    curved += [v - _behind_play(v) for v in u]
    return curved + [np.clip(v, *_DEAD * np.array([-1, 1]) * np.ptp(v)) for v in inputs]


def motions(y: np.ndarray) -> tuple[np.ndarray, ...]:
    """A simulated output (N,), its rate and its integral: a spring that is not linear acts by the
    angle, of which only the rate may be measured."""
    return y, np.gradient(y), np.cumsum(y - y.mean())


def _behind_play(v: np.ndarray) -> np.ndarray:
    """The position of what follows a signal (N,) with play."""
    half, at, out = 0.5 * _PLAY * float(np.ptp(v)), 0.0, []
    # A stick that is held for many samples moves at a few of them.
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
"""of all outputs and questions together; and where residuals in time are autocorrelated, as in
strong gusts: what whitens them is then too short to leave nothing"""
_ROUNDS = 6
"""steps at most to where a whitened residual is least"""
_VARIES = 0.1
"""of the mean, by which an amplitude has to vary to tell what goes with it"""
_WILD = 5.0
"""robust sds of a whitened residual, at which it is bounded to see whether a finding holds"""
_ENOUGH = 1.0
"""of twice the log-likelihood, by which a further step says nothing else"""


class Unmodelled(NamedTuple):
    """A drive that the residual of an output follows beyond chance."""

    output: str
    drive: Drive
    gain: float
    """of twice the log-likelihood"""
    p_value: float
    frequency: float | None
    """[rad/s] of a mode that is missing; None where the answer has none"""
    shifts: dict[str, float]
    """by unknown of interest how far this moves it [SI]"""
    far: tuple[str, ...] = ()
    """of amplitude: the unknowns that it moves by more than noise leaves of their intervals"""


def unmodelled(
    at: Solution, e: Evaluation, flights: Sequence[str], *, coloured: bool = False
) -> tuple[list[Unmodelled], tuple[float, dict[str, float]]]:
    """Return the drives that the residuals follow beyond chance, at most one an output; and the
    probability that the response to the inputs asks for other values by chance, with the step to
    these [SI].

    Output error takes slow drift for slow modes; filter error learns also from how its disturbance
    goes through the vehicle, which misleads it where that acts elsewhere or has another spectrum.

    An output that is slower than the grid is asked at its own samples. Of others with gaps, of a
    simulation that left the record, of windows and of sensors compared with each other nothing is
    asked. Whoever asks has seen to it that inputs do not follow the response: through a loop
    disturbances are in the inputs, and any residual follows these.
    """
    layout, nothing = at.layout, ([], (1.0, {}))
    if is_kinematic(layout.model) or any(count > 1 for count, _ in layout.windows):
        return nothing
    names = sorted({n for outputs in layout.outputs for n in outputs if of_one_clock(at, e, n)})
    if not names:
        return nothing
    level = (IN_COLOUR if coloured else LEVEL) / len(names)
    lacking, J = [], sensitivities(at, e)
    each = {name: _lines(at, e, name, J, flights) for name in names}
    for name, (drives, records) in each.items():
        if not drives:
            continue
        strong = _where_least(at, name, drives, records, level, flights)
        # What rests on a few wild samples is chance: they have most of the power.
        if strong.p_value < level and (
            strongest(_lines(at, e, name, J, flights, _WILD)[1], drives).p_value < level
        ):
            lacking.append(_told(at, e, name, strong, J))
    asked, k = [records for _, records in each.values() if records], len(layout.of_interest)
    chances = [pulled_away(records, k) for records in asked]
    p = min(1.0, min(chances) * len(chances)) if chances else 1.0
    if p > IN_COLOUR:
        return lacking, (p, {})
    step = step_to_least([one for records in asked for one in records])[:k] * np.asarray(e.slopes)
    return lacking, (p, dict(zip(layout.of_interest, step.tolist(), strict=True)))


def _where_least(
    at: Solution,
    name: str,
    drives: Sequence[Drive],
    records: Sequence[Lines],
    level: float,
    called: Sequence[str],
) -> Strongest:
    """The answer where the output's whitened residual is least, if it is significant before.

    With coloured residuals a fit ends elsewhere: its unknowns are off by more than sensitivities
    are straight, and what these cannot take up would pass for something that the model lacks.
    """
    part, strong = 1.0, strongest(records, drives)
    for _ in range(_ROUNDS):
        if not strong.p_value < level:
            break
        there = at._replace(z=at.z + part * jnp.asarray(strong.step, at.z.dtype))
        e = evaluate(*there)
        asked, again = _lines(there, e, name, sensitivities(there, e), called)
        if not asked or not _deviance(again) < _deviance(records):
            part *= 0.25
            continue
        gained, at, records, part = _deviance(records) - _deviance(again), there, again, 1.0
        strong = strongest(records, asked)
        if gained < _ENOUGH:
            break
    return strong


def _deviance(records: Sequence[Lines]) -> float:
    """Twice the negative log-likelihood of a whitened residual, but for a constant: two numbers a
    line, each of the variance size**2."""
    return float(4.0 * sum(one.e.size * np.log(one.size) for one in records))


def _lines(
    at: Solution,
    e: Evaluation,
    name: str,
    J: Mapping[tuple[int, str], np.ndarray],
    called: Sequence[str],
    most: float = np.inf,
) -> tuple[list[Drive], list[Lines]]:
    """The drives that the residual of an output may follow, none where nothing can be tested, and
    its lines by flight.

    Args:
        called: the flights' names.
        most: robust sds at which the whitened residual is bounded.
    """
    moving, samples = moving_inputs(at), of_one_clock(at, e, name)
    # A step may end where the simulation leaves the record.
    if not samples:
        return [], []
    k, m = len(at.layout.of_interest), len(moving)
    steps, lines = [J[i, name].shape[0] for i, _ in samples], []
    # A change of a parameter: a steady one over the flights in their order, and one halfway.
    t = np.split(np.linspace(-1.0, 1.0, sum(steps)), np.cumsum(steps)[:-1])
    for place, ((i, own), shape) in enumerate(zip(samples, t, strict=True)):
        inputs = naming.asdict(at.data.flights[i].inputs)
        u, slopes = [np.asarray(inputs[n]) for n in moving], J[i, name][:, :k]
        known = np.stack([*u, *nonlinear(np.asarray(e.simulated[i][name]), u)], axis=1)
        X = [np.stack([own.of_input(v) for v in known.T], axis=1)]
        # A change in one flight alone, before those over time: it is one halfway as well.
        X += [slopes[own.rows] * (other == place) for other in range(len(samples))]
        X += [(slopes * by[:, None])[own.rows] for by in (shape, np.sign(shape))]
        left = np.asarray(e.raw[i][name])[own.rows]
        found = lines_of(left, J[i, name][own.rows], np.concatenate(X, axis=1), own.holes, most)
        if found is not None:
            lines.append((place, found))
    records = [one for _, one in lines]
    if not records or not m:
        return [], records
    columns = records[0].drives.shape[1]
    first = columns - (len(samples) + 2) * k
    drives = [Drive(c, "input", (n,), NARROW) for c, n in enumerate(moving)]
    drives += [Drive(c, "amplitude", (), BROAD, tuple(range(m))) for c in range(m, first)]
    if len(records) > 1:
        names = [called[i] if i < len(called) else f"flight {i + 1}" for i, _ in samples]
        of = [names[place] for place, _ in lines]
        drives += [
            # Of two nobody knows which is odd.
            Drive(
                first + place * k + c,
                "flights",
                tuple(of) if len(of) == 2 else (names[place], "the others"),
                unknown=c,
            )
            for place, _ in lines
            for c in range(k)
        ]
    drives += [Drive(columns - 2 * k + c, "time", unknown=c % k) for c in range(2 * k)]
    return drives, records


def _told(
    at: Solution,
    e: Evaluation,
    name: str,
    strong: Strongest,
    J: Mapping[tuple[int, str], np.ndarray],
) -> Unmodelled:
    slopes, far = np.asarray(e.slopes), tuple[str, ...]()
    k, drive = slopes.size, strong.drive
    shifts = strong.shift[:k] * slopes
    if drive.kind == "amplitude":
        shifts = _by_amplitude(at, e, name, J) * slopes
        # The shift is a lower bound. It is held against the interval that noise alone leaves: one
        # that allows for coloured residuals is wide by what was found here.
        beyond = np.abs(shifts) > HALF_INTERVAL * deviations(e.J)[:k] * np.abs(slopes)
        far = tuple(n for n, one in zip(at.layout.of_interest, beyond, strict=True) if one)
    elif drive.unknown is not None:
        # The drive is the sensitivity of one parameter, which is off by the change itself as well.
        change = strong.amount * slopes[drive.unknown]
        there = shifts[drive.unknown] + change
        shifts[drive.unknown] = max((shifts[drive.unknown], there, -change), key=abs)
    first, own = of_one_clock(at, e, name)[0]
    frequency = strong.frequency / (float(at.data.flights[first].dt) * own.every)
    return Unmodelled(
        name,
        drive,
        strong.statistic,
        strong.p_value,
        frequency if strong.damping < 1.0 else None,
        dict(zip(at.layout.of_interest, shifts.tolist(), strict=True)),
        far,
    )


def _by_amplitude(
    at: Solution, e: Evaluation, name: str, J: Mapping[tuple[int, str], np.ndarray]
) -> np.ndarray:
    """By unknown of interest (k,) its change from the record's mean amplitude to none, that of an
    input or of the output's `motions`, whichever explains most.

    The residual is regressed on the sensitivities, and on these times the amplitude. It is not
    whitened: the answer that depends on amplitude is as slow as the response itself.
    """
    k, samples = len(at.layout.of_interest), of_one_clock(at, e, name)
    left = np.concatenate([np.asarray(e.raw[i][name])[own.rows] for i, own in samples])
    rows = np.concatenate([J[i, name][own.rows] for i, own in samples])
    inputs = [at.data.flights[i].inputs for i, _ in samples]
    outputs = [np.asarray(e.simulated[i][name]) for i, _ in samples]
    signals = [[np.asarray(getattr(u, drive)) for u in inputs] for drive in moving_inputs(at)]
    signals += [list(v) for v in zip(*(motions(y) for y in outputs), strict=True)]
    best, least = np.zeros(k), np.inf
    for signal in signals:
        amplitude = np.abs(
            np.concatenate([x[own.rows] for x, (_, own) in zip(signal, samples, strict=True)])
        )
        mean, sd = float(amplitude.mean()), float(np.std(amplitude))
        if not sd > _VARIES * mean:
            continue
        columns = np.concatenate([rows, rows[:, :k] * (amplitude - mean)[:, None] / sd], axis=1)
        change = -pseudoinverse(columns) @ left
        squares = float(np.sum((left + columns @ change) ** 2))
        if squares < least:
            best, least = -change[rows.shape[1] :] * mean / sd, squares
    return best
