"""Outputs whose sensor's noise came through an on-board low-pass, and is not white in the log."""

from collections.abc import Sequence

from heli_jax.dynamics.model import LowPass
from heli_jax.flights.flight import Flight
from heli_jax.numerics.white_noise import rises_when_slower, wanders

_WHITE_TO = 3.0
"""times its cut-off, up to which rate noise behind a low-pass is nearly white: by simulation, see
docs/onboard.md"""


def filtered_noise(low_passes: Sequence[LowPass], flights: Sequence[Flight]) -> tuple[LowPass, ...]:
    """Those low-passes above whose cut-off the flights have samples, where these bear it out.

    Args:
        low_passes: `Model.low_passes`.
        flights: as they are fitted.
    """
    return tuple(p for p in low_passes if any(_shows(p, f) for f in flights))


def _shows(low_pass: LowPass, flight: Flight) -> bool:
    """Whether noise in an output falls off as the low-pass lets it, near the Nyquist frequency or
    from the least rate at which it is not white."""
    above = 1.0 / (flight.dt * _WHITE_TO * low_pass.hz)
    if low_pass.output not in flight.outputs or not above > 1.0:
        return False
    signal = flight.outputs[low_pass.output]
    # Noise behind the filter, or a coarse log, hides at the fastest end what came through it.
    return wanders(signal) or rises_when_slower(signal, max(2, int(above)))
