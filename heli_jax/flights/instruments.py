"""Instruments of flights: excitations that were added to inputs and logged."""

from collections.abc import Sequence

import numpy as np

from heli_jax.flights.flight import Flight

_SAME = 1e-6
"""part of an input's power that is not its instrument's, below which the two are one signal"""


def own_instruments(flights: Sequence[Flight], names: Sequence[str]) -> tuple[str, ...]:
    """The inputs whose instrument is the input itself in every flight in which it moves: the stick,
    with all that feedback brings into it.
    """
    held = [n for n in names if all(n in f.instruments and n in f.inputs for f in flights)]
    return tuple(n for n in held if _is_own(flights, n))


def own_said(names: Sequence[str]) -> str:
    """What is to be said of them."""
    return (
        f"instrument of {', '.join(names)}: it is the input itself, which knows gusts as far as a "
        "loop is closed; expected the excitation alone, before pilot or autopilot add to it"
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
