r"""Frequency error: output error on Fourier transforms of whole records, with the noise's spectrum.

For a linear model with inputs that are held, or linear between samples, and $z = e^{i\omega dt}$ at
a frequency of the record's own,

$$X = (zI - A_d)^{-1}\,[B_d U + z\,(x_0 - x_N)]$$

is exact, for unstable vehicles too: nothing is simulated, and the ends of the record are n numbers
that are found by linear least squares and projected out, with n more for the ends of slow gusts.
The noise's spectrum, a matrix over the outputs, is estimated from the residual and weighs the
frequencies; maximum likelihood then holds where gusts disturb the vehicle as well, as long as no
feedback brings them into the inputs. Models that are not linear are linearised where they fly.

Where flights hold an excitation that was added to an input and that no feedback reaches, the errors
are weighed by the response to what of the input follows it: then feedback does no harm either.

Sources: Pintelon and Schoukens (2012), chapters 6, 9 and 10; Klein and Morelli (2006), chapter 7.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

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
    Driving,
    FlightFacts,
    Matrices,
    Record,
    Resolved,
    alike,
    at_lines,
    basis_of,
    by_block,
    by_flight,
    by_real,
    cut_notes,
    errors_of_lines,
    errors_of_some,
    lines_of,
    machines_of,
    measured,
    other_outputs,
    parts_of,
    parts_of_group,
    real,
    records_of,
    resolved,
    shared_of,
    stacked,
    states,
    with_shared,
    without_parts,
)
from heli_jax.identification.estimation.frequency_noise import (
    log_determinants,
    once_a_length,
    whitening_alone,
    whitening_by,
    whitening_without_model,
)
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
        """A row for each unknown of interest, and one for what is left of the errors."""
        return Residuals(rows_of_lines(layout, data, noise, u), None)

    def refusal(self, problem: Problem) -> str | None:
        """Flights of other outputs, without a part in which every output is there, or without a
        trim."""
        flights = problem.training
        refused = other_outputs(flights) or without_parts(flights) or absent_instrument(problem)
        return refused or cannot_linearise(problem)

    def flight_facts(self, problem: Problem, flights: Sequence[Flight]) -> tuple[FlightFacts, ...]:
        """Lines where all outputs are there, and the point about which the model is linearised."""
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
        """The spectrum that the errors show, smoothed over frequency and flights."""
        errors, vehicle = jax.device_get(errors_of_lines(layout, data, noise, z))
        rows = sum(2 * v.size for v in errors)
        freedom = rows / max(rows - len(layout.free), 1)
        errors = [v * freedom**0.5 for v in errors]
        # Powers of errors that overflow have no spectrum.
        with np.errstate(all="ignore"):
            try:
                whitening = whitening_by(vehicle, errors)
                sound = all(np.isfinite(W).all() for W in whitening)
            except np.linalg.LinAlgError:
                sound = False
        if not sound:
            return z, noise._replace(log_variance_ratio=np.asarray(np.nan))
        # A model that is not linear is linearised where its nuisances put it.
        if not layout.model.linear:
            z = in_time(layout, data, noise, z)
        logs = -2.0 * np.concatenate(once_a_length(log_determinants, whitening))
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
        """Log-likelihood of complex normal errors at the lines used, in SI units of the outputs;
        NaN for an estimate by instrument, which has none.

        Args:
            noise: that `e` was evaluated with.
        """
        if data.flights[0].by_instrument is not None and float(noise.by_instrument) > 0:
            return float("nan")
        # A row for each unknown of interest, and one for all that is left of the errors.
        rows = np.asarray(e.r)[: len(layout.of_interest) + 1]
        squares = float(np.sum(np.square(rows)))
        logs = float(np.sum(np.concatenate(once_a_length(log_determinants, noise.whitening))))
        lines = sum(r.lines * len(layout.outputs[r.flight]) for r in records_of(layout))
        return 2.0 * logs - 0.5 * squares - lines * float(np.log(np.pi))

    def findings(
        self, at: Solution, e: Evaluation, names: Sequence[str], ill: bool
    ) -> list[Finding]:
        """Notes on flights with missing samples, on points of linearisation, and on what an
        instrument leaves out."""
        return [
            *cut_notes(at.layout, at.data, names),
            *linearisation_notes(at, e),
            *instrument_notes(at.data),
        ]

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """The simulated flights: what disturbs them is in the noise."""
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


# The rows that frequency error makes small: as many as unknowns, and one for what is left.
#
# With whitened errors $e$, their derivatives $J$ by the unknowns and instruments $Z$, the estimate
# solves $Z^T e = 0$. The rows $r = R^{-T} Z^T e$ with $R^T R = Z^T Z$ have the identity as their
# covariance, and their derivative $R^{-T} Z^T J$ the information of the estimate, $M^T (Z^T Z)^{-1}
# M$ with $M = Z^T J$. Directly $Z = J$, and with the row $|e - J J^+ e|$ beside them the sum of
# squares is that of all errors: maximum likelihood, in a few rows. By instrument $Z$ are the
# derivatives of the response to what of the inputs follows the instruments.
#
# Sources: Söderström and Stoica (1983) for estimates by instrument and their covariance; Pintelon
# and Schoukens (2012), chapter 9.


_NOTHING = 100.0
"""times the vehicle's precision: what of the information, of columns of one size, is rounding"""


