"""Findings on signals that saturate, are stuck, or have stray samples.

If possible they are tested as logged, since resampling hides flat tops.
"""

from collections.abc import Iterator

from heli_jax.finding import Finding, found
from heli_jax.flights.signal_facts import RAIL_SHARE, STUCK_SECONDS
from heli_jax.identification.diagnostics.context import Context

_CUT_OFF = 0.02
"""Share of an output's samples at its limits from which on no model of it is adequate."""


def saturation(c: Context) -> Iterator[Finding]:
    """Find signals that rest at an end of their range."""
    cut = [
        (label, name, kind, facts)
        for label, flight in c.flights
        for (name, kind), facts in flight.facts.items()
        if sum(facts.shares) > 0
    ]
    for label, name, kind, facts in sorted(cut, key=lambda one: -sum(one[3].shares)):
        share = sum(facts.shares)
        ends = zip((facts.low.value, facts.high.value), facts.shares, strict=True)
        yield found(
            "quality.saturation",
            "doubt",
            name,
            value=share,
            denies=kind == "output" and share >= _CUT_OFF,
            flight=label,
            ends=[value for value, part in ends if part],
            percent=100.0 * share,
            limit=RAIL_SHARE,
        )


def stuck_outputs(c: Context) -> Iterator[Finding]:
    """Find outputs that stay at one value while others move."""
    for label, flight in c.flights:
        for (name, _), facts in flight.facts.items():
            if facts.stuck is not None:
                yield found(
                    "quality.stuck-output",
                    "doubt",
                    name,
                    value=round(sum(s.end - s.begin for s in facts.stretches), 6),
                    flight=label,
                    count=len(facts.stretches),
                    longest=facts.stuck.end - facts.stuck.begin,
                    begin=facts.stuck.begin,
                    at=facts.stuck.value,
                    limit=STUCK_SECONDS,
                )


def strays(c: Context) -> Iterator[Finding]:
    """Find stray samples that may be placeholders for missing values; the fit uses them."""
    for label, flight in c.flights:
        for (name, _), facts in flight.facts.items():
            for odd in facts.strays:
                yield found(
                    "quality.stray-samples",
                    "doubt",
                    name,
                    value=float(odd.times.size),
                    flight=label,
                    low=odd.values.min(),
                    high=odd.values.max(),
                    first=odd.times[0],
                )


DIAGNOSTICS = (saturation, stuck_outputs, strays)
