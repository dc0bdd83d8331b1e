"""Figures over time and by lag: signals, residuals, RLS coefficients, whiteness."""

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import (
    BAND99,
    Whiteness,
    band99,
    cross_correlation,
    lags_for,
    metrics,
    seen_autocorrelation,
    sequence,
    whiteness,
)
from heli_jax.numbers import number, percent, vaf_percent
from heli_jax.report import style
from heli_jax.report.charts import (
    Chart,
    Panel,
    Series,
    band,
    limits_of,
    panel,
    samples,
    time_limits,
)
from heli_jax.report.style import label


def response(signals: Signals, output: str, model: Model) -> Chart:
    """Draw measured and simulated output, the residual, and the inputs over time."""
    unit, t = naming.unit(model.Outputs, output), signals.log_times
    residual = samples("", t, signals.residual(output), style.VERMILLION, 0.7)
    # The model's order makes figures comparable, because logs order their columns differently.
    inputs = [n for n in naming.names(model.Inputs) if n in signals.inputs]
    held = {n: Series("", t, signals.inputs[n], style.BLACK, "step", width=0.8) for n in inputs}
    panels = (
        panel(label(output, unit), _measured_and_simulated(signals, output), 1.9),
        panel(label("residual", unit), [residual], 0.8, levels=(0.0,)),
        *(panel(label(n, naming.unit(model.Inputs, n)), [s], 0.6) for n, s in held.items()),
    )
    # Only panels of one flight share cursor and zoom, because different flights have different
    # times.
    of, words = signals.flight, time_label(signals.log_start)
    return Chart(_agreement(signals, output), words, time_limits(t), panels, of=of)


def overview(signals: Signals, output: str, model: Model) -> Chart:
    """Draw only measured and simulated output over time."""
    unit = naming.unit(model.Outputs, output)
    panels = (panel(label(output, unit), _measured_and_simulated(signals, output), 2.2),)
    words, limits = time_label(signals.log_start), time_limits(signals.log_times)
    return Chart(_agreement(signals, output), words, limits, panels, of=signals.flight)


def _measured_and_simulated(signals: Signals, output: str) -> tuple[Series, Series]:
    # The measured line is wider and behind, so that a rim stays visible under the simulation.
    t = signals.log_times
    simulated = Series("simulated", t, signals.simulated[output], style.BLUE, width=0.9)
    return samples("measured", t, signals.measured[output], style.PALE, 1.9), simulated


def time_label(log_start: float | None) -> str:
    """Return the label of a time axis: time in the log, or from the flight's first sample."""
    return "time [s]" if log_start is None else "time in the log [s]"


def _agreement(signals: Signals, output: str) -> str:
    agreement = metrics(signals.measured[output], signals.simulated[output])
    source = "held out, simulated" if signals.hold_out else "simulated"
    # VAF is NaN if the measured output never moves.
    vaf = f", VAF {vaf_percent(agreement.vaf)}" if np.isfinite(agreement.vaf) else ""
    return f"{output}, {style.short(signals.flight)}: {source}{vaf}"


def rls_history(baseline: Baseline, *, log_start: float | None = None) -> Chart:
    """Draw every coefficient of the recursive least squares over time, the a's above the b's.

    Args:
        log_start: time of the flight's first sample in the log [s], if there is a log.
    """
    n, history, begin = baseline.order, baseline.history, log_start or 0.0
    t = begin + baseline.dt * np.arange(history.shape[0])
    panels = (
        _coefficients("-a", t, history[:, :n], [f"-a{i + 1}" for i in range(n)]),
        # All b_i have the unit of output over input in SI; the a's are plain numbers.
        _coefficients("b (SI)", t, history[:, n:], [f"b{i}" for i in range(history.shape[1] - n)]),
    )
    note = f"{baseline.input} to {baseline.output}; scaled to the second half of the record"
    title = f"RLS coefficients over the record, order {n}"
    limits = begin, max(float(t[-1]), begin + baseline.dt)
    return Chart(title, time_label(log_start), limits, panels, note, of=baseline.flight)


