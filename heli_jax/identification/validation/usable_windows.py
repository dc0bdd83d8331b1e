"""Why a window of a record is not to be used: gaps, missing samples, signals at their ends."""

import numpy as np

from heli_jax.flights.flight import Flight
from heli_jax.flights.signal_facts import DROP_SHARE

_RAILS = 0.05
"""part of a window's samples at an end of a signal's range, from which on it is left out"""
_GAP = 0.25
"""seconds without a sample of an output, and five of its usual steps, that are a gap"""


class Exclusions:
    """Why a window of a flight is not to be used."""

    def __init__(self, flights: tuple[Flight, ...]) -> None:
        self.flights = flights
        self.facts = [f.facts for f in flights]

    def of(self, i: int, first: int, last: int) -> str:
        """In words; empty where it may be used.

        Args:
            i: number of the flight.
            first: sample.
            last: sample after the window's last one.
        """
        inside = slice(first, last)
        flight = self.flights[i]
        for name, y in flight.outputs.items():
            if missing := _missing(y, inside, flight.dt):
                return f"{name}: {missing}"
        for (name, _), whole in self.facts[i].items():
            facts = whole.within(first * flight.dt, (last - 1) * flight.dt)
            if facts.stuck is not None:
                length = sum(one.end - one.begin for one in facts.stretches)
                return f"{name} stuck at one value for {length:.2g} s"
            if facts.dropped >= DROP_SHARE and facts.dropouts is not None:
                words = f"jumps to {facts.dropouts.value:.4g} and back"
                return f"{name} {words}, in {100 * facts.dropped:.2g} % of the samples"
            share = sum(facts.shares)
            if share >= _RAILS:
                return f"{name} at an end of its range in {100 * share:.0f} % of the samples"
        return ""


def _missing(y: np.ndarray, inside: slice, dt: float) -> str:
    """What is missing of an output within a window, in words."""
    seen = np.flatnonzero(np.isfinite(y))
    # A sensor slower than the flight's rate leaves samples out that are no gap.
    usual = float(np.median(np.diff(seen))) if seen.size > 1 else 1.0
    here = np.flatnonzero(np.isfinite(y[inside]))
    n = inside.stop - inside.start
    if here.size < 2:
        return "no samples"
    longest = float(np.max(np.diff(np.concatenate([[-1], here, [n]]))))
    if longest > 5.0 * usual and longest * dt > _GAP:
        return f"a gap of {longest * dt:.2g} s"
    if here.size < 0.5 * n / usual:
        return f"{100 * (1 - here.size * usual / n):.0f} % of the samples missing"
    return ""
