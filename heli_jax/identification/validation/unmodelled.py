"""Unmodelled dynamics in the residuals: a mode, a response that depends on amplitude, or one that
changes over the record.

Each output's residual in time is regressed on the sensitivities and on candidate drives
(`score_test`). This needs only a simulation, so it works for every estimation method. The drives:

- the inputs through a bank of filters, for a missing mode or lag;
- nonlinear functions of the inputs and of the simulated output, beyond the input through the same
  filter. They detect saturation, rate limits, deadbands, friction, nonlinear springs and asymmetry;
- the sensitivities times time, and those of single flights. They detect a rotor that slows down, a
  mass that changes, or a stick of another scale.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

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
from heli_jax.identification.validation.excitation import LEVEL
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

# Residuals that can be tested, and their sensitivities.


_FLIGHTS = 6
"""Largest number of flights that are tested; the longest are taken."""
_SEEN = 0.95
"""Least share of an output's samples that are measured."""
_DIVERGED = -10.0
"""VAF below which a simulation has diverged."""
_ROUNDING = 1e-5
"""Share of an output's sd below which its residual is rounding."""
_STEP = 1e-4
"""Step of an unknown's coordinate for finite differences."""


def tested_flights(at: Solution, e: Evaluation, name: str) -> list[tuple[int, np.ndarray]]:
    """Return the flights in which an output's residual can be tested, with the output's rows (M,).

    The output moves, few of its samples are missing, and the simulation follows it. Of these
    flights the longest are taken. All share one sample time, since filters count samples.
    """
    flights, tested = at.data.flights, list[tuple[int, np.ndarray]]()
    sizes = [next(iter(f.outputs.values())).shape[0] for f in flights]
    order = np.argsort(sizes, kind="stable")[::-1].tolist()
    dt = float(flights[order[0]].dt)
    for i in sorted([i for i in order if np.isclose(float(flights[i].dt), dt)][:_FLIGHTS]):
        y = np.asarray(flights[i].outputs.get(name, np.nan))
        rows = np.flatnonzero(np.isfinite(y))
        if rows.size < max(_SEEN * y.size, 2) or not np.ptp(y[rows]) > 0:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            size = np.std(np.asarray(e.raw[i][name])[rows]) / np.std(y[rows])
        if _ROUNDING < size < np.sqrt(1.0 - _DIVERGED):
            tested.append((i, rows))
    return tested


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
    # Finite differences reuse the compiled simulation. A Jacobian would compile another program.
    z = np.asarray(z)
    blocks = [places.every for places in flight_places(layout)]
    common = [np.array([k]) for k in range(layout.first_nuisance)]
    most = max((b.size for b in blocks), default=0)
    # Flights share no own unknowns, so one simulation perturbs those of all flights.
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


# Candidate drives: inputs, nonlinear functions of inputs and response, and changes of parameters.


_PLAY = 0.1
"""Play of a linkage as a share of the input's range; other sizes give similar results."""
_DEAD = 0.02
"""Half width of a deadband as a share of the input's range."""


def moving_inputs(at: Solution) -> list[str]:
    """Return the inputs that move in any flight."""
    flights = [naming.asdict(f.inputs) for f in at.data.flights]
    return [n for n in flights[0] if any(np.ptp(np.asarray(u[n])) > 0 for u in flights)]


