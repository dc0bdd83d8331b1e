"""Motion of an input between the samples of a log, as the record itself shows it.

An input that stays for several samples and jumps was commanded in steps, and each sample holds
until the next. One that moves at nearly every sample was sampled on its way: a straight line from
sample to sample is nearer to it. A record may have both: doublets, then a chirp.
"""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from heli_jax.flights.flight import Flight
from heli_jax.numerics.jumps import FEW, POWER, jumps, smallest_move, split, weights


class Decision(NamedTuple):
    """A hold and, in words, what speaks for it."""

    hold: str
    reason: str


LOW_PASSED = "resampling.input-low-passed"
"""code of an input that was commanded in steps and was low-passed with outputs"""
_SHARE = 0.05, 0.9
"""share of the motion in jumps, from which on an input is held at them, and at all samples: white
noise has 0.01, a random walk 0.02, steps under noise of half a percent 0.96"""


def decide(values: np.ndarray) -> Decision:
    """Decide what an input (N,), in any unit, does between samples, by how it moves.

    An input that was commanded in steps moves in jumps, whether it stays for two samples (a stick
    logged faster than it was sampled) or two hundred, and whatever noise of a few counts lies on
    the steps. A smooth motion has hardly any, with or without pauses, and nor has a step that takes
    several samples. An input that does both is mixed. Moves by one count of the log say nothing by
    themselves: they are the resolution's, of a slow motion or of noise.
    """
    largest = float(np.abs(values).max())
    if largest > 0:
        values = values / largest  # what is left neither overflows nor vanishes
    quantum, span = smallest_move(values), float(np.ptp(values))
    if not np.isfinite(quantum):
        return Decision("zero-order", "never moves")
    moved = np.abs(np.diff(values)) >= quantum
    share = float(moved.mean())
    if span <= FEW * quantum:
        return _of_few_values(np.diff(values), moved, share)
    weight = weights(values)
    if not weight.any():
        return Decision("linear", f"moves by one count of the log at a time, {_percent(share)}")
    held = jumps(values)
    # No move counts for more than the range of nearly all samples: a single absurd number goes
    # farther than all steps together.
    low, high = np.quantile(values, [0.01, 0.99])
    weight = np.minimum(weight, ((high - low) / span or 1.0) ** POWER)
    in_jumps = weight[held].sum() / weight.sum()
    if in_jumps >= _SHARE[1]:
        return Decision("zero-order", _steps(held))
    if in_jumps >= _SHARE[0]:
        count = np.count_nonzero(held)
        return Decision("mixed", f"jumps {count} times and moves at {_percent(share)}")
    return Decision("linear", f"moves at {_percent(share)}")


def without_jumps(flight: Flight) -> Flight:
    """Return the flight with mixed inputs as linear ones that do nearly the same.

    A held staircase does what a linear one does that is late by half a sample, but for terms of
    second order in the sample time.
    """
    inputs = {}
    for name, u in flight.inputs.items():
        if flight.hold[name] == "mixed":
            stairs, rest = split(u)
            inputs[name] = rest + 0.5 * (stairs + np.r_[stairs[:1], stairs[:-1]])
    if not inputs:
        return flight
    return dataclasses.replace(
        flight,
        inputs={**flight.inputs, **inputs},
        hold={**flight.hold, **dict.fromkeys(inputs, "linear")},
    )


def low_passed(outputs: Iterable[str]) -> Decision:
    """Return the decision for an input that was commanded in steps and went through these
    outputs' filter."""
    return Decision("linear", f"was low-passed as {', '.join(outputs)}")


def is_low_passed(flight: Flight, name: str) -> bool:
    """True for an input that went through the filter of the outputs, after which it is linear."""
    notes = flight.source.notes if flight.source else ()
    return any(n.code == LOW_PASSED and name in n.subjects for n in notes)


def _of_few_values(moves: np.ndarray, moved: np.ndarray, share: float) -> Decision:
    """Decide for an input with a handful of values, such as -1, 0 and 1, or noise of a few counts:
    steps, unless it passes through the values between on its way."""
    at = np.flatnonzero(moved)
    # Two moves of the same sign at neighbouring samples are one motion, seen on its way.
    # Of white noise of a few counts less than a third of neighbouring moves agree in sign, since a
    # value above the mean tends to come back: hence 0.4.
    onward = (np.diff(at) == 1) & (np.sign(moves[at[1:]]) == np.sign(moves[at[:-1]]))
    if at.size > 1 and onward.mean() > 0.4:
        return Decision("linear", f"passes through the values between, moves at {_percent(share)}")
    return Decision("zero-order", _steps(moved))


def _steps(jumps: np.ndarray) -> str:
    at = np.flatnonzero(jumps)
    if at.size < 2:
        return "jumps once and stays"
    stay = round(float(np.median(np.diff(at))))
    if stay < 2:  # a random binary signal at the log's own rate
        return "jumps from sample to sample among few values"
    return f"stays for {stay} samples at a time and jumps"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} % of the samples"
