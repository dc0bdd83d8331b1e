"""Flights made ready for regression: smoothed, segment by segment."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import without_jumps
from heli_jax.identification.equation_error import smoothing
from heli_jax.identification.equation_error.structure import Structure
from heli_jax.numerics.white_noise import noise_guess

_SEGMENTS = 20
"""of a flight at most, the longest: each has an initial state of its own for what is hidden"""
_RESOLVED = 4
"""samples to a half width of the kernel that are kept: what is smoothed moves no faster"""


class Segment(NamedTuple):
    """A stretch without gaps, smoothed: arrays (signals, n), SI."""

    states: Float[np.ndarray, "k n"]
    """those that are shown, in the order of `Structure.shown`"""
    inputs: Float[np.ndarray, "m n"]
    left: Float[np.ndarray, "e n"]
    """the left-hand sides of the equations: derivatives per second, or outputs"""
    step: float
    """time between samples [s]"""


class Record(NamedTuple):
    """A flight for regression."""

    label: str
    known: Mapping[str, float]
    structure: Structure
    segments: tuple[Segment, ...]


def whole_segments(flight: Flight, names: Sequence[str]) -> tuple[list[slice], dict]:
    """The stretches in which the named outputs are seen, and these with short gaps bridged."""
    return smoothing.segments({n: flight.outputs[n] for n in names})


def shortest(half: int) -> int:
    """Samples of the shortest segment that is worth smoothing."""
    # Between the margins three widths of the kernel are left, so a few values that do not share
    # their samples.
    return 2 * smoothing.margin(half) + 6 * half


def width(flights: Sequence[Flight]) -> int:
    """The half width of the kernel for all flights [samples], by the noise of their outputs."""
    widths = []
    for flight in flights:
        parts, bridged = whole_segments(flight, list(flight.outputs))
        longest = max(parts, key=lambda s: s.stop - s.start, default=None)
        if longest is None:
            continue
        sd = {n: flight.sd.get(n) or noise_guess(y) for n, y in flight.outputs.items()}
        widths.append(smoothing.half_width({n: y[longest] for n, y in bridged.items()}, sd))
    # One kernel for all flights, since they are regressed together: that whose motion is fastest
    # decides, or its dynamics would be smoothed away.
    return min(widths, default=smoothing.HALF_WIDTHS[0])


def record(
    model: Model, flight: Flight, structure: Structure, half: int, late: Mapping[str, float]
) -> Record:
    """A flight smoothed.

    Args:
        model: linear.
        flight: with outputs as `structure` has them.
        structure: of the flight.
        half: half width of the kernel [samples].
        late: by input, how late it acts [s].
    """
    flight = without_jumps(flight)
    outputs = structure.signals[: -len(naming.names(model.Inputs))]
    parts, bridged = whole_segments(flight, outputs)
    least = shortest(half)
    parts = sorted((p for p in parts if p.stop - p.start >= least), key=lambda p: p.start - p.stop)
    made = [
        _segment(flight, structure, {n: bridged[n][p] for n in outputs}, p, (half, late))
        for p in parts[:_SEGMENTS]
    ]
    return Record(flight.name, flight.known, structure, tuple(made))


def _segment(
    flight: Flight,
    structure: Structure,
    outputs: Mapping[str, np.ndarray],
    part: slice,
    timing: tuple[int, Mapping[str, float]],
) -> Segment:
    (half, late), dt = timing, flight.dt
    made = {n: smoothing.smoothed(y, dt, half) for n, y in outputs.items()}
    n = part.stop - part.start
    # Inputs are known before the segment too, where a delayed one comes from.
    for name in structure.signals[len(outputs) :]:
        all_of_it = flight.inputs[name]
        at = np.clip(np.arange(part.start - n, part.stop), 0, all_of_it.size - 1)
        whole = smoothing.smoothed_input(
            all_of_it[at], dt, half, held=flight.hold[name] == "zero-order", late=late.get(name, 0)
        )
        made[name] = whole[:, n:]
    z = np.stack([made[name] for name in structure.signals])  # (z, orders, n)
    # A state may be made of several signals and of their derivatives: all were smoothed by the same
    # kernel, so the sum is that state smoothed, without an error of its own.
    states = {i: np.einsum("rz,zrn->n", c, z) for i, c in structure.shown.items()}
    # What is a derivative of highest order already has none left; `_by_derivatives` goes once.
    rates = {
        i: np.einsum("rz,zrn->n", structure.shown[i][:-1], z[:, 1:])
        for i in structure.rows
        if i in structure.shown
    }
    left = [
        rates[i] if i in rates else made[name][0]
        for i, name in zip(structure.rows, structure.equations, strict=True)
    ]
    # Neighbours within a kernel are made of the same samples: leaving most of them out loses next
    # to nothing, and hidden states are integrated in fewer steps.
    empty, every = np.zeros((0, z.shape[-1])), max(1, half // _RESOLVED)
    return Segment(
        (np.stack(list(states.values())) if states else empty)[:, ::every],
        z[len(outputs) :, 0, ::every],
        np.stack(left)[:, ::every] if left else empty,
        dt * every,
    )