def nonlinear(y: np.ndarray, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return nonlinear functions of inputs and of the `motions` of a simulated output (each (N,)).

    They include the parts of the inputs that play and a deadband hold back.
    """
    u = [_normal(v) for v in inputs]
    response = [_normal(v) for v in motions(y)]
    curved = [w for v in (*u, *response) for w in (np.abs(v) * v, v**2)]
    # Friction depends on the sign of the motion alone.
    curved += [np.sign(v) for v in response[:2]]
    # Play depends on the stick's past, which no power of its position shows.
    curved += [v - _behind_play(v) for v in u]
    return curved + [np.clip(v, *_DEAD * np.array([-1, 1]) * np.ptp(v)) for v in inputs]


def motions(y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return a simulated output (N,), its rate and its integral.

    A nonlinear spring acts by the angle, of which only the rate may be measured.
    """
    return y, np.gradient(y), np.cumsum(y - y.mean())


def _behind_play(v: np.ndarray) -> np.ndarray:
    """Return the position that follows a signal (N,) with play."""
    half, at, out = 0.5 * _PLAY * float(np.ptp(v)), 0.0, []
    # A held stick moves at a few samples only: the loop visits just these.
    begins = np.flatnonzero(np.diff(v, prepend=np.nan))
    for x in v[begins].tolist():
        at = min(max(at, x - half), x + half)
        out.append(at)
    return np.repeat(out, np.diff(begins, append=v.size))


def _normal(v: np.ndarray) -> np.ndarray:
    v = v - v.mean()
    size = float(np.std(v))
    return v / size if size > 0 else v


LEVEL_COLOURED = 1e-3
"""Significance level of all tests together if residuals in time are autocorrelated.

In strong gusts the whitening filter is too short to remove all autocorrelation."""
_ROUNDS = 6
"""Largest number of steps towards the smallest whitened residual."""
_VARIES = 0.1
"""Least sd of an amplitude over its mean, to estimate an effect of the amplitude."""
_WILD = 5.0
"""Bound of the whitened residual in the robust repeat of a test [robust sds]."""
_ENOUGH = 1.0
"""Gain of twice the log-likelihood below which a further step changes no conclusion."""


class Unmodelled(NamedTuple):
    """A drive that the residual of an output follows beyond chance."""

    output: str
    drive: Drive
    gain: float
    """Gain of twice the log-likelihood."""
    p_value: float
    frequency: float | None
    """Frequency of the missing mode [rad/s]; None without a resonance."""
    shifts: dict[str, float]
    """Bias of each unknown of interest [SI]."""
    far: tuple[str, ...] = ()
    """Unknowns that an effect of amplitude moves beyond their interval for noise alone."""


def unmodelled(
    at: Solution, e: Evaluation, flights: Sequence[str], *, coloured: bool = False
) -> tuple[list[Unmodelled], tuple[float, dict[str, float]]]:
    """Return the drives that the residuals follow beyond chance, at most one per output.

    The second result tests whether the response to the inputs alone gives other values: the p
    value, and the step to these values [SI]. Output error fits slow drift by slow modes. Filter
    error also fits the vehicle's response to its disturbance, which biases it if the disturbance
    acts elsewhere or has another spectrum.

    Slow outputs, diverged simulations, windows and kinematic models are not tested. The inputs must
    not follow the response: in a closed loop they contain disturbances, and every residual follows
    these.
    """
    layout, nothing = at.layout, ([], (1.0, {}))
    if is_kinematic(layout.model) or any(count > 1 for count, _ in layout.windows):
        return nothing
    names = sorted({n for outputs in layout.outputs for n in outputs if tested_flights(at, e, n)})
    if not names:
        return nothing
    level = (LEVEL_COLOURED if coloured else LEVEL) / len(names)
    lacking, J = [], sensitivities(at, e)
    each = {name: _lines(at, e, name, J, flights) for name in names}
    for name, (drives, records) in each.items():
        if not drives:
            continue
        strong = _where_least(at, name, drives, records, level, flights)
        # A few outliers have most of the power: the result must hold without them.
        if strong.p_value < level and (
            strongest(_lines(at, e, name, J, flights, _WILD)[1], drives).p_value < level
        ):
            lacking.append(_described(at, e, name, strong, J))
    tested, k = [records for _, records in each.values() if records], len(layout.of_interest)
    chances = [pulled_away(records, k) for records in tested]
    p = min(1.0, min(chances) * len(chances)) if chances else 1.0
    if p > LEVEL_COLOURED:
        return lacking, (p, {})
    step = step_to_least([one for records in tested for one in records])[:k] * np.asarray(e.slopes)
    return lacking, (p, dict(zip(layout.of_interest, step.tolist(), strict=True)))


def _where_least(
    at: Solution,
    name: str,
    drives: Sequence[Drive],
    records: Sequence[Lines],
    level: float,
    labels: Sequence[str],
) -> Strongest:
    """Return the strongest drive; if it is significant, where the whitened residual is least.

    With coloured residuals a fit ends far from that point, where the sensitivities are not linear
    enough. The part that they cannot explain would look like a missing mode.
    """
    part, strong = 1.0, strongest(records, drives)
    for _ in range(_ROUNDS):
        if not strong.p_value < level:
            break
        there = at._replace(z=at.z + part * jnp.asarray(strong.step, at.z.dtype))
        e = evaluate(*there)
        tested, again = _lines(there, e, name, sensitivities(there, e), labels)
        if not tested or not _deviance(again) < _deviance(records):
            part *= 0.25
            continue
        gained, at, records, part = _deviance(records) - _deviance(again), there, again, 1.0
        strong = strongest(records, tested)
        if gained < _ENOUGH:
            break
    return strong


def _deviance(records: Sequence[Lines]) -> float:
    """Return twice the negative log-likelihood of a whitened residual, up to a constant.

    Each line holds two numbers of variance size**2.
    """
    return float(4.0 * sum(one.e.size * np.log(one.size) for one in records))


def _lines(
    at: Solution,
    e: Evaluation,
    name: str,
    J: Mapping[tuple[int, str], np.ndarray],
    labels: Sequence[str],
    most: float = np.inf,
) -> tuple[list[Drive], list[Lines]]:
    """Return the candidate drives of an output's residual, and its lines by flight.

    No drive is returned if nothing can be tested.

    Args:
        labels: the flights' names.
        most: bound of the whitened residual [robust sds].
    """
    moving, samples = moving_inputs(at), tested_flights(at, e, name)
    # A step may end where the simulation diverges.
    if not samples:
        return [], []
    k, m = len(at.layout.of_interest), len(moving)
    steps, lines = [J[i, name].shape[0] for i, _ in samples], []
    # A parameter changes steadily over the flights in their order, or jumps halfway.
    t = np.split(np.linspace(-1.0, 1.0, sum(steps)), np.cumsum(steps)[:-1])
    for place, ((i, rows), shape) in enumerate(zip(samples, t, strict=True)):
        inputs = naming.asdict(at.data.flights[i].inputs)
        u, slopes = [np.asarray(inputs[n]) for n in moving], J[i, name][:, :k]
        known = np.stack([*u, *nonlinear(np.asarray(e.simulated[i][name]), u)], axis=1)
        X = [known[rows]]
        # One flight's changes come before those over time, since they may also look like a jump.
        X += [slopes[rows] * (other == place) for other in range(len(samples))]
        X += [(slopes * by[:, None])[rows] for by in (shape, np.sign(shape))]
        left, holes = np.asarray(e.raw[i][name])[rows], np.flatnonzero(np.diff(rows) > 1) + 1
        found = lines_of(left, J[i, name][rows], np.concatenate(X, axis=1), holes.tolist(), most)
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
        names = [labels[i] if i < len(labels) else f"flight {i + 1}" for i, _ in samples]
        of = [names[place] for place, _ in lines]
        drives += [
            # With only two flights either may be the odd one.
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


def _described(
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
        # The shift is a lower bound. It is compared with the interval for noise alone: this effect
        # itself widens the interval that allows for coloured residuals.
        beyond = np.abs(shifts) > HALF_INTERVAL * deviations(e.J)[:k] * np.abs(slopes)
        far = tuple(n for n, one in zip(at.layout.of_interest, beyond, strict=True) if one)
    elif drive.unknown is not None:
        # The drive is the sensitivity of one parameter, so the change itself biases that one too.
        change = strong.amount * slopes[drive.unknown]
        there = shifts[drive.unknown] + change
        shifts[drive.unknown] = max((shifts[drive.unknown], there, -change), key=abs)
    first, _ = tested_flights(at, e, name)[0]
    frequency = strong.frequency / float(at.data.flights[first].dt)
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
    """Return the change (k,) of each unknown of interest from the record's mean amplitude to zero.

    The amplitude is that of the input or of the output's `motions` which explains most. The
    residual is regressed on the sensitivities, and on these times the amplitude. It is not
    whitened: a response that depends on amplitude is as slow as the response itself.
    """
    k, samples = len(at.layout.of_interest), tested_flights(at, e, name)
    left = np.concatenate([np.asarray(e.raw[i][name])[seen] for i, seen in samples])
    rows = np.concatenate([J[i, name][seen] for i, seen in samples])
    inputs = [at.data.flights[i].inputs for i, _ in samples]
    outputs = [np.asarray(e.simulated[i][name]) for i, _ in samples]
    signals = [[np.asarray(getattr(u, drive)) for u in inputs] for drive in moving_inputs(at)]
    signals += [list(v) for v in zip(*(motions(y) for y in outputs), strict=True)]
    best, least = np.zeros(k), np.inf
    for signal in signals:
        amplitude = np.abs(
            np.concatenate([x[seen] for x, (_, seen) in zip(signal, samples, strict=True)])
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
