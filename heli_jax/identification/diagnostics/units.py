"""Findings on signs and units of signals.

A record alone shows little of them. Degrees fit as well as radians, with estimates off by 57. An
inverted input fits as well as a right one, with estimates of the other sign. So an angle must be
the integral of its rate, and the size of an angle or a rate must suit its unit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.integrate
from jaxtyping import Float

from heli_jax.dynamics.model import Model, axes_of
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.flights.log import shown
from heli_jax.identification.diagnostics.context import Context
from heli_jax.vehicle import of_helicopter


@dataclass(frozen=True)
class Limits:
    """Limits from which signs and units are in doubt."""

    factor: float = 1.3
    """Largest ratio of an angle's change to that of its integrated rate.

    It allows for coupled rotation and a sensor scale error of a fifth."""
    degrees: float = 1.3
    """Largest factor from 57.3 that still counts as degrees read as radians."""
    scale: float = 1.12
    """Largest ratio by the 95 % interval.

    It allows for a sensor scale error of a tenth. For pitch and heading it also allows for the
    cosine of the bank angle."""
    scale_of_roll: float = 1.04
    """The same for the bank angle, whose rate is p plus coupling by the tangent of the pitch angle.

    The coupling follows another motion and changes the ratio by at most 0.01 to 0.02."""
    near_zero: float = 0.2
    """Start value over the estimate, below which the start value does not state a sign."""
    within: float = 0.5
    """Interval over which changes of an angle and its integrated rate are compared [s]."""
    parts: int = 10
    """Number of parts for the jackknife, and shortest record in these intervals."""
    quantile: float = 2.26
    """Quantile of Student's t for 95 %, with parts - 1 degrees of freedom."""
    alike: float = 0.8
    """Correlation of the two from which on their sizes are compared."""
    gap: float = 0.3
    """Longest gap that is bridged [s]."""
    percentile: float = 99.0
    """Percentile of a signal's size, so that no single spike counts."""
    heading_turns: float = 20.0
    """Largest heading without jumps [turns]."""
    flown_turns: float = 5.0
    """Largest angle without jumps from rolls and loops [turns]."""
    flown: float = 0.3
    """Largest difference from 1 of an angle over its integrated rate, for an angle that was flown.
    """


LIMITS = Limits()
_DEGREE = 180.0 / np.pi
_ROLL = frozenset({"phi", "roll"})
_PAIRS = (("p", "phi"), ("q", "theta"), ("r", "psi"), ("r", "yaw"), ("p", "roll"), ("q", "pitch"))
"""Usual names of rates and their angles, in addition to the model's axes."""
_LARGEST, _LINEAR = {"rad": np.pi, "rad/s": 20.0}, {"rad": np.pi / 2, "rad/s": 8.0}
"""Largest values of a small helicopter (without heading), and largest values for a linear model."""


# An angle and the integral of its rate.


class AngleOverRate(NamedTuple):
    """Change of an angle over that of its integrated rate."""

    factor: float
    """Ratio of the changes; negative if they have opposite signs."""
    scale: tuple[float, float]
    """95 % interval of the size of the rate over that of the angle's rate of change.

    With noise on both, it encloses the two regressions of one on the other (Frisch, 1934)."""

    def beyond(self, most: float) -> bool:
        """True if the whole interval lies beyond a ratio, or beyond its inverse."""
        return self.scale[0] > most or self.scale[1] < 1.0 / most


