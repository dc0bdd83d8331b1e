"""Where the data and the constants came from."""

from collections.abc import Mapping
from typing import NamedTuple

from heli_jax import naming
from heli_jax.finding import sentences
from heli_jax.flights.flight import Flight
from heli_jax.flights.origins import in_words
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.numbers import number
from heli_jax.report.tables.table import Table
from heli_jax.report.unit_symbols import pretty
from heli_jax.vehicle import Constant


class Origin(NamedTuple):
    """Where one flight came from."""

    flight: str
    facts: Table
    notes: tuple[str, ...]


def origins(fit: Fit, problem: Problem) -> list[Origin]:
    """The flights, in order: the fitted ones first."""
    # The order of fit.signals, which is not that of the configuration.
    flights = [*problem.training, *(f for f in problem.flights if f.hold_out)]
    listed = []
    for signals, flight in zip(fit.signals, flights, strict=True):
        rows = [
            ("used for", "validation alone" if flight.hold_out else "the fit"),
            (
                "samples",
                f"{flight.n_samples} at {1 / flight.dt:g} Hz, {flight.duration:.6g} s",
            ),
        ]
        if flight.source:
            start, end = flight.window
            rows.append(("window", f"{start:.6g} s to {end:.6g} s from the log's beginning"))
            # An autopilot's clock rarely begins at zero: by this a moment is found in the raw log.
            first = f"{flight.source.first_time:.15g} s of the log's own clock"
            rows.append(("log's beginning", first))
        if flight.known:
            values = ", ".join(f"{n} = {number(v, 6)}" for n, v in flight.known.items())
            rows.append(("differs in", values))
        rows += [(f"{n} between samples", words) for n, words in _holds(flight).items()]
        source = flight.source
        if source:
            listed_signals = (*source.inputs.items(), *source.outputs.items())
            rows += [(f"{n} in the log", in_words(signal)) for n, signal in listed_signals]
        rows.append(("file", source.path if source else "given in memory, no file"))
        if source:
            rows.append(("sha256", source.sha256))
        notes = tuple(sentences(source.notes)) if source else ()
        listed.append(Origin(signals.flight, Table(("", ""), rows), notes))
    return listed


def _holds(flight: Flight) -> dict[str, str]:
    """By input what it is taken to do between samples, and why."""
    # Only what was read off the log has a reason; the rest was stated in the configuration.
    return {
        n: f"{hold} ({flight.hold_reason.get(n, 'as stated')})" for n, hold in flight.hold.items()
    }


def constants(problem: Problem, vehicle_constants: Mapping[str, Constant]) -> Table:
    """The vehicle as it was given: value in SI, unit, meaning, source."""
    rows = []
    for name, c in vehicle_constants.items():
        # The value is SI, as the model's unit is; the one in the file may be another.
        unit = naming.unit(problem.model.Params, name) or c.unit
        role = "estimated, this is the file's value" if name in problem.free else "fixed"
        meaning = naming.meaning(problem.model.Params, name)
        rows.append((name, number(c.value, 8), pretty(unit), role, meaning, c.source))
    return Table(("constant", "value", "unit", "in this fit", "meaning", "source"), rows)
