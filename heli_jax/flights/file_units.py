"""The unit that a file states for a signal: taken where none is configured, else compared with the
configured one."""

import copy
import dataclasses
import math

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Signal
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.request import Request
from heli_jax.flights.table import Table, column, shown, wrong


def with_file_units(log: ChannelLog | Table, request: Request) -> Request:
    """The request with the units that the file has where none was asked for, and with those that
    contradict what was.

    Raises:
        InputError: the file's unit is of another kind than what is asked for.
    """
    made = copy.copy(request)
    made.signals = {
        key: (_of_file(log, signal, key[0]) if signal.assumed else _compared(log, signal))
        for key, signal in request.signals.items()
    }
    return made


def _of_file(log: ChannelLog | Table, signal: Signal, name: str) -> Signal:
    # Who states a scale has made of the numbers what they are.
    if signal.scale != 1.0 or signal.offset:
        return signal
    stated = unit_in_file(log, signal.name)
    if stated in ("", "-", "1") or not units.is_unit(stated):
        return signal
    try:
        same = math.isclose(units.factor(stated, signal.si), 1.0)
    except ValueError as e:
        problem = f"{name} has no unit stated, and the file's is another: {e}"
        remedy = "state unit, with scale and offset where numbers have to be converted"
        raise wrong(log.path, f"{problem}; {remedy}", column(signal.name)) from e
    return signal if same else dataclasses.replace(signal, unit=stated)


def _compared(log: ChannelLog | Table, signal: Signal) -> Signal:
    """With the file's unit where it is another than the one that was asked for."""
    # Who states a scale has made of the numbers what they are.
    if signal.scale != 1.0 or signal.constant is not None:
        return signal
    stated = unit_in_file(log, signal.name)
    if stated in ("", "-", "1"):
        return signal
    try:
        same = math.isclose(units.factor(stated, signal.unit), 1.0)
    # The file's own words need be no unit that is known here.
    except ValueError:
        same = not units.is_unit(stated)
    return signal if same else dataclasses.replace(signal, contradicted=stated)


def other_units(request: Request) -> list[Finding]:
    """Notes on units that the file states otherwise than the configuration."""
    return [
        note(
            "units.contradicted",
            f"{name}: {shown(signal.name)} is taken in {signal.unit or '1'}, as configured;"
            f" the file says {shown(signal.contradicted)}",
            name,
        )
        for (name, _), signal in request.signals.items()
        if signal.contradicted
    ]


def unit_in_file(log: ChannelLog | Table, name: str) -> str:
    """What a file says of a channel's unit, empty where it says nothing."""
    held = log.topic_of(name).units if isinstance(log, ChannelLog) else log.units
    return held.get(name, "").strip()


def taken_note(name: str, signal: Signal) -> Finding | None:
    """A note on a signal that is read in the file's unit; None for others."""
    if not signal.assumed or signal.unit == signal.si:
        return None
    words = f"no unit stated, {shown(signal.name)} taken in {signal.unit}, as the file says"
    return note("units.assumed", f"{name}: {words}", name)
