"""Findings on signs and units of signals.

A record alone shows little of them. Degrees fit as well as radians, with estimates off by 57. An
inverted input fits as well as a right one, with estimates of the other sign.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from heli_jax.dynamics.model import Model
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.flights.log import shown
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.validation.signal_signs import (
    AGAINST,
    against_start,
    angle_over_rate,
    oversized,
    rates_and_angles,
)


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


LIMITS = Limits()
_DEGREE = 180.0 / np.pi
_ROLL = frozenset({"phi", "roll"})


def rate_against_angle(c: Context) -> Iterator[Finding]:
    """Find angles that do not move as the integral of their rate."""
    for label, flight in c.flights:
        for rate, angle in rates_and_angles(c.problem.model):
            if not {rate, angle} <= flight.outputs.keys():
                continue
            ratio = angle_over_rate(flight.outputs[angle], flight.outputs[rate], flight.dt)
            if ratio is None:
                continue
            backward, off = ratio.factor < 0, ratio.off(LIMITS.factor)
            size = abs(ratio.factor)
            low, high = ratio.scale
            most = LIMITS.scale_of_roll if angle in _ROLL else LIMITS.scale
            numbers: dict[str, Any] = {"flight": label, "rate": rate, "angle": angle}
            if backward or off:
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
            elif low > most or high < 1.0 / most:
                # A scale, a unit or the clock is wrong, and every parameter depends on one of them.
                yield found(
                    "units.rate-scale",
                    "doubt",
                    rate,
                    angle,
                    value=1.0 / size,
                    distrusts=_estimates(c),
                    low=low,
                    high=high,
                    limit=most,
                    **numbers,
                )


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
    for name, size, limit, flown, certain in oversized(model, flight):
        assert flight.source is not None
        signal = flight.source.outputs[name]
        yield found(
            "units.in-doubt",
            "doubt",
            name,
            value=size,
            denies=certain,
            distrusts=() if certain or flown else estimates,
            flight=label,
            unit=signal.unit,
            degrees=signal.unit.replace("rad", "deg"),
            limit=limit,
            channel=shown(signal.name),
            flown=flown,
        )


def _estimates(c: Context) -> tuple[str, ...]:
    """Return all estimates, since any may depend on the unit; none if the fit did not converge."""
    return () if c.status == "not-converged" else tuple(c.estimates)


def outputs_against_start(c: Context) -> Iterator[Finding]:
    """Find outputs that move against those simulated at the start values.

    After a fit this is tested only if the model is inadequate: otherwise it has the right sign.
    """
    if c.fitted and not c.adequacy.denied:
        return
    flights = [flight for _, flight in c.flights]
    against = against_start(flights, c.start.simulated)
    if against:
        yield found(
            "signs.against-start",
            "doubt",
            *against,
            value=min(against.values()),
            correlations=list(against.values()),
            limit=AGAINST,
        )


def turned_from_start(c: Context) -> Iterator[Finding]:
    """Find parameters with a sign that differs significantly from their start values.

    An inverted signal fits equally well, so only the start value shows it.
    """
    turned = {}
    for name, free in c.problem.free.items() if c.arrived else ():
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
    outputs_against_start,
    turned_from_start,
)
