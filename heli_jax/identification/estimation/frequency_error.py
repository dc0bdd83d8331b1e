r"""Frequency error: output error on the Fourier transforms of records, with the noise's spectrum.

For a linear model with inputs that are held, or linear between samples, and $z = e^{i\omega dt}$ at
a Fourier frequency of the record,

$$X = (zI - A_d)^{-1}\,[B_d U + z\,(x_0 - x_N)]$$

is exact, also for unstable vehicles, and needs no simulation. The ends of the record are n
unknowns, with n more for the ends of slow gusts; linear least squares projects them out. The
noise's spectrum, a matrix over the outputs, is estimated from the residual and weights the
frequencies. The estimate is maximum likelihood also in gusts, unless feedback transfers them into
the inputs. Nonlinear models are linearised at the operating point.

Flights may contain an excitation that was added to an input and that feedback does not affect. The
errors are then weighted by the response to the part of the input that follows it, which removes the
effect of feedback.

Sources: Pintelon and Schoukens (2012), chapters 6, 9 and 10; Klein and Morelli (2006), chapter 7.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.operating_point import condition_in_words
from heli_jax.analysis.spectra import windowed
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.estimation.frequency_instrument import (
    absent_instrument,
    as_instruments_have_it,
    instrument_notes,
    instrumented_inputs,
)
from heli_jax.identification.estimation.frequency_lines import (
    FlightFacts,
    Matrices,
    Record,
    Sources,
    alike,
    cannot_linearise,
    condition_of,
    cut_notes,
    discretised,
    ends_of,
    errors_of_lines,
    errors_of_record,
    lines_of,
    lines_of_flights,
    measured,
    orthonormal,
    other_outputs,
    parts_of,
    records_of,
    records_of_group,
    shared_of,
    sources,
    without_parts,
)
from heli_jax.identification.estimation.frequency_noise import (
    first_model,
    inverse_roots,
    log_determinants,
    once_a_length,
    smoothed,
    whitening_by,
)
from heli_jax.identification.estimation.objective import Objective, RowTags, untagged
from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.estimation.residual import Residuals, rows_of
from heli_jax.identification.estimation.response_weights import averages, noise_density
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
)


class NoiseErrors(NamedTuple):
    """Errors from which the noise's spectrum is estimated."""

    errors: list[Complex[np.ndarray, "K p"]]
    """By record, enlarged by the degrees of freedom that the unknowns take."""
    flights: list[int]
    """Flight of each record."""
    model: Matrices
    samples: int | None = None
    """N of every record, if its lines end below the Nyquist frequency."""


