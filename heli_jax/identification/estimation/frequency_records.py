"""The records that frequency error transforms: flights, cut where an output has a missing sample.

A Fourier transform has no place for a missing sample. Since the ends of a record are projected out,
a part costs no more than the few numbers of its own ends, and nothing has to be filled in.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from heli_jax.analysis.trim import Condition
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import FEWEST, SHORTEST, spans
from heli_jax.identification.unknowns.layout import Data, Layout


class FlightFacts(NamedTuple):
    """What is fixed of a flight before anything is traced."""

    parts: tuple[tuple[int, int], ...]
    """first sample, and that behind the last, of each part that is a record of its own"""
    dt: float
    """[s]: flights of one sample time share much of their program"""
    condition: Condition | None = None
    """the steady flight about which a whole helicopter is linearised"""


class Record(NamedTuple):
    """Samples in a row of one flight."""

    flight: int
    """its number"""
    first: int
    last: int
    """the sample behind its last one"""

    @property
    def samples(self) -> int:
        """N."""
        return self.last - self.first

    @property
    def lines(self) -> int:
        """Frequencies of the record's own, without zero and the Nyquist frequency."""
        return (self.samples - 1) // 2


def lines_of(v: Float[np.ndarray, "N c"]) -> Complex[np.ndarray, "K c"]:
    """Fourier transform of signals at a record's own frequencies, over the root of its length."""
    N = len(v)
    return np.fft.rfft(v - v.mean(axis=0), axis=0)[1 : 1 + (N - 1) // 2] / np.sqrt(N)


def in_time_of(lines: Complex[np.ndarray, "K c"], samples: int) -> Float[np.ndarray, "N c"]:
    """The inverse of `lines_of`: signals without a mean."""
    whole = np.zeros((samples // 2 + 1, lines.shape[1]), complex)
    whole[1 : 1 + len(lines)] = lines * np.sqrt(samples)
    return np.fft.irfft(whole, samples, axis=0)


def parts_of(flight: Flight) -> tuple[tuple[int, int], ...]:
    """First sample, and that behind the last, of each part in which all outputs are there; without
    those that are too short to be records. A flight without a missing sample is one part.

    Args:
        flight: with at least one output.
    """
    seen = spans(flight.outputs.values())
    if seen == [(0, flight.n_samples)]:
        return tuple(seen)
    # As with the parts of `gaps: split`: each has ends of its own, which short ones hardly tell.
    least = max(FEWEST, int(np.ceil(SHORTEST / flight.dt)))
    return tuple((a, b) for a, b in seen if b - a >= least)


def records_of(layout: Layout) -> list[Record]:
    """All records, flight after flight."""
    return [Record(i, a, b) for i, facts in enumerate(layout.flight_facts) for a, b in facts.parts]


def without_parts(flights: Sequence[Flight]) -> str | None:
    """Why a flight leaves no record, and what to do; None where each leaves one."""
    for flight in flights:
        if parts_of(flight):
            continue
        missing = {n: float(np.mean(~np.isfinite(y))) for n, y in flight.outputs.items()}
        worst = max(missing, key=lambda n: missing[n])
        return (
            f"{flight.name or 'a flight'}: output {worst} lacks {100 * missing[worst]:.2g} % of "
            f"its samples, and no part of at least {SHORTEST:g} s and {FEWEST} samples has all "
            "outputs without a missing one, which a Fourier transform needs; leave that output "
            "out, lower flights[].rate to its own rate, or use output-error or filter-error"
        )
    return None


def other_outputs(flights: Sequence[Flight]) -> str | None:
    """Which flights have not the outputs of the others, and what to do; None where all have."""
    # The noise's spectrum is one matrix over the outputs.
    common = set.intersection(*(set(f.outputs) for f in flights))
    for flight in flights:
        more = sorted(set(flight.outputs) - common)
        if more:
            return (
                f"{flight.name or 'a flight'}: output {', '.join(more)} is not in every flight, "
                "and frequency-error has one spectrum of noise for all; leave it out "
                "(signals.outputs), or use frequency-response, output-error or filter-error"
            )
    return None


def cut_notes(layout: Layout, data: Data, names: Sequence[str]) -> list[Finding]:
    """By flight that was cut, how much of it is used."""
    notes = []
    for i, (flight, facts) in enumerate(zip(data.flights, layout.flight_facts, strict=True)):
        parts = facts.parts
        n = next(iter(flight.outputs.values())).shape[0]
        used = sum(b - a for a, b in parts)
        if used == n:
            continue
        dt = float(flight.dt)
        lacking = [name for name, y in flight.outputs.items() if not np.isfinite(y).all()]
        several = len(data.flights) > 1
        words = (
            f"{names[i] if several else 'The flight'} was cut where samples of "
            f"{', '.join(lacking)} are missing: {used * dt:.4g} of {n * dt:.4g} s are used, in "
            f"{len(parts)} {'parts' if len(parts) > 1 else 'part'} with ends of their own."
        )
        notes.append(note("frequency.flight-cut", words, *lacking))
    return notes
