"""`heli-jax frf`: frequency responses of a configuration's logs, before any model is fitted."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from heli_jax import run_directory
from heli_jax.analysis.attitude_responses import (
    Handling,
    measured_handling,
)
from heli_jax.analysis.flight_responses import (
    FlightResponses,
    Settings,
    TransferRequest,
    flight_responses,
)
from heli_jax.analysis.spectra import COHERENT, octave_mean
from heli_jax.cli.terminal import print_page_table, print_table, print_text
from heli_jax.config.experiment import Experiment, resolved
from heli_jax.config.frequency import check_pairs, missing_handling, requested_handling, units_of
from heli_jax.config.frequency_section import FrequencyConfig
from heli_jax.config.logs import log_notes, read_flights, with_log
from heli_jax.errors import InputError, located
from heli_jax.finding import Finding, sentences
from heli_jax.flights.flight import Flight
from heli_jax.numbers import plain_words
from heli_jax.stages import Note
from heli_jax.yaml_file import as_yaml


def responses_of_log(
    experiment: Experiment,
    log: str | None = None,
) -> FlightResponses:
    """Return the frequency responses of all flights of a configuration together.

    Args:
        experiment: the configuration; its section `frequency` has band, window and transfer
            functions. The model only names the signals.

    Raises:
        InputError: the log or the configuration is wrong, or there is no response.
    """
    experiment = experiment if log is None else with_log(experiment, log)
    config = experiment.config.frequency or FrequencyConfig()
    requests = tuple(TransferRequest(**dict(t)) for t in config.transfer_functions)
    points = config.points or Settings().points
    settings = Settings(config.band, config.window, points, requests)
    check_pairs(experiment, "transfer_functions", config.transfer_functions)
    requested_handling(experiment)  # before the logs are read
    flights = read_flights(experiment)
    _require_samples(flights, experiment.path)
    with located(f"{experiment.path}: frequency"):
        estimate = flight_responses(flights, settings)
    pairs = [pair for output in estimate.outputs.values() for pair in output.pairs.values()]
    if not any(np.isfinite(pair.coherence).any() for pair in pairs):
        longest = max(f.duration for f in flights)
        raise InputError(
            f"{experiment.path}: no response: nowhere in the band does a signal have ten times "
            "the power that leaks from other frequencies; expected excitation of the sticks "
            f"there (a sweep, doublets) for longer than a few windows of {estimate.window:.3g} s, "
            f"got {longest:.3g} s"
        )
    notes = (*log_notes(flights), *_read_in_degrees(experiment, flights))
    return estimate._replace(notes=(*estimate.notes, *notes))


def _read_in_degrees(experiment: Experiment, flights: Sequence[Flight]) -> tuple[Finding, ...]:
    """Return doubts about outputs that look like degrees read as radians (gains off by 35 dB)."""
    # Late import, since it loads the diagnostics of fits.
    from heli_jax.flights.flight import labels
    from heli_jax.identification.diagnostics.units import in_degrees

    return tuple(
        doubt
        for label, flight in zip(labels(tuple(flights)), flights, strict=True)
        for doubt in in_degrees(experiment.model, label, flight)
    )


def _require_samples(flights: Sequence[Flight], path: str | Path) -> None:
    for name in dict.fromkeys(n for f in flights for n in f.outputs):
        if not any(np.isfinite(f.outputs[name]).any() for f in flights if name in f.outputs):
            raise InputError(
                f"{path}: flights[].signals.outputs.{name}: all its samples are missing, expected "
                "numbers; leave it out, or name another signal"
            )


def run_responses(
    experiment: Experiment, out: Path, log: str | None, say: Callable[[str], None]
) -> list[str]:
    """Write responses into a new directory, print them, and return the transfer functions'
    statuses.
    """
    from heli_jax.report.responses import transfer_status, write_responses
    from heli_jax.report.tables import handling as handling_table
    from heli_jax.report.tables import handling_sentences

    responses = responses_of_log(experiment, log)
    # Axes that did not move need no message unless they were requested by name.
    requested = requested_handling(experiment, responses.outputs)
    named = (experiment.config.frequency or FrequencyConfig()).handling is not None
    handling = [
        Handling(pair, None, measured_handling(responses, pair))
        for pair in requested
        if named or pair.input in responses.holds
    ]
    gaps = missing_handling(experiment, responses.outputs)
    responses = responses._replace(notes=(*responses.notes, *not_usable(responses)))
    with run_directory.whole(out) as temporary:
        title = Path(experiment.path).stem
        written = responses._replace(notes=(*responses.notes, *gaps))
        units, png = units_of(experiment), experiment.config.report.png
        config = as_yaml(resolved(experiment if log is None else with_log(experiment, log)))
        write_responses(temporary, written, units, title, handling, config=config, png=png)
    for found in responses.notes:
        say(Note(found.sentence))
    print_responses(responses)
    if handling:
        print_page_table(handling_table(handling))
    for sentence in (*handling_sentences(handling), *sentences(gaps)):
        print_text(f"! {sentence}")
    say(f"wrote {out / 'responses.html'}")
    return [transfer_status(fit) for _, fit in responses.fits]


def not_usable(responses: FlightResponses) -> tuple[Finding, ...]:
    """Return a finding if no response is coherent with its input."""
    pairs = [pair for output in responses.outputs.values() for pair in output.pairs.values()]
    if any(np.max(octave_mean(responses.omega, p.coherence)) >= COHERENT for p in pairs):
        return ()
    words = (
        f"no response is usable: none has a mean coherence of {COHERENT:g} over an octave; the "
        "excitation was small, or gusts and noise are larger than the response"
    )
    return (Finding("responses.not-usable", "doubt", words),)


def print_responses(responses: FlightResponses) -> None:
    """Print the usable band of each response, and the transfer functions, on standard output."""
    from heli_jax.report.responses import FIT_HEAD, fit_row, fit_sentences, useful_band

    rows = []
    for name, output in responses.outputs.items():
        for input, pair in output.pairs.items():
            band = useful_band(responses.omega, pair)
            by = "by instrument" if input in responses.instruments else "direct"
            rows.append((f"{input} to {name}", by, f"{output.averages:.1f}", *band))
    head = ("response", "taken", "averages", "coherence", "usable from [Hz]", "to [Hz]")
    print_table(head, rows)
    for request, fit in responses.fits:
        orders = f"{request.zeros} zeros, {request.poles} poles"
        print_text(f"{request.input} to {request.output}, {orders}:")
        if not isinstance(fit, str):
            for head, cell in zip(FIT_HEAD, fit_row(fit), strict=True):
                print_text(f"  {head}: {cell}")
        for sentence in fit_sentences(fit, responses.window):
            print_text(f"  {plain_words(sentence)}")
