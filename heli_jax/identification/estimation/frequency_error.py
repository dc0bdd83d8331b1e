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

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.analysis.operating_point import flown
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
    Driving,
    Errors,
    FlightFacts,
    Matrices,
    Resolved,
    alike,
    basis_of,
    cut_notes,
    discretised,
    errors_of_lines,
    errors_of_record,
    lines_of,
    measured,
    other_outputs,
    parts_of,
    parts_of_group,
    records_of,
    resolved,
    shared_of,
    times,
    with_shared,
    without_parts,
)
from heli_jax.identification.estimation.frequency_noise import (
    first_model,
    log_determinants,
    once_a_length,
    whitening_alone,
    whitening_by,
    whitening_without_model,
)
from heli_jax.identification.estimation.linearised_flights import (
    cannot_linearise,
    condition_of,
)
from heli_jax.identification.estimation.objective import Objective, RowTags, untagged
from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.estimation.residual import Residuals, rows_of
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
        """Add the spectrum of the measured signals."""
        return first_spectrum(noise, flights)

    def data_at_start(self, data: Data) -> Data:
        """Return by instrument the parts of inputs and outputs that follow the instruments."""
        # The equations by instrument have several solutions. Least squares of these parts ends near
        # the right one; with measured signals, which contain feedback, it may not.
        by = data.flights[0].by_instrument is not None
        return as_instruments_have_it(data) if by else data

    def noise_of_check(self, layout: Layout, data: Data, noise: Noise) -> Noise:
        """Return the spectrum of the outputs' part that the inputs do not explain.

        The errors at the start values would include errors of these values.
        """
        whitening = whitening_without_model(layout, data)
        return noise if whitening is None else noise._replace(whitening=whitening)

    def relax(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """Return the spectrum of the errors, smoothed over frequency and flights."""
        errors, model = jax.device_get(errors_of_lines(layout, data, noise, z))
        rows = sum(2 * v.size for v in errors)
        freedom = rows / max(rows - len(layout.free), 1)
        errors = [v * freedom**0.5 for v in errors]
        # Powers of errors that overflow have no spectrum.
        with np.errstate(all="ignore"):
            try:
                whitening = whitening_by(model, errors)
                sound = all(np.isfinite(W).all() for W in whitening)
            except np.linalg.LinAlgError:
                sound = False
        if not sound:
            return z, noise._replace(log_variance_ratio=np.asarray(np.nan))
        # The nuisances define the point of linearisation.
        if not layout.model.linear:
            z = in_time(layout, data, noise, z)
        logs = -2.0 * np.concatenate(once_a_length(log_determinants, whitening))
        of_flight = [record.flight for record in records_of(layout)]
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


def first_spectrum(noise: Noise, flights: Sequence[Flight]) -> Noise:
    """Return the noise with the spectrum of the measured signals, as if all of them were noise.

    White noise would give most weight to the frequencies of the largest power, gusts included.
    """
    measured = []
    for flight, sd in zip(flights, noise.sd, strict=True):
        whole = np.stack([flight.outputs[n] for n in sorted(sd)], axis=1)
        for first, last in parts_of(flight):
            measured.append(lines_of(whole[first:last]))
    return noise._replace(whitening=whitening_alone(measured))


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
    conditions = [None if f.condition is None else flown(f.condition) for f in facts]
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
# the response to the part of the inputs that follows the instruments.
#
# Sources: Söderström and Stoica (1983) for estimates by instrument and their covariance; Pintelon
# and Schoukens (2012), chapter 9.


_NOTHING = 100.0
"""Eigenvalues of the normalised information that are rounding, as a multiple of the floating-point
precision."""


class Products(NamedTuple):
    """Products of columns e, J, Z and Q.

    e are the whitened errors without the effects of the records' ends, J the derivatives of the
    response by the unknowns, Z instruments, and Q effects of the ends.
    """

    ee: Float[Array, ""]
    Ze: Float[Array, " q"]
    """Negative product, because the derivatives of e are -J."""
    ZZ: Float[Array, "q q"]
    ZJ: Float[Array, "q q"]
    QZ: Float[Array, "m q"]
    """Zero after `projected`."""
    QJ: Float[Array, "m q"]


def products(Z: Array, J: Array, e: Array, Q: Array) -> Products:
    """Return the products of columns Z, J, Q and one column e."""
    return Products(e @ e, -Z.T @ e, Z.T @ Z, Z.T @ J, Q.T @ Z, Q.T @ J)


def projected(of: Products, S: Float[Array, "m m"]) -> Products:
    """Return the products of Z and J with Q projected out.

    Args:
        S: makes the columns of Q orthonormal.
    """
    Z, J = S.T @ of.QZ, S.T @ of.QJ
    none = jnp.zeros_like(of.QZ)
    return Products(of.ee, of.Ze, of.ZZ - Z.T @ Z, of.ZJ - Z.T @ J, none, none)


def rows_of_lines(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Float[Array, " r"]:
    """Return the rows, with the derivative of a Gauss-Newton step.

    Args:
        noise: noise with the whitening of each record.
    """
    v = shared_of(layout, u)
    at, rest = jax.lax.stop_gradient((v, u))
    made = products_of_lines(layout, data, noise, at, lambda v: with_shared(layout, rest, v))
    r, M = _weighed(made)
    left = jnp.sqrt(jnp.maximum(made.ee - jnp.sum(r**2), 0.0))
    if data.flights[0].by_instrument is not None:
        left = jnp.zeros_like(left)
    r, M, left = jax.lax.stop_gradient((r, M, left))
    # This makes the derivative M by definition.
    return jnp.append(r + M @ (v - at), left)


def _weighed(of: Products) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """Return R^-T Z^T e and R^-T Z^T J, with R^T R = Z^T Z; zero for directions without effect."""
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(of.ZZ), 0.0))
    # Columns are normalised to be independent of units.
    over = jnp.where(sizes > 0, 1.0 / jnp.where(sizes > 0, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(of.ZZ * over[:, None] * over[None, :])
    kept = values > _NOTHING * jnp.finfo(values.dtype).eps * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    along = root[:, None] * vectors.T * over[None, :]
    return along @ of.Ze, along @ of.ZJ


def products_of_lines(
    layout: Layout,
    data: Data,
    noise: Noise,
    v: Float[Array, " q"],
    unknowns: Callable[[Array], Unknowns],
) -> Products:
    """Return the products over all records.

    Z is J, or by instrument the derivatives of the response to the inputs by instrument.

    Args:
        noise: noise with the whitening of each record.
        v: unknowns that all flights share.
    """
    total, with_instruments = [], data.flights[0].by_instrument is not None
    for members in alike(layout, data):

        def model(v: Array, members: Any = members, **by: bool) -> tuple[Matrices, Driving]:
            return discretised(layout, data, unknowns(v), members, **by)

        (m, driving), slopes = differentiated(model, v)
        by = None
        if with_instruments:
            by = differentiated(functools.partial(model, by_instrument=True), v)
        y = measured(layout, data, members)
        for record, W in parts_of_group(layout, noise, members):
            at = resolved(m, record, W)
            e = errors_of_record(at, m, driving, y)
            total.append(_of_record(at, e, ((m, driving), slopes), by))
    return jax.tree.map(lambda *p: sum(p), *total)


type _Differentiated = tuple[tuple[Matrices, Driving], tuple[Matrices, Driving]]
"""A model with its inputs, and their derivatives by the unknowns in a last axis; None replaces zero
derivatives."""


def _of_record(
    at: Resolved,
    e: Errors,
    direct: _Differentiated,
    by: _Differentiated | None,
) -> Products:
    """Return the products over one record of all flights of a group."""

    def at_lines(of: _Differentiated) -> Any:
        # The axis of flights follows that of blocks (b, f, k, ...).
        signals = (of[0][1], of[1][1])
        return jax.tree.map(lambda v: jnp.moveaxis(at.lines(v), -1, 1), signals)

    # Blocks are processed in turn, because the derivatives at all lines exceed the caches.
    def of_block(of: Any) -> Products:
        (W, R, H, effects), own = of
        Q = basis_of(H, effects)

        def of_flight(one: Any) -> Products:
            e, X, direct_lines, by_lines = one
            J = _slopes(H, W, X, direct, direct_lines)
            if by is None:
                return products(J, J, e, Q)
            # Inputs by instrument have no effects of ends.
            of_inputs = times(R, by_lines[0].U @ by[0][0].B.T)
            return products(_slopes(H, W, of_inputs, by, by_lines), J, e, Q)

        return jax.lax.map(of_flight, own)

    rows, X = (jnp.moveaxis(v, -1, 1) for v in (e.rows, e.X))
    own = (rows, X, at_lines(direct), None if by is None else at_lines(by))
    made = jax.lax.map(of_block, ((at.W, at.R, at.H, at.effects), own))
    by_flight = jax.vmap(projected, (0, None))(_summed(made), at.S)
    return _summed(by_flight)


def _summed(of: Products) -> Products:
    return jax.tree.map(lambda p: jnp.sum(p, axis=0), of)


def _slopes(
    H: Float[Array, "k 2p 2n"],
    W: Float[Array, "k 2p 2p"],
    X: Float[Array, "k 2 n"],
    of: _Differentiated,
    signals: tuple[Driving, Driving],
) -> Float[Array, "s q"]:
    """Return the derivatives of the whitened response at the lines of a block, with states X.

    They are H (dAd X + dB U + B dU) + W (dC X + dD held + D dheld).

    Args:
        signals: inputs of the model at the lines, and their derivatives.
    """

    value, slopes = (of[0][0], signals[0]), (of[1][0], signals[1])

    def response(moving: tuple[Matrices, Driving]) -> Float[Array, " s"]:
        m, signals = eqx.combine(moving, value)
        # X @ Ad.T would be slower: XLA lays out its derivatives so that the next product transposes
        # them.
        driving, passing = (
            jnp.einsum("kcj,ij->kci", X, A) + jnp.einsum("kcj,ij->kci", v, B)
            for A, v, B in ((m.Ad, signals.U, m.B), (m.C, signals.held, m.D))
        )
        return (times(H, driving) + times(W, passing)).reshape(-1)

    # Only arrays that depend on the unknowns are kept; long signals usually do not.
    moving = jax.tree.map(
        lambda d, v: None if d is None else v, slopes, value, is_leaf=lambda d: d is None
    )

    def along(direction: tuple[Matrices, Driving]) -> Float[Array, " s"]:
        return jax.jvp(response, (moving,), (direction,))[1]

    return jax.vmap(along, in_axes=-1, out_axes=-1)(slopes)


def differentiated[T](make: Callable[[Array], T], v: Float[Array, " q"]) -> tuple[T, T]:
    """Return arrays in tuples and their derivatives by v in a last axis.

    None replaces zero derivatives.
    """
    moving: list[bool] = []

    # It runs together with `make` and records which derivatives are zero. A separate trace of the
    # model would take as long as differentiating it.
    @jax.custom_jvp
    def look(*leaves: Array) -> Array:
        return jnp.zeros((), v.dtype)

    def rule(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
        zero = jax.custom_derivatives.SymbolicZero
        moving[:] = [not isinstance(t, zero) for t in tangents]
        return jnp.zeros((), v.dtype), jnp.zeros((), v.dtype)

    look.defjvp(rule, symbolic_zeros=True)

    def looked_at(v: Array) -> T:
        made = make(v)
        look(*jax.tree.leaves(made))
        return made

    def along(direction: Array) -> tuple[T, T]:
        return jax.jvp(looked_at, (v,), (direction,))

    value, slopes = jax.vmap(along, out_axes=(None, -1))(jnp.eye(v.size, dtype=v.dtype))
    leaves, structure = jax.tree.flatten(slopes)
    kept = [d if moves else None for d, moves in zip(leaves, moving, strict=True)]
    return value, jax.tree.unflatten(structure, kept)