class FrequencyError(Objective):
    """The model's response to the inputs against the measured outputs, at each frequency."""

    noise_model = "spectrum"

    def tags(self, layout: Layout, data: Data, count: int) -> RowTags:
        """Return empty tags, because rows are sums over the lines of all flights."""
        return untagged(count)

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Return a row for each unknown of interest, and one for the rest of the errors."""
        return Residuals(rows_of_lines(layout, data, noise, u), None)

    def refusal(self, problem: Problem) -> str | None:
        """Return why flights are unusable: different outputs, no complete part, or no trim."""
        flights = problem.training
        refused = other_outputs(flights) or without_parts(flights) or absent_instrument(problem)
        return refused or cannot_linearise(problem)

    def flight_facts(self, problem: Problem, flights: Sequence[Flight]) -> tuple[FlightFacts, ...]:
        """Return the parts that have all outputs, and the point of linearisation."""
        return tuple(
            FlightFacts(parts_of(f), f.dt, condition_of(problem.model, f)) for f in flights
        )

    def instrumented(
        self, problem: Problem, flights: Sequence[Flight]
    ) -> tuple[dict[str, np.ndarray], ...] | None:
        """Return, by flight and input, the part that follows the instruments."""
        return instrumented_inputs(problem, flights)

    def first_noise(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """Add the spectrum of each measured signal alone, as if all of it were noise."""
        # White noise would give most weight to frequencies of large power, gusts included.
        measured = []
        for flight, sd in zip(flights, noise.sd, strict=True):
            whole = np.stack([flight.outputs[n] for n in sorted(sd)], axis=1)
            measured += [lines_of(whole[first:last]) for first, last in parts_of(flight)]

        def whitening(S: np.ndarray) -> np.ndarray:
            return inverse_roots(S * np.eye(S.shape[1]))

        return noise._replace(whitening=tuple(once_a_length(whitening, smoothed(measured))))

    def data_at_start(self, data: Data) -> Data:
        """Return by instrument the parts of inputs and outputs that follow the instruments."""
        # The equations by instrument have several solutions. Least squares of these parts ends near
        # the right one; with measured signals, which contain feedback, it may not.
        by = data.flights[0].by_instrument is not None
        return as_instruments_have_it(data) if by else data

    def noise_of_check(self, layout: Layout, data: Data, noise: Noise) -> Noise:
        """Return the spectrum of the outputs' part that the inputs do not explain.

        The errors at the start values would include errors of these values. In closed loop that
        part is too small where feedback moves the inputs more than the excitation does.
        """
        flights = []
        for f, names in zip(jax.device_get(data.flights), layout.outputs, strict=True):
            outputs = {n: f.outputs[n] for n in names}
            flights.append(Flight(dt=float(f.dt), inputs=naming.asdict(f.inputs), outputs=outputs))
        try:
            w = windowed(flights)
        except ValueError:  # too few windows
            return noise
        if w.left_out:
            return noise
        # A one-sided density per Hz is twice the sample time times the power of a line.
        S = noise_density(w, averages(w), w.Y) / (2.0 * w.dt)

        def whitening(record: Record) -> np.ndarray:
            hz = np.arange(1, record.lines + 1) / (record.samples * w.dt)
            return inverse_roots(np.apply_along_axis(lambda v: np.interp(hz, w.hz, v), 0, S))

        return noise._replace(whitening=tuple(whitening(r) for r in records_of(layout)))

    def noise_errors(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> NoiseErrors:
        """Return the errors of all records."""
        errors, model = jax.device_get(errors_of_lines(layout, data, noise, z))
        rows = sum(2 * v.size for v in errors)
        freedom = rows / max(rows - len(layout.free), 1)
        errors = [v * freedom**0.5 for v in errors]
        return NoiseErrors(errors, [record.flight for record in records_of(layout)], model)

    def relax(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """Return the spectrum of the errors, smoothed over frequency and flights."""
        errors, of_flight, model, samples = self.noise_errors(layout, data, noise, z)
        # Powers of errors that overflow have no spectrum.
        with np.errstate(all="ignore"):
            try:
                whitening = whitening_by(model, errors, samples)
                sound = all(np.isfinite(W).all() for W in whitening)
            except np.linalg.LinAlgError:
                sound = False
        if not sound:
            return z, noise._replace(log_determinant=np.asarray(np.nan))
        # The nuisances define the point of linearisation.
        if not layout.model.linear:
            z = in_time(layout, data, noise, z)
        logs = -2.0 * np.concatenate(once_a_length(log_determinants, whitening))
        sd = []
        for i, names in enumerate(layout.outputs):
            own = np.concatenate([v for v, f in zip(errors, of_flight, strict=True) if f == i])
            rms = np.sqrt(np.mean(np.abs(own) ** 2, axis=0))
            sd.append({n: np.asarray(v) for n, v in zip(names, rms, strict=True)})
        return z, Noise(tuple(sd), np.asarray(np.mean(logs)), whitening)

    def finish(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> Float[Array, " q"]:
        """Estimate biases and initial states, which no row determines, by a simulation in time."""
        return in_time(layout, data, noise, z) if layout.model.linear else z

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Return the log-likelihood of complex normal errors at the used lines, in SI units of the
        outputs; NaN by instrument.

        Args:
            noise: the noise that `e` was evaluated with.
        """
        if data.flights[0].by_instrument is not None:
            return float("nan")
        # There is one row for each unknown of interest, and one for the rest of the errors.
        rows = np.asarray(e.r)[: len(layout.of_interest) + 1]
        squares = float(np.sum(np.square(rows)))
        logs = float(np.sum(np.concatenate(once_a_length(log_determinants, noise.whitening))))
        lines = sum(r.lines * len(layout.outputs[r.flight]) for r in records_of(layout))
        return 2.0 * logs - 0.5 * squares - lines * float(np.log(np.pi))

    def findings(
        self, at: Solution, e: Evaluation, names: Sequence[str], ill: bool
    ) -> list[Finding]:
        """Return notes on missing samples, linearisation and instruments."""
        return [
            *cut_notes(at.layout, at.data, names),
            *linearisation_notes(at, e),
            *instrument_notes(at.data),
        ]

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """Return the simulated flights; the noise includes the disturbances."""
        return OUTPUT_ERROR.records(reached, u, runs, seed)


