"""Weights of fits of frequency responses: covariance and whitening of the response errors.

With Z, U, E the transforms of instruments, inputs and errors in each window, the response in the
errors is dH = S_zu^-1 S_ze. Given the inputs, its covariance between outputs i and j is

    P V P^H S_ij,    P = S_zu^-1,

with S the noise's spectral matrix and V the sum of conj(Z) Z, with overlapping windows weighted by
their correlation. It is exact also for a chirp, whose power at one frequency lies in one window.

Sources: Bendat and Piersol, Random Data (2010), chapter 9; Pintelon and Schoukens (2012), chapter
2, for the estimate by instrument.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float

from heli_jax import naming
from heli_jax.analysis.responses import inverse
from heli_jax.analysis.spectra import (
    PER_AVERAGE,
    STEPS,
    PairOptions,
    ResponseOptions,
    Windowed,
    hann,
    octave_mean,
    windowed,
)
from heli_jax.errors import nearest
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.problem import Problem

_WIDEST = 2.0
"""sd of the Gaussian that smooths the noise's spectrum over frequency, in lines of the window; half
of it if there are enough averages."""
_PART = 0.04
"""Least sd of this Gaussian as a fraction of the frequency."""
_ENOUGH = 30.0
"""Independent averages for each output that a spectral matrix needs."""
_LINES = 2.0 * np.pi**0.5 / (STEPS / PER_AVERAGE)
"""Independent lines of Hann windows in a Gaussian of one line."""
_NEIGHBOURS = 3
"""Lines on either side that are correlated with a line in Hann windows."""
_ROUNDING = 1e-14
"""Least density of the noise, as a fraction of the signal's."""
_SMALLEST = 1e-9
"""Least eigenvalue of the noise's coherence matrix, for outputs computed from one another."""


class Averages(NamedTuple):
    """Errors of responses as determined by the inputs; m inputs, k lines."""

    P: np.ndarray
    """Inverse cross-spectra (k, m, m) from instruments to inputs; zero if inputs are dependent."""
    sound: np.ndarray
    """True (k,) if inputs are independent."""
    covariance: np.ndarray
    """Covariance (k, m, m) of the responses' errors over the density of the noise."""
    share: np.ndarray
    """Independent share (k, m) of an error, because errors at neighbouring lines are correlated."""
    freedom: np.ndarray
    """Expected sum (k,) over windows of the squares of white noise of density 1, less the part that
    a response explains."""


