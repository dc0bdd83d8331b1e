"""Instruments of flights: excitations that were added to inputs and logged."""

from collections.abc import Sequence

import numpy as np

from heli_jax.flights.flight import Flight

_SAME = 1e-6
"""part of an input's power that is not its instrument's, below which the two are one signal"""


def own_instruments(flights: Sequence[Flight], names: Sequence[str]) -> tuple[str, ...]:
    """The inputs whose instrument is the input itself in every flight in which it moves: the stick,
    with all that feedback brings into it.

    Args:
        flights: with an instrument of each of the inputs.
        names: inputs.
    """
    return tuple(n for n in names if _is_own(flights, n))


def refuse_own(flights: Sequence[Flight], names: Sequence[str]) -> str | None:
    """Why instruments cannot be used, in words; None where none is its own input.

    Args:
        flights: with an instrument of each of the inputs.
        names: inputs.
    """
    own = own_instruments(flights, names)
    if not own:
        return None
    return (
        f"instrument of {', '.join(own)}: it is the input itself, and what follows it knows gusts "
        "as the input does; expected the excitation alone, before pilot or autopilot add to it "
        "(without any, leave it out of signals.instruments)"
    )


def _is_own(flights: Sequence[Flight], name: str) -> bool:
    same = []
    for flight in flights:
        u, r = (np.asarray(v[name], float) for v in (flight.inputs, flight.instruments))
        u, r = u - np.mean(u), r - np.mean(r)
        if np.any(u) or np.any(r):
            both = float(u @ r) ** 2
            same.append(bool(both > 0 and 1.0 - both / float(u @ u) / float(r @ r) < _SAME))
    return bool(same) and all(same)
