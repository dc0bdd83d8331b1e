"""`heli-jax frf`: frequency responses of a configuration's logs, before any model is fitted."""

from collections.abc import Callable
from pathlib import Path

from heli_jax import naming, run_directory
from heli_jax.analysis.flight_responses import FlightResponses, Settings, Wanted, flight_responses
from heli_jax.config.experiment import Experiment
from heli_jax.config.frequency_section import FrequencyConfig
from heli_jax.config.logs import read_flights
from heli_jax.errors import InputError, nearest
from heli_jax.numbers import number

_TOO_LARGE = 2.0
"""chi-squared per degree of freedom from which on a transfer function is called too simple"""


def responses_of_log(
    experiment: Experiment,
    log: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> FlightResponses:
    """Frequency responses of all flights of a configuration together.

    Args:
        experiment: the configuration; its section `frequency` says band, window and transfer
            functions, its model only how signals are called.
        log: in place of the configuration's, read as its first flight's is.
        progress: called with what the log's reader assumed, in words.

    Raises:
        InputError: the log or something of the configuration is wrong, or no response is to be had.
    """
    if log is not None:
        whole = {"log": str(Path(log).absolute()), "window": None, "hold_out": False}
        if not experiment.config.flights:
            raise InputError(f"{experiment.path}: flights: expected at least one log, got none")
        first = experiment.config.flights[0].model_copy(update=whole)
        experiment = experiment._replace(
            config=experiment.config.model_copy(update={"flights": [first]})
        )
    config = experiment.config.frequency or FrequencyConfig()
    wanted = tuple(Wanted(**dict(t)) for t in config.transfer_functions)
    settings = Settings(config.band, config.window, config.points or Settings().points, wanted)
    _check_pairs(experiment, config)
    flights = read_flights(experiment)
    for note in (n for f in flights for n in (f.source.notes if f.source else ())):
        if progress is not None:
            progress(note)
    try:
        return flight_responses(flights, settings)
    except ValueError as e:
        raise InputError(f"{experiment.path}: frequency: {e}") from e


def _check_pairs(experiment: Experiment, config: FrequencyConfig) -> None:
    for i, wanted in enumerate(config.transfer_functions):
        for role, record in (
            ("input", experiment.model.Inputs),
            ("output", experiment.model.Outputs),
        ):
            name, known = getattr(wanted, role), naming.names(record)
            if name not in known:
                raise InputError(
                    f"{experiment.path}: frequency.transfer_functions[{i}].{role}: model "
                    f"{experiment.model.name} has no {role} {name!r}{nearest(name, known)}"
                )


def run_responses(
    experiment: Experiment, out: Path, log: str | None, say: Callable[[str], None]
) -> None:
    """Write the responses into a new directory, and print them.

    Args:
        experiment: the configuration.
        out: the directory.
        log: in place of the configuration's.
        say: called with notes, and where the page is.
    """
    from heli_jax.report.responses import write_responses

    found = responses_of_log(experiment, log, say)
    with run_directory.whole(out) as temporary:
        write_responses(temporary, found, units_of(experiment), Path(experiment.path).stem)
    for note in found.notes:
        say(note)
    print_responses(found)
    say(f"wrote {out / 'responses.html'}")


def units_of(experiment: Experiment) -> dict[str, str]:
    """SI units of the model's inputs and outputs, by name; 1 where it states none."""
    model = experiment.model
    records = (model.Inputs, model.Outputs)
    return {n: naming.unit(r, n) or "1" for r in records for n in naming.names(r)}


def print_responses(found: FlightResponses) -> None:
    """What each response is good for, and the transfer functions, on standard output."""
    from heli_jax.output import print_table
    from heli_jax.report.responses import FIT_HEAD, fit_row, useful_band

    rows = []
    for name, output in found.outputs.items():
        for input, pair in output.pairs.items():
            band = useful_band(found.omega, pair)
            rows.append((f"{input} to {name}", f"{output.averages:.1f}", *band))
    print_table(("response", "averages", "coherence", "usable from [Hz]", "to [Hz]"), rows)
    for wanted, fit in found.fits:
        orders = f"{wanted.zeros} zeros, {wanted.poles} poles"
        print(f"{wanted.input} to {wanted.output}, {orders}:")
        for head, cell in zip(FIT_HEAD, fit_row(fit), strict=True):
            print(f"  {head}: {cell}")
        if not fit.converged:
            print("  the search did not converge: these numbers are no result")
        elif fit.chi_squared > _TOO_LARGE:
            print(
                f"  squared errors are {number(fit.chi_squared, 2)} times what the random errors "
                "let expect: the order is too low, or the machine is not linear"
            )