def averages(w: Windowed) -> Averages:
    """Compute the averages of flights in windows."""
    turns = np.outer(w.lines, np.arange(w.length)) / w.length
    g = hann(w.length) * np.exp(-2j * np.pi * turns)
    g = g - np.mean(g, axis=1, keepdims=True)
    z, u = (np.mean(np.abs(v) ** 2, axis=0) for v in (w.Z, w.U))
    P = inverse(_cross(w.Z, w.U), z, u)
    sound, P = np.isfinite(P).all((1, 2)), np.nan_to_num(P)
    near = [_correlations(g, d, w.step) for d in range(min(_NEIGHBOURS + 1, len(g)))]
    spreads = [_spread(w, c) for c in near]
    # Covariances of a response's errors with those at the d-th line after it.
    C = [
        np.einsum("kxa,kab,kyb->kxy", P[: len(V)], V, np.conj(P[d:]), optimize=True)
        for d, V in enumerate(spreads)
    ]
    own = [np.real(np.einsum("kxx->kx", v)) for v in C]
    size, total = np.sqrt(np.maximum(own[0], 1e-300)), np.ones(P.shape[:2])
    for d, v in enumerate(own[1:], 1):
        # Negative correlations are ignored, because no response varies that fast.
        rho = np.maximum(v / (size[: len(v)] * size[d:]), 0.0)
        total[: len(v)] += rho
        total[d:] += rho
    # Subtracting the mean removes part of the white noise at the first line.
    power = np.real(near[0][0])
    taken = np.real(np.einsum("kab,kba->k", _inverse_power(w), spreads[0]))
    return Averages(P, sound, C[0], 1.0 / total, np.maximum(len(w.Z) * (power - taken), 0.5))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean (k, x, y) of conj(a) b over the windows."""
    return np.einsum("wkx,wky->kxy", np.conj(a), b, optimize=True) / len(a)


def _correlations(g: np.ndarray, d: int, step: int) -> dict[int, np.ndarray]:
    """Return the correlation (k - d,) of the transforms of white noise at lines d apart, in windows
    j steps apart, by j.

    Args:
        g: window times complex exponential of each line (k, samples), less their means.
    """
    a, b = g[: len(g) - d], np.conj(g[d:])
    size, found = np.sum(hann(g.shape[1]) ** 2), {}
    for j in range(1 - STEPS, STEPS):
        first, second = max(j, 0) * step, max(-j, 0) * step
        shared = g.shape[1] - abs(j) * step
        products = a[:, first : first + shared] * b[:, second : second + shared]
        found[j] = np.sum(products, axis=1) / size
    return found


def _spread(w: Windowed, correlations: dict[int, np.ndarray]) -> np.ndarray:
    """Return the covariance (k - d, m, m) of two means of conj(Z) E, d lines apart.

    E is white noise of density 1.
    """
    k = len(correlations[0])
    a, b = w.Z[:, :k], w.Z[:, len(w.numbers) - k :]
    total = np.zeros((k, a.shape[2], b.shape[2]), complex)
    for j, correlation in correlations.items():
        first, second = w.pairs(j)
        products = np.einsum("wkx,wky->kxy", np.conj(a[first]), b[second], optimize=True)
        total += correlation[:, None, None] * products
    return total / len(w.Z) ** 2


def response_of(
    w: Windowed, at: Averages, E: Complex[np.ndarray, "W k p"]
) -> Complex[np.ndarray, "k p m"]:
    """Return the response dH of errors, or of the outputs themselves, to the inputs; zero if inputs
    are dependent."""
    return np.swapaxes(at.P @ _cross(w.Z, E), 1, 2)


def noise_density(
    w: Windowed, at: Averages, E: Complex[np.ndarray, "W k p"]
) -> Complex[np.ndarray, "k p p"]:
    """Return the smoothed spectral matrix of the errors' part that no response explains."""
    p, power = E.shape[2], np.mean(np.abs(w.Y) ** 2, axis=(0, 1))
    floor = np.maximum(_ROUNDING * power, 1e-300)
    averages = max(w.averages - len(w.inputs), 0.5)
    least = _ENOUGH * p / (_LINES * averages)
    width = np.clip(least, 0.5 * _WIDEST, _WIDEST) * np.maximum(1.0, _PART * w.lines)
    kernel = np.exp(-0.5 * ((w.lines[:, None] - w.lines[None, :]) / width[:, None]) ** 2)
    kernel = kernel / np.sum(kernel, axis=1, keepdims=True)
    # The regression is on the instruments, because the response is unbounded without excitation.
    explained = _inverse_power(w) @ _cross(w.Z, E)
    left = E - np.einsum("wkm,kmp->wkp", w.Z, explained, optimize=True)
    own = np.sum(np.abs(left) ** 2, axis=0) / at.freedom[:, None]
    own = np.maximum(own, floor)
    # The mean over lines of a steep spectrum is too large. So it is taken of the spectrum over its
    # geometric mean (prewhitening: Blackman and Tukey, 1958).
    shape = np.exp(kernel @ np.log(own))
    size = np.sqrt(shape * (kernel @ (own / shape)))
    R = np.broadcast_to(np.eye(p), (len(own), p, p))
    if w.together:
        D = left / np.sqrt(shape)
        S = np.einsum("kl,wli,wlj->kij", kernel, D, np.conj(D), optimize=True)
        root = np.sqrt(np.maximum(np.real(np.einsum("kii->ki", S)), _ROUNDING))
        R = S / (root[:, :, None] * root[:, None, :])
    return _definite(R * size[:, :, None] * size[:, None, :], floor)


def _inverse_power(w: Windowed) -> Complex[np.ndarray, "k m m"]:
    """Return the inverse of the instruments' spectral matrix; zero if they are dependent."""
    S_zz = _cross(w.Z, w.Z)
    power = np.real(np.einsum("kaa->ka", S_zz))
    return np.nan_to_num(inverse(S_zz, power, power))


