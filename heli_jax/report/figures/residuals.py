"""Whether residuals are white: their autocorrelation, and their correlation with the inputs."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import (
    BAND99,
    autocorrelation,
    cross_correlation,
    lags_for,
    sequence,
    whiteness,
)
from heli_jax.report import style
from heli_jax.report.figures.panels import Panels, panels, sample_time
from heli_jax.report.style import subtitle


def residual_correlation(
    signals: Signals, output: str, *, together: int = 1, figure: Figure | None = None
) -> Panels:
    """Autocorrelation of the residual (filter error: the innovations) and its correlation with each
    input, with 99 % bands.

    Args:
        signals: one flight, measured and simulated.
        output: whose residual.
        together: how many residuals are tested side by side (Bonferroni, as in `whiteness`).
        figure: to draw on; a new one where None.
    """
    residual, dt = signals.error(output), sample_time(signals)
    whole, residual = residual, sequence(residual)
    seen = np.arange(whole.size)
    if residual.size < whole.size:
        # Mostly missing: lags count in the sensor's own samples.
        seen = np.flatnonzero(~np.isnan(whole))
        dt *= float(np.median(np.diff(seen)))
    n, lags = residual.size, lags_for(residual.size)
    inputs = list(signals.inputs)
    axes = panels(figure, 2.4 + 1.6 * len(inputs), [1.2, *[1.0] * len(inputs)], sharex=False)
    # At lag 0 an autocorrelation is 1 whatever the residual, and would set the panel's scale.
    r = autocorrelation(residual, lags)[1:]
    _stems(axes[0], dt * np.arange(1, lags + 1), r, BAND99 / np.sqrt(n))
    axes[0].set_xlim(0.0, dt * (lags + 0.5))
    axes[0].set_ylabel("autocorrelation")
    _head(axes[0], signals, output, together)
    for ax, name in zip(axes[1:], inputs, strict=True):
        # Both signs: correlation at negative lags means that the input answers the residual (a
        # pilot, a controller), or that the clocks of the two differ.
        c = cross_correlation(signals.inputs[name][seen], residual, lags)
        _stems(ax, dt * np.arange(-lags, lags + 1), c, BAND99 / np.sqrt(n))
        ax.set_xlim(-dt * (lags + 0.5), dt * (lags + 0.5))
        ax.set_ylabel(f"with {name}")
    axes[-1].set_xlabel("lag [s]" + (" (positive: the input came first)" if inputs else ""))
    return axes


def _head(ax: Axes, signals: Signals, output: str, together: int) -> None:
    """Title and subtitle: what of which flight, and the test of whiteness."""
    residual = sequence(signals.error(output))
    test = whiteness(residual, together)
    what = "Residual" if signals.innovations is None else "Innovations"
    result = "white" if test.white else "not white"
    ax.set_title(f"{what} of {output}, {signals.flight}: {result}", loc="left")
    lag1 = f"{test.lag1:+.2f}".replace("-", "−")
    subtitle(
        ax,
        f"{100 * test.outside:.1f} % of {lags_for(residual.size)} lags outside the 99 % band; "
        f"{lag1} at one sample; Ljung-Box p = {test.p_value:.2g}",
    )


def _stems(ax: Axes, x: np.ndarray, y: np.ndarray, band: float) -> None:
    """Stems from zero over a band; those outside the band in another colour and thicker."""
    ax.axhspan(-band, band, color=style.SKY, alpha=0.35, lw=0, label="99 % band")
    outside = np.abs(y) > band
    for which, color, width in ((~outside, style.GREY, 0.6), (outside, style.VERMILLION, 0.9)):
        # One path, broken by NaN: stem() and vlines() write an element into the SVG for each of up
        # to a thousand stems.
        feet, gaps = np.zeros(which.sum()), np.full(which.sum(), np.nan)
        stems = np.stack([feet, y[which], gaps], axis=1).ravel()
        ax.plot(np.repeat(x[which], 3), stems, color=color, lw=width)
    ax.axhline(0.0, color="#444444", lw=0.6)
    # Twice the band at least: where all is white, the band shall look like one.
    low, high = min(-2.0 * band, float(np.min(y))), max(2.0 * band, float(np.max(y)))
    ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