def angle_over_rate(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> AngleOverRate | None:
    """Compare the motion of an angle [rad] with the integral of its rate [rad/s].

    Both are NaN where missing. None if a gap is long, the record is short, or the two are hardly
    correlated.
    """
    steps = max(1, round(LIMITS.within / dt))
    phi, p = (_bridged(v, dt) for v in (angle, rate))
    if phi is None or p is None or angle.size < (LIMITS.parts + 1) * steps:
        return None
    # Unwrap, since headings jump by a turn at south. Compare changes over half a second: a bias of
    # the rate is then only in their mean, and noise of the angle is not divided by a sample time.
    turned = scipy.integrate.cumulative_trapezoid(p, dx=dt, initial=0.0)
    both = [v[steps:] - v[:-steps] for v in (np.unwrap(phi), turned)]
    both = [v - v.mean() for v in both]
    sds = [float(np.std(v)) for v in both]
    alike = float(np.corrcoef(*both)[0, 1]) if min(sds) > 0 else 0.0
    if abs(alike) < LIMITS.alike:
        return None
    size, wide = sds[1] / sds[0], float(np.exp(LIMITS.quantile * _log_sd(*both)))
    scale = (size * abs(alike) / wide, size / abs(alike) * wide)
    return AngleOverRate(float(np.copysign(1.0 / size, alike)), scale)


def _log_sd(first: np.ndarray, second: np.ndarray) -> float:
    """Return the sd of the logarithm of the ratio of two records' (N,) sizes, by the jackknife."""
    n = LIMITS.parts
    squares = [[float(part @ part) for part in np.array_split(x, n)] for x in (first, second)]
    left = [sum(of) - np.asarray(of) for of in squares]
    return float(np.sqrt((n - 1) * np.var(0.5 * np.log(left[0] / left[1]))))


def _bridged(signal: Float[np.ndarray, " N"], dt: float) -> Float[np.ndarray, " N"] | None:
    """Return a signal with straight lines over its gaps; None if a gap is long."""
    seen = np.flatnonzero(np.isfinite(signal))
    longest = np.max(np.diff(np.r_[0, seen, signal.size - 1]))
    if seen.size < 2 or longest * dt > LIMITS.gap:
        return None
    return np.interp(np.arange(signal.size), seen, signal[seen])


def rate_against_angle(c: Context) -> Iterator[Finding]:
    """Find angles that do not move as the integral of their rate."""
    axes = [(a.rate, a.angle) for a in axes_of(c.problem.model) if a.angle is not None]
    for label, flight in c.flights:
        for rate, angle in dict.fromkeys([*axes, *_PAIRS]):
            if not {rate, angle} <= flight.outputs.keys():
                continue
            ratio = angle_over_rate(flight.outputs[angle], flight.outputs[rate], flight.dt)
            if ratio is None:
                continue
            backward, size = ratio.factor < 0, abs(ratio.factor)
            most = LIMITS.scale_of_roll if angle in _ROLL else LIMITS.scale
            numbers: dict[str, Any] = {"flight": label, "rate": rate, "angle": angle}
            if backward or ratio.beyond(LIMITS.factor):
                far = max(size, 1.0 / size) / _DEGREE
                # No model follows an angle that runs against its rate, or is in other units.
                yield found(
                    "signs.rate-against-angle",
                    "doubt",
                    rate,
                    angle,
                    value=ratio.factor,
                    denies=backward or 1.0 / LIMITS.degrees < far < LIMITS.degrees,
                    limit=LIMITS.factor,
                    **numbers,
                )
            elif ratio.beyond(most):
                # A scale, a unit or the clock is wrong, and every parameter depends on one of them.
                yield found(
                    "units.rate-scale",
                    "doubt",
                    rate,
                    angle,
                    value=1.0 / size,
                    distrusts=_estimates(c),
                    low=ratio.scale[0],
                    high=ratio.scale[1],
                    limit=most,
                    **numbers,
                )


# Units.


def against_file(c: Context) -> Iterator[Finding]:
    """Find signals for which file and configuration state different units."""
    for label, flight in c.flights:
        source = flight.source
        for name, signal in ({**source.inputs, **source.outputs} if source else {}).items():
            if signal.contradicted:
                yield found(
                    "units.against-file",
                    "doubt",
                    name,
                    distrusts=_estimates(c),
                    flight=label,
                    unit=signal.unit or "1",
                    stated=shown(signal.contradicted),
                    channel=shown(signal.name),
                )


def size_of_angles(c: Context) -> Iterator[Finding]:
    """Find angles and rates that are too large for their unit."""
    for label, flight in c.flights:
        yield from in_degrees(c.problem.model, label, flight, _estimates(c))


def in_degrees(
    model: Model, label: str, flight: Flight, estimates: tuple[str, ...] = ()
) -> Iterator[Finding]:
    """Find angles and rates of a flight that look like degrees read as radians."""
    axes = axes_of(model)
    # A rotor turns faster than any fuselage, and the angle of a user's nonlinear model, such as a
    # pendulum, makes any number of turns.
    helicopter = of_helicopter(model.Params)
    fuselage = {n for pair in _PAIRS for n in pair} | {n for a in axes for n in (a.rate, a.angle)}
    headings = {a.angle for a in axes if a.rate == "r"} | {"psi", "yaw"}
    for name, signal in (flight.source.outputs if flight.source else {}).items():
        values = flight.outputs.get(name)
        if values is None or signal.unit not in _LARGEST or signal.scale != 1.0:
            continue
        free = signal.unit == "rad" and not model.linear
        seen = np.abs(values[np.isfinite(values)])
        if not seen.size or not (helicopter or (name in fuselage and not free)):
            continue
        size = float(np.percentile(seen, LIMITS.percentile))
        impossible = _LARGEST[signal.unit]
        limit = _LINEAR[signal.unit] if model.linear else impossible
        if signal.unit == "rad" and name in headings:
            limit = impossible = LIMITS.heading_turns * 2 * np.pi
        if size <= limit:
            continue
        flown = _flown(model, flight, str(name), size)
        certain = size > impossible and not flown
        yield found(
            "units.in-doubt",
            "doubt",
            str(name),
            value=size,
            denies=certain,
            distrusts=() if flown else estimates,
            flight=label,
            unit=signal.unit,
            degrees=signal.unit.replace("rad", "deg"),
            limit=limit,
            channel=shown(signal.name),
            flown=flown,
        )


def _flown(model: Model, flight: Flight, name: str, size: float) -> bool:
    """True if an angle of several turns is the integral of a rate that a helicopter can reach.

    This holds in aerobatics, and if both are in degrees.
    """
    rate = next((a.rate for a in axes_of(model) if a.angle == name), None)
    p = flight.outputs.get(rate or "")
    if p is None or not np.nanmax(np.abs(p), initial=0.0) <= _LARGEST["rad/s"]:
        return False
    ratio = angle_over_rate(flight.outputs[name], p, flight.dt)
    turns = size <= LIMITS.flown_turns * 2 * np.pi
    return turns and ratio is not None and abs(ratio.factor - 1.0) < LIMITS.flown


def _estimates(c: Context) -> tuple[str, ...]:
    """Return all estimates, since any may depend on the unit; none if the fit did not converge."""
    return () if c.status == "not-converged" else tuple(c.estimates)


def turned_from_start(c: Context) -> Iterator[Finding]:
    """Find parameters with a sign that differs significantly from their start values.

    An inverted signal fits equally well, so only the start value shows it.
    """
    turned = {}
    for name, free in c.problem.free.items() if c.at_optimum else ():
        e = c.estimates[name]
        if name in c.problem.model.delay_parameters or e.lower95 is None or e.upper95 is None:
            continue
        surely = e.lower95 * e.upper95 > 0 and e.value * free.start < 0
        if surely and abs(free.start) > LIMITS.near_zero * abs(e.value):
            turned[name] = (free.start, e.value)
    if turned:
        starts, ends = zip(*turned.values(), strict=True)
        yield found(
            "signs.turned-from-start", "doubt", *turned, starts=list(starts), ends=list(ends)
        )


DIAGNOSTICS = (
    rate_against_angle,
    against_file,
    size_of_angles,
    turned_from_start,
)
