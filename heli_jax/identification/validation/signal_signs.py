"""Signs and units of signals, as far as signals tell them.

Three tests that need no fit. An angle is the integral of its rate, so the two move alike, and as
far. With start values of the right signs and units the simulated outputs move with the measured
ones, and about as far. And the size of a signal suits one unit better than another: degrees fit as
well as radians where all outputs are in them, with every estimate off by 57.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax import units
from heli_jax.dynamics.model import Model, axes_of
from heli_jax.flights.flight import Flight, Signal
from heli_jax.identification.validation.metrics import autocorrelation, cross_correlation
from heli_jax.vehicle import of_helicopter

# An angle and the integral of its rate.


_PAIRS = (("p", "phi"), ("q", "theta"), ("r", "psi"), ("r", "yaw"), ("p", "roll"), ("q", "pitch"))
"""rate and angle by the names that outputs have here, beside those of the model's axes"""
WITHIN = 0.5
"""[s] over which an angle and the integral of its rate are compared"""
PARTS = 10
"""so many of these parts of a record at least"""
_ALIKE = 0.8
"""correlation of the two from which on their sizes are compared"""
_QUANTILE = 2.26
"""of Student's t with as many degrees of freedom as parts but one, for 95 %"""
_GAP = 0.3
"""[s] without a sample, over which nothing is put between"""


class AngleOverRate(NamedTuple):
    """The change of an angle over that of its integrated rate.

    Where both are noisy, the regressions of the one on the other and of the other on the one
    enclose the factor (Frisch, 1934): it lies between `factor` times and over `|correlation|`.
    """

    factor: float
    """negative where they go against one another"""
    correlation: float
    scale: tuple[float, float]
    """95 % interval of the rate's size over that of the angle's rate of change, noise of either
    allowed for"""

    def off(self, by: float) -> bool:
        """True if the size is off by a factor of `by` or more, whatever the noise."""
        size, alike = abs(self.factor), abs(self.correlation)
        return size * alike > by or size / alike < 1.0 / by


def rates_and_angles(model: Model) -> list[tuple[str, str]]:
    """The outputs that are a rate and its angle, by the model's axes and by the names that they
    have here."""
    axes = [(a.rate, a.angle) for a in axes_of(model) if a.angle is not None]
    return list(dict.fromkeys([*axes, *_PAIRS]))


def angle_over_rate(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> AngleOverRate | None:
    """Compare the motion of an angle [rad] with the integral of its rate [rad/s], both NaN where
    missing; None if a gap is long, the record is short, or the two have little in common."""
    steps = max(1, round(WITHIN / dt))
    if min(np.isfinite(v).sum() for v in (angle, rate)) < 2 or angle.size < (PARTS + 1) * steps:
        return None
    (phi, known), (p, known_too) = (over_gaps(v, dt) for v in (angle, rate))
    if not (known & known_too).all():
        return None
    # Headings jump by a turn where they pass south. Changes over half a second: a bias of the rate
    # is in their mean alone, and noise of the angle is not divided by a sample time.
    both = [v[steps:] - v[:-steps] for v in (np.unwrap(phi), integral(p, dt))]
    both = [v - v.mean() for v in both]
    sds = [float(np.std(v)) for v in both]
    alike = float(np.corrcoef(*both)[0, 1]) if min(sds) > 0 else 0.0
    if abs(alike) < _ALIKE:
        return None
    size, wide = sds[1] / sds[0], float(np.exp(_QUANTILE * _log_sd(*both)))
    scale = (size * abs(alike) / wide, size / abs(alike) * wide)
    return AngleOverRate(float(np.copysign(1.0 / size, alike)), alike, scale)


def _log_sd(first: np.ndarray, second: np.ndarray) -> float:
    """Standard deviation of the logarithm of the ratio of two records' sizes (N,), by leaving out
    one part after the other (the jackknife)."""
    squares = [[float(part @ part) for part in np.array_split(x, PARTS)] for x in (first, second)]
    left = [sum(of) - np.asarray(of) for of in squares]
    return float(np.sqrt((PARTS - 1) * np.var(0.5 * np.log(left[0] / left[1]))))


def integral(rate: Float[np.ndarray, " N"], dt: float) -> Float[np.ndarray, " N"]:
    """Integral of a signal without gaps, in straight lines between samples of dt [s], from zero."""
    return np.concatenate([np.zeros(1), np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))])


