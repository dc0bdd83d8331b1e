r"""Frequency error: output error on Fourier transforms of whole records, with the noise's spectrum.

For a linear model with inputs that are held, or linear between samples, and $z = e^{i\omega dt}$ at
a frequency of the record's own,

$$X = (zI - A_d)^{-1}\,[B_d U + z\,(x_0 - x_N)]$$

is exact, for unstable machines too: nothing is simulated, and the ends of the record are n numbers
that are found by linear least squares and projected out, with n more for the ends of slow gusts.
The noise's spectrum, a matrix over the outputs, is estimated from the residual and weighs the
frequencies; maximum likelihood then holds where gusts disturb the machine as well, as long as no
feedback brings them into the inputs. Models that are not linear are linearised where they fly.

Where flights hold an excitation that was added to an input and that no feedback reaches, the errors
are weighed by the response to what of the input follows it: then feedback does no harm either.

Sources: Pintelon and Schoukens (2012), chapters 6, 9 and 10; Klein and Morelli (2006), chapter 7.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Float

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.frequency_instrument import (
    absent_instrument,
    as_instruments_have_it,
    instrument_notes,
    instrumented_inputs,
)
from heli_jax.identification.estimation.frequency_lines import (
    FlightFacts,
    cut_notes,
    errors_of_lines,
    lines_of,
    other_outputs,
    parts_of,
    records_of,
    without_parts,
)
from heli_jax.identification.estimation.frequency_noise import (
    log_determinants,
    whitening_alone,
    whitening_by,
    whitening_without_model,
)
from heli_jax.identification.estimation.frequency_slopes import rows_of_lines
from heli_jax.identification.estimation.linearised_flights import (
    cannot_linearise,
    condition_of,
    linearisation_notes,
)
from heli_jax.identification.estimation.objective import Objective, RowTags, untagged
from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
)


class FrequencyError(Objective):
    """The model's response to the inputs against the measured outputs, at each frequency."""

    noise_model = "spectrum"

    def tags(self, layout: Layout, data: Data, count: int) -> RowTags:
        """Rows are sums over the lines of all flights."""
        return untagged(count)

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """A row for each unknown of interest, and one for what is left of the errors.

        Args:
            u: the unknowns, in the units of the model.
        """
        return Residuals(rows_of_lines(layout, data, noise, u), None)

    def refusal(self, problem: Problem) -> str | None:
        """Flights of other outputs, without a part in which every output is there, or without a
        trim.
        """
        flights = problem.training
        refused = other_outputs(flights) or without_parts(flights) or absent_instrument(problem)
        return refused or cannot_linearise(problem)

    def flight_facts(self, problem: Problem, flights: Sequence[Flight]) -> tuple[FlightFacts, ...]:
        """Where all outputs are there, and about what the model is linearised."""
        return tuple(
            FlightFacts(parts_of(f), f.dt, condition_of(problem.model, f)) for f in flights
        )

    def instrumented(
        self, problem: Problem, flights: Sequence[Flight]
    ) -> tuple[dict[str, np.ndarray], ...] | None:
        """By flight and input what of it follows the instruments."""
        return instrumented_inputs(problem, flights)

    def first_noise(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """Add the spectrum of what is measured."""
        return first_spectrum(noise, flights)

    def data_at_start(self, data: Data) -> Data:
        """By instrument what follows the instruments, of inputs and outputs."""
        # The equations by instrument have other solutions, far from the least squares of these, and
        # what feedback makes of the signals as they were measured may lead to one.
        by = data.flights[0].by_instrument is not None
        return as_instruments_have_it(data) if by else data

    def noise_of_check(self, layout: Layout, data: Data, noise: Noise) -> Noise:
        """By instrument, where there is one; the noise is what the inputs leave of the outputs.

        That of the errors at the start values would hold all that is wrong with these.
        """
        if (whitening := whitening_without_model(layout, data)) is not None:
            noise = noise._replace(whitening=whitening)
        if data.flights[0].by_instrument is None:
            return noise
        return noise._replace(by_instrument=np.ones(()))

    def relax(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """The spectrum that the errors show, smoothed over frequency and flights.

        Args:
        """
        errors, machine = jax.device_get(errors_of_lines(layout, data, noise, z))
        rows = sum(2 * v.size for v in errors)
        freedom = rows / max(rows - len(layout.free), 1)
        errors = [v * freedom**0.5 for v in errors]
        # Powers of errors that overflow have no spectrum.
        with np.errstate(all="ignore"):
            try:
                whitening = whitening_by(machine, errors)
                sound = all(np.isfinite(W).all() for W in whitening)
            except np.linalg.LinAlgError:
                sound = False
        if not sound:
            return z, noise._replace(log_variance_ratio=np.asarray(np.nan))
        # A model that is not linear is linearised where its nuisances put it.
        if not layout.model.linear:
            z = in_time(layout, data, noise, z)
        # Records of one length have one spectrum.
        by_id = {id(W): -2.0 * log_determinants(W) for W in whitening}
        logs = np.concatenate([by_id[id(W)] for W in whitening])
        of_flight = [record.flight for record in records_of(layout)]
        sd = []
        for i, names in enumerate(layout.outputs):
            own = np.concatenate([v for v, f in zip(errors, of_flight, strict=True) if f == i])
            rms = np.sqrt(np.mean(np.abs(own) ** 2, axis=0))
            sd.append({n: np.asarray(v) for n, v in zip(names, rms, strict=True)})
        by = np.asarray(float(data.flights[0].by_instrument is not None))
        return z, Noise(tuple(sd), np.asarray(np.mean(logs)), whitening, by)

    def finish(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> Float[Array, " q"]:
        """Biases and initial states are in none of the rows: the simulation in time has them."""
        return in_time(layout, data, noise, z) if layout.model.linear else z

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Of complex normal errors at the lines used, in SI units of the outputs; NaN for an
        estimate by instrument, which has none.

        Args:
            noise: that `e` was evaluated with.
        """
        if data.flights[0].by_instrument is not None and float(noise.by_instrument) > 0:
            return float("nan")
        # A row for each unknown of interest, and one for all that is left of the errors.
        rows = np.asarray(e.r)[: len(layout.of_interest) + 1]
        squares = float(np.sum(np.square(rows)))
        by_id = {id(W): W for W in noise.whitening}
        by_id = {k: float(np.sum(log_determinants(np.asarray(W)))) for k, W in by_id.items()}
        logs = sum(by_id[id(W)] for W in noise.whitening)
        lines = sum(r.lines * len(layout.outputs[r.flight]) for r in records_of(layout))
        return 2.0 * logs - 0.5 * squares - lines * float(np.log(np.pi))

    def findings(
        self, at: Solution, e: Evaluation, names: Sequence[str], ill: bool
    ) -> list[Finding]:
        """How much of flights with missing samples is used, where models were linearised, and what
        there is not by instrument.
        """
        return [
            *cut_notes(at.layout, at.data, names),
            *linearisation_notes(at, e),
            *instrument_notes(at.data),
        ]

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """The simulated flights: what disturbs them is in the noise.

        Args:
            reached: where the fit ended.
            runs: how many records; one simulation serves them all.
        """
        return OUTPUT_ERROR.records(reached, u, runs, seed)


def first_spectrum(noise: Noise, flights: Sequence[Flight]) -> Noise:
    """Return the noise with the spectrum of what is measured, as if all of it were noise.

    White noise would give all the say to where the record is largest, gusts included.
    """
    measured = []
    for flight, sd in zip(flights, noise.sd, strict=True):
        whole = np.stack([flight.outputs[n] for n in sorted(sd)], axis=1)
        for first, last in parts_of(flight):
            measured.append(lines_of(whole[first:last]))
    whitening = whitening_alone(measured)
    # Least squares at first: near that estimate the equations by instrument have one solution.
    return noise._replace(whitening=whitening, by_instrument=np.zeros(()))


OBJECTIVE = FrequencyError()
