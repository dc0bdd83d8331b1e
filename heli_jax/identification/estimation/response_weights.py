"""Weights of the fit of frequency responses: covariance and whitening of the responses' errors.

With Z, U, E the transforms of instruments, inputs and errors in each window, the response that is
left in the errors is dH = S_zu^-1 S_ze. Given the inputs, its covariance between outputs i and j is

    P_i V_ij P_j^H S_ij,    P = S_zu^-1,

with S the noise's spectral matrix and V_ij the sum of conj(Z) Z over windows that both outputs
have, overlapping ones by their correlation: exact for a chirp too, whose power at one frequency is
in one window.

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
"""sd of the Gaussian that smooths the noise's spectrum over frequency, in lines of the window: half
of it where averages are many enough"""
_PART = 0.04
"""the same as a part of the frequency, of each line"""
_ENOUGH = 30.0
"""independent averages for each output that a spectral matrix is taken from. A wider mean takes a
mode of gusts for a wide one: with twice the width errors were by 20 % larger"""
_LINES = 2.0 * np.pi**0.5 / (STEPS / PER_AVERAGE)
"""independent lines in a Gaussian of one line, of Hann windows"""
_NEIGHBOURS = 3
"""lines to either side with which a line is correlated in Hann windows"""
_ROUNDING = 1e-14
"""of a signal's density, below which noise is not taken to fall"""
_SMALLEST = 1e-9
"""eigenvalue of the noise's matrix of coherences: outputs that were computed from one another have
none of their own"""


class Averages(NamedTuple):
    """The errors of responses as the inputs alone determine them; p outputs, m inputs, k lines."""

    P: np.ndarray
    """(p, k, m, m) inverses of the cross-spectra from instruments to inputs, of the windows that
    each output has; NaN where inputs move as one"""
    V: np.ndarray
    """(p, p, k, m, m) covariance of the cross-spectra over the density of the noise"""
    share: np.ndarray
    """(p, k, m) of each error how much of an independent one it is: errors at neighbouring lines
    are correlated, and responses are smooth"""
    freedom: np.ndarray
    """(k, p) squares of white noise of density 1 that no response explains, summed over windows"""


def averages(w: Windowed) -> Averages:
    """The spectra of flights in windows."""
    turns = np.outer(w.lines, np.arange(w.length)) / w.length
    g = hann(w.length) * np.exp(-2j * np.pi * turns)
    g = g - np.mean(g, axis=1, keepdims=True)
    near = [_correlations(g, d, w.step) for d in range(min(_NEIGHBOURS + 1, len(g)))]
    # Most outputs miss samples in the same windows, or nowhere: each case once.
    cases, case = np.unique(w.seen, axis=1, return_inverse=True)
    masks, case = cases.T, case.reshape(-1)
    V = np.array([[_spread(w, a, b, near[0]) for b in masks] for a in masks])
    P, share, freedom = [], [], []
    # White noise at the first line has a density below 1: the mean takes a part of it.
    power = np.real(near[0][0])
    for i, seen in enumerate(masks):
        S = _cross(seen, w.Z, w.U)
        z, u = (np.real(np.einsum("kaa->ka", _cross(seen, v, v))) for v in (w.Z, w.U))
        P.append(inverse(S, z, u))
        share.append(_share(w, seen, np.nan_to_num(P[-1]), near))
        taken = np.real(np.einsum("kab,kba->k", _inverse_power(w, seen), V[i, i]))
        freedom.append(np.maximum(np.sum(seen) * (power - taken), 0.5))
    return Averages(
        np.stack(P)[case],
        V[case][:, case],
        np.stack(share)[case],
        np.stack(freedom, axis=1)[:, case],
    )


