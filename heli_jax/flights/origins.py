"""Scales and constants of a flight's signals in its log, and their description."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from heli_jax.flights.flight import Flight, Signal
from heli_jax.flights.table import shown
from heli_jax.numbers import number


def scale_problem(signal: Signal) -> str:
    """Reason why the scale or the offset of a signal is wrong; empty if neither is."""
    # A scale of zero would make a constant of the signal, and one of 1e300 overflows.
    if not 1e-12 <= abs(signal.scale) <= 1e12:
        return f"scale is {signal.scale:g}, expected a number other than 0 from 1e-12 to 1e12"
    if not abs(signal.offset) <= 1e12:
        return f"offset is {signal.offset:g}, expected at most 1e12"
    # Two minus signs are more likely a slip than an intention, and look like none.
    if signal.invert and signal.scale < 0:
        return f"scale is {signal.scale:g} and invert is true, expected one of the two"
    return ""


def without_constants(
    inputs: Mapping[str, Signal],
) -> tuple[dict[str, Signal], dict[str, Signal]]:
    """The inputs that are in the log, and those that are constant."""
    logged = {name: s for name, s in inputs.items() if s.constant is None}
    return logged, {name: s for name, s in inputs.items() if s.constant is not None}


def with_origins(
    flight: Flight,
    inputs: Mapping[str, Signal],
    outputs: Mapping[str, Signal],
    constants: Mapping[str, Signal],
) -> Flight:
    """The flight with its constant inputs, and with what its signals are in the log.

    Raises:
        ValueError: a constant is no finite number.
    """
    values, reasons = dict(flight.inputs), dict(flight.hold_reason)
    for name, signal in constants.items():
        value = 1.0 if signal.constant is None else signal.constant
        # Scale and offset are of numbers in a log, and a constant is none.
        plain = dataclasses.replace(signal, scale=1.0, offset=0.0, invert=False)
        values[name] = plain.to_si(np.full(flight.n_samples, value))
        reasons[name] = "a constant"
    source = flight.source
    if source is not None:
        source = dataclasses.replace(source, inputs=dict(inputs), outputs=dict(outputs))
    return dataclasses.replace(
        flight, inputs={name: values[name] for name in inputs}, hold_reason=reasons, source=source
    )


def in_words(signal: Signal) -> str:
    """Describe a signal in the log: `'RCIN.C1', (number - 1500) x 0.002 in 1, inverted`."""
    if signal.constant is not None:
        words = f"{number(signal.constant, 6)} {_unit(signal)}".rstrip() + ", a constant"
    else:
        steps = f"number - {number(signal.offset, 6)}" if signal.offset else "number"
        if signal.scale != 1.0:
            steps = f"({steps})" if signal.offset else steps
            steps += f" x {number(signal.scale, 6)}"
        words = shown(signal.name) + ("" if steps == "number" else f", {steps}")
        words += f", in {signal.unit}" if _unit(signal) else ""
        words += ", inverted" if signal.invert else ""
    return f"{words}; {signal.origin}" if signal.origin else words


def _unit(signal: Signal) -> str:
    return "" if signal.unit.strip() in ("", "1", "-") else signal.unit


def as_content(signal: Signal) -> dict[str, str | float | bool | None]:
    """A signal as plain data, for `fit.json`."""
    if signal.constant is not None:
        return {"constant": signal.constant, "unit": signal.unit, "origin": signal.origin}
    return {
        "signal": signal.name,
        "unit": signal.unit,
        "scale": signal.scale,
        "offset": signal.offset,
        "invert": signal.invert,
        "origin": signal.origin,
    }
