"""Excitations that a log holds beside the sticks: read as inputs are, and kept apart from them."""

import dataclasses
from collections.abc import Mapping

from heli_jax import naming, units
from heli_jax.config.schema import SignalsConfig
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.flights import Flight, Signal

_PREFIX = "instrument of "


def instrument_signals(model: Model, config: SignalsConfig, where: str) -> dict[str, Signal]:
    """The instruments as further inputs of the log, by a name that says which input they excite.

    Raises:
        InputError: an input that the model lacks, a constant, or a unit that is unknown.
    """
    signals = {}
    for name, stated in config.instruments.items():
        place = f"{where}.instruments.{name}"
        known = naming.names(model.Inputs)
        if name not in known:
            raise InputError(
                f"{place}: model {model.name} has no input {name!r}{nearest(name, known)}"
            )
        if stated.signal is None:
            raise InputError(f"{place}: expected a signal of the log, got a constant")
        unit = stated.unit or "1"
        try:
            # Its size does not matter: a response by instrument is a quotient of two.
            si = units.si_of(unit)
        except ValueError as e:
            raise InputError(f"{place}.unit: {e}") from e
        signals[_PREFIX + name] = Signal(
            stated.signal, unit, si, hold=stated.hold, **stated.conversion
        )
    return signals


def with_instruments(flight: Flight, instruments: Mapping[str, Signal]) -> Flight:
    """The flight with its instruments apart from its inputs.

    Args:
        flight: as read, the instruments among its inputs.
        instruments: as `instrument_signals` named them.
    """
    if not instruments:
        return flight

    def apart(by_input: dict) -> dict:
        return {n: v for n, v in by_input.items() if n not in instruments}

    source = flight.source
    if source is not None:
        source = dataclasses.replace(source, inputs=apart(dict(source.inputs)))
    return dataclasses.replace(
        flight,
        inputs=apart(flight.inputs),
        hold=apart(flight.hold),
        hold_reason=apart(flight.hold_reason),
        instruments={n.removeprefix(_PREFIX): flight.inputs[n] for n in instruments},
        source=source,
    )