def _definite(S: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Return an invertible spectral matrix (k, p, p) with a diagonal of at least `floor` (p,)."""
    power = np.maximum(np.real(np.einsum("kii->ki", S)), floor)
    scale = np.sqrt(power)
    rho = S / (scale[:, :, None] * scale[:, None, :])
    # The matrix is singular with more outputs than averages, and with outputs computed from others.
    values, vectors = np.linalg.eigh(0.5 * (rho + np.conj(np.swapaxes(rho, 1, 2))))
    rho = np.einsum("kia,ka,kja->kij", vectors, np.maximum(values, _SMALLEST), np.conj(vectors))
    return rho * scale[:, :, None] * scale[:, None, :]


def covariance(at: Averages, S: Complex[np.ndarray, "k p p"]) -> Complex[np.ndarray, "k p m p m"]:
    """Return the covariance of the errors of all responses at each line."""
    return np.einsum("kxy,kij->kixjy", at.covariance, S)


def whitening(
    at: Averages, S: Complex[np.ndarray, "k p p"], used: Bool[np.ndarray, "k p m"]
) -> Complex[np.ndarray, "k r r"]:
    """Return factors that whiten the errors of the used responses at each line; the rows of the
    others are zero. r = p m."""
    k, p, m = used.shape
    taken = used.reshape(k, -1)
    C = covariance(at, S).reshape(k, p * m, p * m)
    size = np.sqrt(np.real(np.einsum("krr->kr", C)))
    # An unused response has variance 1 and no correlation.
    scale = np.where(taken & (size > 0), size, 1.0)
    both = taken[:, :, None] & taken[:, None, :]
    C = np.where(both, C / (scale[:, :, None] * scale[:, None, :]), 0.0)
    C = C + np.eye(p * m) * ~taken[:, None, :]
    return np.linalg.inv(np.linalg.cholesky(C)) / scale[:, None, :] * taken[:, :, None]


def partial_coherence(w: Windowed, at: Averages) -> Float[np.ndarray, "k p m"]:
    """Return the partial coherence of each output with each input; 0 if inputs are dependent."""
    H = response_of(w, at, w.Y)
    left = w.Y - np.einsum("wkm,kpm->wkp", w.U, H, optimize=True)
    density = np.mean(np.abs(left) ** 2, axis=0)
    spread = np.einsum("kxa,kab,kxb->kx", at.P, _cross(w.Z, w.Z), np.conj(at.P), optimize=True)
    error = density[:, :, None] * np.real(spread)[:, None, :]
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.abs(H) ** 2 / (np.abs(H) ** 2 + error))


def pairs_used(
    w: Windowed,
    options: ResponseOptions,
    coherence: Float[np.ndarray, "k p m"],
) -> Bool[np.ndarray, "k p m"]:
    """Return, by frequency, which responses are used."""
    used = np.zeros(coherence.shape, bool)
    omega = 2.0 * np.pi * w.hz
    everything = tuple(PairOptions(i, o) for i in w.inputs for o in w.outputs)
    for pair in options.pairs or everything:
        if pair.input not in w.inputs or pair.output not in w.outputs:
            continue
        at = (slice(None), w.outputs.index(pair.output), w.inputs.index(pair.input))
        low, high = pair.band or (0.0, np.inf)
        least = options.coherence if pair.coherence is None else pair.coherence
        # The mean over an octave is compared: a line that exceeds the limit by chance also has too
        # large a gain by chance.
        enough = octave_mean(omega, coherence[at]) >= least
        used[at] = enough & (w.hz >= low * (1 - 1e-9)) & (w.hz <= high * (1 + 1e-9))
    return used


# Fields are Any, because they are NumPy arrays, or JAX arrays once traced.


class ResponseWeights(NamedTuple):
    """Flights in windows, and the whitening of the errors of their responses."""

    windows: Windowed
    averages: Averages
    coherence: Any
    """Partial coherence (k, p, m)."""
    used: Any
    """True for responses that are used (k, p, m)."""
    density: Any
    """Spectral matrix of the noise, per Hz (k, p, p)."""
    whitening: Any
    """Whitening times the square root of `share` (k, r, r), r = p m."""
    share: Any
    """Share of an independent line (k,)."""

    @property
    def log_determinant(self) -> float:
        """Log-determinant of the weights of the used responses, lines weighted by their share."""
        r = np.arange(self.whitening.shape[1])
        diagonal = np.real(np.asarray(self.whitening)[:, r, r])
        taken = np.asarray(self.used).reshape(diagonal.shape)
        share = np.asarray(self.share)[:, None]
        logs = np.log(np.where(taken, diagonal / np.sqrt(share), 1.0))
        return float(np.sum(share * logs))

    @property
    def numbers(self) -> float:
        """Number of independent complex responses used."""
        return float(np.sum(np.asarray(self.share)[:, None, None] * np.asarray(self.used)))

    @property
    def numbers_of_noise(self) -> float:
        """Number of independent real values from which the noise's spectrum is estimated."""
        averages = max(self.windows.averages - len(self.windows.inputs), 1.0)
        seen = np.any(np.asarray(self.used), axis=2)
        return float(np.sum(2.0 * np.asarray(self.share)[:, None] * seen * averages))

    def variance(self) -> np.ndarray:
        """Variance of the complex error of each response (k, p, m)."""
        return np.real(np.einsum("kxx,kii->kix", self.averages.covariance, self.density))


def first_weights(problem: Problem, flights: Sequence[Flight]) -> ResponseWeights:
    """Return the weights of the measured signals.

    The noise is the outputs' part that no response explains.

    Raises:
        ValueError: windows, band or pairs do not fit the flights, or too few data remain.
    """
    options = problem.frequency
    w = windowed(flights, options, instruments_of(problem))
    at = averages(w)
    if len(w.inputs) > 1 and not at.sound.any():
        raise ValueError(
            f"frequency: {' and '.join(w.inputs)} move together, so that their responses cannot "
            "be separated; expected inputs that move independently, or one of them"
        )
    coherence = partial_coherence(w, at)
    used = pairs_used(w, options, coherence) & at.sound[:, None, None]
    _require_lines(problem, w, used)
    density = noise_density(w, at, w.Y)
    weights = weighed(ResponseWeights(w, at, coherence, used, density, None, None), density)
    _require_numbers(problem, weights)
    return weights


def weighed(weights: ResponseWeights, density: Complex[np.ndarray, "k p p"]) -> ResponseWeights:
    """Return the weights with another spectrum of the noise."""
    used = weights.used
    each = weights.averages.share[:, None, :]
    share = np.sum(each * used, axis=(1, 2)) / np.maximum(np.sum(used, axis=(1, 2)), 1)
    share = np.where(share > 0, share, 1.0)
    W = whitening(weights.averages, density, used) * np.sqrt(share)[:, None, None]
    return weights._replace(density=density, whitening=W, share=share)


def _require_lines(problem: Problem, w: Windowed, used: Bool[np.ndarray, "k p m"]) -> None:
    options, model = problem.frequency, problem.model
    for i, pair in enumerate(options.pairs):
        for role, record in (("input", model.Inputs), ("output", model.Outputs)):
            name, known = getattr(pair, role), naming.names(record)
            if name not in known:
                raise ValueError(
                    f"frequency.pairs[{i}].{role}: model {model.name} has no {role} "
                    f"{name!r}{nearest(name, known)}"
                )
        place = f"frequency.pairs[{i}] ({pair.input} to {pair.output})"
        if pair.input not in w.inputs:
            raise ValueError(f"{place}: {pair.input} does not move, expected an input that does")
        if pair.output not in w.outputs:
            why = w.left_out.get(pair.output, "it is not measured")
            raise ValueError(f"{place}: no response of {pair.output}; {why}")
        low, high = pair.band or (0.0, np.inf)
        if not np.any((w.hz >= low * (1 - 1e-9)) & (w.hz <= high * (1 + 1e-9))):
            raise ValueError(
                f"{place}: expected a band that holds a line of the window within {w.hz[0]:.3g} to "
                f"{w.hz[-1]:.3g} Hz, got {low:g} to {high:g} Hz"
            )
    if not used.any():
        raise ValueError(
            "frequency: no response is left, expected one with the coherence asked for "
            f"({options.coherence:g}) in the mean over an octave"
        )


def _require_numbers(problem: Problem, weights: ResponseWeights) -> None:
    nuisance = problem.nuisance
    unknowns = len(problem.free) + nuisance.time_shift
    unknowns += len(naming.names(problem.model.Inputs)) if nuisance.input_gain else 0
    numbers = 2.0 * weights.numbers
    if numbers <= unknowns:
        raise ValueError(
            f"frequency: expected more independent numbers than the {unknowns} unknowns, got "
            f"{numbers:.2g} of the responses; a wider band, a longer window or a lower coherence"
        )


def on_device(weights: ResponseWeights) -> ResponseWeights:
    """Return the weights as JAX arrays, copied once instead of with every call."""
    return jax.tree.map(lambda v: jax.device_put(v) if isinstance(v, np.ndarray) else v, weights)
