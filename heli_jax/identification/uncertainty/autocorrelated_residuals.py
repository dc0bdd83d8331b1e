"""Covariance of output-error estimates when the residuals are autocorrelated.

The estimate minimises r'r with residuals of a covariance R that is not the unit matrix. Its own
covariance is H^-1 (J' R J) H^-1 (Klein and Morelli, Aircraft System Identification, 2006, section
5.3; White, 1982). H is half the Hessian of r'r: J'J plus the curvature of the residuals.

R is estimated by the residuals' autocovariances under Parzen's lag window, whose length depends on
the record (Andrews, 1991). Two corrections are for short records: the fit removes from the
residuals what lies along the sensitivities (HC2, MacKinnon and White, 1985), and a variance of few
independent parts of a spectrum needs Student's t (Satterthwaite).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import NULL, Evaluation, deviations
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.unknowns.layout import Data, Layout, Solution

_LENGTH = 6.0
"""length of Parzen's window over tau^(4/5) n^(1/5), where tau is the sum of squared
autocorrelations. The smallest mean squared error has 3.5 (Andrews, 1991, Table I); coverage of
intervals needs more (Sun, Phillips and Jin, 2008)."""
_LONGEST = 0.5
"""of the window, as a part of the record"""
_RESOLVED = 1e-3
"""singular value over the largest below which the curvature is rounding"""
_LARGEST_STEP = 0.1
"""of a coordinate, for differences of the slopes"""
_FLATTEST = 0.05
"""smallest curvature over that of J'J"""


class Sandwich(NamedTuple):
    """Covariance of all unknowns z (q,) with autocorrelated residuals."""

    covariance: Float[np.ndarray, "q q"]
    inflation: Float[np.ndarray, " q"]
    """sd of each unknown over that by white noise"""
    quantile: Float[np.ndarray, " q"]
    """Student's 97.5 % quantile"""


def sandwich(
    layout: Layout, data: Data, e: Evaluation, curvature: Float[np.ndarray, "q q"] | None = None
) -> Sandwich:
    """Return the covariance of the unknowns at an optimum of output error.

    Outputs of a flight are correlated, flights are independent.

    Args:
        curvature: of `residual_curvature`.
    """
    J, r = np.asarray(e.J, np.float64), np.asarray(e.r, np.float64)
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    J = J / norms
    _, singular, right = np.linalg.svd(np.linalg.qr(J, mode="r"), full_matrices=False)
    kept = singular > NULL * max(singular[0], 1e-300)
    T = right[kept].T / singular[kept]
    bread = white = T @ T.T
    if curvature is not None:
        bread = _bread(T, singular[kept], curvature / np.outer(norms, norms))
    # Rows stand flight after flight, output after output; those of the priors come last and have
    # known variances.
    first, parts = 0, []
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        seen = ~np.isnan(np.stack([np.asarray(flight.outputs[n]) for n in outputs]))
        rows = slice(first, first + seen.size)
        of_flight = J[rows].reshape(*seen.shape, -1), r[rows].reshape(seen.shape)
        parts.append(_part(*of_flight, seen, T, bread))
        first = rows.stop
    whole = bread @ (J[first:].T @ J[first:] + sum(p.meat for p in parts)) @ bread
    plain = np.diag(whole)
    variance = plain + sum(p.variance - np.diag(bread @ p.meat @ bread) for p in parts)
    # A variance by priors alone is known.
    positive = np.where(variance > 0, variance, 1.0)
    freedom = 1.0 / np.maximum(sum((p.variance / positive) ** 2 / p.freedom for p in parts), 1e-12)
    # The corrected variances, with the correlations of the sandwich.
    factor = np.sqrt(np.divide(variance, plain, out=np.zeros_like(plain), where=plain > 0))
    by_white = np.where(np.diag(white) > 0, np.diag(white), 1.0)
    return Sandwich(
        whole * np.outer(factor / norms, factor / norms),
        np.sqrt(np.maximum(variance / by_white, 0.0)),
        scipy.special.stdtrit(np.maximum(freedom, 1.0), 0.975),
    )


class _Part(NamedTuple):
    """Contribution of one flight."""

    meat: Float[np.ndarray, "q q"]
    """J' R J"""
    variance: Float[np.ndarray, " q"]
    """of the unknowns"""
    freedom: Float[np.ndarray, " q"]
    """degrees of freedom of that variance (Satterthwaite)"""


