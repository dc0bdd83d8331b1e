"""Spectra of records at their own frequencies, smoothed over frequency and over records.

Source: Brillinger, Time Series (1981), chapter 7; Pintelon and Schoukens (2012), chapter 10.
"""

import functools
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Complex, Float

LEAST, PART = 6.0, 0.08
"""sd of the Gaussian that smooths the noise's spectrum over frequency: lines at least, and as a
part of the frequency. Narrower ones follow the noise itself: intervals are then too narrow"""
AVERAGES = 2.0 * np.pi**0.5 * LEAST
"""independent lines of one record in a smoothed spectrum, at least: (sum w)^2 / sum w^2"""
_ROUNDING = 1e-10
"""of the mean over all frequencies, below which a spectrum is not taken to fall"""
_KNOTS = 4.0
"""in one sd of the Gaussian: between two of them a smoothed spectrum is a straight line to a
hundredth"""


def smoothed(
    lines: Sequence[Complex[np.ndarray, "K p"]], part: float = PART, *, least: float = LEAST
) -> list[Complex[np.ndarray, "K p p"]]:
    """By record the spectrum E e e^H (K, p, p) of all records, smoothed over frequency.

    Args:
        lines: by record at its own frequencies, those of N samples K = (N - 1) // 2.
        part: sd of the Gaussian as a part of the frequency.
        least: the same in lines, at least.
    """
    p = lines[0].shape[1]
    # The half that lies below the diagonal: a spectrum is Hermitian.
    below = _below(p)

    def half(v: np.ndarray) -> np.ndarray:
        # Of a session in single precision too: the view is of double numbers.
        power = np.ascontiguousarray(summed_powers(v)[:, below[0], below[1]], dtype=complex)
        return power.view(float)

    spectra = {}
    for K, of_half in _over_lines(lines, half, part, least).items():
        made, S = of_half.view(complex), np.empty((K, p, p), complex)
        S[:, below[1], below[0]], S[:, below[0], below[1]] = np.conj(made), made
        own = np.einsum("kii->ki", S)
        own += _ROUNDING * np.mean(np.real(own), axis=0)
        spectra[K] = S
    return [spectra[len(v)] for v in lines]


def smoothed_with(
    lines: Sequence[Complex[np.ndarray, "K p"]],
    others: Sequence[Complex[np.ndarray, "K r"]],
    part: float = PART,
) -> list[Complex[np.ndarray, "K p r"]]:
    """By record the cross-spectrum E e r^H with other signals, smoothed likewise.

    Args:
        lines: by record at its own frequencies.
        others: the other signals, likewise.
        part: sd of the Gaussian as a part of the frequency.
    """
    p, r = lines[0].shape[1], others[0].shape[1]

    def products(v: np.ndarray) -> np.ndarray:
        made = v[:, :, :p].transpose(1, 2, 0) @ np.conj(v[:, :, p:].transpose(1, 0, 2))
        return np.ascontiguousarray(made.reshape(len(made), -1), dtype=complex).view(float)

    both = [np.concatenate(v, axis=1) for v in zip(lines, others, strict=True)]
    made = _over_lines(both, products, part, LEAST)
    spectra = {K: v.view(complex).reshape(K, p, r) for K, v in made.items()}
    return [spectra[len(v)] for v in lines]