def _coefficients(words: str, t: np.ndarray, values: np.ndarray, names: list[str]) -> Panel:
    """Draw columns of values (N, k) over t (N,), by their names."""
    # The second half of the record sets the range, with a margin. A constant gives no range, so a
    # fraction of its value is used. The first samples, with P(0) = 1e12 I, spread over many powers
    # of ten; values are clipped to keep huge numbers out of paths.
    later = values[values.shape[0] // 2 :]
    later = later[np.isfinite(later)]
    low, high = (float(later.min()), float(later.max())) if later.size else (0.0, 0.0)
    margin = 0.5 * (high - low) or 0.1 * abs(high) or 1.0
    inside = np.clip(values, low - 5 * margin, high + 5 * margin)
    colours = style.CYCLE
    series = [
        # A high order has more coefficients than the palette has colours.
        Series(name, t, inside[:, k], colours[k % len(colours)], dashed=k >= len(colours))
        for k, name in enumerate(names)
    ]
    return panel(words, series, 1.45, limits=(low - margin, high + margin))


def residual_correlation(
    signals: Signals,
    output: str,
    test: Whiteness | None = None,
) -> Chart:
    """Draw the residual's autocorrelation and its correlation with each input, with 99 % bands.

    Args:
        test: whiteness from the fit, whose numbers the figure shows; computed by default.
    """
    residual, dt = signals.error(output), _sample_time(signals.times)
    whole, residual = residual, sequence(residual)
    seen = np.arange(whole.size)
    if residual.size < whole.size:
        # If most samples are missing, lags count the sensor's own samples.
        seen = np.flatnonzero(~np.isnan(whole))
        dt *= float(np.median(np.diff(seen)))
    n, lags = residual.size, lags_for(residual.size)
    # As in the whiteness test, missing samples are left out, and so is lag 0, whose autocorrelation
    # is always 1.
    at, r, pairs, parts = seen_autocorrelation(residual)
    panels = [_stems("autocorrelation", dt * at, r * parts, band99(pairs, parts))]
    for name in signals.inputs:
        # Both signs are shown. Correlation at negative lags means that the input follows the
        # residual (a pilot, a controller), or that the clocks differ.
        c = cross_correlation(signals.inputs[name][seen], residual, lags)
        limit = np.full(c.size, BAND99 / np.sqrt(n))
        panels.append(_stems(f"with {name}", dt * np.arange(-lags, lags + 1), c, limit))
    test = test or whiteness(residual)
    what = "Residual" if signals.innovations is None else "Innovations"
    result = "white" if test.white else "not white"
    lag1 = f"{test.lag1:+.2f}".replace("-", "−")
    words = "lag [s]" + (" (positive: the input came first)" if signals.inputs else "")
    reach = dt * (max(lags, int(at[-1])) + 0.5)
    return Chart(
        f"{what} of {output}, {style.short(signals.flight)}: {result}",
        words,
        (-reach if signals.inputs else 0.0, reach),
        tuple(panels),
        f"{percent(test.outside, 1)} of {test.lags} lags outside the 99 % band; "
        f"{lag1} at one sample; Ljung-Box p = {number(test.p_value, 2)}",
        of=signals.flight,
    )


def _sample_time(t: np.ndarray) -> float:
    """Return the time between samples [s]; 1 for a single sample."""
    return float(t[1] - t[0]) if t.size > 1 else 1.0


def _stems(words: str, x: np.ndarray, y: np.ndarray, limit: np.ndarray) -> Panel:
    """Draw stems from zero over a band (lags,); those outside it in another colour."""
    outside = np.abs(y) > limit
    series = [band(x, -limit, limit, style.SKY)]
    for which, color, name in (
        (~outside, style.GREY, "within the 99 % band"),
        (outside, style.VERMILLION, "outside it"),
    ):
        ends = np.minimum(y[which], 0.0), np.maximum(y[which], 0.0)
        series.append(Series(name, x[which], y[which], color, "bars", *ends, width=1.4))
    # The axis spans at least twice the band, so that white residuals look white.
    least = 2.0 * float(limit.max()) * np.array([-1.0, 1.0])
    limits = limits_of([*series, Series("", least, least, "")])
    return panel(words, series, 1.1, limits=limits, levels=(0.0,))
