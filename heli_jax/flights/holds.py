"""Motion of an input between the samples of a log, decided from the record.

An input that is constant for several samples and then jumps was commanded in steps: each sample
holds until the next. One that moves at nearly every sample was sampled during a motion, and
straight lines fit better. A record may have both, such as doublets and then a chirp.
"""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from heli_jax.flights.flight import Flight
from heli_jax.numerics.jumps import FEW, POWER, jumps, smallest_move, split, weights


class Decision(NamedTuple):
    """A hold and the reason for it."""

    hold: str
    reason: str


LOW_PASSED = "resampling.input-low-passed"
"""Code of the note on an input commanded in steps that was low-passed with outputs."""
_SHARE = 0.05, 0.9
"""Smallest shares of the motion in jumps for a mixed and for a held input. White noise has 0.01, a
random walk 0.02, steps under 0.5 % of noise 0.96."""


def decide(values: np.ndarray) -> Decision:
    """Decide what an input (N,), in any unit, does between samples, by how it moves.

    An input commanded in steps moves in jumps, also with noise of a few counts. It may hold for two
    samples (logged faster than sampled) or two hundred. A smooth motion, with or without pauses,
    has hardly any jumps. Neither has a step over several samples. An input with both is mixed.
    Moves by one count of the log decide nothing: they are the resolution of a slow motion or of
    noise.
    """
    largest = float(np.abs(values).max())
    if largest > 0:
        values = values / largest  # the rest neither overflows nor underflows
    quantum, span = smallest_move(values), float(np.ptp(values))
    if not np.isfinite(quantum):
        return Decision("zero-order", "never moves")
    moved = np.abs(np.diff(values)) >= quantum
    share = float(moved.mean())
    if span <= FEW * quantum:
        return _of_few_values(np.diff(values), moved, share)
    weight = weights(values)
    if not weight.any():
        return Decision("linear", f"moves by single counts of the log, {_percent(share)}")
    held = jumps(values)
    # A move counts at most as much as the range of nearly all samples. Otherwise a single absurd
    # number would outweigh all steps.
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
    """Return the flight with mixed inputs replaced by nearly equivalent linear ones.

    A held staircase acts like a linear one that is late by half a sample, up to second order in the
    sample time.
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
    """Return the decision for an input commanded in steps that was filtered like these outputs."""
    return Decision("linear", f"was low-passed as {', '.join(outputs)}")


def is_low_passed(flight: Flight, name: str) -> bool:
    """True for an input that was filtered like the outputs, after which it is linear."""
    notes = flight.source.notes if flight.source else ()
    return any(n.code == LOW_PASSED and name in n.subjects for n in notes)


def _of_few_values(moves: np.ndarray, moved: np.ndarray, share: float) -> Decision:
    """Decide for an input with few values, such as -1, 0 and 1, or noise of a few counts.

    It has steps, unless it passes through the values between.
    """
    at = np.flatnonzero(moved)
    # Two moves of the same sign at neighbouring samples are one motion. In white noise of a few
    # counts, less than a third of neighbouring moves agree in sign, because values tend to return
    # to the mean. Therefore the limit is 0.4.
    onward = (np.diff(at) == 1) & (np.sign(moves[at[1:]]) == np.sign(moves[at[:-1]]))
    if at.size > 1 and onward.mean() > 0.4:
        return Decision("linear", f"takes intermediate values, moves at {_percent(share)}")
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
