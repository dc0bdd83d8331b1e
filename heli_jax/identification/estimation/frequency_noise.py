"""Spectra of noise and gusts, estimated from residuals of a model."""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.identification.estimation.frequency_lines import Matrices, discretised
from heli_jax.identification.unknowns.layout import Data, Layout, unpack

# Spectra of records at their own frequencies, smoothed over frequency and records.
#
# Source: Brillinger, Time Series (1981), chapter 7; Pintelon and Schoukens (2012), chapter 10.


LEAST, PART = 6.0, 0.08
"""Least sd of the Gaussian that smooths the noise's spectrum, in lines and as a fraction of the
frequency. Narrower ones overfit the noise and make intervals too narrow."""
_ROUNDING = 1e-10
"""Least spectrum, as a fraction of the mean over all frequencies."""
_KNOTS = 4.0
"""Knots in one sd of the Gaussian; linear interpolation between them is accurate to 1 %."""


def smoothed(
    lines: Sequence[Complex[np.ndarray, "K p"]], part: float = PART, *, least: float = LEAST
) -> list[Complex[np.ndarray, "K p p"]]:
    """Return for each record the spectrum E e e^H (K, p, p) of all, smoothed over frequency.

    Args:
        lines: by record at its own frequencies; N samples give K = (N - 1) // 2.
        part: sd of the Gaussian as a fraction of the frequency.
        least: least sd in lines.
    """
    p, counts = lines[0].shape[1], Counter(len(v) for v in lines)
    # Records of equal length share spectrum and kernel, so their powers are added first.
    sums = {}
    for K in counts:
        power = summed_powers(np.stack([v for v in lines if len(v) == K]))
        # Products of real matrices are faster than those with complex ones.
        sums[K] = np.ascontiguousarray(power.reshape(K, -1), dtype=complex).view(float)
    spectra = {}
    for K in counts:
        kernels = {other: _kernel(K, other, part, least) for other in counts}
        total = sum(kernels[other] @ power for other, power in sums.items())
        weight = sum(n * np.sum(kernels[other], axis=1) for other, n in counts.items())
        S = _between_knots(total / np.asarray(weight)[:, None], K, part, least)
        S = S.view(complex).reshape(K, p, p)
        own = np.einsum("kii->ki", S)
        own += _ROUNDING * np.mean(np.real(own), axis=0)
        spectra[K] = S
    return [spectra[len(v)] for v in lines]


def once_a_length(make: Callable[..., Any], *records: Sequence[Any]) -> list[Any]:
    """Return an array by record, computed once for records of equal length."""
    made: dict[int, Any] = {}
    each = list(zip(*records, strict=True))
    for v in each:
        if len(v[0]) not in made:
            made[len(v[0])] = make(*v)
    return [made[len(v[0])] for v in each]


def summed_powers(v: Complex[np.ndarray, "f K p"]) -> Complex[np.ndarray, "K p p"]:
    """Return the sum of e e^H over records."""
    at_line = v.transpose(1, 2, 0)
    return at_line @ np.conj(at_line.transpose(0, 2, 1))


@functools.lru_cache(maxsize=32)
def _knots(K: int, part: float, least: float) -> np.ndarray:
    """Return the lines, counted from 0 to K - 1, at which a spectrum is computed."""
    knots = [0]
    while knots[-1] < K - 1:
        width = max(least, part * (knots[-1] + 1))
        knots.append(min(knots[-1] + max(1, int(width / _KNOTS)), K - 1))
    return np.array(knots if K > 1 else [0, 0])


def _between_knots(values: np.ndarray, K: int, part: float, least: float) -> np.ndarray:
    """Interpolate values at the knots (knots, ...) to all lines (K, ...)."""
    at = _knots(K, part, least)
    low = np.clip(np.searchsorted(at, np.arange(K), side="right") - 1, 0, len(at) - 2)
    share = (np.arange(K) - at[low]) / np.maximum(at[low + 1] - at[low], 1)
    share = share.reshape(-1, *(1 for _ in values.shape[1:]))
    return values[low] + share * np.diff(values, axis=0)[low]


@functools.lru_cache(maxsize=32)
def _kernel(K: int, other: int, part: float, least: float) -> Float[np.ndarray, "knots other"]:
    """Return the weights of a record of `other` lines at the knots of K lines."""
    # Frequencies are relative to the sampling rate, which all records share.
    f, first = (_knots(K, part, least) + 1) / (2 * K + 1), 1 / (2 * other + 1)
    g = first * np.arange(1, other + 1)
    width = np.maximum(least * first, part * f)
    return np.exp(-0.5 * ((f[:, None] - g[None, :]) / width[:, None]) ** 2)


def inverse_roots(S: Complex[np.ndarray, "K p p"]) -> Complex[np.ndarray, "K p p"]:
    """Return L^-1 with S = L L^H.

    Raises:
        numpy.linalg.LinAlgError: a matrix is not positive definite.
    """
    return np.linalg.inv(np.linalg.cholesky(S))


