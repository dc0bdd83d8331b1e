"""Numbers of a log that are hardly what a configuration takes them for."""

import numpy as np

from heli_jax import units
from heli_jax.config.onboard import VibrationConfig
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight

_PULSE = (800.0, 2200.0)
"""us; what receivers and servos know"""
_FASTEST_ROTOR = 500.0
"""rad/s, or 4800 rpm: the smallest machines stay below"""
OFFSET_AND_SCALE = "such as offset: 1500, scale: 0.002"


def pulse_width_doubts(flight: Flight) -> tuple[Finding, ...]:
    """A doubt for each input whose numbers look like pulse widths and are taken as something
    else.

    Args:
        flight: as read.
    """
    doubts = []
    for name, signal in (flight.source.inputs if flight.source else {}).items():
        # A rotor's speed in rpm has such numbers too.
        if signal.constant is not None or signal.offset or signal.si in ("rad/s", "1/s", "Hz"):
            continue
        numbers = signal.from_si(flight.inputs[name])
        low, high = float(np.min(numbers)), float(np.max(numbers))
        if low < _PULSE[0] or high > _PULSE[1]:
            continue
        taken = "plain numbers" if units.is_plain(signal.unit) else signal.unit
        if signal.scale != 1.0:
            taken = f"{signal.scale:g} {taken} each"
        words = (
            f"{name}: {low:.4g} to {high:.4g} in the log look like pulse widths in us, and are "
            f"taken as {taken}, with no offset: state offset and scale, {OFFSET_AND_SCALE}"
        )
        doubts.append(Finding("units.unlikely", "doubt", words, high, "largest number", (name,)))
    return tuple(doubts)


def rotor_doubt(vibration: VibrationConfig, speed: float) -> tuple[Finding, ...]:
    """A finding where a rotor's stated speed is none, or its unit is not stated.

    Args:
        vibration: as configured.
        speed: what it states [rad/s].
    """
    if speed > _FASTEST_ROTOR:
        words = (
            f"vibration: a rotor of {speed:.4g} rad/s turns at {speed * 30 / np.pi:.0f} rpm, "
            f"expected less than {_FASTEST_ROTOR:g} rad/s; was unit: rpm meant?"
        )
        criterion = f"rad/s, {_FASTEST_ROTOR:g}"
        return (Finding("units.unlikely", "doubt", words, speed, criterion),)
    if "unit" not in vibration.model_fields_set:
        words = f"vibration: rotor: no unit stated, {speed:g} taken as rad/s"
        return (note("units.assumed", words, value=speed),)
    return ()