_NOTABLE = 0.3
"""Shift above which an estimate is reported [standard deviations]."""
_GROWS = 3.0
"""Growth of an unstable mode over a flight beyond which a simulation diverges from the record
[e-foldings]."""


def linearisation_notes(at: Solution, e: Evaluation) -> list[Finding]:
    """Return the point of linearisation, and the shifts of the estimates that it causes.

    The shifts are one Gauss-Newton step with the model's own simulation as the record.
    """
    layout, data, noise, _ = at
    if layout.model.linear:
        return []
    flights = tuple(
        flight._replace(outputs={n: jnp.asarray(run[n]) for n in flight.outputs})
        for flight, run in zip(data.flights, e.simulated, strict=True)
    )
    rows = eqx.filter_jit(rows_of)(layout, data._replace(flights=flights), noise, jnp.asarray(e.z))
    # The rows of priors are no error of the model.
    J, r, q = np.asarray(e.J), np.zeros(len(e.J)), len(layout.of_interest)
    r[:q] = np.asarray(rows)[:q]
    shifts: dict[str, float] = {}
    modes = np.linalg.eigvals(first_model(layout, data, jnp.asarray(e.z)).Ad)
    growth = np.log(np.max(np.abs(modes)))
    samples = max(len(v) for run in e.simulated for v in run.values())
    known = samples * growth < _GROWS and np.isfinite(r).all() and np.isfinite(J).all()
    if known:
        step = -np.linalg.lstsq(J, r, rcond=1e-10)[0]
        shifts = dict(zip(layout.of_interest, step[:q] * e.slopes, strict=True))
    sds = dict(zip(layout.of_interest, deviations(J)[:q] * np.abs(e.slopes), strict=True))
    in_sds = {n: v / sds[n] for n, v in shifts.items()}
    facts = layout.flight_facts
    conditions = [None if f.condition is None else condition_in_words(f.condition) for f in facts]
    where = [f"the trim {c}" if c else "the equilibrium at its mean inputs" for c in conditions]
    moved = [f"{n} by {v:+.2g}" for n, v in in_sds.items() if abs(v) >= _NOTABLE]
    if not known:
        moved = ["estimates by an unknown number of"]
    return [
        found(
            "dynamics.linearised",
            "note",
            value=max((abs(v) for v in in_sds.values()), default=None),
            shifts=shifts,
            where=list(dict.fromkeys(where)),
            moved=moved or [f"no estimate by {_NOTABLE:g}"],
        )
    ]


OBJECTIVE = FrequencyError()