def log_determinants(W: Complex[np.ndarray, "K p p"]) -> Float[np.ndarray, " K"]:
    """Return log |det W| of triangular whitening matrices."""
    return np.sum(np.log(np.abs(np.diagonal(np.asarray(W), axis1=1, axis2=2))), axis=1)


# The noise's spectrum is that of gusts through the vehicle, times a mean over lines of the rest.
#
# Gusts pass through integrations and modes of the vehicle: the outputs are coherent, with a gain
# that changes from line to line. A mean over lines loses that coherence, which makes estimates
# inaccurate and intervals too narrow. So the spectrum is first modelled as
#
# $$S_0 = \sum_i h_i\, q_i\, h_i^H + R, \qquad [h_1 \ldots h_n] = C (zI - A_d)^{-1}$$
#
# with a gust at every state whose spectrum $q_i \ge 0$ falls with frequency, and white noise of
# each output in R. The errors, whitened by $S_0$, have a nearly flat spectrum, whose mean over
# lines corrects errors of this model.
#
# Weights by a spectrum from n averages of p outputs are too large by $n / (n - p)$, and the
# variance of the estimate grows by about the same factor: both are corrected.
#
# Sources: Blackman and Tukey (1958) for prewhitening; Sawada, Kameoka, Araki and Ueda (2013) for
# the multiplicative steps to the largest likelihood; Brillinger (1981), chapter 8, for estimated
# weights.


GUST_LEAST, GUST_PART = 12.0, 0.12
"""Least sd of the Gaussian that smooths the rest, in lines and as a fraction of the frequency."""
_CELLS = 0.16, 6.0
"""`part` and `least` of the spectral cells, see `_knots`. Up to the fiftieth line cells are
single lines, because slow modes are narrow; above they span 4 % of the frequency."""
_OCTAVES = 2
"""Octaves between the corners of the gusts' spectra."""
_STEPS = 24
"""Multiplicative steps towards the largest likelihood; the mean over lines corrects the rest."""
_NOTHING = 1e-9
"""Least noise, as a fraction of an output's power."""
_UNSEEN = 1e-20
"""Power of a state's effect, relative to the largest one, below which it is rounding."""


@eqx.filter_jit
def first_model(layout: Layout, data: Data, z: Float[Array, " q"]) -> Matrices:
    """Return the discretised model of the first flight."""
    return discretised(layout, data, unpack(layout, data, z), [0])[0]


def whitening_by(
    vehicle: Matrices, errors: Sequence[Complex[np.ndarray, "K p"]], samples: int | None = None
) -> tuple[Complex[np.ndarray, "K p p"], ...]:
    """Return the whitening of each record's errors; records of equal length share an array.

    Args:
        samples: N of every record, if its lines end below the Nyquist frequency.
    """
    counts, p = Counter(len(e) for e in errors), errors[0].shape[1]
    before = _prewhitening(vehicle, errors, list(counts), samples)
    left = smoothed(
        [np.einsum("kij,kj->ki", before[len(e)], e) for e in errors], GUST_PART, least=GUST_LEAST
    )

    def whitening(S: np.ndarray) -> np.ndarray:
        # Number of independent lines in the smoothed spectrum, (sum w)^2 / sum w^2.
        kernels = [(n, _kernel(len(S), K, GUST_PART, GUST_LEAST)) for K, n in counts.items()]
        total, squares = (sum(n * np.sum(w**k, axis=1) for n, w in kernels) for k in (1, 2))
        n = _between_knots(total**2 / np.asarray(squares), len(S), GUST_PART, GUST_LEAST)
        n = np.maximum(n, p + 1.0)
        return ((n - p) / n)[:, None, None] * (inverse_roots(S) @ before[len(S)])

    return tuple(once_a_length(whitening, left))