class Products(NamedTuple):
    """Rows of whitened errors e (of white noise of variance 1), their derivatives J by the
    unknowns and instruments Z, all without what the ends of the records may add."""

    ee: Float[Array, ""]
    Ze: Float[Array, " q"]
    ZZ: Float[Array, "q q"]
    ZJ: Float[Array, "q q"]


def rows_of_lines(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Float[Array, " r"]:
    """The rows, with the derivative that a step of Gauss and Newton needs.

    Args:
        noise: with the whitening of each record, and whether instruments are used.
    """
    v = shared_of(layout, u)
    at, rest = jax.lax.stop_gradient((v, u))
    made = products_of_lines(layout, data, noise, at, lambda v: with_shared(layout, rest, v))
    r, M = _weighed(made)
    left = jnp.sqrt(jnp.maximum(made.ee - jnp.sum(r**2), 0.0))
    left = jnp.where(noise.by_instrument > 0.5, 0.0, left)
    r, M, left = jax.lax.stop_gradient((r, M, left))
    # The derivative is exactly M, whatever else moves with the unknowns.
    return jnp.append(r + M @ (v - at), left)


def _weighed(of: Products) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """R^-T Z e and R^-T Z J^T, with R^T R = Z Z^T; zero along what is no direction of Z."""
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(of.ZZ), 0.0))
    # Of one size: units do not decide what is rounding.
    over = jnp.where(sizes > 0, 1.0 / jnp.where(sizes > 0, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(of.ZZ * over[:, None] * over[None, :])
    kept = values > _NOTHING * jnp.finfo(values.dtype).eps * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    along = root[:, None] * vectors.T * over[None, :]
    return along @ of.Ze, along @ of.ZJ


# Products of errors, their derivatives by the unknowns, and instruments, over all lines.
#
# With $H = W C (zI - A_d)^{-1}$ the derivative of the whitened response is
# $H (dA_d X + dB\,U) + W (dC X + dD\,U)$: one product for each line and unknown in place of a
# solution, of which all unknowns share the first factor.
#
# Source: Pintelon and Schoukens (2012), chapter 9.


def products_of_lines(
    layout: Layout,
    data: Data,
    noise: Noise,
    v: Float[Array, " q"],
    unknowns: Callable[[Array], Unknowns],
) -> Products:
    """Over all records. Directly Z = J; by instrument the derivatives of the response to the inputs
    by instrument.

    Args:
        noise: with the whitening of each record, and whether instruments are used.
    """
    total = []
    for members in alike(layout, data):
        parts = parts_of_group(layout, noise, members)
        vehicles, slopes = differentiated(
            lambda v, members=members: machines_of(layout, data, unknowns(v), members), v
        )

        def ready(matrices: Any, parts: Any = parts) -> Any:
            return matrices, [resolved(matrices[0], record, W) for record, W in parts]

        def of_some(common: Any, some: Any, parts: Any = parts) -> Products:
            matrices, ats = common
            made = [
                _of_record(at, matrices, record, noise.by_instrument, *some)
                for at, (record, _) in zip(ats, parts, strict=True)
            ]
            return jax.tree.map(lambda *v: sum(v), *made)

        direct = (vehicles.driving, slopes.driving)
        by = None if vehicles.by is None else (vehicles.by, slopes.by)
        each = (direct, by, measured(layout, data, members))
        common = (vehicles.matrices, slopes.matrices)
        made = by_flight(data, members, ready, of_some, common, each)
        total.append(jax.tree.map(lambda v: jnp.sum(v, axis=0), made))
    return jax.tree.map(lambda *v: sum(v), *total)


def _of_record(
    at: Resolved,
    matrices: tuple[Matrices, Matrices],
    record: Record,
    by_instrument: Array,
    direct: tuple[Driving, Driving],
    by: tuple[Driving, Driving] | None,
    y: Float[Array, "f N p"],
) -> Products:
    """Rows of one record of a few flights, with a leading axis.

    Args:
        direct: what drives the vehicles, and its derivatives by the unknowns.
        by: the same by instrument.
    """
    m, dm = matrices
    e = errors_of_some(at, m, record, direct[0], y)

    def blocks(v: Array) -> Array:
        lines = at_lines(record, v.reshape(*v.shape[:2], -1))
        return by_block(lines.reshape(*lines.shape[:2], *v.shape[2:]), len(at.z), axis=1)

    own = (e.rows, e.X, *jax.tree.map(blocks, (direct, by)))
    # What passes a vehicle by, without its states, hangs on no unknown of most.
    passes = any(v is not None for v in (dm.C, dm.D, direct[1].held))

    # Block by block: the derivatives at all lines would leave every cache.
    def gram(of: Any) -> Float[Array, "f r c"]:
        (z, W, H, ends), own = of
        Q = basis_of(H, ends)
        H, W = real(H), real(W) if passes else None

        def of_one(one: tuple[Array, Array, Any, Any]) -> Array:
            e, X, direct, by = one
            J = _slopes(H, W, matrices, X, direct)

            # One product of tall matrices in place of several: each is read once.
            def products(Z: Array, *right: Array) -> Array:
                left = jnp.concatenate([Z, e[:, None], Q], axis=1)
                return left.T @ jnp.concatenate([*right, e[:, None]], axis=1)

            def directly() -> Array:
                G = products(J, J)
                return jnp.concatenate([G[:, :-1], G], axis=1)

            def with_instruments() -> Array:
                # The states are those of the inputs alone: such a record has no ends.
                X = states(at, z, by_real(by[0].U, m.B.T)[None])[0]
                Z = _slopes(H, W, matrices, X, by)
                return products(Z, J, Z)

            if by is None:
                return directly()
            # One program for both: the direct estimate is where the search begins.
            return jax.lax.cond(by_instrument > 0.5, with_instruments, directly)

        return jax.lax.map(of_one, own)

    G = jnp.sum(jax.lax.map(gram, ((at.z, at.W, at.H, at.ends), own)), axis=0)
    return jax.vmap(lambda one: projected(one, at.S))(G)


def projected(G: Float[Array, "r c"], S: Float[Array, "m m"]) -> Products:
    """Products with what the ends may add projected out of them: only they change (Kaufman).

    Args:
        G: of the columns [Z, e, Q], with Q what the ends may add, and [J, Z, e]; Z and J are minus
            the derivatives.
        S: makes an orthonormal basis of Q.
    """
    q = G.shape[1] // 2
    along = S.T @ G[q + 1 :]
    # Of a complex normal error each part has half of the variance.
    P = 2.0 * (G[: q + 1] - along[:, q:].T @ along)
    return Products(P[q, -1], -P[:q, -1], P[:q, q:-1], P[:q, :q])


def _slopes(
    H: Float[Array, "k p2 n2"],
    W: Float[Array, "k p2 p2"] | None,
    matrices: tuple[Matrices, Matrices],
    X: Complex[Array, "k n"],
    driven: tuple[Driving, Driving],
) -> Float[Array, "s q"]:
    """The derivatives of the whitened response, real parts and imaginary ones.

    Args:
        X: the states.
        driven: what drives them, and its derivatives (k, c, q), None for those that do not move.
    """
    (m, dm), (lines, slopes) = matrices, driven
    driving = _moved(X, lines.U, (dm.Ad, dm.B), (m.B, slopes.U))
    passing = _moved(X, lines.held, (dm.C, dm.D), (m.D, slopes.held))
    pairs = ((H, driving), (W, passing))
    made = sum(M @ v for M, v in pairs if M is not None and v is not None)
    return made.reshape(-1, made.shape[-1])  # pyright: ignore


def _moved(
    X: Complex[Array, "K n"],
    u: Complex[Array, "K r"],
    slopes: tuple[Any, Any],
    of_signals: tuple[Array, Any],
) -> Any:
    """dF X + dG u + G du (K, 2a, q), real parts and imaginary ones; None where all are zero.

    Args:
        slopes: dF (a, n, q) and dG (a, r, q), None where zero.
        of_signals: G (a, r) and du (K, r, q), None where zero.
    """
    total, K = None, X.shape[0]
    pairs = [(v, d) for v, d in zip((X, u), slopes, strict=True) if d is not None]
    if pairs:
        # One product of large real matrices: real and imaginary parts are rows of the first.
        v = stacked(jnp.concatenate([v for v, _ in pairs], axis=1)).reshape(2 * K, -1)
        d = jnp.concatenate([d for _, d in pairs], axis=1)
        a, c, q = d.shape
        total = (v @ jnp.swapaxes(d, 0, 1).reshape(c, a * q)).reshape(K, 2 * a, q)
    G, du = of_signals
    if du is not None:
        part = jnp.einsum("ar,ksrq->ksaq", G, stacked(du)).reshape(K, 2 * G.shape[0], -1)
        total = part if total is None else total + part
    return total


def differentiated[T](make: Callable[[Array], T], v: Float[Array, " q"]) -> tuple[T, T]:
    """Arrays in tuples and their derivatives by v, a last axis; None in place of those that are
    zero."""

    moving: list[bool] = []

    # Called beside `make`: which derivatives are zero shows as they are made, and to trace a model
    # once more for it takes as long as to differentiate it.
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
