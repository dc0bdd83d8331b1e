"""Signs and units of signals: three tests that need no fit.

An angle is the integral of its rate. Simulated outputs move with the measured ones if the start
values have the right signs. The size of an angle or a rate suits radians or degrees: where all
outputs are in degrees, they fit as well, with every estimate off by 57.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.dynamics.model import Model, axes_of
from heli_jax.flights.flight import Flight
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
"""[s] to either side: at longer lags an oscillation of the right sign looks inverted"""
_LARGER = 1.3
"""by how much the correlation of the wrong sign exceeds any of the right one"""


def against_start(
    flights: Sequence[Flight], simulated: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, float]:
    """Return by output the correlation over all flights with the simulation at the start values,
    where it surely is negative.

    Args:
        simulated: by flight and output (N,), SI.
    """
    against = {}
    for name in dict.fromkeys(n for f in flights for n in f.outputs):
        both = [
            (f.outputs[name], run[name])
            for f, run in zip(flights, simulated, strict=True)
            if name in f.outputs
        ]
        # Each flight about its mean: flights have biases of their own.
        measured, model = (
            np.concatenate([v - np.nanmean(v) for v in of]) for of in zip(*both, strict=True)
        )
        correlation = _surely(measured, model, flights[0].dt)
        if correlation is not None and correlation < 0:
            against[name] = correlation
    return against


def _surely(measured: np.ndarray, simulated: np.ndarray, dt: float) -> float | None:
    """Return the most negative correlation, or else the largest, where it is sure."""
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
