"""Measured and simulated signals of a fit, and their agreement."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax.flights.flight import Flight, labels
from heli_jax.identification.estimation.evaluation import Evaluation, directions
from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.result import Signals
from heli_jax.identification.unknowns.layout import Layout
from heli_jax.identification.validation.metrics import (
    NO_METRICS,
    Metrics,
    Whiteness,
    diverges,
    is_decimated,
    metrics,
    whiteness,
    whiteness_in_band,
)

_SURELY_CORRELATED = 4.5
"""Correlation of two residuals that is significant [standard deviations]."""
_WORTH_IT = 0.1
"""Correlation below which intervals hardly change, even if a long record shows it."""
_FEWEST = 8
"""Fewest pairs of samples for a correlation."""


def correlated_residuals(signals: tuple[Signals, ...]) -> dict[str, float]:
    """Return the correlation of dependent residuals by 'output and output, flight'.

    The intervals are too narrow then, because two correlated residuals count as independent.
    """
    correlated = {}
    for s in signals:
        # Two diverging simulations have correlated errors, whatever the noise.
        names = [n for n, y in s.measured.items() if not diverges(metrics(y, s.simulated[n]))]
        for b, a in itertools.combinations(names, 2):
            # Flights are kept apart, because biases of joined flights would look like correlation.
            x, y = s.residual(a), s.residual(b)
            # Sensors of different rates share few samples; only those count.
            seen = np.isfinite(x) & np.isfinite(y)
            n = int(seen.sum())
            if n < _FEWEST or not (np.std(x[seen]) > 0 and np.std(y[seen]) > 0):
                continue
            rho = float(np.corrcoef(x[seen], y[seen])[0, 1])
            # For independent white residuals the standard deviation of rho is 1 / sqrt(n).
            if abs(rho) > max(_SURELY_CORRELATED / n**0.5, _WORTH_IT):
                correlated[f"{b} and {a}, {s.flight}"] = rho
    return correlated


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
        name: whiteness_in_band(error, len(errors))
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
