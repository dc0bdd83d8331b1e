"""Outputs whose sensor's noise came through an on-board low-pass, and is not white in the log."""

from collections.abc import Sequence

from heli_jax.dynamics.model import LowPass
from heli_jax.flights.flight import Flight
from heli_jax.numerics.white_noise import wanders

_WHITE_TO = 3.0
"""times its cut-off, up to which rate noise behind a low-pass is nearly white: by simulation, see
docs/onboard.md"""


def filtered_noise(low_passes: Sequence[LowPass], flights: Sequence[Flight]) -> tuple[LowPass, ...]:
    """Those low-passes above whose cut-off the flights have samples, where these bear it out.

    Args:
        low_passes: `Model.low_passes`.
        flights: as they are fitted.
    """
    return tuple(
        p
        for p in low_passes
        if any(
            p.output in f.outputs and 1.0 / f.dt > _WHITE_TO * p.hz and wanders(f.outputs[p.output])
            for f in flights
        )
    )
