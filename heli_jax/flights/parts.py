"""Division of a flight at its gaps into several flights."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.flights.resample import longest_gap

SHORTEST = 2.0
"""Shortest part [s]. Each part has its own initial state and biases, which shorter parts do not
determine well."""
FEWEST = 50
"""Fewest samples of the fastest clock in a part."""


def stretches(clocks: Sequence[np.ndarray]) -> list[tuple[float, float]]:
    """Return first and last time [s] of each stretch in which no clock has a long gap.

    A single row between gaps is a stretch too.
    """
    begin = max(float(seconds[0]) for seconds in clocks)
    end = min(float(seconds[-1]) for seconds in clocks)
    gaps = []
    for seconds in clocks:
        rows = np.flatnonzero(np.diff(seconds) > longest_gap(seconds) * (1 + 1e-9))
        gaps += [(float(seconds[i]), float(seconds[i + 1])) for i in rows]
    intervals, at = [], begin
    for before, after in sorted(gaps):
        if before >= at:
            intervals.append((at, min(before, end)))
        # Gaps of several clocks may overlap.
        at = max(at, after)
    if at <= end:
        intervals.append((at, end))
    return [(a, b) for a, b in intervals if b >= a]


def is_too_short(stretch: tuple[float, float], clocks: Sequence[np.ndarray]) -> bool:
    """True if a stretch [s] is too short to be a flight."""
    fastest = min(float(np.median(np.diff(seconds))) for seconds in clocks)
    length = stretch[1] - stretch[0]
    return length < SHORTEST or length < (FEWEST - 1.5) * fastest


def spans(signals: Iterable[np.ndarray]) -> list[tuple[int, int]]:
    """Return the stretches [first, end) of samples in which every signal has numbers."""
    seen = np.all([np.isfinite(y) for y in signals], axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


# A part of a flight as a flight of its own.


def part(
    flight: Flight, first: int, last: int, name: str = "", note: Finding | None = None
) -> Flight:
    """Return the samples from `first` up to but not including `last`.

    Args:
        flight: the whole flight.
        first: first sample.
        last: end, exclusive.
        name: name of the part; by default that of the whole.
        note: a further note for its source.

    Raises:
        ValueError: there are no such samples.
    """
    if not 0 <= first < last <= flight.n_samples:
        raise ValueError(
            f"expected a part of samples 0 to {flight.n_samples}, got {first} to {last}"
        )
    source = flight.source
    if source is not None:
        notes = (*source.notes, note) if note else source.notes
        begin, end = first * flight.dt, (last - 1) * flight.dt
        facts = {key: f.within(begin, end) for key, f in source.facts.items()}
        source = dataclasses.replace(source, notes=notes, facts=facts)
    return dataclasses.replace(
        flight,
        inputs={n: u[first:last] for n, u in flight.inputs.items()},
        outputs={n: y[first:last] for n, y in flight.outputs.items()},
        instruments={n: r[first:last] for n, r in flight.instruments.items()},
        t0=flight.t0 + first * flight.dt,
        name=name or flight.name,
        source=source,
        choose_windows=False,
    )