def _cross(seen: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(k, m, m) mean over the windows seen of conj(a) b."""
    return np.einsum("w,wkx,wky->kxy", seen, np.conj(a), b, optimize=True) / np.sum(seen)


def _correlations(g: np.ndarray, d: int, step: int) -> dict[int, np.ndarray]:
    """Correlation of the transform of white noise at each line in a window with that at the d-th
    line after it in another window, (k - d,), by how many steps that one begins later.

    Args:
        g: windows times the turning of each line (k, samples), less their means.
    """
    a, b = g[: len(g) - d], np.conj(g[d:])
    size, found = np.sum(hann(g.shape[1]) ** 2), {}
    for j in range(1 - STEPS, STEPS):
        first, second = max(j, 0) * step, max(-j, 0) * step
        shared = g.shape[1] - abs(j) * step
        products = a[:, first : first + shared] * b[:, second : second + shared]
        found[j] = np.sum(products, axis=1) / size
    return found


def _spread(
    w: Windowed, first: np.ndarray, second: np.ndarray, c: dict[int, np.ndarray]
) -> np.ndarray:
    """(k - d, m, m) covariance of two means of conj(Z) E of white noise E of density 1, the second
    at the d-th line after the first."""
    k = len(c[0])
    a = first[:, None, None] * w.Z[:, :k]
    b = second[:, None, None] * w.Z[:, len(w.numbers) - k :]
    total = np.zeros((k, *a.shape[2:], b.shape[2]), complex)
    for j, correlation in c.items():
        later = w.later(abs(j))
        here, there = slice(max(-j, 0), len(a) - max(j, 0)), slice(max(j, 0), len(a) - max(-j, 0))
        x, y = a[here][later], b[there][later]
        products = np.einsum("wkx,wky->kxy", np.conj(x), y, optimize=True)
        total += correlation[:, None, None] * products
    return total / (np.sum(first) * np.sum(second))


def _share(
    w: Windowed, seen: np.ndarray, P: np.ndarray, near: list[dict[int, np.ndarray]]
) -> np.ndarray:
    """(k, m) one over the sum of an error's correlations with those at the lines around it."""
    size, total = np.ones(P.shape[:2]), np.ones(P.shape[:2])
    for d, c in enumerate(near):
        k = len(c[0])
        V = _spread(w, seen, seen, c)
        C = np.real(np.einsum("kxa,kab,kxb->kx", P[:k], V, np.conj(P[d:]), optimize=True))
        if d == 0:
            size = np.sqrt(np.maximum(C, 1e-300))
            continue
        # Where they alternate nothing is gained: no response moves that fast.
        rho = np.maximum(C / (size[:k] * size[d:]), 0.0)
        total[:k] += rho
        total[d:] += rho
    return 1.0 / total


def response_of(
    w: Windowed, at: Averages, E: Complex[np.ndarray, "W k p"]
) -> Complex[np.ndarray, "k p m"]:
    """The response dH from the inputs that errors have; NaN where inputs move as one.

    Args:
        E: errors, or the outputs themselves; zero in windows that an output does not have.
    """
    S = np.einsum("wkz,wkp->kpz", np.conj(w.Z), E, optimize=True)
    S = S / np.sum(w.seen, axis=0)[None, :, None]
    return np.einsum("pkmz,kpz->kpm", at.P, S)


def noise_density(
    w: Windowed, at: Averages, E: Complex[np.ndarray, "W k p"]
) -> Complex[np.ndarray, "k p p"]:
    """Return the spectral matrix of the part of errors that no response explains, smoothed over
    frequency.

    Args:
        E: errors (W, k, p); zero in windows that an output does not have.
    """
    p, power = E.shape[2], np.mean(np.abs(w.Y) ** 2, axis=(0, 1))
    floor = np.maximum(_ROUNDING * power, 1e-300)
    averages = np.maximum(w.averages - len(w.inputs), 0.5)
    least = _ENOUGH * len(w.outputs) / (_LINES * float(np.min(averages)))
    width = np.clip(least, 0.5 * _WIDEST, _WIDEST) * np.maximum(1.0, _PART * w.lines)
    kernel = np.exp(-0.5 * ((w.lines[:, None] - w.lines[None, :]) / width[:, None]) ** 2)
    kernel = kernel / np.sum(kernel, axis=1, keepdims=True)
    own = np.sum(np.abs(_unexplained(w, E, w.seen)) ** 2, axis=0) / at.freedom
    own = np.maximum(own, floor)
    # The mean over lines of a steep spectrum is too large: it is taken of the spectrum over its
    # geometric mean (Blackman and Tukey, 1958, prewhitening).
    shape = np.exp(kernel @ np.log(own))
    size = np.sqrt(shape * (kernel @ (own / shape)))
    R = np.broadcast_to(np.eye(p), (len(own), p, p))
    if w.together:
        # Coherences are taken from windows that all outputs have: those of pairs would contradict
        # one another, and the matrix would not be positive definite.
        D = _unexplained(w, E, np.repeat(w.common[:, None], p, axis=1)) / np.sqrt(shape)
        S = np.einsum("kl,wli,wlj->kij", kernel, D, np.conj(D), optimize=True)
        root = np.sqrt(np.maximum(np.real(np.einsum("kii->ki", S)), _ROUNDING))
        R = S / (root[:, :, None] * root[:, None, :])
    return _definite(R * size[:, :, None] * size[:, None, :], floor)


def _unexplained(
    w: Windowed, E: Complex[np.ndarray, "W k p"], seen: Float[np.ndarray, "W p"]
) -> Complex[np.ndarray, "W k p"]:
    """Return the part of errors that no response to the instruments explains, in the windows
    seen."""
    # By regression on the instruments and not by the response: that one is unbounded where the
    # excitation has no power.
    P = np.stack([_inverse_power(w, mask) for mask in seen.T])
    S_ze = np.einsum("wp,wkz,wkp->kpz", seen, np.conj(w.Z), E, optimize=True)
    part = np.einsum("pkmz,kpz->kpm", P, S_ze / np.sum(seen, axis=0)[None, :, None])
    return (E - np.einsum("wkm,kpm->wkp", w.Z, part, optimize=True)) * seen[:, None, :]


def _inverse_power(w: Windowed, seen: Float[np.ndarray, " W"]) -> Complex[np.ndarray, "k m m"]:
    """Return the inverse of the instruments' spectral matrix; zero where they move as one."""
    S_zz = _cross(seen, w.Z, w.Z)
    power = np.real(np.einsum("kaa->ka", S_zz))
    return np.nan_to_num(inverse(S_zz, power, power))


def _definite(S: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """A spectral matrix (k, p, p) that has an inverse; `floor` (p,) of its diagonal."""
    power = np.maximum(np.real(np.einsum("kii->ki", S)), floor)
    scale = np.sqrt(power)
    rho = S / (scale[:, :, None] * scale[:, None, :])
    # Of more outputs than averages, or of some that were computed from others, none is left.
    values, vectors = np.linalg.eigh(0.5 * (rho + np.conj(np.swapaxes(rho, 1, 2))))
    rho = np.einsum("kia,ka,kja->kij", vectors, np.maximum(values, _SMALLEST), np.conj(vectors))
    return rho * scale[:, :, None] * scale[:, None, :]


def covariance(at: Averages, S: Complex[np.ndarray, "k p p"]) -> Complex[np.ndarray, "k p m p m"]:
    """Covariance of the errors of all responses at one frequency."""
    P = np.nan_to_num(at.P)
    return np.einsum("ikxa,ijkab,jkyb,kij->kixjy", P, at.V, np.conj(P), S, optimize=True)


def whitening(
    at: Averages, S: Complex[np.ndarray, "k p p"], used: Bool[np.ndarray, "k p m"]
) -> Complex[np.ndarray, "k r r"]:
    """Factors that make rows of variance 1 of the errors of the responses that are used,
    independent of one another at a line; the rows of the others are zero. r = p m."""
    k, p, m = used.shape
    taken = used.reshape(k, -1)
    C = covariance(at, S).reshape(k, p * m, p * m)
    size = np.sqrt(np.real(np.einsum("krr->kr", C)))
    # A response that is not used is one of variance 1 that goes with no other.
    scale = np.where(taken & (size > 0), size, 1.0)
    both = taken[:, :, None] & taken[:, None, :]
    C = np.where(both, C / (scale[:, :, None] * scale[:, None, :]), 0.0)
    C = C + np.eye(p * m) * ~taken[:, None, :]
    return np.linalg.inv(np.linalg.cholesky(C)) / scale[:, None, :] * taken[:, :, None]


def partial_coherence(w: Windowed, at: Averages) -> Float[np.ndarray, "k p m"]:
    """Partial coherence of each output with each input; 0 where inputs move as one."""
    H = response_of(w, at, w.Y)
    left = (w.Y - np.einsum("wkm,kpm->wkp", w.U, np.nan_to_num(H))) * w.seen[:, None, :]
    density = np.sum(np.abs(left) ** 2, axis=0) / np.sum(w.seen, axis=0)
    spread = [
        np.einsum("kxa,kab,kxb->kx", P, _cross(w.seen[:, j], w.Z, w.Z), np.conj(P), optimize=True)
        for j, P in enumerate(at.P)
    ]
    error = density[:, :, None] * np.real(np.stack(spread, axis=1))
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.abs(H) ** 2 / (np.abs(H) ** 2 + error))


def pairs_used(
    w: Windowed,
    options: ResponseOptions,
    coherence: Float[np.ndarray, "k p m"],
    sound: Bool[np.ndarray, "k p m"],
) -> Bool[np.ndarray, "k p m"]:
    """The responses that take part, by frequency."""
    used = np.zeros(sound.shape, bool)
    omega = 2.0 * np.pi * w.hz
    everything = tuple(PairOptions(i, o) for i in w.inputs for o in w.outputs)
    for pair in options.pairs or everything:
        if pair.input not in w.inputs or pair.output not in w.outputs:
            continue
        at = (slice(None), w.outputs.index(pair.output), w.inputs.index(pair.input))
        low, high = pair.band or (0.0, np.inf)
        least = options.coherence if pair.coherence is None else pair.coherence
        # The mean over an octave: a single frequency that reaches a limit by chance has too large
        # a gain by the same chance.
        enough = octave_mean(omega, coherence[at]) >= least
        used[at] = sound[at] & enough & (w.hz >= low * (1 - 1e-9)) & (w.hz <= high * (1 + 1e-9))
    return used


# Numbers of these classes are arrays, NumPy's or JAX's once they are traced: Any or Array.


class ResponseWeights(NamedTuple):
    """Flights in windows, and the whitening of the errors of their responses."""

    windows: Windowed
    averages: Averages
    """with zeros in place of what is not determined"""
    coherence: Any
    """(k, p, m) partial"""
    used: Any
    """(k, p, m) which take part: asked for, and coherent enough"""
    density: Any
    """(k, p, p) the noise's spectral matrix, per Hz"""
    whitening: Any
    """(k, r, r), r = p m: rows whose squares count for as much as a line is independent"""
    share: Any
    """(k,) of each line how much of an independent one it is"""

    @property
    def log_determinant(self) -> float:
        """Weights of the responses that take part, lines by their share."""
        r = np.arange(self.whitening.shape[1])
        diagonal = np.real(np.asarray(self.whitening)[:, r, r])
        taken = np.asarray(self.used).reshape(diagonal.shape)
        share = np.asarray(self.share)[:, None]
        logs = np.log(np.where(taken, diagonal / np.sqrt(share), 1.0))
        return float(np.sum(share * logs))

    @property
    def numbers(self) -> float:
        """Independent complex ones that take part."""
        return float(np.sum(np.asarray(self.share)[:, None, None] * np.asarray(self.used)))

    @property
    def numbers_of_noise(self) -> float:
        """Independent real ones that the noise's spectrum is taken from."""
        averages = np.maximum(self.windows.averages - len(self.windows.inputs), 1.0)
        seen = np.any(np.asarray(self.used), axis=2)
        return float(np.sum(2.0 * np.asarray(self.share)[:, None] * seen * averages))

    def variance(self) -> np.ndarray:
        """(k, p, m) of the complex error of each response"""
        C = covariance(self.averages, self.density)
        return np.real(np.einsum("kixix->kix", C))


def first_weights(problem: Problem, flights: Sequence[Flight]) -> ResponseWeights:
    """The spectra of the measured signals alone: the noise is what no response explains of the
    outputs.

    Raises:
        ValueError: windows, band or pairs do not fit the flights, or too little is left.
    """
    options = problem.frequency
    w = windowed(flights, options, instruments_of(problem))
    at = averages(w)
    sound = np.isfinite(response_of(w, at, w.Y))
    if len(w.inputs) > 1 and not sound.any():
        raise ValueError(
            f"frequency: {' and '.join(w.inputs)} move as one, so that no response tells what each "
            "of them does; expected inputs that move apart, or one of them"
        )
    coherence = partial_coherence(w, at)
    at = at._replace(P=np.nan_to_num(at.P))
    used = pairs_used(w, options, coherence, sound)
    _require_lines(problem, w, used)
    density = noise_density(w, at, w.Y)
    weights = weighed(ResponseWeights(w, at, coherence, used, density, None, None), density)
    _require_numbers(problem, weights)
    return weights


def weighed(weights: ResponseWeights, density: Complex[np.ndarray, "k p p"]) -> ResponseWeights:
    """The same with another spectrum of the noise."""
    used = weights.used
    each = np.moveaxis(weights.averages.share, 0, 1)
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
    """The same, what a trace needs of it as JAX's arrays: copied once, not with every call."""
    return jax.tree.map(lambda v: jax.device_put(v) if isinstance(v, np.ndarray) else v, weights)


def back(weights: ResponseWeights) -> ResponseWeights:
    """The same in NumPy."""
    return jax.tree.map(lambda v: np.asarray(v) if isinstance(v, jax.Array) else v, weights)
