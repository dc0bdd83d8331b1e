"""Measured and simulated signals, their agreement, and the whiteness of residuals."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import scipy.fft
import scipy.special

from heli_jax.flights.flight import Flight, labels
from heli_jax.flights.resample import PASSED
from heli_jax.identification.estimation.evaluation import Evaluation, directions
from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.numerics.white_noise import robust_sd


class Metrics(NamedTuple):
    """Agreement of one output; NaN if a signal never moves."""

    vaf: float
    """Variance accounted for, 1 - var(residual)/var(measured)."""
    nrmse_fit_percent: float
    """100 (1 - |residual| / |measured - mean|)."""
    rmse: float
    """Rms error in the output's SI unit."""
    tic: float
    """Theil inequality coefficient, 0 (equal) to 1."""
    bias: float
    """Share of the mean squared error from a wrong mean (Theil's bias proportion)."""
    variance: float
    """Share from a wrong size of the motion (Theil's variance proportion)."""
    covariance: float
    """Share from uncorrelated motion; the three shares sum to 1."""


BAND99 = 2.5758293035489004
"""Half width of the 99 % band of a white residual's correlation, times sqrt(N).

It is the 99.5 % point of the normal distribution."""

_HUGE = 1e100
_MOSTLY_MISSING = 0.4
"""Share of measured samples below which a signal counts as a slower one."""

NO_METRICS = Metrics(*[float("nan")] * 7)


FAR = 1e4
"""Squared error over the signal's variance, above which a simulation in gusts diverges."""


def diverges(m: Metrics, times: float = 10.0) -> bool:
    """True if a simulation is not finite, or its squared error is over `times` the variance."""
    return not np.isfinite(m.rmse) or m.vaf < 1.0 - times


@np.errstate(over="ignore", invalid="ignore")
def metrics(measured: np.ndarray, simulated: np.ndarray) -> Metrics:
    """Return the agreement of two signals (N,) over the measured samples (not NaN)."""
    seen = ~np.isnan(measured)
    measured, simulated = measured[seen], simulated[seen]
    residual = measured - simulated
    motion = np.linalg.norm(measured - measured.mean())
    # Rounding of a constant is no motion.
    motion = motion if motion > 1e-9 * np.linalg.norm(measured) else 0.0
    rms = np.sqrt(np.mean(measured**2)) + np.sqrt(np.mean(simulated**2))
    mse = float(np.mean(residual**2))
    rmse = mse**0.5
    # Theil's decomposition of the mean squared error: squared difference of the means, squared
    # difference of the standard deviations, and 2 (1 - r) times their product.
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
    """P-value of the Ljung-Box test over `lags` lags, for all signals that are tested together."""
    lags: int
    outside: float
    """Share of the lags outside the 99 % band."""
    lag1: float
    """Autocorrelation at one sample, or at the shortest lag with enough measured pairs."""


def _padded(n: int, lags: int) -> int:
    """Return the size of a transform of n samples without wrap-around up to `lags` lags."""
    return cast(int, scipy.fft.next_fast_len(n + lags, real=True))


def cross_correlation(u: np.ndarray, residual: np.ndarray, lags: int) -> np.ndarray:
    """Return the correlation (2 lags + 1,) of u(t - lag) with the residual, from -lags to lags.

    Args:
        u: one signal (N,), any unit; NaN counts as its mean.
        residual: the other (N,), as the first.
    """
    a, b = _centred(u), _centred(residual)
    n = a.size
    size = _padded(n, lags)
    # Gaps count as the mean and in n, which reduces the correlation.
    c = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size) / n
    # The inverse transform keeps negative lags at its end.
    both = np.concatenate([c[-lags:], c[: lags + 1]])
    scale = a.std() * b.std()
    return both / scale if scale > 0 else np.zeros(2 * lags + 1)


@np.errstate(over="ignore", invalid="ignore")  # of a simulation that diverges
def _centred(signal: np.ndarray) -> np.ndarray:
    # A missing sample at the mean adds nothing to any sum of products.
    centred = np.where(np.isnan(signal), 0.0, signal - np.nanmean(signal))
    # Correlations are independent of scale; the squares of a diverged simulation would overflow.
    size = np.max(np.abs(centred), initial=0.0)
    return centred / size if _HUGE < size < np.inf else centred