def _prewhitening(
    vehicle: Matrices,
    errors: Sequence[Complex[np.ndarray, "K p"]],
    lengths: list[int],
    samples: int | None,
) -> dict[int, Complex[np.ndarray, "K p p"]]:
    """Return S0^(-1/2) by length of the record; the identity if the gust model fails."""
    Ad, C = np.asarray(vehicle.Ad, float), np.asarray(vehicle.C, float)
    cells = []
    for K in lengths:
        of_length = np.stack([e for e in errors if len(e) == K])
        at = _knots(K, *_CELLS)
        edges = np.concatenate([[0], (at[1:] + at[:-1] + 1) // 2])
        count = np.diff(np.append(edges, K)).astype(float)
        power = np.add.reduceat(summed_powers(of_length), edges, axis=0)
        lines = count * len(of_length)
        cells.append(((at + 1) / (samples or 2 * K + 1), power / lines[:, None, None], lines))
    f, power, lines = (np.concatenate(v) for v in zip(*cells, strict=True))
    with np.errstate(all="ignore"):
        h = C @ np.linalg.inv(np.exp(2j * np.pi * f)[:, None, None] * np.eye(len(Ad)) - Ad)
        h = np.swapaxes(h, 1, 2)
        S0 = gust_spectrum(h[:, :, :, None] * np.conj(h[:, :, None, :]), f, power, lines)
    if S0 is None:
        return {
            K: np.broadcast_to(np.eye(len(C), dtype=complex), (K, *power.shape[1:]))
            for K in lengths
        }
    roots = np.split(inverse_roots(S0), np.cumsum([len(v[0]) for v in cells])[:-1])
    return {K: _between_knots(root, K, *_CELLS) for K, root in zip(lengths, roots, strict=True)}


def gust_spectrum(
    ways: Complex[np.ndarray, "c n p p"],
    f: Float[np.ndarray, " c"],
    power: Complex[np.ndarray, "c p p"],
    lines: Float[np.ndarray, " c"],
) -> Complex[np.ndarray, "c p p"] | None:
    """Return the most likely spectrum S0 for complex normal errors, or None.

    Args:
        ways: by cell and state, the outputs' spectrum for a gust of power 1 at the state.
        f: frequencies of the cells, in cycles per sample.
        power: mean of e e^H over the lines of a cell.
        lines: number of lines in each cell.
    """
    size = np.sqrt(np.average(np.real(np.einsum("cii->ci", power)), axis=0, weights=lines))
    # The response at the frequency of an undamped mode is infinite.
    fine = np.flatnonzero(np.isfinite(ways).all((1, 2, 3)))
    if not (fine.size and np.isfinite(size).all() and (size > 0).all()):
        return None
    scale = size[:, None] * size[None, :]
    corners = 0.5 * 0.5 ** np.arange(1.0, np.log2(0.5 / np.min(f)), _OCTAVES)
    # A gust's spectrum is a sum of white noise and first-order lags.
    shapes = [np.ones((1, fine.size)), 1.0 / (1.0 + (f[fine] / corners[:, None]) ** 2)]
    shapes, ways = np.concatenate(shapes), ways[fine] / scale
    # The effect of a state that does not reach the outputs is a rounding error. It would look like
    # a huge gust, and the spectrum would depend on the parameters' last digit.
    effects = np.max(np.real(np.einsum("cnii->cni", ways)), axis=(0, 2))
    ways = np.where((effects > _UNSEEN * np.max(effects))[:, None, None], ways, 0.0)
    q, r = _powers_of_gusts(ways, shapes, power[fine] / scale, lines[fine])
    S = (np.einsum("cn,cnij->cij", (q @ shapes).T, ways) + np.diag(r)) * scale
    if not np.isfinite(S).all():
        return None
    return S[np.clip(np.searchsorted(fine, np.arange(len(f))), 0, fine.size - 1)]


def _powers_of_gusts(
    ways: Complex[np.ndarray, "c n p p"],
    shapes: Float[np.ndarray, "b1 c"],
    power: Complex[np.ndarray, "c p p"],
    lines: Float[np.ndarray, " c"],
) -> tuple[Float[np.ndarray, "n b1"], Float[np.ndarray, " p"]]:
    """Return the powers of gusts, by state and shape, and of the outputs' own white noise."""
    own, gains = (np.real(np.einsum("...ii->...i", v)) for v in (power, ways))
    gains = np.swapaxes(gains, 1, 2)
    # Start from the largest power that every output allows for a state.
    room = np.median(np.min(own[:, :, None] / np.maximum(gains, 1e-300), axis=1), axis=0)
    room = np.where(np.max(gains, axis=(0, 1)) > 0, room, 0.0)
    c, n, p, _ = ways.shape
    # An output's own noise affects only that output and is white: the first shape.
    powers = np.zeros((len(shapes), n + p))
    powers[:, :n], least = room / len(shapes), np.zeros_like(powers)
    powers[0, n:], least[0, n:] = np.maximum(0.3 * np.median(own, axis=0), _NOTHING), _NOTHING
    alone = np.eye(p)[:, :, None] * np.eye(p)[:, None, :]
    ways = np.concatenate([ways, np.broadcast_to(alone, (c, p, p, p))], axis=1)
    # Matrices become rows of real numbers, so that sums over effects are products of real matrices.
    ways = np.ascontiguousarray(ways.reshape(c, n + p, -1), complex).view(float)
    by_way, matrices = np.swapaxes(ways, 1, 2).copy(), np.empty((c, 2, p, p), complex)
    by_shape = shapes * lines
    # With a quarter of these steps a false gust peak remained at the flybar's mode, and the
    # interval of If was a third wider.
    for _ in range(_STEPS):
        S = ((shapes.T @ powers)[:, None, :] @ ways).view(complex).reshape(c, p, p)
        matrices[:, 1] = np.linalg.inv(S)
        matrices[:, 0] = matrices[:, 1] @ power @ matrices[:, 1]
        # Power in the errors and expected power, by shape and effect. The square root that
        # guarantees an increase in each step is omitted, which halves the number of steps.
        told = (matrices.view(float).reshape(c, 2, -1) @ by_way).reshape(c, -1)
        shown, due = np.moveaxis((by_shape @ told).reshape(-1, 2, n + p), 1, 0)
        powers = np.maximum(powers * (shown / np.where(due > 0, due, 1.0)), least)
    return powers[:, :n].T, powers[0, n:]
