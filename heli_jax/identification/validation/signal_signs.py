"""Signs and units of signals: three tests that need no fit.

- An angle must be the integral of its rate.
- Outputs simulated at the start values must move with the measured ones, not against them.
- The size of an angle or a rate must suit its unit. A record with all outputs in degrees fits as
  well as one in radians, with every estimate off by 57.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.dynamics.model import Model, axes_of
from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.metrics import cross_correlation
from heli_jax.vehicle import of_helicopter

# An angle and the integral of its rate.


_PAIRS = (("p", "phi"), ("q", "theta"), ("r", "psi"), ("r", "yaw"), ("p", "roll"), ("q", "pitch"))
"""Usual names of rates and their angles, in addition to the model's axes."""
WITHIN = 0.5
"""Interval over which changes of an angle and its integrated rate are compared [s]."""
PARTS = 10
"""Number of parts for the jackknife, and shortest record in these intervals."""
_ALIKE = 0.8
"""Correlation of the two from which on their sizes are compared."""
_QUANTILE = 2.26
"""Quantile of Student's t for 95 %, with PARTS - 1 degrees of freedom."""
_GAP = 0.3
"""Longest gap that is bridged [s]."""


class AngleOverRate(NamedTuple):
    """Change of an angle over that of its integrated rate.

    With noise on both, the two regressions of one on the other enclose the factor (Frisch, 1934):
    it lies between `factor * |correlation|` and `factor / |correlation|`.
    """

    factor: float
    """Ratio of the changes; negative if they have opposite signs."""
    correlation: float
    scale: tuple[float, float]
    """95 % interval of the rate over the angle's rate of change, with noise on both."""

    def off(self, by: float) -> bool:
        """True if the factor is wrong by `by` or more for any noise."""
        size, alike = abs(self.factor), abs(self.correlation)
        return size * alike > by or size / alike < 1.0 / by


def rates_and_angles(model: Model) -> list[tuple[str, str]]:
    """Return the pairs of a rate and its angle, by the model's axes and by their usual names."""
    axes = [(a.rate, a.angle) for a in axes_of(model) if a.angle is not None]
    return list(dict.fromkeys([*axes, *_PAIRS]))


def angle_over_rate(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> AngleOverRate | None:
    """Compare the motion of an angle [rad] with the integral of its rate [rad/s].

    Both are NaN where missing. None if a gap is long, the record is short, or the two are hardly
    correlated.
    """
    steps = max(1, round(WITHIN / dt))
    if min(np.isfinite(v).sum() for v in (angle, rate)) < 2 or angle.size < (PARTS + 1) * steps:
        return None
    (phi, known), (p, known_too) = (over_gaps(v, dt) for v in (angle, rate))
    if not (known & known_too).all():
        return None
    # Unwrap, since headings jump by a turn at south. Compare changes over half a second: a bias of
    # the rate is then only in their mean, and noise of the angle is not divided by a sample time.
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
    """Return the sd of the logarithm of the ratio of two records' (N,) sizes, by the jackknife."""
    squares = [[float(part @ part) for part in np.array_split(x, PARTS)] for x in (first, second)]
    left = [sum(of) - np.asarray(of) for of in squares]
    return float(np.sqrt((PARTS - 1) * np.var(0.5 * np.log(left[0] / left[1]))))


def integral(rate: Float[np.ndarray, " N"], dt: float) -> Float[np.ndarray, " N"]:
    """Return the trapezoidal integral of a signal without gaps, from zero; dt in [s]."""
    return np.concatenate([np.zeros(1), np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))])


