"""Agreement of a simulated signal with a measured one, and whiteness of the residual."""

from typing import NamedTuple, cast

import numpy as np
import scipy.fft
import scipy.special

from heli_jax.flights.flight import Flight
from heli_jax.flights.resample import PASSED


class Metrics(NamedTuple):
    """Agreement of one output; NaN where a signal never moves."""

    vaf: float
    """variance accounted for, 1 - var(residual)/var(measured)"""
    nrmse_fit_percent: float
    """100 (1 - |residual| / |measured - mean|)"""
    rmse: float
    """in the output's SI unit"""
    tic: float
    """Theil inequality coefficient, 0 (equal) to 1"""
    bias: float
    """part of the mean squared error that a wrong mean makes (Theil's bias proportion)"""
    variance: float
    """part that a wrong size of the motion makes (his variance proportion)"""
    covariance: float
    """the rest: what does not move together; the three make 1"""


BAND99 = 2.5758293035489004
"""half width of the 99 % band of a white residual's correlation, times sqrt(N): the 99.5 % point of
the normal distribution"""

_HUGE = 1e100
_MOSTLY_MISSING = 0.4
"""part of the samples that are measured, below which a signal counts as a slower one"""

NO_METRICS = Metrics(*[float("nan")] * 7)


FAR = 1e4
"""error over variance of the signal, above which a simulation in gusts diverges"""


def diverges(m: Metrics, times: float = 10.0) -> bool:
    """True if a simulation is not finite, or its error has several times the signal's variance."""
    return not np.isfinite(m.rmse) or m.vaf < 1.0 - times


@np.errstate(over="ignore", invalid="ignore")
def metrics(measured: np.ndarray, simulated: np.ndarray) -> Metrics:
    """Agreement of two signals (N,) where something is measured (not NaN)."""
    seen = ~np.isnan(measured)
    measured, simulated = measured[seen], simulated[seen]
    residual = measured - simulated
    motion = np.linalg.norm(measured - measured.mean())
    # The rounding of a constant is no motion.
    motion = motion if motion > 1e-9 * np.linalg.norm(measured) else 0.0
    rms = np.sqrt(np.mean(measured**2)) + np.sqrt(np.mean(simulated**2))
    mse = float(np.mean(residual**2))
    rmse = mse**0.5
    # Theil's decomposition: the mean squared error is the sum of the squared difference of the
    # means, that of the standard deviations, and 2 (1 - r) times their product.
    bias = (measured.mean() - simulated.mean()) ** 2 / mse if mse > 0 else float("nan")
    variance = (measured.std() - simulated.std()) ** 2 / mse if mse > 0 else float("nan")
    return Metrics(
        vaf=float(1.0 - np.var(residual) / np.var(measured)) if motion > 0 else float("nan"),
        nrmse_fit_percent=(
            float(100.0 * (1.0 - np.linalg.norm(residual) / motion)) if motion > 0 else float("nan")
        ),
        rmse=rmse,
        tic=float(rmse / rms) if rms > 0 else float("nan"),
        bias=float(bias),
        variance=float(variance),
        covariance=float(1.0 - bias - variance),
    )


class Whiteness(NamedTuple):
    """Whiteness of residuals over all their lags."""

    white: bool
    p_value: float
    """of the Ljung-Box test over `lags` lags, for all signals that are tested together"""
    lags: int
    outside: float
    """share of the lags outside the 99 % band"""
    lag1: float
    """autocorrelation at one sample, or at the shortest lag of which enough pairs are seen"""


def _padded(n: int, lags: int) -> int:
    """Return the size of a transform of n samples without wrap-around up to so many lags."""
    return cast(int, scipy.fft.next_fast_len(n + lags, real=True))