# Rows of frequency error: one for each unknown, and one for the rest of the errors.
#
# With whitened errors $e$, their derivatives $J$ by the unknowns and instruments $Z$, the estimate
# solves $Z^T e = 0$. The rows $r = R^{-T} Z^T e$ with $R^T R = Z^T Z$ have unit covariance. Their
# derivative $R^{-T} Z^T J$ contains the information of the estimate, $M^T (Z^T Z)^{-1} M$ with $M =
# Z^T J$. Without instruments $Z = J$; with the additional row $|e - J J^+ e|$ the sum of squares is
# that of all errors: maximum likelihood with few rows. By instrument, $Z$ are the derivatives of
# the errors' response to the part of the inputs that follows the instruments.
#
# Sources: Söderström and Stoica (1983) for estimates by instrument and their covariance; Pintelon
# and Schoukens (2012), chapter 9.


def rows_of_lines(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Float[Array, " r"]:
    """Return the rows, with the derivative of a Gauss-Newton step.

    Args:
        noise: noise with the whitening of each record.
    """
    v, unknowns = shared_of(u)
    instruments, products = data.flights[0].by_instrument is not None, []
    for members in alike(layout, data):
        y = measured(layout, data, members)
        for record, W in records_of_group(layout, noise, members):

            def model(
                v: Array, by_instrument: bool, members: list[int] = members, record: Record = record
            ) -> tuple[Matrices, Sources]:
                m, driving = discretised(
                    layout, data, unknowns(v), members, by_instrument=by_instrument
                )
                return m, sources(record, driving)

            of_record = lines_of_flights(record, y)
            products.append(products_of_record(model, v, record, W, of_record, instruments))
    return rows_of_products(jax.tree.map(lambda *v: sum(v), *products), v, instruments)


type Products = tuple[
    Float[Array, ""], Float[Array, " q"], Float[Array, "q q"], Float[Array, "q q"]
]
"""e'e, Z'e, Z'Z and Z'J."""


def rows_of_products(
    products: Products, v: Float[Array, " q"], instruments: bool = False
) -> Float[Array, " r"]:
    """Return the rows of products over all records at v."""
    ee, Ze, ZZ, ZJ = products
    at, S = jax.lax.stop_gradient(v), orthonormal(ZZ)
    r, M = S.T @ Ze, S.T @ ZJ
    left = jnp.zeros_like(ee) if instruments else jnp.sqrt(jnp.maximum(ee - r @ r, 0.0))
    r, M, left = jax.lax.stop_gradient((r, M, left))
    # This makes the derivative M by definition.
    return jnp.append(r + M @ (v - at), left)


def products_of_record(
    model: Callable[[Array, bool], tuple[Matrices, Sources]],
    v: Float[Array, " q"],
    record: Record,
    W: Complex[Array, "K p p"],
    y: Complex[Array, "K p f"],
    instruments: bool = False,
) -> Products:
    """Return the products over one record of each flight of a group, without its ends.

    Args:
        model: model and transforms of the inputs by the shared unknowns v, directly or by
            instrument.
        y: transforms of the measured outputs.
        instruments: take the derivatives Z by instrument; else they are J.
    """
    v = jax.lax.stop_gradient(v)
    m, at = model(v, False)
    ends = ends_of(m, record, W, at, y)

    def errors(v: Array, by_instrument: bool) -> Float[Array, "r f"]:
        m, at = model(v, by_instrument)
        # Inputs by instrument have no effects of ends.
        at = at if by_instrument else at._replace(ends=ends.inputs)
        return errors_of_record(m, W, ends.R, at, y)

    # Variable projection (Kaufman): derivatives keep the ends fixed.
    e, J = ends.errors[:, :, None], jax.jacfwd(lambda v: errors(v, False))(v)
    Z = jax.jacfwd(lambda v: errors(v, True))(v) if instruments else J

    def product(a: Float[Array, "r f c"], b: Float[Array, "r f d"]) -> Float[Array, "c d"]:
        # The ends' effects are projected out of the products, not out of the long columns.
        along = [(ends.Q.T @ v.reshape(len(v), -1)).reshape(-1, v.shape[2]) for v in (a, b)]
        return a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2]) - along[0].T @ along[1]

    return product(e, e)[0, 0], product(Z, e)[:, 0], product(Z, Z), product(Z, J)
