"""Covariance of output-error estimates when the residuals are autocorrelated.

The estimate minimises r'r with residuals whose covariance R is not the unit matrix, so that its
covariance is H^-1 (J' R J) H^-1 (Klein and Morelli, Aircraft System Identification, 2006, section
5.3; White, 1982), where H is half the Hessian of r'r: J'J and what the residuals themselves add
where the model is curved, which counts once they are as large as the response.

R comes from the residuals: autocovariances over the pairs of samples that are seen, under Parzen's
lag window with a length that the record chooses (Andrews, 1991), their spectrum held at zero or
above. Two effects of a short record are allowed for: the fit takes from the residuals what lies
along the sensitivities (HC2, MacKinnon and White, 1985), and few independent parts of a spectrum
tell a variance poorly (Student's t with their number, Satterthwaite).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from heli_jax.identification.estimation.evaluation import NULL, Evaluation, deviations
from heli_jax.identification.identifiability.equivalents import rows_at
from heli_jax.identification.unknowns.layout import Data, Layout, Solution

_LENGTH = 6.0
"""Parzen's window over tau^(4/5) n^(1/5), where tau is the sum of squared autocorrelations. The
smallest mean squared error has 3.5 here (Andrews, 1991, Table I); intervals suffer more from the
bias than from the variance and want a longer one (Sun, Phillips and Jin, 2008)."""
_LONGEST = 0.5
"""of the window, as a part of the record"""
_RESOLVED = 1e-3
"""singular value over the largest below which finite differences tell no curvature"""
_LARGEST_STEP = 0.1
"""of a coordinate, most of them logarithms, for differences of the slopes"""
_FLATTEST = 0.05
"""curvature over that of J'J that is believed at least"""


