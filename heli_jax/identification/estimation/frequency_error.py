r"""Frequency error: output error on Fourier transforms of whole records, with the noise's spectrum.

For a linear model with inputs that are held, or linear between samples, and $z = e^{i\omega dt}$ at
a frequency of the record's own,

$$X = (zI - A_d)^{-1}\,[B_d U + z\,(x_0 - x_N)]$$

is exact, for unstable machines too: nothing is simulated, and the ends of the record are n numbers
that are found by linear least squares and projected out. The noise's spectrum, a matrix over the
outputs, is estimated from the residual and weighs the frequencies; maximum likelihood then holds
where gusts disturb the machine as well, as long as no feedback brings them into the inputs.

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Klein and Morelli (2006), chapter 7;
Golub and Pereyra (1973) and Kaufman (1975) for the projection.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.estimator import Estimator, Evaluation, Residuals
from heli_jax.identification.estimation.in_time import in_time
from heli_jax.identification.estimation.output_error import ESTIMATOR as OUTPUT_ERROR
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
    unpack,
)
from heli_jax.simulation.hold import linear_inputs
from heli_jax.simulation.stepping import held_columns

_LEAST, _PART = 6.0, 0.08
"""sd of the Gaussian that smooths the noise's spectrum over frequency: lines at least, and as a
part of the frequency. Narrower ones follow the noise itself: intervals are then too narrow"""
_ROUNDING = 1e-10
"""of the mean over all frequencies, below which a spectrum is not taken to fall"""


class _Lines(NamedTuple):
    """A flight at its own frequencies k = 1 ... K, below the Nyquist frequency."""

    z: Complex[Array, " K"]
    error: Complex[Array, "K p"]
    """measured less simulated, the ends of the record taken off"""
    basis: Complex[Array, "K p n"]
    """what the ends of the record may add, whitened"""


class FrequencyError(Estimator):
    """The model's response to the inputs against the measured outputs, at each frequency."""

    rows_are_samples = False
    least_squares = False
    nuisances_in_rows = False
    noise_spectrum = True
    errors = "residuals"

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """The whitened errors, real and imaginary parts, flight after flight.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: with the whitening of each flight.
            u: the unknowns, in the units of the model.
        """
        rows = [
            _rows(_lines(layout, data, u, i, noise.whitening[i]), noise.whitening[i])
            for i in range(len(data.flights))
        ]
        return Residuals(jnp.concatenate(rows), None)

    def refusal(self, problem: Problem) -> str | None:
        """Other than linear models, and records with missing samples.

        Args:
            problem: what is to be fitted.
        """
        if not problem.model.linear:
            return (
                f"model {problem.model.name} is not linear; expected output-error or filter-error"
            )
        for flight in problem.training:
            for name, y in flight.outputs.items():
                missing = int(np.count_nonzero(~np.isfinite(y)))
                if missing:
                    return (
                        f"{flight.name or 'a flight'}: output {name} has {missing} missing "
                        "samples, which a Fourier transform has no place for; expected a window "
                        "without them, gaps: split, or another method"
                    )
        return None

    def one_program(self, layout: Layout) -> bool:
        """Thousands of small matrices are inverted: a step is cheap to call for beside that."""
        return False

    def prepared(self, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """A spectrum to begin with, that of what is measured.

        Args:
            noise: standard deviations by flight and output.
            flights: those fitted.
        """
        measured = []
        for flight, sd in zip(flights, noise.sd, strict=True):
            y = np.stack([flight.outputs[n] for n in sorted(sd)], axis=1)
            lines = np.fft.rfft(y - y.mean(axis=0), axis=0) / np.sqrt(len(y))
            measured.append(lines[1 : 1 + _count(len(y))])
        # As if all of it were noise: each frequency by its own size. White noise would give all
        # the say to where the record is largest, gusts included.
        return noise._replace(whitening=_whitening(_diagonal(s) for s in smoothed(measured)))

    def relax(
        self, layout: Layout, data: Data, e: Evaluation, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """The spectrum that the errors show, smoothed over frequency and flights.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            e: at z with `noise`.
            noise: so far.
            z: the unknowns.
        """
        errors = [np.asarray(v) for v in _errors(layout, data, noise, z)]
        rows = sum(2 * v.size for v in errors)
        freedom = rows / max(rows - len(layout.free), 1)
        spectra = [s * freedom for s in smoothed(errors)]
        # Biases and initial states are in none of these rows: the simulation in time has them.
        z = in_time(layout, data, noise, z)
        logs = np.concatenate([np.linalg.slogdet(s)[1] for s in spectra])
        sd = tuple(
            {n: np.asarray(np.sqrt(np.mean(s[:, j, j].real))) for j, n in enumerate(names)}
            for names, s in zip(layout.outputs, spectra, strict=True)
        )
        return z, Noise(sd, np.asarray(np.mean(logs)), _whitening(spectra))

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Of complex normal errors at the lines used, in SI units of the outputs.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: that `e` was evaluated with.
            e: the evaluation.
        """
        numbers = self.row_signals(layout, data).size
        squares = float(np.sum(np.square(np.asarray(e.r)[:numbers])))
        logs = sum(float(np.sum(np.linalg.slogdet(np.asarray(W))[1])) for W in noise.whitening)
        lines = numbers / 2
        return 2.0 * logs - 0.5 * squares - lines * float(np.log(np.pi))

    def row_signals(self, layout: Layout, data: Data) -> np.ndarray:
        """Of the first rows (n,) the signal: real parts, then imaginary ones, flight by flight.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
        """
        first, out = 0, []
        for i, names in enumerate(layout.outputs):
            K = _count(data.flights[i].outputs[names[0]].shape[0])
            out.append(np.tile(first + np.arange(len(names)), 2 * K))
            first += len(names)
        return np.concatenate(out)

    def errors_of(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation
    ) -> list[np.ndarray]:
        """By signal the whitened rows times its sd, SI.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: that the rows were divided by.
            e: the evaluation that holds the rows.
        """
        return self.rows_by_signal(layout, data, noise, e)

    def log_density(self, layout: Layout, data: Data, rows: Float[Array, " n"]) -> Array:
        """Of the whitened rows, the spectrum taken as it was estimated.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            rows: those of the measurements, traced.
        """
        return -0.5 * jnp.sum(rows**2)

    def noise_unknowns(self, layout: Layout) -> int:
        """None that is counted: a smooth spectrum, and that of each candidate model its own."""
        return 0

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """The simulated flights: what disturbs them is in the noise.

        Args:
            reached: where the fit ended.
            u: the unknowns there.
            runs: how many records; one simulation serves them all.
            seed: of nothing here, since nothing is drawn.
        """
        return OUTPUT_ERROR.records(reached, u, runs, seed)


def _diagonal(S: np.ndarray) -> np.ndarray:
    """Spectra (K, p, p) without what outputs share."""
    return S * np.eye(S.shape[1])


def _whitening(spectra: Iterable[np.ndarray]) -> tuple[np.ndarray, ...]:
    # Lower triangles: S = L L^H, and L^-1 e is white.
    return tuple(np.linalg.inv(np.linalg.cholesky(S)) for S in spectra)


def _count(N: int) -> int:
    """Lines of a record of N samples, without zero and the Nyquist frequency."""
    return (N - 1) // 2


@eqx.filter_jit
def _errors(layout: Layout, data: Data, noise: Noise, z: Array) -> list[Array]:
    """By flight the errors (K, p), the ends of the record taken off, not whitened."""
    u = unpack(layout, data, z)
    return [_lines(layout, data, u, i, noise.whitening[i]).error for i in range(len(data.flights))]


def smoothed(errors: Sequence[Complex[np.ndarray, "K p"]]) -> list[np.ndarray]:
    """By flight the spectrum (K, p, p) of the errors of all flights, smoothed over frequency.

    Args:
        errors: by flight at its own lines, those of N samples K = (N - 1) // 2.
    """
    powers = [np.einsum("ki,kj->kij", v, np.conj(v)) for v in errors]
    # In parts of the rate, which all flights have in common.
    at = [np.arange(1, len(v) + 1) / (2 * len(v) + 1) for v in errors]
    out = []
    for f in at:
        total, weight = np.zeros((f.size, *powers[0].shape[1:]), complex), np.zeros(f.size)
        for g, power in zip(at, powers, strict=True):
            width = np.maximum(_LEAST * g[0], _PART * f)
            # Few lines carry weight for each: by sums over the lines themselves.
            kernel = np.exp(-0.5 * ((f[:, None] - g[None, :]) / width[:, None]) ** 2)
            total += np.einsum("fg,gij->fij", kernel, power)
            weight += np.sum(kernel, axis=1)
        S = total / weight[:, None, None]
        floor = _ROUNDING * np.mean(np.real(np.einsum("kii->ki", S)), axis=0)
        out.append(S + np.diag(floor)[None])
    return out


def _rows(lines: _Lines, whitening: Complex[Array, "K p p"]) -> Float[Array, " r"]:
    e = jnp.einsum("kij,kj->ki", whitening, lines.error)
    stacked = _real(e.reshape(-1, 1))[:, 0]
    # What the ends of the record can explain is taken off: as good as searching for them (Kaufman).
    Q = jnp.linalg.qr(_real(lines.basis.reshape(-1, lines.basis.shape[2])))[0]
    Q = jax.lax.stop_gradient(Q)
    # Of a complex normal error each part has half of the variance.
    return 2.0**0.5 * (stacked - Q @ (Q.T @ stacked))


def _real(v: Complex[Array, "r n"]) -> Float[Array, "s n"]:
    return jnp.concatenate([jnp.real(v), jnp.imag(v)])


def _lines(layout: Layout, data: Data, u: Unknowns, i: int, whitening: Array) -> _Lines:
    drive, names = driven(layout, data, u, i), layout.outputs[i]
    model, flight = layout.model, data.flights[i]
    linear = linear_inputs(model, drive.inputs, layout.hold(i))
    Ad, B, U, acting = held_columns(model, drive.params, drive.inputs, drive.dt, u.shift, linear)
    _, _, C, D = jacobians(model, drive.params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in names])
    C, D = C[rows], D[rows]
    N = U.shape[0]
    k = np.arange(1, (N - 1) // 2 + 1)
    z = jnp.asarray(np.exp(2j * np.pi * k / N))

    def lines(v: Array) -> Array:
        # Without a mean: the zero line is not used, and rounding would carry it to the others.
        return jnp.fft.rfft(v - jnp.mean(v, axis=0, keepdims=True), axis=0)[k] * float(N) ** -0.5

    y = jnp.stack([flight.outputs[n] for n in names], axis=1)
    identity = jnp.eye(Ad.shape[0], dtype=z.dtype)
    still = jax.lax.stop_gradient(Ad).astype(z.dtype)
    P = jnp.linalg.inv(z[:, None, None] * identity[None] - still[None])
    X = _states(P, Ad, lines(U) @ B.T.astype(z.dtype))
    error = lines(y) - X @ C.T.astype(z.dtype) - lines(acting) @ D.T.astype(z.dtype)
    ends = z[:, None, None] * jnp.einsum("pn,knm->kpm", jax.lax.stop_gradient(C).astype(z.dtype), P)
    basis = jnp.einsum("kij,kjn->kin", whitening, ends)
    white = jnp.einsum("kij,kj->ki", whitening, jax.lax.stop_gradient(error))
    d = jnp.linalg.lstsq(
        _real(basis.reshape(-1, basis.shape[2])), _real(white.reshape(-1, 1))[:, 0]
    )[0]
    d = jax.lax.stop_gradient(d)
    X = _states(P, Ad, z[:, None] * d.astype(z.dtype)[None, :])
    return _Lines(z, error - X @ C.T.astype(z.dtype), basis)


@jax.custom_jvp
def _states(P: Array, Ad: Array, b: Array) -> Array:
    """(zI - Ad)^-1 b at every line (K, n); P is that inverse."""
    return jnp.einsum("kij,kj->ki", P, b)


@_states.defjvp
def _states_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    P, Ad, b = primals
    _, dA, db = tangents
    X = _states(P, Ad, b)
    # One product for each line in place of a solution: the inverse is the same for all unknowns.
    return X, jnp.einsum("kij,kj->ki", P, X @ dA.T.astype(X.dtype) + db)


ESTIMATOR = FrequencyError()