def _part(
    J: np.ndarray, r: np.ndarray, seen: np.ndarray, T: np.ndarray, bread: np.ndarray
) -> _Part:
    """Return the contribution of sensitivities J (outputs, N, q) and residuals r (outputs, N), zero
    where not seen; T (q, k) whitens J'J."""
    S, apart, window = _spectrum(r, seen)
    size, plain = window.size, np.tensordot(J, J, ((0, 1), (0, 1)))
    J = np.moveaxis(np.fft.rfft(J, size, axis=1), 0, 1)
    # HC2: U U' projects on the sensitivities; its autocovariance is the part of that of white
    # residuals which the fit takes up. At least a quarter is left.
    U = J @ T
    fitted = np.fft.irfft(U @ U.conj().swapaxes(1, 2), size, axis=0) * apart
    L = np.fft.rfft(fitted * window[:, None, None], axis=0)
    meat, taken = (_weighed(J, x, size) for x in (S, L))
    taken, white = (np.diag(bread @ M @ bread) for M in (taken, plain))
    left = 1.0 - np.clip(taken / np.where(white > 0, white, 1.0), 0.0, 0.75)
    # The windowed autocorrelation of each unknown's terms gives its independent parts.
    W = J @ bread
    p = np.fft.irfft(np.sum(np.real(W.conj() * (S @ W)), axis=1), size, axis=0)
    spent = np.sum(np.square(window[:, None] * (p / np.where(p[0] > 0, p[0], 1.0))), axis=0)
    freedom = np.mean(seen.sum(axis=1)) / np.where(spent > 0, spent, 1.0)
    variance = np.maximum(p[0], 0.0) / left
    return _Part(meat, variance, np.maximum(freedom, 1.0))


def residual_curvature(at: Solution, J: Float[np.ndarray, "n q"]) -> Float[np.ndarray, "q q"]:
    """Return the sum of r_k r_k'', which the Hessian of r'r/2 has beside J'J, (q, q).

    By central differences of J'r along the unknowns of interest; zero if it is not finite. For a
    nonlinear model they reach two standard deviations to either side, across the kinks of limits
    and dead bands.
    """
    least = float(np.finfo(np.asarray(at.z).dtype).eps) ** 0.25
    q, k = J.shape[1], len(at.layout.of_interest)
    curvature = np.zeros((q, q))
    steps = np.full(k, least)
    if not at.layout.model.linear:
        sds = deviations(J)[:k]
        steps = np.where(np.isfinite(sds), 2.0 * sds, _LARGEST_STEP)
        steps = np.clip(steps, least, _LARGEST_STEP)
    with np.errstate(all="ignore"):  # the simulation may be unstable a step away
        # Initial states and biases enter nearly linearly.
        for i, step in enumerate(steps.tolist()):
            ends = []
            for end in (step, -step):
                near = residual_and_jacobian(*at[:3], jnp.asarray(at.z).at[i].add(end))
                ends.append(np.asarray(near.J).T @ np.asarray(near.r))
            curvature[:, i] = (ends[0] - ends[1]) / (2.0 * step) - J.T @ J[:, i]
    # The differences are symmetric up to rounding.
    curvature[:k, :k] = 0.5 * (curvature[:k, :k] + curvature[:k, :k].T)
    curvature[:k, k:] = curvature[k:, :k].T
    return curvature if np.all(np.isfinite(curvature)) else np.zeros((q, q))


def _bread(
    T: Float[np.ndarray, "q k"], singular: Float[np.ndarray, " k"], curvature: np.ndarray
) -> Float[np.ndarray, "q q"]:
    """Return the inverse of J'J + curvature, where T'(J'J)T = 1."""
    resolved = singular > _RESOLVED * singular[0]
    added = T.T @ curvature @ T
    added[~resolved] = 0.0
    added[:, ~resolved] = 0.0
    values, vectors = np.linalg.eigh(np.eye(singular.size) + added)
    V = T @ vectors
    # With residuals as large as the response the Hessian may be singular or indefinite.
    return V / np.maximum(values, _FLATTEST) @ V.T