class Sandwich(NamedTuple):
    """The covariance of all unknowns z (q,) with autocorrelated residuals, in parts.

    All arrays are of unknowns that are scaled to columns of J of length one.
    """

    norms: Float[np.ndarray, " q"]
    """lengths of the columns of J"""
    white: Float[np.ndarray, "q q"]
    """inverse of J'J"""
    bread: Float[np.ndarray, "q q"]
    """inverse of the Hessian"""
    parts: tuple["_Part", ...]
    """by flight"""
    rest: Float[np.ndarray, "q q"]
    """J'J of the rows that are no measurements (priors), whose variance is known"""

    def inflation(self, along: np.ndarray | None = None) -> np.ndarray:
        """Return the sd of combinations `along` (k, q) of unknowns, or of every unknown, over that
        by white noise; (k,) or (q,)."""
        along = self._scaled(along)
        by_white = np.sum(along @ self.white * along, axis=1)
        variance, _ = self._variance(along)
        return np.sqrt(np.maximum(variance / np.where(by_white > 0, by_white, 1.0), 0.0))

    def quantile(self, along: np.ndarray | None = None) -> np.ndarray:
        """Return Student's 97.5 % quantile of each combination, as `inflation` has them."""
        _, freedom = self._variance(self._scaled(along))
        return scipy.special.stdtrit(np.maximum(freedom, 1.0), 0.975)

    def covariance(self) -> np.ndarray:
        """Return the covariance (q, q), with the variances that `inflation` has."""
        meat = self.rest + sum(p.meat for p in self.parts)
        whole = self.bread @ meat @ self.bread
        variance, _ = self._variance(np.eye(self.norms.size))
        plain = np.diag(whole)
        # The correlations stay.
        factor = np.sqrt(np.divide(variance, plain, out=np.zeros_like(plain), where=plain > 0))
        whole *= np.outer(factor, factor)
        np.fill_diagonal(whole, variance)
        return whole / np.outer(self.norms, self.norms)

    def _scaled(self, along: np.ndarray | None) -> np.ndarray:
        """Return the combinations (k, q) by unknowns of unit columns, their largest parts one."""
        if along is None:
            return np.eye(self.norms.size)
        along = along / self.norms
        return along / np.maximum(np.max(np.abs(along), axis=1, keepdims=True), 1e-300)

    def _variance(self, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance (k,) of combinations, and its degrees of freedom (Satterthwaite)."""
        D = self.bread @ along.T
        variance = np.sum(D * (self.rest @ D), axis=0)
        uncertainty = np.zeros_like(variance)
        for part in self.parts:
            of_flight, freedom = part.variance(D)
            variance = variance + of_flight
            uncertainty += of_flight**2 / freedom
        # Where priors alone speak the variance is known.
        known = uncertainty <= 1e-12 * variance**2
        return variance, np.where(known, 1e12, variance**2 / np.where(known, 1.0, uncertainty))


class _Part(NamedTuple):
    """Sensitivities and residuals of one flight as spectra over f frequencies."""

    J: Complex[np.ndarray, "f outputs q"]
    S: Complex[np.ndarray, "f outputs outputs"]
    """spectrum of the residuals"""
    meat: Float[np.ndarray, "q q"]
    """J' R J"""
    plain: Float[np.ndarray, "q q"]
    """J'J"""
    taken: Float[np.ndarray, "q q"]
    """what the fit takes from J' R J, were R one"""
    window: Float[np.ndarray, " 2*f-2"]
    """over all lags"""
    seen: Float[np.ndarray, " outputs"]
    """samples"""

    def variance(self, D: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance of D' J' r for the columns of D (q, k), with degrees of freedom."""
        W = self.J @ D
        by_output = np.real(W.conj() * (self.S @ W))
        power = np.sum(by_output, axis=1)
        # At lag zero the variance; its windowed square gives the number of independent parts.
        p = np.fft.irfft(power, self.window.size, axis=0)
        whole = np.where(p[0] > 0, p[0], 1.0)
        spent = np.sum(np.square(self.window[:, None] * (p / whole)), axis=0)
        # As many samples as those outputs have that the combination is known from.
        share = np.maximum(np.sum(by_output, axis=0), 0.0)
        seen = self.seen @ share / np.maximum(np.sum(share, axis=0), 1e-300)
        freedom = np.where(p[0] > 0, seen / np.where(spent > 0, spent, 1.0), 1.0)
        white = np.sum(D * (self.plain @ D), axis=0)
        taken = np.sum(D * (self.taken @ D), axis=0) / np.where(white > 0, white, 1.0)
        # HC2 divides by what the fit leaves, which may be next to nothing: a quarter at least.
        return np.maximum(p[0], 0.0) / (1.0 - np.clip(taken, 0.0, 0.75)), np.maximum(freedom, 1.0)


def sandwich(
    layout: Layout, data: Data, e: Evaluation, curvature: Float[np.ndarray, "q q"] | None = None
) -> Sandwich:
    """Return the covariance of the unknowns at an optimum of output error, with `curvature` of
    `residual_curvature`; outputs of a flight are correlated, flights are independent."""
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
    # Rows stand flight after flight, output after output; those of the priors come last.
    at, parts = 0, []
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        seen = ~np.isnan(np.stack([np.asarray(flight.outputs[n]) for n in outputs]))
        rows = slice(at, at + seen.size)
        parts.append(_part(J[rows].reshape(*seen.shape, -1), r[rows].reshape(seen.shape), seen, T))
        at = rows.stop
    return Sandwich(norms, white, bread, tuple(parts), J[at:].T @ J[at:])


def residual_curvature(at: Solution) -> Float[np.ndarray, "q q"]:
    """Return what the residuals add to J'J in the Hessian of r'r/2, (q, q): the sum of r_k r_k''.

    By central differences of J'r along the unknowns of interest; zero where it is not finite. Those
    of a model that is not linear reach two standard deviations to either side, across the kinks
    that a limit, a stop or a dead band makes.
    """
    least = float(np.finfo(np.asarray(at.z).dtype).eps) ** 0.25
    _, J = rows_at(at, at.z)
    q, k = J.shape[1], len(at.layout.of_interest)
    curvature = np.zeros((q, q))
    steps = np.full(k, least)
    if not at.layout.model.linear:
        sds = deviations(J)[:k]
        steps = np.where(np.isfinite(sds), 2.0 * sds, _LARGEST_STEP)
        steps = np.clip(steps, least, _LARGEST_STEP)
    with np.errstate(all="ignore"):  # an unstable simulation a step away: zero, as said above
        # Initial states and biases enter linearly, or so nearly that they are left at J'J.
        for i, step in enumerate(steps.tolist()):
            ends = []
            for end in (step, -step):
                near = rows_at(at, jnp.asarray(at.z).at[i].add(end))
                ends.append(near.J.T @ near.r)
            curvature[:, i] = (ends[0] - ends[1]) / (2.0 * step) - J.T @ J[:, i]
    # A Hessian is symmetric, its differences only nearly so.
    curvature[:k, :k] = 0.5 * (curvature[:k, :k] + curvature[:k, :k].T)
    curvature[:k, k:] = curvature[k:, :k].T
    return curvature if np.all(np.isfinite(curvature)) else np.zeros((q, q))


def _bread(
    T: Float[np.ndarray, "q k"], singular: Float[np.ndarray, " k"], curvature: np.ndarray
) -> Float[np.ndarray, "q q"]:
    """Return the inverse of J'J + curvature, where T'(J'J)T = 1."""
    # Along the flattest directions the differences are rounding.
    resolved = singular > _RESOLVED * singular[0]
    added = T.T @ curvature @ T
    added[~resolved] = 0.0
    added[:, ~resolved] = 0.0
    values, vectors = np.linalg.eigh(np.eye(singular.size) + added)
    V = T @ vectors
    # Residuals as large as the response can make the Hessian singular or indefinite.
    return V / np.maximum(values, _FLATTEST) @ V.T


def _part(J: np.ndarray, r: np.ndarray, seen: np.ndarray, T: np.ndarray) -> _Part:
    """Return what a flight adds by its sensitivities J (outputs, N, q), residuals r (outputs, N),
    zero where not seen, and T (q, k) that whitens J'J."""
    S, apart, window = _spectrum(r, seen)
    size, plain = window.size, np.tensordot(J, J, ((0, 1), (0, 1)))
    J = np.moveaxis(np.fft.rfft(J, size, axis=1), 0, 1)
    U = J @ T
    # U U' is the projection on the sensitivities: its autocovariance is what a fit to white noise
    # takes from that of the residuals.
    fitted = np.fft.irfft(U @ U.conj().swapaxes(1, 2), size, axis=0) * apart
    L = np.fft.rfft(fitted * window[:, None, None], axis=0)
    meat, taken = (_weighed(J, x, size) for x in (S, L))
    return _Part(J, S, meat, plain, taken, window, seen.sum(axis=1).astype(float))


def _spectrum(r: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the spectrum (f, outputs, outputs) of residuals (outputs, N), zero where not seen, one
    over the number of pairs (2 f - 2, outputs, outputs), and the lag window (2 f - 2,)."""
    k, n = r.shape
    # Twice the record at least: circular products then wrap onto zeros alone.
    size = 2 << (n - 1).bit_length()
    pairs, R = _pairs(seen, size), _pairs(r, size)
    apart = np.divide(1.0, pairs, where=pairs > 0.5, out=np.zeros_like(pairs))
    R *= apart
    window = _window(n, size, [_correlation_time(R[:, a, a], pairs[:, a, a], n) for a in range(k)])
    S = np.fft.rfft(R * window[:, None, None], axis=0)
    # With pairs counted, a spectrum may come out below zero somewhere.
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
    # One run at a time: the transforms are two to four times as long as what is kept of them.
    for run in noise:
        white = np.fft.rfft(rng.standard_normal((size, k)), axis=0)
        run[:] = np.fft.irfft((root @ white[..., None])[..., 0], size, axis=0)[:n]
    # Whatever was held at zero in the spectrum, the variance is that of the residuals.
    variance = np.fft.irfft(np.real(np.diagonal(S, axis1=1, axis2=2)), size, axis=0)[0]
    expected = np.sum(r**2, axis=1) / np.maximum(seen.sum(axis=1), 1)
    scale = np.sqrt(np.divide(expected, variance, out=np.zeros(k), where=variance > 0))
    return np.moveaxis(noise * scale, 1, 2)


def _weighed(J: np.ndarray, S: np.ndarray, size: int) -> np.ndarray:
    """Return the sum over samples i, k of J_i R(i - k) J_k' by spectra, (q, q)."""
    # Real signals: each frequency stands for its negative too, but for zero and Nyquist's.
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
    # A fifth of the record: beyond, autocorrelations have too few pairs that are independent.
    lags = np.arange(1, max(n // 5, 1) + 1)
    lags = lags[pairs[lags] > 0.5]
    if lags.size == 0 or not R[0] > 0:
        return 1.0
    # Lags at which no pair is seen count as those between which they lie.
    whole = 1.0 + 2.0 * (n // 5) * float(np.mean((R[lags] / R[0]) ** 2))
    # The noise of an autocorrelation has the variance 1 / n, which its square adds at each lag.
    return max(1.0, whole / (1.0 + 2.0 * (n // 5) / round(float(pairs[0]))))


def _window(n: int, size: int, times: list[float]) -> Float[np.ndarray, " size"]:
    """Return Parzen's lag window (size,) over all lags, as long as the correlation times [samples]
    ask."""
    # One for all outputs: with one each, the windowed spectra need not be a covariance.
    length = max(_LENGTH * time * (n / time) ** 0.2 for time in times)
    x = np.minimum(np.arange(size // 2 + 1) / min(max(length, 2.0), max(_LONGEST * n, 2.0)), 1.0)
    half = np.where(x < 0.5, 1.0 - 6.0 * x**2 * (1.0 - x), 2.0 * (1.0 - x) ** 3)
    return np.concatenate([half, half[-2:0:-1]])
