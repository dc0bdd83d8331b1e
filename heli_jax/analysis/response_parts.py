"""Which parts of flights an output's response is taken from: those without a missing sample."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import spans

_AT_REST = 0.01
"""of an input's largest standard deviation in a part, below which it rests in another"""

type Parts = tuple[tuple[int, int, int], ...]
"""flight, first sample and the one behind the last of each part"""
type Names = tuple[list[str], tuple[str, ...]]
"""of the inputs, and of those with an instrument"""


def groups(
    flights: Sequence[Flight], window: int, without: list[Finding]
) -> list[tuple[list[str], Parts]]:
    """Outputs by the parts that they are known in, so that inputs are transformed once for all of
    them.

    Args:
        flights: of one rate.
        window: samples of one, the least of a part.
        without: why an output has no part is added to them.
    """
    by_parts: dict[Parts, list[str]] = {}
    order = dict.fromkeys(n for f in flights for n in f.outputs)
    for name in order:
        parts = parts_of(flights, name, window)
        if isinstance(parts, str):
            without.append(note("responses.none", parts, name))
        else:
            by_parts.setdefault(parts, []).append(name)
    return [(names, parts) for parts, names in by_parts.items()]


def parts_of(flights: Sequence[Flight], output: str, window: int) -> Parts | str:
    """The parts without a missing sample, or in words why there is none.

    Args:
        flights: of one rate.
        window: samples of one, the least of a part.
    """
    parts, longest = [], 0
    for i, f in enumerate(flights):
        if output not in f.outputs:
            continue
        for first, last in spans([f.outputs[output]]):
            longest = max(longest, last - first)
            if last - first >= window:
                parts.append((i, first, last))
    if parts:
        return tuple(parts)
    return (
        f"{output}: no response, expected a part of at least {window} samples (a window) without a "
        f"missing one, got {longest} at most"
    )


def records_of(
    flights: Sequence[Flight], names: Names, outputs: list[str], parts: Parts
) -> list[np.ndarray]:
    """Inputs, instruments and outputs (signals, N) of each part.

    Args:
        flights: of one rate.
        names: inputs and instruments.
        parts: as outputs share them.
    """
    inputs, instruments = names
    return [
        np.stack(
            [
                *(flights[i].inputs[n][first:last] for n in inputs),
                *(flights[i].instruments[n][first:last] for n in instruments),
                *(flights[i].outputs[n][first:last] for n in outputs),
            ]
        )
        for i, first, last in parts
    ]


def coherence_where_moving(
    coherence: Float[np.ndarray, "k l m"],
    records: Sequence[Float[np.ndarray, "signals N"]],
    moving: Sequence[int],
    window: int,
) -> Float[np.ndarray, "k l m"]:
    """Coherence in the flights in which an input moves, of that in all.

    Of sweeps of one stick at a time the others are at rest, and the noise of those flights is
    nothing that they could be coherent with.

    Args:
        coherence: of l outputs with m inputs, partial.
        records: signals of each part.
        moving: the inputs, or their instruments, by their place among the signals.
        window: samples of one.
    """
    windows = np.array([max(r.shape[1] - window + 1, 0) for r in records], float)
    sizes = np.array([np.std(r[list(moving)], axis=1) for r in records])
    moves = sizes > _AT_REST * np.max(sizes, axis=0)
    used = np.sum(np.where(moves, windows[:, None], 0.0), axis=0)
    # One that moves in parts alone that are shorter than a window has none.
    share = np.where(used > 0, used, np.sum(windows)) / np.sum(windows)
    with np.errstate(all="ignore"):
        return coherence / (coherence + share * (1.0 - coherence))
