"""Inputs that move so little that they tell nothing: a count of the log, a few samples. Outputs
that never move."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight

_FEW = 8
"""samples away from the value that an input mostly has: fewer are a spike rather than a stick"""
_ON_LATTICE = 5
"""steps from zero, of a value between which and the next one all motion is, from which on that
step is taken for the log's: what is commanded seldom stands at whole multiples of its own size"""


def hardly_moving(flights: Sequence[Flight], moving: Sequence[str]) -> list[Finding]:
    """Doubts about inputs that move by one step of the log, or in a few samples alone.

    Args:
        flights: those that are fitted.
        moving: the inputs that move in any of them.
    """
    findings = []
    for name in moving:
        values = [f.inputs[name] for f in flights]
        away, samples = sum(_away(u) for u in values), sum(u.size for u in values)
        levels = np.unique(np.concatenate(values))
        if words := _one_step(levels):
            text = f"{name} moves by one step of the log alone, between {words}: it excites nothing"
        elif away < _FEW:
            text = f"{name} moves in {away} of {samples} samples alone: it excites hardly anything"
        else:
            continue
        criterion = f"samples in which it is away from its usual value, {_FEW}"
        findings.append(
            Finding("excitation.excited-band", "doubt", f"{text}.", float(away), criterion)
        )
    return findings


def _away(u: Float[np.ndarray, " N"]) -> int:
    """Samples at other values than the one that is most frequent."""
    _, counts = np.unique(u, return_counts=True)
    return int(u.size - counts.max())


def _one_step(levels: Float[np.ndarray, " k"]) -> str:
    """Between which two neighbouring counts an input moves, in words; empty where it moves more."""
    if levels.size != 2:
        return ""
    low, high = (float(v) for v in levels)
    multiple = min(abs(low), abs(high)) / (high - low)
    if multiple < _ON_LATTICE or abs(multiple - round(multiple)) > 1e-6 * multiple:
        return ""
    return f"{low:.6g} and {high:.6g}"


def moving_outputs(flight: Flight) -> tuple[Flight | None, str]:
    """The flight with the outputs that move, or None; what to say of the others.

    Args:
        flight: with at least one measured sample of each output.
    """
    outputs = {n: y for n, y in flight.outputs.items() if np.nanmin(y) < np.nanmax(y)}
    still = ", ".join(n for n in flight.outputs if n not in outputs)
    if not outputs:
        return None, f"none of its outputs ({still}) ever moves"
    said = f"{still} never moves, and is left out in frequency" if still else ""
    return with_outputs(flight, outputs), said


def with_outputs(flight: Flight, names: Collection[str]) -> Flight:
    """The flight with some of its outputs.

    Args:
        flight: any.
        names: of the outputs to keep.
    """
    outputs, sd = (
        {n: v for n, v in of.items() if n in names} for of in (flight.outputs, flight.sd)
    )
    return replace(flight, outputs=outputs, sd=sd)