def _spectrum(r: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the spectrum (f, outputs, outputs) of residuals (outputs, N), zero where not seen, one
    over the number of pairs (2 f - 2, outputs, outputs), and the lag window (2 f - 2,)."""
    k, n = r.shape
    # Twice the record, so that circular products do not wrap.
    size = 2 << (n - 1).bit_length()
    pairs, R = _pairs(seen, size), _pairs(r, size)
    apart = np.divide(1.0, pairs, where=pairs > 0.5, out=np.zeros_like(pairs))
    R *= apart
    window = _window(n, size, [_correlation_time(R[:, a, a], pairs[:, a, a], n) for a in range(k)])
    S = np.fft.rfft(R * window[:, None, None], axis=0)
    # With missing samples the spectrum may be negative.
    values, vectors = np.linalg.eigh(0.5 * (S + S.conj().swapaxes(1, 2)))
    S = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.conj().swapaxes(1, 2)
    return S, apart, window


def drawn(residual: np.ndarray, runs: int, rng: np.random.Generator) -> np.ndarray:
    """Draw Gaussian noise (runs, outputs, N) with the variances and correlations, over time and
    between outputs, of residuals (outputs, N) that are NaN where nothing is measured.

    By circulant embedding (Dietrich and Newsam, 1997).
    """
    seen = ~np.isnan(residual)
    r = np.where(seen, residual, 0.0)
    S, _, window = _spectrum(r, seen)
    k, n, size = *r.shape, window.size
    values, vectors = np.linalg.eigh(S)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    noise = np.empty((runs, n, k))
    # One run at a time, for memory.
    for run in noise:
        white = np.fft.rfft(rng.standard_normal((size, k)), axis=0)
        run[:] = np.fft.irfft((root @ white[..., None])[..., 0], size, axis=0)[:n]
    # The variance is that of the residuals.
    variance = np.fft.irfft(np.real(np.diagonal(S, axis1=1, axis2=2)), size, axis=0)[0]
    expected = np.sum(r**2, axis=1) / np.maximum(seen.sum(axis=1), 1)
    scale = np.sqrt(np.divide(expected, variance, out=np.zeros(k), where=variance > 0))
    return np.moveaxis(noise * scale, 1, 2)


def _weighed(J: np.ndarray, S: np.ndarray, size: int) -> np.ndarray:
    """Return the sum over samples i, k of J_i R(i - k) J_k' by spectra, (q, q)."""
    # One-sided spectra: all but zero and Nyquist's frequency count twice.
    twice = np.full(S.shape[0], 2.0 / size)
    twice[[0, -1]] = 1.0 / size
    left = (J * twice[:, None, None]).reshape(-1, J.shape[2])
    total = np.real(left.conj().T @ (S @ J).reshape(-1, J.shape[2]))
    return 0.5 * (total + total.T)  # symmetric but for rounding


def _pairs(x: np.ndarray, size: int) -> np.ndarray:
    """Return the sums (size, outputs, outputs) over k of x_a[k + lag] x_b[k] for x (outputs, N)."""
    spectra = np.fft.rfft(x.astype(np.float64), size, axis=1).T
    return np.fft.irfft(spectra[:, :, None] * spectra[:, None, :].conj(), size, axis=0)


def _correlation_time(R: np.ndarray, pairs: np.ndarray, n: int) -> float:
    """Return the sum of squared autocorrelations over all lags, in samples; 1 for white noise."""
    # Lags up to a fifth of the record.
    lags = np.arange(1, max(n // 5, 1) + 1)
    lags = lags[pairs[lags] > 0.5]
    if lags.size == 0 or not R[0] > 0:
        return 1.0
    # Lags without pairs count as the mean.
    whole = 1.0 + 2.0 * (n // 5) * float(np.mean((R[lags] / R[0]) ** 2))
    # Less the variance 1 / n of an autocorrelation at each lag.
    return max(1.0, whole / (1.0 + 2.0 * (n // 5) / round(float(pairs[0]))))


def _window(n: int, size: int, times: list[float]) -> Float[np.ndarray, " size"]:
    """Return Parzen's lag window (size,) over all lags for correlation times [samples]."""
    # One for all outputs, so that the windowed spectra are a covariance.
    length = max(_LENGTH * time * (n / time) ** 0.2 for time in times)
    x = np.minimum(np.arange(size // 2 + 1) / min(max(length, 2.0), max(_LONGEST * n, 2.0)), 1.0)
    half = np.where(x < 0.5, 1.0 - 6.0 * x**2 * (1.0 - x), 2.0 * (1.0 - x) ** 3)
    return np.concatenate([half, half[-2:0:-1]])