def over_gaps(signal: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a signal (N,) with straight lines over its gaps, and True (N,) outside long gaps.

    Missing samples are NaN; at least two must be known.
    """
    seen = np.flatnonzero(np.isfinite(signal))
    rows = np.arange(signal.size)
    ends = np.r_[0, seen, signal.size - 1]
    after = np.searchsorted(ends, rows, side="left")
    # Distance between the samples before and after a row, or to the record's ends.
    gap = ends[np.minimum(after, ends.size - 1)] - ends[np.maximum(after - 1, 0)]
    known = np.isfinite(signal) | (gap * dt <= _GAP)
    return np.interp(rows, seen, signal[seen]), known


# Outputs against those simulated at the start values.


AGAINST = -0.3
"""Correlation below which a simulated output moves against the measured one."""
_SURE = 3.0
"""Least correlation in standard deviations of that by chance."""
_LAG = 0.25
"""Longest lag to either side [s]; at longer lags an oscillation may look inverted."""
_LARGER = 1.3
"""Least ratio of the correlation with the wrong sign to any with the right one."""


def against_start(
    flights: Sequence[Flight], simulated: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, float]:
    """Return the outputs that correlate negatively with the simulation at the start values.

    The result is the correlation over all flights by output, if it is significantly negative.

    Args:
        simulated: by flight and output (N,) [SI].
    """
    against = {}
    for name in dict.fromkeys(n for f in flights for n in f.outputs):
        both = [
            (f.outputs[name], run[name])
            for f, run in zip(flights, simulated, strict=True)
            if name in f.outputs
        ]
        # Remove each flight's mean, since flights have their own biases.
        measured, model = (
            np.concatenate([v - np.nanmean(v) for v in of]) for of in zip(*both, strict=True)
        )
        correlation = _surely(measured, model, flights[0].dt)
        if correlation is not None and correlation < 0:
            against[name] = correlation
    return against


def _surely(measured: np.ndarray, simulated: np.ndarray, dt: float) -> float | None:
    """Return the most negative correlation, or else the largest; None if not significant."""
    seen = np.isfinite(measured)
    if not np.max(np.abs(simulated)) < 1e100 or np.std(simulated) == 0 or seen.mean() < 0.5:
        return None
    lags = max(1, min(round(_LAG / dt), measured.size // 4))
    # Missing samples add nothing to the products, but the scale counts all of the simulation.
    c = cross_correlation(simulated, measured, lags) / np.sqrt(seen.mean())
    worst, best = float(np.min(c)), float(np.max(c))
    # Standard deviation for independent signals, from their autocorrelations (Bartlett, 1935).
    most = max(1, measured.size // 5)
    window = 1.0 - np.arange(most + 1) / (most + 1)
    a, b = (cross_correlation(y, y, most)[most:] for y in (measured, simulated))
    both = window * a * b
    chance = float(np.sqrt(max(both[0] + 2.0 * both[1:].sum(), 1e-12) / seen.sum()))
    least = max(-AGAINST, _SURE * chance)
    if -worst > least and -worst > _LARGER * best:
        return worst
    return best if best > least and best > -worst else None


# The size of a signal in its unit.


_ATTITUDE = {"p", "q", "r", "phi", "theta", "psi", "roll", "pitch", "yaw"}
"""Usual names of attitudes and rates, for models without axes (kinematics) and for files."""
_LARGEST, _LINEAR = {"rad": np.pi, "rad/s": 20.0}, {"rad": np.pi / 2, "rad/s": 8.0}
"""Largest values of a small helicopter (without heading), and largest values for a linear model."""
_HEADING_TURNS = 20.0
"""Largest heading without jumps [turns]."""
_FLOWN_TURNS = 5.0
"""Largest angle without jumps from rolls and loops [turns]."""
_MOST = 99.0
"""Percentile of the size that is compared with these limits, so that no single spike counts."""
_FLOWN = 0.3
"""Largest difference from 1 of an angle over its integrated rate, for an angle that was flown."""


def oversized(model: Model, flight: Flight) -> Iterator[tuple[str, float, float, bool, bool]]:
    """Yield the angles and rates of a log that are too large for their unit.

    Each item is the name, the size and its limit [SI], and two flags. The first is True if an angle
    is the integral of its rate: it was flown, or both are in degrees. The second is True if another
    unit is certain.
    """
    headings = {a.angle for a in axes_of(model) if a.rate == "r"} | {"psi", "yaw"}
    for name, signal in (flight.source.outputs if flight.source else {}).items():
        values = flight.outputs.get(name)
        if values is None or signal.unit not in ("rad", "rad/s") or signal.scale != 1.0:
            continue
        seen = np.abs(values[np.isfinite(values)])
        # The unit in the file is certain evidence; the size alone is not.
        said = signal.contradicted == ("deg" if signal.unit == "rad" else "deg/s")
        # A motor's shaft makes any number of turns, and a rotor turns faster than any fuselage. So
        # may the angle of a user's nonlinear model, such as a pendulum.
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
    """True if an output is an attitude or a rate of the fuselage, and no other angle."""
    of_axes = {n for a in axes_of(model) for n in (a.rate, a.angle)}
    return name in of_axes | _ATTITUDE or of_helicopter(model.Params)


def _flown(model: Model, flight: Flight, name: str, size: float) -> bool:
    """True if an angle of several turns is the integral of a rate that a helicopter can reach.

    This holds in aerobatics, and if both are in degrees.
    """
    rate = next((a.rate for a in axes_of(model) if a.angle == name), None)
    p = flight.outputs.get(rate or "")
    if p is None or not np.nanmax(np.abs(p), initial=0.0) <= _LARGEST["rad/s"]:
        return False
    ratio = angle_over_rate(flight.outputs[name], p, flight.dt)
    turns = size <= _FLOWN_TURNS * 2 * np.pi
    return turns and ratio is not None and abs(ratio.factor - 1.0) < _FLOWN
