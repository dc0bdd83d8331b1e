"""Measured and simulated signals of a fit, and how well they agree."""

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
"""standard deviations from zero at which two residuals are taken for correlated"""
_WORTH_IT = 0.1
"""correlation below which intervals do not change enough to speak of: a long record shows less"""
_FEWEST = 8
"""pairs of samples from which a correlation is told"""


def correlated_residuals(signals: tuple[Signals, ...]) -> dict[str, float]:
    """By 'output and output, flight' the correlation of residuals that are not independent.

    White residuals of two outputs that go together count one piece of news twice.
    """
    correlated = {}
    for s in signals:
        names = list(s.measured)
        for b, a in ((b, a) for i, a in enumerate(names) for b in names[:i]):
            # By flight: over several joined flights a bias of each would pass for correlation.
            x, y = s.residual(a), s.residual(b)
            # Only samples at which both were measured: sensors of different rates share few.
            seen = np.isfinite(x) & np.isfinite(y)
            n = int(seen.sum())
            if n < _FEWEST or not (np.std(x[seen]) > 0 and np.std(y[seen]) > 0):
                continue
            # Two errors that grow go together whatever the noise does.
            if any(diverges(metrics(s.measured[m], s.simulated[m])) for m in (a, b)):
                continue
            rho = float(np.corrcoef(x[seen], y[seen])[0, 1])
            # Of independent white residuals rho has the standard deviation 1 / sqrt(n).
            if abs(rho) > max(_SURELY_CORRELATED / n**0.5, _WORTH_IT):
                correlated[f"{b} and {a}, {s.flight}"] = rho
    return correlated


def whiteness_of(
    signals: tuple[Signals, ...], e: Evaluation, flights: tuple[Flight, ...], layout: Layout
) -> dict[str, Whiteness]:
    """Whiteness by 'flight/output' of the innovations where there are some, else of the residuals,
    whose colour intervals allow for; innovations of an output that was logged at a higher rate may
    have its low-pass's."""
    fitted: dict[str, np.ndarray] = {}
    if e.innovations:
        # Their variance falls while the filter learns the initial state: only over it are they one
        # sequence of equal variance.
        # A filter that is ill-conditioned may have variances below zero: NaN there, and said by it.
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
    # Of many signals one looks coloured by chance: the level is shared by all.
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
    """Measured and simulated signals; what is simulated carries the bias."""
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
    """Metrics by output over all the flights that have it; of one-step predictions none without
    innovations.

    Over their samples together and not averaged over flights: a long one counts for more, and a
    flight in which an output hardly moves has no R^2 of its own worth having.
    """
    if one_step:
        signals = tuple(s for s in signals if s.innovations is not None)
    outputs = sorted({n for s in signals for n in s.measured})
    pooled = {}
    for n in outputs:
        have = [s for s in signals if n in s.measured]
        measured = np.concatenate([s.measured[n] for s in have])
        model = np.concatenate([s.predicted(n) if one_step else s.simulated[n] for s in have])
        # A simulation that diverges has no metrics: one number of it would outweigh all others.
        finite = bool(np.isfinite(model[~np.isnan(measured)]).all())
        pooled[n] = metrics(measured, model) if finite else NO_METRICS
    return pooled