@functools.cache
def _below(p: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tril_indices(p)


def summed_powers(v: Complex[np.ndarray, "f K p"]) -> Complex[np.ndarray, "K p p"]:
    """The sum of e e^H over records.

    Args:
        v: at the lines of records of one length.
    """
    at_line = v.transpose(1, 2, 0)
    return at_line @ np.conj(at_line.transpose(0, 2, 1))


def _over_lines(
    lines: Sequence[Complex[np.ndarray, "K p"]],
    numbers: Callable[[Complex[np.ndarray, "f K p"]], Float[np.ndarray, "K m"]],
    part: float,
    least: float,
) -> dict[int, Float[np.ndarray, "K m"]]:
    """By length of the record the mean of some powers, smoothed over frequency.

    Args:
        lines: by record.
        numbers: of records of one length the sum of these powers.
        part: as that of `smoothed`.
        least: likewise.
    """
    # Records of one length have one spectrum and one kernel: their powers are added first.
    of_length = {len(v): [w for w in lines if len(w) == len(v)] for v in lines}
    sums = {K: numbers(np.stack(v)) for K, v in of_length.items()}
    made = {}
    for K in sums:
        _, (low, share) = knots_of(K, part, least)
        total, weight = 0.0, 0.0
        for other, power in sums.items():
            kernel, of_one = _kernel(K, other, part, least)
            total = total + kernel @ power
            weight = weight + len(of_length[other]) * of_one
        at_knots = total / np.asarray(weight)[:, None]
        made[K] = at_knots[low] + share[:, None] * np.diff(at_knots, axis=0)[low]
    return made


def whitening_alone(
    lines: Sequence[Complex[np.ndarray, "K p"]],
) -> tuple[Complex[np.ndarray, "K p p"], ...]:
    """By record what makes white each signal by itself, with nothing of what they share.

    Args:
        lines: by record at its own frequencies.

    Raises:
        numpy.linalg.LinAlgError: a signal is zero throughout.
    """

    def own(v: np.ndarray) -> np.ndarray:
        return np.sum(np.real(v) ** 2 + np.imag(v) ** 2, axis=0)

    made = {}
    # Flights held out may have other outputs.
    for p in {v.shape[1] for v in lines}:
        alike = [v for v in lines if v.shape[1] == p]
        for K, power in _over_lines(alike, own, PART, LEAST).items():
            root = _positive(power + _ROUNDING * np.mean(power, axis=0)) ** -0.5
            made[K, p] = root[:, :, None] * np.eye(p, dtype=complex)
    return tuple(made[v.shape] for v in lines)


@functools.lru_cache(maxsize=32)
def knots_of(
    K: int, part: float = PART, least: float = LEAST
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Lines (from 0) at which a spectrum of K lines is computed, and of each line the knot below
    and how far it is on the way to the next.

    Args:
        K: lines.
        part: sd of the Gaussian as a part of the frequency.
        least: the same in lines, at least.
    """
    knots = [0]
    while knots[-1] < K - 1:
        width = max(least, part * (knots[-1] + 1))
        knots.append(min(knots[-1] + max(1, int(width / _KNOTS)), K - 1))
    at = np.array(knots if K > 1 else [0, 0])
    low = np.clip(np.searchsorted(at, np.arange(K), side="right") - 1, 0, len(at) - 2)
    share = (np.arange(K) - at[low]) / np.maximum(at[low + 1] - at[low], 1)
    return at, (low, share)


@functools.lru_cache(maxsize=32)
def _kernel(
    K: int, other: int, part: float, least: float
) -> tuple[Float[np.ndarray, "knots other"], Float[np.ndarray, " knots"]]:
    """Weights that the lines of a record of `other` lines have at the knots of one of K, and their
    sums."""
    # In parts of the rate, which all records have in common.
    f, first = (knots_of(K, part, least)[0] + 1) / (2 * K + 1), 1 / (2 * other + 1)
    g = first * np.arange(1, other + 1)
    width = np.maximum(least * first, part * f)
    kernel = np.exp(-0.5 * ((f[:, None] - g[None, :]) / width[:, None]) ** 2)
    return kernel, kernel.sum(axis=1)


@functools.lru_cache(maxsize=32)
def averages(
    K: int, counts: tuple[tuple[int, int], ...], part: float = PART, least: float = LEAST
) -> Float[np.ndarray, " K"]:
    """Independent lines in a smoothed spectrum of K lines: (sum w)^2 / sum w^2.

    Args:
        K: lines of the record.
        counts: lines of a record and how many there are of them, for each length.
        part: sd of the Gaussian as a part of the frequency.
        least: the same in lines, at least.
    """
    at, _ = knots_of(K, part, least)
    kernels = [(n, *_kernel(K, other, part, least)) for other, n in counts]
    total = sum(n * of_one for n, _, of_one in kernels)
    squares = sum(n * np.sum(w**2, axis=1) for n, w, _ in kernels)
    return np.interp(np.arange(K), at, total**2 / squares)


def whitening_of(
    spectra: Iterable[Complex[np.ndarray, "K p p"]],
) -> tuple[Complex[np.ndarray, "K p p"], ...]:
    """By record L^-1, where S = L L^H: L^-1 e is white."""
    # Records of one length share their spectrum.
    spectra = tuple(spectra)
    made = {id(S): S for S in spectra}
    made = {key: inverse_roots(S) for key, S in made.items()}
    return tuple(made[id(S)] for S in spectra)


def inverse_roots(S: Complex[np.ndarray, "K p p"]) -> Complex[np.ndarray, "K p p"]:
    """L^-1, where S = L L^H.

    Raises:
        numpy.linalg.LinAlgError: one is not positive definite.
    """
    # Written out over the lines: for each matrix a routine would be called that takes longer to
    # call.
    p, at = S.shape[1], np.ascontiguousarray(S.transpose(1, 2, 0))
    L, W = np.zeros_like(at), np.zeros_like(at)
    for i in range(p):
        left = np.real(at[i, i])
        for j in range(i):
            inner = sum((L[i, m] * np.conj(L[j, m]) for m in range(j)), start=0.0)
            L[i, j] = np.real(W[j, j]) * (at[i, j] - inner)
            left = left - np.real(L[i, j]) ** 2 - np.imag(L[i, j]) ** 2
        W[i, i] = root = _positive(left) ** -0.5
        for j in range(i):
            W[i, j] = -root * sum((L[i, m] * W[m, j] for m in range(j, i)), start=0.0)
    return np.ascontiguousarray(W.transpose(2, 0, 1))


def _positive(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    if not (values > 0).all():
        raise np.linalg.LinAlgError("a spectrum is not positive definite")
    return values


def log_determinants(W: Complex[np.ndarray, "K p p"]) -> Float[np.ndarray, " K"]:
    """log |det W| of what makes noise white: products of triangles, whose diagonals say it.

    Args:
        W: lower triangular.
    """
    return np.sum(np.log(np.abs(np.diagonal(W, axis1=1, axis2=2))), axis=1)
