"""Spectra of records at their own frequencies, smoothed over frequency and over records.

Source: Brillinger, Time Series (1981), chapter 7; Pintelon and Schoukens (2012), chapter 10.
"""

import functools
from collections.abc import Iterable, Sequence

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
    # Records of one length have one spectrum and one kernel: their powers are added first.
    powers: dict[int, np.ndarray] = {}
    p = lines[0].shape[1]
    # The half that lies below the diagonal: a spectrum is Hermitian.
    below = np.tril_indices(p)
    for v in lines:
        product = v[:, below[0]] * np.conj(v[:, below[1]])
        powers[len(v)] = powers[len(v)] + product if len(v) in powers else product
    counts = {K: sum(len(v) == K for v in lines) for K in powers}
    spectra = {}
    for K in powers:
        _, between = knots_of(K, part, least)
        total, weight = 0.0, 0.0
        for other, power in powers.items():
            kernel = _kernel(K, other, part, least)
            # Of a session in single precision too: the view below is of double numbers.
            flat = np.ascontiguousarray(power, dtype=complex)
            total = total + (kernel @ flat.view(float)).view(complex)
            weight = weight + counts[other] * kernel.sum(axis=1)
        at_knots, (low, share) = total / np.asarray(weight)[:, None], between
        half = at_knots[low] + share[:, None] * (at_knots[low + 1] - at_knots[low])
        S = np.empty((K, p, p), complex)
        S[:, below[1], below[0]], S[:, below[0], below[1]] = np.conj(half), half
        floor = _ROUNDING * np.mean(np.real(np.einsum("kii->ki", S)), axis=0)
        spectra[K] = S + np.diag(floor)[None]
    return [spectra[len(v)] for v in lines]


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
def _kernel(K: int, other: int, part: float, least: float) -> Float[np.ndarray, "knots other"]:
    """Weights that the lines of a record of `other` lines have at the knots of one of K."""
    # In parts of the rate, which all records have in common.
    f, first = (knots_of(K, part, least)[0] + 1) / (2 * K + 1), 1 / (2 * other + 1)
    g = first * np.arange(1, other + 1)
    width = np.maximum(least * first, part * f)
    return np.exp(-0.5 * ((f[:, None] - g[None, :]) / width[:, None]) ** 2)


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
    kernels = [(n, _kernel(K, other, part, least)) for other, n in counts]
    total = sum(n * w.sum(axis=1) for n, w in kernels)
    squares = sum(n * np.sum(w**2, axis=1) for n, w in kernels)
    return np.interp(np.arange(K), at, total**2 / squares)


def without_shared(S: Complex[np.ndarray, "K p p"]) -> Complex[np.ndarray, "K p p"]:
    """Spectra without what signals share."""
    return S * np.eye(S.shape[1])


def whitening_of(
    spectra: Iterable[Complex[np.ndarray, "K p p"]],
) -> tuple[Complex[np.ndarray, "K p p"], ...]:
    """By record L^-1, where S = L L^H: L^-1 e is white."""
    # Records of one length share their spectrum.
    spectra = tuple(spectra)
    made = {id(S): S for S in spectra}
    made = {key: inverse_roots(S) for key, S in made.items()}
    return tuple(made[id(S)] for S in spectra)


def inverses(S: Complex[np.ndarray, "K p p"]) -> Complex[np.ndarray, "K p p"]:
    """S^-1."""
    # Of one output thousands of numbers, not of matrices.
    return 1.0 / S if S.shape[1] == 1 else np.linalg.inv(S)


def inverse_roots(S: Complex[np.ndarray, "K p p"]) -> Complex[np.ndarray, "K p p"]:
    """L^-1, where S = L L^H.

    Raises:
        numpy.linalg.LinAlgError: one is not positive definite.
    """
    if S.shape[1] > 1:
        return np.linalg.inv(np.linalg.cholesky(S))
    if not (np.real(S) > 0).all():
        raise np.linalg.LinAlgError("a spectrum is not positive")
    return S**-0.5


def log_determinants(W: Complex[np.ndarray, "K p p"]) -> Float[np.ndarray, " K"]:
    """log |det W| of what makes noise white: products of triangles, whose diagonals say it.

    Args:
        W: lower triangular.
    """
    return np.sum(np.log(np.abs(np.diagonal(W, axis1=1, axis2=2))), axis=1)
