"""A part of a flight as a flight of its own."""

import dataclasses

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight


def part(
    flight: Flight, first: int, last: int, name: str = "", note: Finding | None = None
) -> Flight:
    """The samples from `first` up to but not including `last`.

    Args:
        flight: the whole.
        name: of the part; that of the whole unless given.
        note: what its source says of it, beside what the reader noted.

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
