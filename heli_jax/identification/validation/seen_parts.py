"""Parts of flights in which outputs are seen without a hole, for what needs samples in a row."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import spans

_BRIDGED = 5
"""samples in a row at most that a straight line bridges: far fewer than a segment of a spectrum"""
_SHARE = 0.05
"""part of an output's samples that may be bridged; what makes up more is no longer measured"""


class Part(NamedTuple):
    """Samples in a row of one flight, every output seen or bridged in all of them."""

    inputs: dict[str, Float[np.ndarray, " n"]]
    outputs: dict[str, Float[np.ndarray, " n"]]

    @property
    def n_samples(self) -> int:
        """The samples of the part."""
        return next(iter(self.inputs.values())).size


class SeenParts(NamedTuple):
    """What can be looked at of some flights, and what cannot."""

    outputs: tuple[str, ...]
    parts: tuple[Part, ...]
    left_out: dict[str, str]
    """by output why it is not among `outputs`, in words"""


def seen_parts(flights: Sequence[Flight]) -> SeenParts:
    """Parts without a hole, few missing samples bridged by straight lines.

    Args:
        flights: of one sample time.
    """
    used: list[str] = []
    left_out: dict[str, str] = {}
    filled: list[dict[str, np.ndarray]] = [{} for _ in flights]
    for name in dict.fromkeys(n for f in flights for n in f.outputs):
        if not all(name in f.outputs for f in flights):
            left_out[name] = "is not in every flight"
            continue
        made = [_bridged(f.outputs[name]) for f in flights]
        missing = sum(int(np.isnan(f.outputs[name]).sum()) for f in flights)
        line = sum(count for _, count in made)
        total = sum(f.n_samples for f in flights)
        # Within its own span: what is missing before the first and after the last is cut off.
        if line > _SHARE * total or missing > 0.5 * total:
            left_out[name] = f"lacks {100 * missing / total:.2g} % of its samples"
            continue
        used.append(name)
        for outputs, (y, _) in zip(filled, made, strict=True):
            outputs[name] = y
    parts = tuple(p for f, ys in zip(flights, filled, strict=True) for p in _whole(f, ys))
    return SeenParts(tuple(used), parts, left_out)


def _bridged(y: Float[np.ndarray, " N"]) -> tuple[Float[np.ndarray, " N"], int]:
    """An output with its short holes bridged, and by how many samples; longer ones stay."""
    seen = np.flatnonzero(np.isfinite(y))
    if seen.size < 2:
        return y, 0
    within = np.arange(y.size)
    # Which pair of seen samples a missing one lies between, and how far these are apart.
    after = np.searchsorted(seen, within)
    inside = (after > 0) & (after < seen.size) & np.isnan(y)
    apart = np.zeros(y.size)
    apart[inside] = seen[after[inside]] - seen[after[inside] - 1] - 1
    short = inside & (apart <= _BRIDGED)
    line = y.copy()
    line[short] = np.interp(within[short], seen, y[seen])
    return line, int(short.sum())


def _whole(flight: Flight, outputs: dict[str, np.ndarray]) -> list[Part]:
    """The runs of samples in which every output has a number."""
    return [
        Part(
            {n: u[first:last] for n, u in flight.inputs.items()},
            {n: y[first:last] for n, y in outputs.items()},
        )
        for first, last in spans([np.zeros(flight.n_samples), *outputs.values()])
    ]