def autocorrelation(residual: np.ndarray, lags: int) -> np.ndarray:
    """Autocorrelation (lags + 1,) from lag 0, by the biased estimate; NaN counts as the mean."""
    r = _centred(residual)
    n = r.size
    size = _padded(n, lags)
    spectrum = np.abs(np.fft.rfft(r, size)) ** 2
    # Divided by n, not by the pairs at each lag: only so is the sequence positive semi-definite.
    c = np.fft.irfft(spectrum, size)[: lags + 1] / n
    return c / c[0] if c[0] > 0 else np.concatenate([[1.0], np.zeros(lags)])


def cross_correlation(u: np.ndarray, residual: np.ndarray, lags: int) -> np.ndarray:
    """Correlation (2 lags + 1,) of u(t - lag) with the residual, lags from -lags to lags.

    Args:
        u: one signal (N,), any unit; NaN counts as its mean.
        residual: the other (N,), as the first.
    """
    a, b = _centred(u), _centred(residual)
    n = a.size
    size = _padded(n, lags)
    # Gaps are at the mean and divided by n all the same: they draw the correlation towards zero.
    c = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size) / n
    # The inverse transform keeps negative lags at its end.
    both = np.concatenate([c[-lags:], c[: lags + 1]])
    scale = a.std() * b.std()
    return both / scale if scale > 0 else np.zeros(2 * lags + 1)


@np.errstate(over="ignore", invalid="ignore")  # of a simulation that diverges
def _centred(signal: np.ndarray) -> np.ndarray:
    # A missing sample at the mean adds nothing to any sum of products.
    centred = np.where(np.isnan(signal), 0.0, signal - np.nanmean(signal))
    # Correlations have no size; of a simulation that diverges the squares would overflow.
    size = np.max(np.abs(centred), initial=0.0)
    return centred / size if _HUGE < size < np.inf else centred


def sequence(signal: np.ndarray) -> np.ndarray:
    """Return a signal (N,), or its measured samples in a row where most are missing.

    The samples of a slow sensor on a fast grid have no lag with many pairs: lags are then counted
    in its own samples.
    """
    return signal[kept(signal)]


def kept(signal: np.ndarray) -> np.ndarray:
    """True (N,) for the samples that `sequence` keeps."""
    seen = ~np.isnan(signal)
    return seen if seen.mean() < _MOSTLY_MISSING else np.ones_like(seen)