def over_gaps(signal: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """A signal (N,), NaN where missing, with straight lines over its gaps, and which samples (N,)
    are in no long one; two samples or more have to be known."""
    seen = np.flatnonzero(np.isfinite(signal))
    rows = np.arange(signal.size)
    ends = np.r_[0, seen, signal.size - 1]
    after = np.searchsorted(ends, rows, side="left")
    # Of the samples before and behind a row, or of the ends of the record.
    gap = ends[np.minimum(after, ends.size - 1)] - ends[np.maximum(after - 1, 0)]
    known = np.isfinite(signal) | (gap * dt <= _GAP)
    return np.interp(rows, seen, signal[seen]), known


# Outputs against those simulated at the start values.


AGAINST = -0.3
"""correlation below which a simulated output moves against the measured one"""
_SURE = 3.0
"""times what chance makes of it"""
_LAG = 0.25
"""[s] to either side: later, a swing of the right sign looks like one of the wrong sign"""
_LARGER = 1.3
"""by how much the correlation of the wrong sign exceeds any of the right one"""
_MORE = 1.3
"""times as far an output is simulated to move in a flight that says more of it"""


class Turned(NamedTuple):
    """Outputs of a flight that move against those simulated at the start values."""

    flight: str
    correlations: dict[str, float]
    """by output"""
    sticks: tuple[str, ...]
    """inputs one of which may have the wrong sign instead; none where another output of the same
    input has the right one"""


def against_start(
    flights: Sequence[tuple[str, Flight]],
    simulated: Sequence[Mapping[str, np.ndarray]],
    sticks: Mapping[str, str],
) -> Iterator[Turned]:
    """Outputs that move against those simulated at the start values: all that a stick moves, or one
    of them that others do not go with.

    A stick that only holds an output against gusts moves against it by feedback alone. So what
    another flight shows, in which it moves the output further and the right way, goes before it.

    Args:
        simulated: by flight and output (N,), SI.
        sticks: by output the input that moves it, of `sticks_of`; of others any input may.
    """
    # By output its correlation with the simulated one, where that is sure, and the latter's sd.
    by_flight = [
        {
            name: (c, float(np.std(run[name])))
            for name, measured in f.outputs.items()
            if (c := _surely(measured, run[name], f.dt)) is not None
        }
        for (_, f), run in zip(flights, simulated, strict=True)
    ]
    for (label, flight), signs in zip(flights, by_flight, strict=True):
        groups: dict[tuple[str, ...], dict[str, float]] = {}
        for name, (correlation, size) in signs.items():
            others = [of_flight[name] for of_flight in by_flight if name in of_flight]
            if correlation > 0 or not any(c > 0 and sd > _MORE * size for c, sd in others):
                of = (sticks[name],) if name in sticks else tuple(flight.inputs)
                groups.setdefault(of, {})[name] = correlation
        for of, group in groups.items():
            turned = {n: c for n, c in group.items() if c < 0}
            if turned and len(turned) == len(group):
                yield Turned(label, turned, of)
            else:
                yield from (Turned(label, {n: c}, ()) for n, c in turned.items())


def sticks_of(model: Model) -> dict[str, str]:
    """By output, named as its axis names it or as outputs are here, the input that turns the model
    about that axis."""
    sticks = {}
    for axis in axes_of(model):
        if axis.stick is not None:
            names = {axis.rate, axis.angle, *(a for r, a in _PAIRS if r == axis.rate)}
            sticks |= {name: axis.stick for name in names if name is not None}
    return sticks


def _surely(measured: np.ndarray, simulated: np.ndarray, dt: float) -> float | None:
    """The correlation of the wrong sign, or else of the right one, where it is sure."""
    seen = np.isfinite(measured)
    if not np.max(np.abs(simulated)) < 1e100 or np.std(simulated) == 0 or seen.mean() < 0.5:
        return None
    lags = max(1, min(round(_LAG / dt), measured.size // 4))
    # Missing samples add nothing to the products and all of the simulation to their scale.
    c = cross_correlation(simulated, measured, lags) / np.sqrt(seen.mean())
    worst, best = float(np.min(c)), float(np.max(c))
    # Of two independent signals, by their autocorrelations (Bartlett, 1935).
    most = max(1, measured.size // 5)
    window = 1.0 - np.arange(most + 1) / (most + 1)
    both = window * autocorrelation(measured, most) * autocorrelation(simulated, most)
    chance = float(np.sqrt(max(both[0] + 2.0 * both[1:].sum(), 1e-12) / seen.sum()))
    least = max(-AGAINST, _SURE * chance)
    if -worst > least and -worst > _LARGER * best:
        return worst
    return best if best > least and best > -worst else None


# The size of a signal in its unit.


_ATTITUDE = {"p", "q", "r", "phi", "theta", "psi", "roll", "pitch", "yaw"}
"""what the outputs of models without axes (kinematics) and of files are called then"""
_LARGEST, _LINEAR = {"rad": np.pi, "rad/s": 20.0}, {"rad": np.pi / 2, "rad/s": 8.0}
"""what a small helicopter does not exceed, but for its heading, and up to what a linear model may
mean something"""
_HEADING_TURNS = 20.0
"""turns in one sense, of a heading without jumps"""
_FLOWN_TURNS = 5.0
"""turns that rolls and loops may add up to in an angle without jumps"""
_MOST = 99.0
"""percentile of the size that is held against them: no single spike counts"""
_FLOWN = 0.3
"""by which an angle's changes may differ from those of its integrated rate where it was flown"""


def oversized(model: Model, flight: Flight) -> Iterator[tuple[str, float, float, bool, bool]]:
    """Yield the angles and rates of a log that are too large for the unit that they are read in:
    name, size and limit [SI], whether an angle is what its rate adds up to (it was flown, or both
    are in degrees), and whether another unit is certain."""
    headings = {a.angle for a in axes_of(model) if a.rate == "r"} | {"psi", "yaw"}
    for name, signal in (flight.source.outputs if flight.source else {}).items():
        values = flight.outputs.get(name)
        if values is None or signal.unit not in ("rad", "rad/s") or signal.scale != 1.0:
            continue
        seen = np.abs(values[np.isfinite(values)])
        # What the file says of it makes sure what its size alone does not.
        said = signal.contradicted == ("deg" if signal.unit == "rad" else "deg/s")
        # The shaft of a motor turns as often as it likes, and a rotor faster than any fuselage; so
        # may the angle of a nonlinear model of one's own, such as a pendulum.
        free = signal.unit == "rad" and not (model.linear or of_helicopter(model.Params))
        if not seen.size or not ((_of_fuselage(model, name) and not free) or said):
            continue
        size, impossible = float(np.percentile(seen, _MOST)), _LARGEST[signal.unit]
        limit = _LINEAR[signal.unit] if model.linear else impossible
        if signal.unit == "rad" and name in headings:
            limit = impossible = _HEADING_TURNS * 2 * np.pi
        if size > limit:
            flown = _flown(model, flight, str(name), size) and not said
            certain = said or (size > impossible and not flown)
            yield str(name), size, limit, flown, certain


def _of_fuselage(model: Model, name: str) -> bool:
    """True if an output is an attitude or a rate of the vehicle, and no other angle of it."""
    of_axes = {n for a in axes_of(model) for n in (a.rate, a.angle)}
    return name in of_axes | _ATTITUDE or of_helicopter(model.Params)


def _flown(model: Model, flight: Flight, name: str, size: float) -> bool:
    """True if an angle of some turns is what its rate, of a size that a helicopter has, adds up to:
    so it is in aerobatics, and where both are in degrees."""
    rate = next((a.rate for a in axes_of(model) if a.angle == name), None)
    p = flight.outputs.get(rate or "")
    if p is None or not np.nanmax(np.abs(p), initial=0.0) <= _LARGEST["rad/s"]:
        return False
    ratio = angle_over_rate(flight.outputs[name], p, flight.dt)
    turns = size <= _FLOWN_TURNS * 2 * np.pi
    return turns and ratio is not None and abs(ratio.factor - 1.0) < _FLOWN


# A stick in per cent that is read as plain numbers fits as well as one read right, with its effect
# a hundredth of what it is. Two things together tell: numbers that are large (or small) for the
# unit, and a model that at the start values moves its outputs too far (or not far enough) by about
# as much.


NEAR = 3.0
"""factor by which start values may be off beside the unit"""
_FULL = 1.2
"""of a stick's or a surface's full travel: 1, or a radian"""


class OtherUnit(NamedTuple):
    """An input whose numbers suit another unit than the one that was stated."""

    flight: str
    name: str
    stated: str
    unit: str
    """that they suit"""
    factor: float
    """of the stated unit over this one"""
    moved: dict[str, float]
    """by output how many times as far it moves as is simulated"""


def inputs_in_other_units(
    flights: Sequence[tuple[str, Flight]],
    simulated: Sequence[Mapping[str, np.ndarray]],
    sticks: Mapping[str, str],
) -> Iterator[OtherUnit]:
    """Inputs that look like degrees for radians, per cent for plain numbers, or the reverse;
    arguments as of `against_start`."""
    for (label, flight), run in zip(flights, simulated, strict=True):
        for name, signal in (flight.source.inputs if flight.source else {}).items():
            if signal.constant is not None:
                continue
            outputs = [n for n in flight.outputs if sticks.get(n, name) == name]
            sizes = {n: _size(flight.outputs[n], run[n]) for n in outputs}
            stated, other = _units_by_size(signal, flight.inputs[name])
            if other and sizes:
                factor = units.factor(other, stated)
                if all(factor / NEAR < size < factor * NEAR for size in sizes.values()):
                    yield OtherUnit(label, name, stated, other, factor, sizes)


def _units_by_size(signal: Signal, values: np.ndarray) -> tuple[str, str]:
    """The stated unit of an input, and the one that its size suits better; empty for none."""
    named = signal.unit in ("rad", "deg", "%")
    stated = "1" if not named and units.is_plain(signal.unit) else signal.unit
    if not named and stated != "1":
        return stated, ""
    size = float(np.max(np.abs(values), initial=0.0)) / units.factor(signal.unit, signal.si)
    for small, large in (("rad", "deg"), ("1", "%")):
        # Of the larger unit no more than its full travel, so that a motor's speed is none.
        if stated == small and _FULL < size <= _FULL * units.factor(small, large):
            return stated, large
        if stated == large and size <= _FULL:
            return stated, small
    return stated, ""


def _size(measured: np.ndarray, simulated: np.ndarray) -> float:
    """Measured over simulated motion of an output; 0 if there is none."""
    seen = np.isfinite(measured)
    with np.errstate(over="ignore", invalid="ignore"):
        far = float(np.std(simulated[seen])) if seen.any() else 0.0
    return float(np.std(measured[seen])) / far if far > 0 and np.isfinite(far) else 0.0