def sequence(signal: np.ndarray) -> np.ndarray:
    """Return a signal (N,), or only its measured samples if most are missing.

    A slow sensor on a fast grid has few pairs at any lag, so its lags count its own samples.
    """
    return signal[kept(signal)]


def kept(signal: np.ndarray) -> np.ndarray:
    """Return True (N,) for the samples that `sequence` keeps."""
    seen = ~np.isnan(signal)
    return seen if seen.mean() < _MOSTLY_MISSING else np.ones_like(seen)


def lags_for(n: int) -> int:
    """Return the number of lags for a record of n samples: a quarter of n, at most 500."""
    # Autocorrelations at longer lags average too few products (Box and Jenkins).
    return max(1, min(n // 4, 500))


def whiteness(
    residual: np.ndarray, together: int = 1, fitted: np.ndarray | None = None
) -> Whiteness:
    """Test residuals for whiteness (Ljung-Box, 1 %).

    Args:
        residual: (N,), any unit; NaN where nothing is measured.
        together: number of signals that are tested together, for the p-value.
        fitted: (N, k), see `seen_autocorrelation`.
    """
    fitted = None if fitted is None else fitted[kept(residual)]
    residual = sequence(residual)
    # A few wild samples have most of the power, and correlate with each other by chance.
    known = residual[~np.isnan(residual)]
    size = robust_sd(known) if known.size else 0.0
    residual = np.clip(residual, -_WILD * size, _WILD * size) if size > 0 else residual
    n = int(np.count_nonzero(~np.isnan(residual)))
    _, r, pairs, whole = seen_autocorrelation(residual, fitted)
    lags = r.size
    # The expected squared autocorrelation of white noise is one over the number of pairs.
    q = (n + 2) / max(n, 1) * np.cumsum(r**2 * pairs)
    # A short autocorrelation is significant over few lags and not over many: test both.
    short = min(lags, 20)
    p_all, p_short = (_chance(q[k - 1], k, n) for k in (lags, short))
    # Two tests of each signal (Sidak, 1967).
    p = -np.expm1(2 * together * np.log1p(-min(p_all, p_short, 1.0 - 1e-12)))
    outside = float(np.mean(np.abs(r) * whole > band99(pairs, whole)))
    return Whiteness(bool(p > 0.01), float(p), lags, outside, float(r[0] * whole[0]))


_WILD = 5.0
"""Bound of a residual that is tested [robust sds]."""
_SPREAD = 2.2
"""Relative excess variance of the Ljung-Box statistic over chi-squared, per lags over samples.

Measured on 4000 records of white noise each of 200 to 4000 samples."""


def _chance(statistic: float, lags: int, samples: int) -> float:
    """Return the probability that white noise exceeds the Ljung-Box statistic.

    Its mean is the number of lags. Its variance exceeds that of chi-squared if lags are a large
    share of the samples. A scaled chi-squared matches both.
    """
    wide = 1.0 + _SPREAD * lags / max(samples, 1)
    return float(scipy.special.chdtrc(lags / wide, statistic / wide))


def band99(pairs: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return the 99 % band (lags,) of white noise for the biased autocorrelation.

    Arguments are results of `seen_autocorrelation`.
    """
    return BAND99 * np.sqrt(whole / pairs)


def seen_autocorrelation(
    residual: np.ndarray, fitted: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the autocorrelation over the measured pairs of samples.

    The results (lags,) are the lags in samples, the autocorrelation, the number of pairs, and the
    share 1 - lag/N of the record. They hold the shortest lags with enough pairs.

    Args:
        residual: (N,), NaN where nothing is measured.
        fitted: (N, k) rows of the orthonormal directions U along which the unknowns move the
            signals. Least squares leaves nothing along them: white noise of variance s^2 becomes a
            residual of covariance s^2 (1 - U U'). Its autocovariance is corrected. Otherwise many
            free initial states would make the residuals of a right model look coloured.
    """
    seen = ~np.isnan(residual)
    r = _centred(residual)
    n, count = r.size, int(seen.sum())
    at = np.arange(1, max(n // 4, 1) + 1)
    size = _padded(n, int(at[-1]))

    def products(x: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)

    # The numbers of pairs are the autocorrelation of the mask, up to rounding of the transform.
    all_seen = n - np.arange(at[-1] + 1.0)
    pairs, c = all_seen if count == n else np.round(products(seen.astype(float))), products(r)
    if fitted is not None:
        taken = sum((products(u) for u in fitted.T), np.zeros_like(c))
        c = c + c[0] / max(count - taken[0], 1.0) * taken
    # Leave out lags of few pairs, which are noise. With every second sample missing, odd lags have
    # no pairs at all.
    at = at[pairs[at] >= min(0.1 * count, 0.75 * n)][: lags_for(count)]
    if at.size == 0 or not c[0] > 0:
        return np.ones(1, int), np.zeros(1), np.ones(1), np.ones(1)
    return at, c[at] / c[0] * count / pairs[at], pairs[at], 1.0 - at / n


# Whiteness of signals that were decimated.
#
# Decimation applies a low-pass that also removes the last fifth of the new band. A sensor's white
# noise then has an autocorrelation of +0.13 at one sample, which is significant in a long record.
# This is neither a disturbance nor a missing mode. The lower part of the band is unchanged, so
# whiteness is tested at the lower rate that this part needs.


_FEWER = 0.9
"""Sample time of the log over the flight's, below which the log is faster."""
_SEEN = 0.95
"""Least share of measured samples for a spectrum."""


def is_decimated(flight: Flight, output: str) -> bool:
    """True if an output was logged at a higher rate than the flight's."""
    facts = None if flight.source is None else flight.source.facts.get((output, "output"))
    return facts is not None and facts.usual < _FEWER * flight.dt


def in_passed_band(signal: np.ndarray) -> np.ndarray:
    """Return a decimated signal (N,) at the lower rate that its low-pass passes entirely.

    It is unchanged if many samples are missing (NaN).
    """
    seen = np.isfinite(signal)
    if np.mean(seen) < _SEEN:
        return signal
    kept = int(PASSED * signal.size)
    return np.fft.irfft(np.fft.rfft(np.where(seen, signal, 0.0))[: kept + 1], 2 * kept)


# Signals of a fit.


class Signals(NamedTuple):
    """Measured and simulated signals of one flight; arrays (N,), SI."""

    flight: str
    hold_out: bool
    times: np.ndarray
    """Time [s]."""
    inputs: dict[str, np.ndarray]
    measured: dict[str, np.ndarray]
    simulated: dict[str, np.ndarray]
    """Simulation including the estimated bias."""
    innovations: dict[str, np.ndarray] | None = None
    """Filter error: measurement less its prediction from all earlier samples, SI."""
    log_start: float | None = None
    """Time of the first sample from the log's beginning [s]; None without a log."""

    @property
    def log_times(self) -> np.ndarray:
        """Time from the log's beginning (N,) [s]; from zero without a log."""
        return self.times + (self.log_start or 0.0)

    def predicted(self, output: str) -> np.ndarray:
        """Return the one-step prediction of filter error (N,)."""
        assert self.innovations is not None
        return self.measured[output] - self.innovations[output]

    def residual(self, output: str) -> np.ndarray:
        """Return measured minus simulated (N,)."""
        return self.measured[output] - self.simulated[output]

    def error(self, output: str) -> np.ndarray:
        """Return innovations with filter error, else residuals (N,)."""
        return self.residual(output) if self.innovations is None else self.innovations[output]


_SURELY_CORRELATED = 4.5
"""Correlation of two residuals that is significant [standard deviations]."""
_WORTH_IT = 0.1
"""Correlation below which intervals hardly change, even if a long record shows it."""
_FEWEST = 8
"""Fewest pairs of samples for a correlation."""


def outputs_correlated(signals: tuple[Signals, ...]) -> bool:
    """True if residuals of two outputs of a flight are correlated.

    The intervals are too narrow then, because two correlated residuals count as independent.
    """
    for s in signals:
        # Two diverging simulations have correlated errors, whatever the noise.
        names = [n for n, y in s.measured.items() if not diverges(metrics(y, s.simulated[n]))]
        # Flights are kept apart, because biases of joined flights would look like correlation.
        for x, y in itertools.combinations([s.residual(n) for n in names], 2):
            # Sensors of different rates share few samples; only those count.
            seen = np.isfinite(x) & np.isfinite(y)
            n = int(seen.sum())
            if n < _FEWEST or not (np.std(x[seen]) > 0 and np.std(y[seen]) > 0):
                continue
            # For independent white residuals the standard deviation is 1 / sqrt(n).
            rho = abs(float(np.corrcoef(x[seen], y[seen])[0, 1]))
            if rho > max(_SURELY_CORRELATED / n**0.5, _WORTH_IT):
                return True
    return False


def whiteness_of(
    signals: tuple[Signals, ...], e: Evaluation, flights: tuple[Flight, ...], layout: Layout
) -> dict[str, Whiteness]:
    """Return the whiteness by 'flight/output' of innovations if there are any, else of residuals.

    Intervals allow for autocorrelated residuals. Innovations of a decimated output may keep the
    autocorrelation of its low-pass filter.
    """
    fitted: dict[str, np.ndarray] = {}
    if e.innovations:
        # The variance of innovations falls while the filter learns the initial state, so they are
        # normalised. An ill-conditioned filter may have negative variances: these give NaN, and the
        # filter reports them.
        with np.errstate(invalid="ignore", divide="ignore"):
            errors = {
                f"{s.flight}/{n}": np.asarray(error) / np.sqrt(np.asarray(innovations.variance[n]))
                for s, innovations in zip(signals, e.innovations, strict=True)
                for n, error in innovations.error.items()
            }
    else:
        errors = {f"{s.flight}/{n}": s.residual(n) for s in signals for n in s.measured}
        if layout.noise_model == "white" and np.isfinite(e.J).all():
            U, at = directions(e.J), 0
            for s, outputs in zip(signals, layout.outputs, strict=True):
                for n in outputs:
                    fitted[f"{s.flight}/{n}"] = U[at : at + s.times.size]
                    at += s.times.size
    low_passed = {
        f"{s.flight}/{n}"
        for s, f in zip(signals, flights, strict=True)
        for n in s.measured
        if e.innovations and is_decimated(f, n)
    }
    # Among many signals one looks autocorrelated by chance, so all share the significance level.
    return {
        name: whiteness(in_passed_band(error), len(errors))
        if name in low_passed
        else whiteness(error, len(errors), fitted.get(name))
        for name, error in errors.items()
    }


def signals_of(
    flights: tuple[Flight, ...],
    simulated: Sequence[Mapping[str, Any]],
    innovations: Sequence[Innovations] = (),
) -> tuple[Signals, ...]:
    """Return measured and simulated signals; simulations include the bias."""
    each = zip(labels(flights), flights, simulated, strict=True)
    return tuple(
        Signals(
            label,
            f.hold_out,
            f.times,
            dict(f.inputs),
            dict(f.outputs),
            {n: np.asarray(v) for n, v in run.items()},
            {n: np.asarray(v) for n, v in innovations[i].error.items()} if innovations else None,
            None if f.source is None else f.window[0],
        )
        for i, (label, f, run) in enumerate(each)
    )


def pooled_metrics(signals: tuple[Signals, ...], *, one_step: bool = False) -> dict[str, Metrics]:
    """Return metrics by output, pooled over all flights that have it.

    One-step predictions need innovations. Samples are pooled instead of averaging over flights.
    Long flights then count for more, and flights in which an output hardly moves have no meaningful
    R^2.
    """
    if one_step:
        signals = tuple(s for s in signals if s.innovations is not None)
    outputs = sorted({n for s in signals for n in s.measured})
    pooled = {}
    for n in outputs:
        have = [s for s in signals if n in s.measured]
        measured = np.concatenate([s.measured[n] for s in have])
        model = np.concatenate([s.predicted(n) if one_step else s.simulated[n] for s in have])
        # A diverging simulation has no metrics, because one such number would outweigh all others.
        finite = bool(np.isfinite(model[~np.isnan(measured)]).all())
        pooled[n] = metrics(measured, model) if finite else NO_METRICS
    return pooled