def lags_for(n: int) -> int:
    """Number of lags for a record of n samples: a quarter of it, at most 500."""
    # Beyond a quarter an autocorrelation is the mean of too few products (Box and Jenkins).
    return max(1, min(n // 4, 500))


def whiteness(
    residual: np.ndarray, together: int = 1, fitted: np.ndarray | None = None
) -> Whiteness:
    """The Ljung-Box test at 1 % on residuals (N,); NaN where nothing is measured.

    Args:
        residual: (N,), any unit.
        together: number of signals that are tested side by side, for the p value.
        fitted: (N, k) of `seen_autocorrelation`.
    """
    fitted = None if fitted is None else fitted[kept(residual)]
    residual = sequence(residual)
    n = int(np.count_nonzero(~np.isnan(residual)))
    _, r, pairs, whole = seen_autocorrelation(residual, fitted)
    lags = r.size
    # Of the squared autocorrelation at a lag white noise expects one over the pairs seen there.
    q = (n + 2) / max(n, 1) * np.cumsum(r**2 * pairs)
    # A short autocorrelation is significant at few lags, and not at many: both are tested.
    short = min(lags, 20)
    p_all, p_short = (_chance(q[k - 1], k, n) for k in (lags, short))
    # Two tests of each signal (Sidak, 1967).
    p = -np.expm1(2 * together * np.log1p(-min(p_all, p_short, 1.0 - 1e-12)))
    outside = float(np.mean(np.abs(r) * whole > band99(pairs, whole)))
    return Whiteness(bool(p > 0.01), float(p), lags, outside, float(r[0] * whole[0]))


_SPREAD = 2.2
"""times lags over samples, part by which the variance of Ljung and Box's statistic is above twice
the lags (4000 records of white noise each of 200 to 4000 samples)"""


def _chance(statistic: float, lags: int, samples: int) -> float:
    """Probability that white noise exceeds Ljung and Box's statistic.

    Its mean is the number of lags; its variance is above that of chi-squared where these are a
    large part of the samples. A scaled chi-squared has both.
    """
    wide = 1.0 + _SPREAD * lags / max(samples, 1)
    return float(scipy.special.chdtrc(lags / wide, statistic / wide))


def band99(pairs: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Band that holds 99 % of white noise's autocorrelations (lags,), as `seen_autocorrelation`
    counts them times the part of the record that a lag leaves."""
    return BAND99 * np.sqrt(whole / pairs)


def seen_autocorrelation(
    residual: np.ndarray, fitted: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lags in samples, autocorrelation over the pairs of samples that are seen, the number of
    these, and the part of the record that a lag leaves, each (lags,), at the shortest lags at which
    enough are seen; at all of them where nothing is missing.

    Args:
        residual: (N,), NaN where nothing is measured.
        fitted: (N, k) rows of the orthonormal directions along which all unknowns moved the
            signals. Least squares leaves nothing along them: white noise of variance s^2 ends with
            the covariance s^2 (1 - U U'), whose autocovariance is taken off. Without it many free
            initial states make the residuals of a right model look coloured.
    """
    seen = ~np.isnan(residual)
    r = _centred(residual)
    n, count = r.size, int(seen.sum())
    at = np.arange(1, max(n // 4, 1) + 1)
    size = _padded(n, int(at[-1]))

    def products(x: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)

    # How many pairs are seen at each lag is the autocorrelation of the mask, whole numbers but for
    # the rounding of the transform.
    all_seen = n - np.arange(at[-1] + 1.0)
    pairs, c = all_seen if count == n else np.round(products(seen.astype(float))), products(r)
    if fitted is not None:
        taken = sum((products(u) for u in fitted.T), np.zeros_like(c))
        c = c + c[0] / max(count - taken[0], 1.0) * taken
    # With every second sample missing no pair is an odd lag apart; a lag of few pairs is noise that
    # the division by them would blow up.
    at = at[pairs[at] >= min(0.1 * count, 0.75 * n)][: lags_for(count)]
    if at.size == 0 or not c[0] > 0:
        return np.ones(1, int), np.zeros(1), np.ones(1), np.ones(1)
    return at, c[at] / c[0] * count / pairs[at], pairs[at], 1.0 - at / n


# Whiteness of what was low-passed on its way to a lower rate.
#
# Where a flight has fewer samples a second than its log, a low-pass has taken away what the new
# rate cannot hold, and with it the last fifth of its band: white noise of a sensor comes out with
# an autocorrelation of +0.13 at one sample, which a long record tells from none. That is no
# disturbance and no dynamics that a model lacks. Below that fifth the spectrum is as it was:
# sampled as fast as this band needs and no faster, what is white there is white.


_FEWER = 0.9
"""times the flight's sample time, below which the log's is that of a faster clock"""
_SEEN = 0.95
"""part of the samples that a spectrum needs"""


def is_decimated(flight: Flight, output: str) -> bool:
    """True if an output was logged at a higher rate than the flight has."""
    facts = None if flight.source is None else flight.source.facts.get((output, "output"))
    return facts is not None and facts.usual < _FEWER * flight.dt


def whiteness_in_band(innovations: np.ndarray, together: int) -> Whiteness:
    """As `whiteness`, of the band that the low-pass of a lower rate passes, where all of it is not.

    Args:
        innovations: (N,) over their standard deviations, NaN where nothing is measured.
    """
    found, seen = whiteness(innovations, together), np.isfinite(innovations)
    if found.white or np.mean(seen) < _SEEN:
        return found
    spectrum = np.fft.rfft(np.where(seen, innovations, 0.0))
    kept = int(PASSED * innovations.size)
    other = whiteness(np.fft.irfft(spectrum[: kept + 1], 2 * kept), together)
    return other if other.white else found
