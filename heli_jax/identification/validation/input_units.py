"""Whether an input's numbers are of the unit that they are said to be in.

A stick in per cent that is read as plain numbers fits as well as one read right, with its effect a
hundredth of what it is. Two things together tell: numbers that are large (or small) for the unit,
and a model that at the start values moves its outputs too far (or not far enough) by about as much.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax import naming, units
from heli_jax.finding import UNIT_IN_DOUBT, Finding
from heli_jax.flights.flight import Flight, Signal
from heli_jax.flights.table import shown
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.other_hold import pseudoinverse

_NEAR = 3.0
"""factor by which start values may be off beside the unit"""
_STEP, _SCALED = 1.001, 0.2
"""factor on a signal, and the relative change of a parameter over its own, from which on the unit
of the signal decides what the parameter is"""
_FULL = 1.2
"""of a stick's or a surface's full travel: 1, or a radian"""


class _Other(NamedTuple):
    """A unit that numbers may have had in place of the one that was stated."""

    unit: str
    factor: float
    """of the stated unit over this one"""


def doubtful_inputs(
    flights: Sequence[tuple[str, Flight]],
    simulated: Sequence[Mapping[str, np.ndarray]],
    sticks: Mapping[str, str] | None = None,
) -> list[Finding]:
    """A doubt for each input that looks like degrees for radians, per cent for plain numbers, or
    the reverse.

    Args:
        flights: by what each is called.
        simulated: at the start values, by flight and output (N,), SI.
        sticks: by output the input that moves it, of `signal_signs.sticks_of`; without it any.
    """
    findings = []
    for (label, flight), run in zip(flights, simulated, strict=True):
        for name, signal in (flight.source.inputs if flight.source else {}).items():
            if signal.constant is not None:
                continue
            other = _other(signal, flight.inputs[name])
            moved = [n for n in flight.outputs if (sticks or {}).get(n, name) == name]
            sizes = [_size(flight.outputs[n], run[n]) for n in moved]
            if other is None or not sizes:
                continue
            if all(s and other.factor / _NEAR < s < other.factor * _NEAR for s in sizes):
                findings.append(_said(label, name, signal, other, moved, sizes))
    return findings


def scaled_by(at: Solution, name: str) -> tuple[str, ...]:
    """The parameters that another unit of a signal would change by a good part of its factor.

    Args:
        at: where the fit ended.
        name: of the input or output.
    """
    layout, data = at.layout, at.data
    flights = []
    for flight in data.flights:
        outputs = {n: y * _STEP if n == name else y for n, y in flight.outputs.items()}
        inputs = {n: u * _STEP if n == name else u for n, u in naming.asdict(flight.inputs).items()}
        flights.append(
            flight._replace(outputs=outputs, inputs=naming.replace(flight.inputs, **inputs))
        )
    e = evaluate(*at)
    other = evaluate(layout, data._replace(flights=tuple(flights)), at.noise, at.z)
    step = pseudoinverse(np.asarray(e.J)) @ (np.asarray(e.r) - np.asarray(other.r))
    values, slopes = np.asarray(e.named), np.asarray(e.slopes)
    change = step[: slopes.size] * slopes / (_STEP - 1.0)
    return tuple(
        n
        for n, c, v in zip(layout.of_interest, change, values, strict=True)
        if abs(c) > _SCALED * abs(v)
    )


def _other(signal: Signal, values: np.ndarray) -> _Other | None:
    """What the numbers of an input may be instead, by their size in the stated unit."""
    if signal.unit in ("rad", "deg", "%"):
        stated = signal.unit
    elif units.is_plain(signal.unit):
        stated = "1"
    else:
        return None
    size = float(np.max(np.abs(values), initial=0.0)) / units.factor(signal.unit, signal.si)
    for small, large in (("rad", "deg"), ("1", "%")):
        # Of the larger unit no more than its full travel, so that a motor's speed is none.
        per = 1.0 / units.factor(large, small)
        if stated == small and _FULL < size <= _FULL * per:
            return _Other(large, 1.0 / per)
        if stated == large and size <= _FULL:
            return _Other(small, per)
    return None


def _size(measured: np.ndarray, simulated: np.ndarray) -> float:
    """How many times as far an output moves as was simulated; 0 where nothing can be told."""
    seen = np.isfinite(measured)
    with np.errstate(over="ignore", invalid="ignore"):
        far = float(np.std(simulated[seen])) if seen.any() else 0.0
    return float(np.std(measured[seen])) / far if far > 0 and np.isfinite(far) else 0.0


def _said(
    label: str,
    name: str,
    signal: Signal,
    other: _Other,
    moved: Sequence[str],
    sizes: Sequence[float],
) -> Finding:
    now = signal.unit if signal.unit in ("rad", "deg", "%") else "plain numbers"
    was = "plain numbers" if other.unit == "1" else other.unit
    move = "move" if len(moved) > 1 else "moves"
    words = (
        f"{label}: at the start values {' and '.join(moved)} {move} "
        f"{', '.join(f'{s:.2g}' for s in sizes)} times as far as simulated: {shown(signal.name)} "
        f"looks like {was} read as {now}, with the effect of {name} off by "
        f'{max(other.factor, 1.0 / other.factor):.3g}; state unit: "{other.unit}" if so.'
    )
    criterion = f"within a factor of {_NEAR:g} of {other.factor:.3g}"
    return Finding(
        UNIT_IN_DOUBT,
        "doubt",
        words,
        max(sizes),
        criterion,
        (name,),
        brief=f"the unit of {name} is in doubt",
    )
